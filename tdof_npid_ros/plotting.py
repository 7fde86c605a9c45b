"""One look for all pictures: colours, what a picture shows of a response, and the picture of responses itself.

Matplotlib is imported where something is drawn, so that whoever draws nothing does not wait for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tdof_npid_ros.units import Units, common_units

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Told apart by colour-blind eyes, with a contrast of at least 3:1 on white and on the pages' dark ground.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#a67c00", "#9467bd", "#808080")
DASHES = (
    "-",
    (0, (6, 2)),
    (0, (6, 2, 1.5, 2)),
    (0, (1.5, 1.5)),
    (0, (10, 3)),
    (0, (3, 2)),
    (0, (8, 2, 1.5, 2, 1.5, 2)),
)
WIDTHS = (2.2, 1.9, 1.7, 1.6, 1.5, 1.4, 1.3)  # the first curve shines out from under one that coincides with it
GUIDE = "#808080"  # setpoint, disturbance, limits: what is given, not what the loop does
DPI = 130
WIDTH, HEIGHT = 5.4, 2.9  # inches of one set of axes

AT_REST = 0.01  # of a curve's range: nearer to where it ends, it counts as there
ROOM = 1.3  # a picture ends this much later than the last curve has come to rest
LEAST_SHOWN = 0.05  # of the whole time
KICK = 4.0  # an effort's range is cut where a few first samples alone make it this many times larger
KICK_SAMPLES = 0.02  # of all samples: how many a kick has at the most
LARGEST_KICK = 300.0  # times what follows: beyond, what follows is rest, and the kicks are the response


class PlottingError(ValueError):
    """A picture that cannot be written; the message names the file and why."""


@dataclass(frozen=True)
class Curve:
    """One run in a picture.

    Attributes:
        label: in the legend.
        time: s, (samples,).
        output, effort: (samples,); NaN where there is none.
        setpoint, disturbance: what is given, (samples,); None: nothing to draw.
    """

    label: str
    time: np.ndarray
    output: np.ndarray
    effort: np.ndarray
    setpoint: np.ndarray | None = None
    disturbance: np.ndarray | None = None


@dataclass(frozen=True)
class Panel:
    """One episode under several controllers: outputs above, efforts below.

    Attributes:
        title: what the episode is called.
        curves: the runs.
        limits: of the effort, drawn where they are finite and near.
        notes: lines beside the title: numbers of the response.
        units: of its axes.
    """

    title: str
    curves: Sequence[Curve]
    limits: tuple[float, float] = (-np.inf, np.inf)
    notes: Sequence[str] = field(default=())
    units: Units = field(default_factory=Units)

    @property
    def begin(self) -> float:
        """When the first curve begins, s."""
        return min(float(curve.time[0]) for curve in self.curves)

    @property
    def end(self) -> float:
        """When the last curve ends, s."""
        return max(float(curve.time[-1]) for curve in self.curves)


def shown_until(panel: Panel) -> float:
    """The time (s) up to which a panel is worth showing: all has come to rest, and a little more.

    Example:
        >>> t = np.linspace(0, 100, 1001)
        >>> rise = 1 - np.exp(-t)
        >>> shown_until(Panel("", [Curve("", t, rise, rise)]))
        6.5
    """
    begin, end = panel.begin, panel.end
    last = begin + LEAST_SHOWN * (end - begin)
    for curve in panel.curves:
        for values in (curve.setpoint, curve.disturbance, curve.output, curve.effort):
            known = np.empty(0) if values is None else values[np.isfinite(values)]
            if values is None or not known.size:
                continue
            moving = np.flatnonzero(np.abs(np.nan_to_num(values - known[-1])) > AT_REST * float(np.ptp(known)))
            if moving.size:
                last = max(last, float(curve.time[min(moving[-1] + 1, len(curve.time) - 1)]))
    return min(end, float(f"{begin + ROOM * (last - begin):.2g}")) if last < end else end


def effort_range(panel: Panel, until: float) -> tuple[float, float, bool]:
    """Least and largest effort to show, and whether a kick of a few samples was cut off.

    A derivative's kick at a step may be a hundred times what follows, which would be a flat line.
    """
    shown = [c.effort[(c.time <= until) & np.isfinite(c.effort)] for c in panel.curves]
    values = np.concatenate(shown)
    if not values.size:
        return 0.0, 1.0, False
    low, high = float(values.min()), float(values.max())
    usual = [np.quantile(v, (KICK_SAMPLES, 1.0 - KICK_SAMPLES)) for v in shown if v.size]
    least, most = min(float(q[0]) for q in usual), max(float(q[1]) for q in usual)
    wide = max(most - least, 1e-300)
    cut = KICK * wide < high - low < LARGEST_KICK * wide
    if cut:
        low, high = max(low, least - wide), min(high, most + wide)
    for curve in panel.curves:
        if curve.disturbance is not None and np.ptp(curve.disturbance):
            low, high = min(low, float(curve.disturbance.min())), max(high, float(curve.disturbance.max()))
    margin = 0.06 * ((high - low) or max(abs(high), 1.0))
    return low - margin, high + margin, cut


def new_figure(
    rows: int, columns: int, width: float = WIDTH, height: float = HEIGHT
) -> tuple[Figure, list[list[Axes]]]:
    """An empty picture in the project's look, and its axes, [row][column]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns + 0.6, height * rows + 0.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.grid(True, color="#e6e6e6", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=9)
    return figure, axes.tolist()


def style(index: int) -> dict[str, Any]:
    """Colour, dashes and width of the curve of that number."""
    return {
        "color": PALETTE[index % len(PALETTE)],
        "linestyle": DASHES[index % len(DASHES)],
        "linewidth": WIDTHS[min(index, len(WIDTHS) - 1)],
    }


def save(figure: Figure, path: Path) -> None:
    """Write a picture; its kind follows the file's name, PNG by default.

    Raises:
        PlottingError: the file cannot be written, or there is no such kind of picture.
    """
    try:
        figure.savefig(path, format=path.suffix[1:] or "png")
    except (OSError, ValueError) as error:
        raise PlottingError(f"{path} cannot be written: {error}") from None


def draw_responses(panels: Sequence[Panel], path: Path, *, title: str = "") -> None:
    """Write the picture of some episodes: outputs above, efforts below, one legend for all.

    Args:
        panels: one for each column; curves of one number have one colour in all of them.

    Raises:
        PlottingError: the file cannot be written.
    """
    figure, axes = new_figure(2, len(panels))
    for column, panel in enumerate(panels):
        above, below = axes[0][column], axes[1][column]
        until = shown_until(panel)
        _draw_panel(panel, above, below, until)
        above.set_title(panel.title, fontsize=11, loc="left", fontweight="bold")
        if panel.notes:
            above.set_title("\n".join(panel.notes), fontsize=8, loc="right", color="#555555")
        above.tick_params(labelbottom=False)
        below.set_xlabel("time (s)")
        for axis in (above, below):
            axis.set_xlim(panel.begin, until)
    units = common_units(panel.units for panel in panels)
    axes[0][0].set_ylabel(units.titled("output y", "{output}"))
    axes[1][0].set_ylabel(units.titled("effort u", "{effort}"))
    handles: dict[str, Any] = {}
    for axis in (one for row in axes for one in row):
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=min(len(handles), 5),
        frameon=False,
        fontsize=9,
    )
    if title:
        figure.suptitle(title, fontsize=12)
    save(figure, path)


def _draw_panel(panel: Panel, above: Axes, below: Axes, until: float) -> None:
    _draw_given(panel, above, below)
    for number, curve in enumerate(panel.curves):
        look = {**style(number), "label": curve.label, "zorder": 3 + number}
        above.plot(curve.time, curve.output, **look)
        below.plot(curve.time, curve.effort, drawstyle="steps-post", **look)
    low, high, _ = effort_range(panel, until)
    for limit in panel.limits:
        if np.isfinite(limit) and low - 0.5 * (high - low) <= limit <= high + 0.5 * (high - low):
            below.axhline(limit, label="effort's limits", color=GUIDE, linewidth=1.0, zorder=1)
            low, high = min(low, limit - 0.04 * (high - low)), max(high, limit + 0.04 * (high - low))
    _shade_saturation(panel, below)
    below.set_ylim(low, high)
    below.annotate(
        "\n".join(effort_notes(panel, until)),
        (0.99, 0.96),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=8,
        color="#555555",
    )


def effort_notes(panel: Panel, until: float) -> list[str]:
    """What a plot of the efforts does not show: a disturbance that never changes, and what of a kick was cut off."""
    known = (c.disturbance[np.isfinite(c.disturbance)] for c in panel.curves if c.disturbance is not None)
    constant = {float(d[0]) for d in known if np.any(d) and not np.ptp(d)}
    notes = [f"disturbance {d:g} throughout" for d in sorted(constant)]
    if effort_range(panel, until)[2]:
        most = max(float(np.nanmax(np.abs(c.effort[c.time <= until]), initial=0.0)) for c in panel.curves)
        notes.append(f"kick to {most:.3g}, cut off")
    return notes


def _draw_given(panel: Panel, above: Axes, below: Axes) -> None:
    """Setpoints and disturbances, each once; a disturbance that never changes is told, not drawn."""
    guide: dict[str, Any] = {"color": GUIDE, "linewidth": 1.1, "drawstyle": "steps-post", "zorder": 1}
    drawn: set[bytes] = set()
    for curve in panel.curves:
        r, d = curve.setpoint, curve.disturbance
        if r is not None and not np.isnan(r).all() and (content := r.tobytes()) not in drawn:
            drawn.add(content)
            above.plot(curve.time, r, label="setpoint r", linestyle=(0, (4, 3)), **guide)
        if d is None or not np.any(d) or (content := b"d" + d.tobytes()) in drawn:
            continue
        drawn.add(content)
        if np.ptp(d):
            below.plot(curve.time, d, label="disturbance d", linestyle=(0, (1, 2)), **guide)


def _shade_saturation(panel: Panel, axis: Axes) -> None:
    low, high = panel.limits
    for curve in panel.curves:
        at_limit = (curve.effort <= low) | (curve.effort >= high)
        if at_limit.any():
            axis.fill_between(
                curve.time, 0, 1, where=at_limit.tolist(), transform=axis.get_xaxis_transform(), color=GUIDE,
                alpha=0.15, linewidth=0, label="at a limit", step="post", zorder=0,
            )  # fmt: skip
