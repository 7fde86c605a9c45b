"""The paper's figures, drawn: data in, one PNG out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tdof_npid_ros.paper.evaluation import CONTROLLER_TITLES
from tdof_npid_ros.plotting import GUIDE, PALETTE, new_figure
from tdof_npid_ros.tuning.pareto import Front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

STYLE: dict[str, dict[str, Any]] = {
    "pid": {"color": PALETTE[0], "linestyle": "-", "marker": "o"},
    "npid": {"color": PALETTE[3], "linestyle": ":", "marker": "s"},
    "tdof_npid1": {"color": PALETTE[1], "linestyle": "--", "marker": "^"},
    "tdof_npid2": {"color": PALETTE[2], "linestyle": "-.", "marker": "v"},
}
REFERENCE: dict[str, Any] = {"color": GUIDE, "linewidth": 0.8, "zorder": 0}
WIDTH = 10.0  # inches
TITLE_SIZE = 10  # points
POINTS = 2000  # of a curve, about: more than its axes have pixels


class Curve(NamedTuple):
    """One response: time (s) and value, of one length."""

    controller: str
    time: np.ndarray
    value: np.ndarray


class Panel(NamedTuple):
    """One set of axes with the responses of several controllers.

    Attributes:
        reference: where the response should be; a thin line.
        scale: what the values are multiplied by for the picture; the label says so.
    """

    title: str
    ylabel: str
    curves: Sequence[Curve]
    until: float
    reference: float | None = None
    scale: float = 1.0


def draw_panels(rows: Sequence[Sequence[Panel]], path: Path) -> None:
    """A grid of responses."""
    canvas, axes = _canvas(len(rows), len(rows[0]), 3.1)
    for row, row_axes in zip(rows, axes, strict=True):
        for panel, ax in zip(row, row_axes, strict=True):
            _draw_panel(panel, ax)
    axes[0][0].legend(loc="best", frameon=False)
    canvas.savefig(path)


def draw_error_scaling(error: np.ndarray, scaled: Mapping[float, np.ndarray], path: Path) -> None:
    """Figure 1: ζ over e for several σ, each of shape (errors,)."""
    canvas, axes = _canvas(1, 1, 4.0, width=6.5)
    ax = axes[0][0]
    ax.plot(error, error, color=GUIDE, linewidth=0.8, label="ζ = e (linear)")
    for (sigma, value), color in zip(scaled.items(), PALETTE[:3], strict=True):
        ax.plot(error, value, color=color, label=f"σ = {sigma:g}")
    ax.set(xlabel="error e", ylabel="scaled error ζ", ylim=(-2.5, 2.5), xlim=(error[0], error[-1]))
    ax.legend(frameon=False)
    canvas.savefig(path)


def draw_fronts(fronts: Sequence[Front], path: Path) -> None:
    """Figure 6: the fronts of each loop in axes of their own, by their ratio L/T."""
    titles = {front.title: front for front in sorted(fronts, key=lambda front: front.ratio or 0.0)}
    canvas, axes = _canvas(1, len(titles), 3.8)
    for title, ax in zip(titles, axes[0], strict=True):
        for front in (front for front in fronts if front.title == title):
            style = STYLE[front.controller]
            ax.plot(*front.iae.T, linewidth=0.8, markersize=3.0, label=CONTROLLER_TITLES[front.controller], **style)
        unit, units = "s" if titles[title].ratio else "{output} s", titles[title].case.units
        ax.set(xlabel=units.titled("IAE_SP", unit), ylabel=units.titled("IAE_DIS", unit))
        ax.set_title(title, fontsize=TITLE_SIZE)
    axes[0][-1].legend(frameon=False)
    canvas.savefig(path)


def draw_chaos(time: np.ndarray, x1: np.ndarray, x2: np.ndarray, path: Path) -> None:
    """Figure 13: the phase portrait and the output of the circuit left alone."""
    canvas, axes = _canvas(1, 2, 3.8)
    portrait, series = axes[0]
    portrait.plot(x1, x2, color=PALETTE[0], linewidth=0.5)
    portrait.plot(x1[0], x2[0], "o", color=PALETTE[1], markersize=5, label="start")
    portrait.set(xlabel="x₁", ylabel="x₂")
    portrait.set_title("(a) phase portrait", fontsize=TITLE_SIZE)
    portrait.legend(frameon=False)
    series.plot(time, x1, color=PALETTE[0], linewidth=0.8)
    series.set_title("(b) output", fontsize=TITLE_SIZE)
    series.set(xlabel="time (s)", ylabel="y = x₁", xlim=(time[0], time[-1]))
    canvas.savefig(path)


def _draw_panel(panel: Panel, ax: Axes) -> None:
    if panel.reference is not None:
        ax.axhline(panel.reference * panel.scale, **REFERENCE)
    for curve in panel.curves:
        samples = int(np.searchsorted(curve.time, panel.until, side="right"))
        shown = slice(0, samples, max(1, samples // POINTS))
        style = {name: STYLE[curve.controller][name] for name in ("color", "linestyle")}
        value = curve.value[shown] * panel.scale
        ax.plot(curve.time[shown], value, linewidth=1.4, label=CONTROLLER_TITLES[curve.controller], **style)
    ax.set_title(panel.title, fontsize=TITLE_SIZE)
    ax.set(xlabel="time (s)", ylabel=panel.ylabel, xlim=(panel.curves[0].time[0], panel.until))


def _canvas(rows: int, columns: int, height: float, width: float = WIDTH) -> tuple[Canvas, list[list[Axes]]]:
    return new_figure(rows, columns, width / columns, height)
