"""The paper, reproduced: its tables and figures beside ours, and one page about it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tdof_npid_ros.control.gains import CONTROLLER_TYPES, PER_LANE
from tdof_npid_ros.output_file import OutputError
from tdof_npid_ros.paper.conclusions import (
    NO,
    WITH_SIGMA,
    YES,
    against_pid,
    against_published,
    at_a_glance,
    at_least_as_good,
    beats_pid,
    front_claims,
    front_statements,
    reproduced,
)
from tdof_npid_ros.paper.evaluation import (
    CONTROLLER_TITLES,
    GENERATIONS,
    Measured,
    Rows,
    RowSearch,
    evaluated_row,
    optimum,
    searches_of,
)
from tdof_npid_ros.paper.findings import findings
from tdof_npid_ros.paper.items import ITEMS, Evaluated
from tdof_npid_ros.paper.nominal_robust import nominal_beside_robust
from tdof_npid_ros.paper.output import claim_folder, kept_until_written
from tdof_npid_ros.paper.pages import Section, html_page, markdown_page, markdown_table
from tdof_npid_ros.paper.report import Figure, Finding, Table
from tdof_npid_ros.paper.robust import price_of_robustness
from tdof_npid_ros.paper.tables import CASE_TITLES, COMPARED, ROWS, Published
from tdof_npid_ros.tuning.pareto import GENERATIONS as PARETO_GENERATIONS
from tdof_npid_ros.tuning.pareto import (
    RATIOS,
    Front,
    FrontChain,
    FrontSearch,
    chain_points,
    chains_of,
    check_installed,
    fronts_of,
)
from tdof_npid_ros.workers import ChunkCheckpoint, Workers

TITLE = "Design of novel TDOF nonlinear PID controllers, reproduced"
SUBCOMMAND = "reproduce"
SECTIONS = {  # of the page: the paper's own
    "The controllers": ("figure1", "figure6"),
    "Process 1: first order plus dead time": ("table1", "table2", "figure7", "figure8"),
    "Process 2: second order plus dead time": ("table3", "table4", "figure9", "figure10"),
    "Process 3: third order with a positive zero": ("table5", "table6", "figure11", "figure12"),
    "Sprott circuit": (
        "figure13",
        "table7",
        "table8",
        "figure14",
        "table9",
        "figure15",
        "figure16",
    ),
}
LEAD = """\
S. Jin et al. propose two PID controllers with setpoint weights (two degrees of freedom, TDOF) and an integral \
action that \
fades for large errors (nonlinear, N): TDOF-NPID1 and TDOF-NPID2. They tune them, and a PID, by a hybrid genetic \
algorithm \
(HGA) for three linear processes and a chaotic circuit, and find theirs better. Here every table and figure is \
computed anew \
and set beside the printed one."""
CONVENTIONS = """\
- 'Published': as printed. 'Ours at the published gains': the printed gains in our loop. 'Ours, tuned': the gains \
that our \
HGA finds for the same objective, IAE_SP + IAE_DIS, knowing nothing of the printed ones.
- IAE: integral of the absolute error, after a unit step of the setpoint (SP) and after a disturbance (DIS). M_p: \
overshoot \
in per cent of the step. t_s: time to within 5 % of the step. M_peak: largest deviation under the disturbance. \
t_rcy: time \
to within 2 % of the setpoint step.
- Δ: ours against the published value; green up to 4 % (M_p: points), amber up to 10 %, red beyond.
- Our loop: the paper's equations (1) to (8), N = 10, σ = 1, sampled; plants discretised exactly, exact dead time. \
One set \
of conventions for all rows: nothing is adjusted where a row does not come out. The circuit's effort limit, \
which the paper does not give, has a paragraph of its own."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Effort:
    """How much is spent on tuning.

    Attributes:
        seeds: HGA runs per row; the best counts, the worst is told.
        generations: of each HGA run.
        pareto_generations: of each NSGA-II run.
    """

    seeds: int = 1
    generations: int = GENERATIONS
    pareto_generations: int = PARETO_GENERATIONS


class Reproduction:
    """The chosen tables and figures, and what they need to be computed.

    Raises:
        OutputError: an unknown table or figure, or no seed.
        TuningError: what it needs is not installed.
    """

    def __init__(self, only: Sequence[str] = (), effort: Effort | None = None) -> None:
        """
        Args:
            only: names out of `ITEMS`; none: all of them.
        """
        unknown = [name for name in only if name not in ITEMS]
        if unknown:
            raise OutputError(f"the paper has no {unknown[0]!r} to reproduce: take any of {', '.join(ITEMS)}")
        self.effort = effort or Effort()
        if self.effort.seeds < 1:
            raise OutputError(f"{self.effort.seeds} seeds: at least 1")
        self.names = tuple(name for name in ITEMS if not only or name in only)
        if self._needs_fronts:
            check_installed()
        self.rows: Rows = {}
        self.fronts: list[Front] = []
        self.built: dict[str, Table | Figure] = {}
        self.findings: tuple[Finding, ...] = ()

    @property
    def work(self) -> dict[str, Any]:
        """What the searches depend on, as JSON holds it."""
        return {"reproduce": list(self.names), **asdict(self.effort)}

    def search(self, where: Workers, checkpoint: ChunkCheckpoint | None = None) -> None:
        """Run the searches, each a chunk of work."""
        rows = self._published
        chains = chains_of(RATIOS, CONTROLLER_TYPES) if self._needs_fronts else []
        searches = [search for row in rows for search in searches_of(row, self.effort.seeds)]
        chunks: list[FrontChain | RowSearch] = [*chains, *searches]
        found = where.map(
            _searched, (self.effort, where.threads_in(len(chunks))), chunks, unit="search", checkpoint=checkpoint
        )
        fronts = fronts_of(chains, found[: len(chains)])
        self.fronts = [fronts[ratio, controller] for ratio in RATIOS for controller in CONTROLLER_TYPES if fronts]
        optima = dict(zip(searches, found[len(chains) :], strict=True))
        self.rows = {(row.case, row.controller): evaluated_row(row, optima) for row in rows}

    def jobs(self, folder: Path) -> list[tuple[str, Callable[[], None]]]:
        """What is to be done with what the searches found, in order: each a label and a function.

        Args:
            folder: where the files go.
        """
        return [
            ("evidence", self._find),
            *((name, lambda name=name: self._build(name, folder)) for name in self.names),
            ("page", lambda: self._write_page(folder)),
        ]

    def summary(self, folder: Path) -> dict[str, Any]:
        """The outcome as one JSON object."""
        return {
            "directory": str(folder),
            "page": str(folder / "index.html"),
            "items": list(self.names),
            "rows": [
                {
                    "case": case,
                    "controller": controller,
                    "published": {**row.published._asdict(), "objective": row.published.objective},
                    "at_published_gains": row.at_published.values,
                    "tuned": _measured(row.tuned),
                    "tuned_sigma_too": _measured(row.sigma_free) if row.sigma_free else None,
                    "objectives_by_seed": list(row.objectives),
                    "reproduced": reproduced(row),
                    "at_or_below_published": at_least_as_good(row),
                }
                for (case, controller), row in self.rows.items()
            ],
            "conclusions": [
                {
                    "case": case,
                    "controller": controller,
                    **dict(
                        zip(("lower_overshoot", "lower_objective"), beats_pid(self.rows, case, controller), strict=True)
                    ),
                }
                for case in self._cases
                for controller in COMPARED[1:]
            ],
        }

    @property
    def _needs_fronts(self) -> bool:
        return any(ITEMS[name].needs_fronts for name in self.names)

    @property
    def _published(self) -> list[Published]:
        """The paper's rows that are needed."""
        cases = {case for name in self.names for case in ITEMS[name].cases}
        return [row for row in ROWS if row.case in cases]

    @property
    def _cases(self) -> list[str]:
        return list(dict.fromkeys(case for case, _ in self.rows))

    def _find(self) -> None:
        self.findings = findings(self.rows) if self.rows else ()

    def _build(self, name: str, folder: Path) -> None:
        built = self.built[name] = ITEMS[name].build(Evaluated(self.rows, tuple(self.fronts)))
        if isinstance(built, Figure):
            built.draw(folder / f"{name}.png")
            (folder / f"{name}.csv").write_text(built.csv(), encoding="utf-8")
        else:
            _write_table(built, folder)

    def _write_page(self, folder: Path) -> None:
        sections = list(self._sections())
        for section in sections:
            for block in section.blocks:
                table = block.table if isinstance(block, Finding) else block
                if isinstance(table, Table):
                    _write_table(table, folder)
        (folder / "index.md").write_text(markdown_page(TITLE, sections), encoding="utf-8")
        (folder / "index.html").write_text(html_page(TITLE, sections, folder), encoding="utf-8")
        text = json.dumps(self.summary(folder), indent=1)
        (folder / "summary.json").write_text(text + "\n", encoding="utf-8")

    def _sections(self) -> Iterator[Section]:
        yield Section("In short", (LEAD, "\n".join(f"- {sentence}" for sentence in self._in_short())))
        yield Section("How to read this page", (CONVENTIONS,))
        if self.rows:
            yield Section("What reproduces", (at_a_glance(self.rows),))
            yield Section(
                "The paper's conclusions on our numbers",
                (
                    against_pid(self.rows),
                    against_published(self.rows),
                    price_of_robustness(self.rows),
                    nominal_beside_robust(self.rows),
                ),
            )
            yield Section("What does not reproduce, and why", self.findings)
        for title, names in SECTIONS.items():
            blocks = [self.built[name] for name in names if name in self.built]
            if blocks:
                claims = (front_claims(self.fronts),) if "figure6" in self.built and "figure6" in names else ()
                yield Section(title, (*blocks, *claims))

    def _in_short(self) -> Iterator[str]:
        rows = self.rows.values()
        if rows:
            pairs = [(case, controller) for case in self._cases for controller in COMPARED[1:]]
            lost = [pair for pair in pairs if not all(beats_pid(self.rows, *pair))]
            rescued = sum(all(beats_pid(self.rows, *pair, sigma_tuned=True)) for pair in lost)
            yield (
                "**The claim.** Tuned by our HGA, the TDOF-NPID controllers beat PID both in overshoot and in the "
                "objective "
                f"in {len(pairs) - len(lost)} of {len(pairs)} comparisons"
                + (f"; NOT {_named(lost)} ({rescued} of these {len(lost)} do when σ is tuned too)." if lost else ".")
            )
            good = [at_least_as_good(row) for row in rows]
            yield (
                f"**The optimiser.** Our HGA is at or below the published optimum in {good.count(YES)} of {len(good)} "
                "rows"
                + (f", with σ tuned too in {good.count(WITH_SIGMA)} more" if WITH_SIGMA in good else "")
                + (f"; NOT in {good.count(NO)}." if NO in good else ".")
            )
            away = [key for key, row in self.rows.items() if not reproduced(row)]
            yield (
                f"**The printed numbers.** {len(rows) - len(away)} of {len(rows)} rows come out at the published "
                "gains, within 2 "
                "points of M_p, 4 % of both IAE and 3 % of M_peak" + (f"; NOT {_named(away)}." if away else ".")
            )
        if self.findings:
            tests = (finding.title for finding in self.findings[1:] if finding.title.startswith("A test"))
            yield " ".join((f"**Why not all.** {self.findings[0].paragraphs[0]}", *(f"{test}." for test in tests)))
        if self.fronts:
            yield "**Tracking against rejection (Figure 6).** " + " ".join(front_statements(self.fronts))
        if len(self.names) < len(ITEMS):
            yield "This run holds only " + ", ".join(self.names) + "."


def _named(rows: Sequence[tuple[str, str]]) -> str:
    """Rows by process, as "Process 3, c = 1 (TDOF-NPID1, TDOF-NPID2)"."""
    by_case: dict[str, list[str]] = {}
    for case, controller in rows:
        by_case.setdefault(case, []).append(CONTROLLER_TITLES[controller])
    return "; ".join(
        f"{CASE_TITLES[case]}" + (f" ({', '.join(names)})" if len(names) < len(COMPARED) else "")
        for case, names in by_case.items()
    )


def reproduce(
    folder: Path, reproduction: Reproduction, where: Workers, before_job: Progress = lambda _: None
) -> dict[str, Any]:
    """Compute and write everything; returns the summary. A run that was killed goes on where it was.

    Args:
        where: the searches run.
        before_job: called with the label of each job after them, for a progress bar.

    Raises:
        OutputError: the folder holds other files, or cannot be written.
    """
    claim_folder(folder, SUBCOMMAND)
    with kept_until_written(folder, reproduction.work) as checkpoint:
        reproduction.search(where, checkpoint)
        for label, job in reproduction.jobs(folder):
            before_job(label)
            job()
    return reproduction.summary(folder)


def _searched(how: tuple[Effort, int], search: FrontChain | RowSearch) -> Any:
    """A chunk of work: what one search finds."""
    effort, threads = how
    if isinstance(search, FrontChain):
        return chain_points(FrontSearch(generations=effort.pareto_generations, threads=threads), search)
    return optimum(search, effort.generations, threads)


def _write_table(table: Table, folder: Path) -> None:
    (folder / f"{table.name}.csv").write_text(table.csv(), encoding="utf-8")
    (folder / f"{table.name}.md").write_text(markdown_table(table) + "\n", encoding="utf-8")


def _measured(measured: Measured) -> dict[str, Any]:
    return {"gains": {name: getattr(measured.gains, name) for name in PER_LANE}, **measured.values}
