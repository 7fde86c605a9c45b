"""The page of figures: RESULTS.md and a picture per question."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.harness import Rate, Result

OURS = "#0072b2"
PEERS = "#999999"


def write_page(results: Mapping[str, Result], machine: Mapping[str, Any], folder: Path) -> None:
    """Write `RESULTS.md` and `pictures/<benchmark>.png` into a folder."""
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    verdicts = [verdict for result in results.values() for verdict in result.verdicts]
    lines = [
        "# Figures",
        "",
        f"One run of `make bench` on {machine['cpu']}, {machine['cores']} cores, Python {machine['python']}. Absolute figures "
        "belong to that machine; the ratios are of figures measured side by side in the same run.",
        "",
        f"{sum(v.met for v in verdicts)} of {len(verdicts)} goals met.",
        "",
    ]
    for name, result in results.items():
        _draw(result.rates, folder / "pictures" / f"{name}.png")
        lines += [f"## {result.question}", "", f"![{result.question}](pictures/{name}.png)", ""]
        lines += ["| claim | reached | goal | |", "| --- | --- | --- | --- |"]
        for v in result.verdicts:
            sign = "≤" if v.at_most else "≥"
            lines.append(f"| {v.claim} | {v.ratio:.3g} | {sign} {v.goal:g} | {'met' if v.met else '**missed**'} |")
        lines += ["", "| figure | median | spread | unit | |", "| --- | --- | --- | --- | --- |"]
        lines += [
            f"| {r.name} | {r.median:,.4g} | {r.low:,.4g} to {r.high:,.4g} | {r.unit} | {r.note} |"
            for r in result.rates
        ]
        lines += ["", *(f"* {note}" for note in result.notes), ""]
        lines += [f"Alone: `python -m benchmarks.{name}`", ""]
    (folder / "RESULTS.md").write_text("\n".join(lines), encoding="utf-8")


def _draw(rates: list[Rate], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.6 + 0.32 * max(1, len(rates))), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    names = [rate.name for rate in rates]
    medians = [rate.median for rate in rates]
    errors = [[r.median - r.low for r in rates], [r.high - r.median for r in rates]]
    axes.barh(names, medians, xerr=errors, color=[_colour(name) for name in names], ecolor="0.3", height=0.7)
    axes.invert_yaxis()
    if medians and min(medians) > 0 and max(medians) / min(medians) > 30:
        axes.set_xscale("log")
    axes.set_xlabel(rates[0].unit if rates else "")
    axes.tick_params(labelsize=8)
    axes.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)


def _colour(name: str) -> str:
    return OURS if any(word in name for word in ("tdof", "HGA", "loop", "ours", "recorder", "node")) else PEERS
