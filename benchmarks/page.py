"""The page of figures: RESULTS.md, results.json and a picture per question."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

from benchmarks import LONG, MODULES
from benchmarks.harness import Curve, Dots, Rate, Result

DATA = "results.json"
OURS, PEERS = "#0072b2", "#a6a6a6"
DOT_COLOURS = (OURS, "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8c564b", "#7f7f7f")
DOT_MARKERS = "osD^vP*Xh"


def read_results(folder: Path) -> dict[str, Result]:
    """The results that the page in a folder shows; none if there is none."""
    path = folder / DATA
    if not path.is_file():
        return {}
    return {name: Result.from_dict(one) for name, one in json.loads(path.read_text(encoding="utf-8")).items()}


def write_page(results: Mapping[str, Result], folder: Path) -> None:
    """Write `RESULTS.md`, `results.json` and `pictures/<benchmark>.png` into a folder."""
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    ordered = {name: results[name] for name in (*MODULES, *LONG) if name in results}
    content = json.dumps({name: result.as_dict() for name, result in ordered.items()}, indent=1, ensure_ascii=False)
    (folder / DATA).write_text(content + "\n", encoding="utf-8")
    lines = _head(ordered)
    for name, result in ordered.items():
        draw(result, folder / "pictures" / f"{name}.png")
        lines += _section(name, result)
    (folder / "RESULTS.md").write_text("\n".join(lines), encoding="utf-8")


def _head(results: Mapping[str, Result]) -> list[str]:
    judged = [verdict for result in results.values() for verdict in result.verdicts if verdict.met is not None]
    lines = [
        "# Figures",
        "",
        "How fast and how good tdof_npid_ros is, measured beside what one would use instead. tdof_npid_ros is a "
        "control "
        "loop as ROS 2 nodes: a simulated *plant*, a *controller* (nonlinear PID), a *tuner* that finds the "
        "controller's gains by a hybrid genetic algorithm (HGA), a *recorder* to MCAP bags. A *lane* is one of many "
        "independent loops that are computed side by side; in *lockstep* plant and controller wait for each other.",
        "",
        f"**{sum(bool(v.met) for v in judged)} of {len(judged)} goals met.** A goal compares figures of the same run; "
        "absolute figures belong to the machine named below. Where a goal is missed, its section says what bounds it. "
        "A line without a goal is there to compare.",
        "",
        "| question | reached | goal | verdict |",
        "| --- | ---: | ---: | --- |",
    ]
    for name, result in results.items():
        title = importlib.import_module(f"benchmarks.{name}").TITLE
        lines.append(f"| [**{title}**](#{name.replace('_', '-')}) | | | |")
        lines += [f"| {v.claim} | {_number(v.reached)} | {v.limit} | {v.word} |" for v in result.verdicts]
    lines += [
        "",
        "All of it again: `make bench` (less than an hour on two slow cores, less on fast ones) writes this page; "
        "`python -m benchmarks --only NAME` renews one section. `make bench-long` renews what takes too long for "
        "that: seeds, the plants from forums and the soak.",
        "",
        "## The machine",
        "",
    ]
    machines: dict[str, list[str]] = {}  # as JSON, and the sections from it
    for name, result in results.items():
        machines.setdefault(json.dumps(result.circumstances["machine"]), []).append(name)
    for machine, sections in machines.items():
        lines += [] if len(machines) == 1 else [f"Sections {', '.join(sections)}:", ""]
        lines += ["| | |", "| --- | --- |", *(f"| {key} | {value} |" for key, value in json.loads(machine).items()), ""]
    return lines


def _section(name: str, result: Result) -> list[str]:
    module = importlib.import_module(f"benchmarks.{name}")
    where = result.circumstances
    lines = [f'<a id="{name.replace("_", "-")}"></a>', "", f"## {module.TITLE}", "", module.METHOD, ""]
    lines += [f"![{module.TITLE}](pictures/{name}.png)", ""]
    if result.verdicts:
        lines += ["| claim | reached | goal | verdict |", "| --- | ---: | ---: | --- |"]
        lines += [f"| {v.claim} | {_number(v.reached)} | {v.limit} | {v.word} |" for v in result.verdicts]
        lines.append("")
    for table in result.tables:
        lines += [f"{table.title}:", "", _row(table.header), _row(["---", *["---:"] * (len(table.header) - 1)])]
        lines += [*map(_row, table.rows), ""]
    if result.rates:
        lines += ["| figure | median | lowest to highest | unit | |", "| --- | ---: | ---: | --- | --- |"]
        lines += [
            f"| {r.name} | {_number(r.median)} | {_number(r.low)} to {_number(r.high)} | {r.unit} | {r.note} |"
            for r in result.rates
        ]
        lines.append("")
    notes = [*result.notes, *module.NOTES]
    lines += [*(f"* {note}" for note in notes), *([""] if notes else [])]
    versions = ", ".join(f"{peer} {version}" for peer, version in where["versions"].items())
    lines += [
        f"{f'Peers: {versions}. ' if versions else ''}Measured {where['date']} in {where['seconds']} s on "
        f"{where['machine']['cpu']}, {where['machine']['cores']} cores"
        f"{'' if where['size'] == 'full' else ', **at the smallest size: the figures mean nothing**'}. "
        f"Alone: `python -m benchmarks.{name}`",
        "",
    ]
    return lines


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _number(value: float) -> str:
    """Three or four digits, without a power of ten where one can do without."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if abs(value) >= 1e5:
        return next(
            f"{value / size:,.4g} {word}" for size, word in ((1e6, "million"), (1e3, "thousand")) if abs(value) >= size
        )
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def draw(result: Result, path: Path) -> None:
    """Draw what the result is best seen as: curves, dots or bars."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if result.curves:
        size = (4.2 * len(result.curves), 3.6)
    elif result.dots:
        size = (9, 1.4 + 0.3 * len(result.dots.rows))
    else:
        units = [list(group) for _, group in groupby(result.rates, lambda rate: rate.unit)]
        size = (9, sum(0.7 + 0.3 * len(group) for group in units) or 1)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    if result.curves:
        for axes, curve in zip(figure.subplots(1, len(result.curves), squeeze=False)[0], result.curves, strict=True):
            _draw_curve(axes, curve)
    elif result.dots:
        _draw_dots(figure.subplots(), result.dots)
    elif result.rates:
        panels = figure.subplots(
            len(units), squeeze=False, gridspec_kw={"height_ratios": [0.5 + len(group) for group in units]}
        )
        for axes, group in zip(panels[:, 0], units, strict=True):
            _draw_bars(axes, group)
    figure.savefig(path, dpi=110)


def _draw_bars(axes: Any, rates: list[Rate]) -> None:
    medians = [rate.median for rate in rates]
    errors = [[rate.median - rate.low for rate in rates], [rate.high - rate.median for rate in rates]]
    positive = [median for median in medians if median > 0]
    if positive and len(positive) == len(medians) and max(medians) / min(medians) > 30:
        axes.set_xscale("log")
        axes.set_xlim(min(medians) / 3, max(medians) * 4)
    else:
        axes.set_xlim(0, 1.2 * max([*medians, *(rate.high for rate in rates), 1e-300]))
    colours = [OURS if rate.ours else PEERS for rate in rates]
    axes.barh(range(len(rates)), medians, xerr=errors, color=colours, ecolor="0.3", height=0.7)
    for i, rate in enumerate(rates):
        axes.annotate(
            _number(rate.median), (max(rate.median, rate.high), i), xytext=(4, 0), textcoords="offset points",
            va="center", fontsize=8,
        )  # fmt: skip
    axes.set_yticks(range(len(rates)), [rate.name for rate in rates], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel(rates[0].unit, fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_dots(axes: Any, dots: Dots) -> None:
    places = range(len(dots.rows))
    for i, (name, values) in reversed(list(enumerate(zip(dots.contestants, dots.values, strict=True)))):
        axes.plot(
            values, places, DOT_MARKERS[i % len(DOT_MARKERS)], color=DOT_COLOURS[i % len(DOT_COLOURS)],
            markersize=8 if i == 0 else 5, label=name, alpha=0.9, linestyle="none",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yticks(places, dots.rows, fontsize=8)
    axes.set_ylim(len(dots.rows) - 0.5, -0.5)
    axes.set_xlabel(dots.axis, fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def _draw_curve(axes: Any, curve: Curve) -> None:
    linear = [curve.seconds[0] * size / curve.sizes[0] for size in curve.sizes]
    axes.loglog(curve.sizes, curve.seconds, "o-", color=OURS, label="measured")
    axes.loglog(curve.sizes, linear, "--", color="0.5", label="linear growth")
    axes.set_title(curve.name, fontsize=9)
    axes.set_xlabel(curve.size_unit, fontsize=8)
    axes.set_ylabel(curve.unit, fontsize=8)
    for axis, values in ((axes.xaxis, curve.sizes), (axes.yaxis, [*curve.seconds, *linear])):
        _few_plain_numbers(axis, max(values) / min(values))
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _few_plain_numbers(axis: Any, span: float) -> None:
    """Label a logarithmic axis with 1, 2, 5 or, where it is long, with powers of ten alone."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if span < 200.0 else (1.0,)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _number(value)))
