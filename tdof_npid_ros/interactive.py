"""Pages for a browser: one self-contained file of tables and plots to hover, zoom and hide, made with Bokeh.

Bokeh is imported where a page is made, so that whoever makes none does not wait for it.
"""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdof_npid_ros.plotting import GUIDE, PALETTE, Panel, PlottingError, effort_range, shown_until

MOST_POINTS = 20_000  # of a curve; longer ones are thinned to the least and the largest value of each stretch
DASHES = ("solid", "dashed", "dashdot", "dotted", [10, 3], [3, 2], [8, 2, 2, 2])
LEGEND_COLUMNS = 3  # narrow enough for a phone
INK = "#808080"  # of axes and labels: readable on light and on dark
_NUMBER = re.compile(r"[-+]?(inf|nan|[\d.]+(e[-+]?\d+)?)|-?")

CSS = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --faint: #666; --grid: #8883; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e6e6; --paper: #16181c; --faint: #a0a0a0; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 80rem; padding: 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: 1.8rem 0 .3rem; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: .25rem .7rem; text-align: left; border-bottom: 1px solid var(--grid); white-space: nowrap; }
.number { text-align: right; } .note { color: var(--faint); font-size: 14px; max-width: 60rem; }
"""


class Page:
    """A page that is put together from headings, texts, tables and plots, and written as one file.

    Example:
        >>> page = Page("A heater")
        >>> page.text("Nothing was recorded.")
        >>> "A heater" in page.html()
        True
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts: list[str] = []
        self._models: list[Any] = []

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def text(self, text: str) -> None:
        """A paragraph."""
        self._parts.append(f'<p class="note">{html.escape(text)}</p>')

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """A table, titles first; columns of numbers are aligned to the right; wide ones scroll."""
        numeric = [all(_NUMBER.fullmatch(cell) for cell in column) for column in zip(*rows[1:], strict=True)]
        if not numeric:
            return

        def line(cells: Sequence[str], tag: str) -> str:
            classes = (' class="number"' if is_number else "" for is_number in numeric)
            pairs = zip(cells, classes, strict=True)
            return "<tr>" + "".join(f"<{tag}{class_}>{html.escape(cell)}</{tag}>" for cell, class_ in pairs) + "</tr>"

        body = "".join(line(row, "td") for row in rows[1:])
        self._parts.append(
            f'<div class="table"><table><thead>{line(rows[0], "th")}</thead><tbody>{body}</tbody></table></div>'
        )

    def plot(self, *models: Any) -> None:
        """Plots, one below the other."""
        for model in models:
            self._parts.append(f"<!-- plot {len(self._models)} -->")
            self._models.append(model)

    def html(self) -> str:
        """The page's text; it needs nothing else, no network either."""
        body = "\n".join(self._parts)
        head = script = ""
        if self._models:
            from bokeh.embed import components
            from bokeh.resources import Resources

            script, divisions = components(tuple(self._models))
            head = Resources(mode="inline", components=["bokeh"]).render_js()
            for number, division in enumerate(divisions):
                body = body.replace(f"<!-- plot {number} -->", division)
        title = html.escape(self._title)
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{title}</title><style>{CSS}</style>{head}</head>\n"
            f"<body><h1>{title}</h1>\n{body}\n{script}</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page.

        Raises:
            PlottingError: the file cannot be written.
        """
        try:
            path.write_text(self.html(), encoding="utf-8")
        except OSError as error:
            raise PlottingError(f"{path} cannot be written: {error.strerror}") from None


def new_plot(y_label: str, height: int = 300, **options: Any) -> Any:
    """An empty Bokeh plot in the project's look: as wide as the page, readable on light and on dark ground."""
    from bokeh.models import BoxZoomTool, HoverTool, PanTool, ResetTool, SaveTool, WheelZoomTool
    from bokeh.plotting import figure

    plot = figure(
        height=height, sizing_mode="stretch_width", toolbar_location="right", y_axis_label=y_label, tools="",
        background_fill_color=None, border_fill_color=None, outline_line_color=None, min_width=260,
        min_border_left=74, **options,
    )  # fmt: skip
    wheel = WheelZoomTool(dimensions="width")
    plot.add_tools(PanTool(), BoxZoomTool(), wheel, ResetTool(), SaveTool())
    plot.add_tools(HoverTool(tooltips=[("", "$name"), ("t", "@x{0.[0000]} s"), ("", "@y{0.[000000]}")], mode="mouse"))
    plot.toolbar.logo = None
    plot.toolbar.active_scroll = wheel
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_color = axis.major_label_text_color = INK
        axis.axis_line_color = axis.major_tick_line_color = INK
        axis.minor_tick_line_color = None
    for grid in (*plot.xgrid, *plot.ygrid):
        grid.grid_line_color, grid.grid_line_alpha = INK, 0.25
    return plot


def finish_legend(plot: Any) -> None:
    """Put the legend above the plot; a click hides a curve."""
    for legend in plot.legend:
        legend.click_policy = "hide"
        legend.orientation = "horizontal"
        legend.background_fill_color = legend.border_line_color = None
        legend.label_text_color = INK
        legend.label_text_font_size = "12px"
        legend.padding, legend.margin, legend.spacing = 0, 4, 12
        legend.location, legend.ncols = "left", LEGEND_COLUMNS
    if plot.legend:
        plot.add_layout(plot.legend[0], "above")


def response_plots(panel: Panel, *, unit: str = "", effort_unit: str = "") -> list[Any]:
    """The output and the effort of an episode, two plots that zoom together; limits drawn, saturation shaded."""
    from bokeh.models import BoxAnnotation, Range1d, Span

    until = shown_until(panel)
    output = new_plot("output" + (f" ({unit})" if unit else ""), 300)
    effort = new_plot("effort" + (f" ({effort_unit})" if effort_unit else ""), 220, x_range=output.x_range)
    output.x_range.start, output.x_range.end = panel.begin, until
    effort.xaxis.axis_label = "time (s)"
    drawn: set[bytes] = set()
    for number, curve in enumerate(panel.curves):
        given = ((output, curve.setpoint, "setpoint", "dashed"), (effort, curve.disturbance, "disturbance", "dotted"))
        for plot, values, name, dash in given:
            if values is None or not np.nan_to_num(values).any() or (key := name.encode() + values.tobytes()) in drawn:
                continue
            drawn.add(key)
            line(plot, curve.time, values, name, color=GUIDE, dash=dash, width=1.4, steps=True)
        look: dict[str, Any] = {"color": PALETTE[number % len(PALETTE)], "dash": DASHES[number % len(DASHES)]}
        above = line(output, curve.time, curve.output, curve.label, width=2.2, **look)
        below = line(effort, curve.time, curve.effort, curve.label, width=1.8, steps=True, **look)
        above.js_link("visible", below, "visible")
        for first, last in _at_limit(panel, curve.time, curve.effort):
            shade = {"fill_color": GUIDE, "fill_alpha": 0.15, "line_color": None}
            effort.add_layout(BoxAnnotation(left=first, right=last, **shade))
    low, high, _ = effort_range(panel, until)
    effort.y_range = Range1d(low, high)
    for limit in panel.limits:
        if np.isfinite(limit):
            effort.add_layout(Span(location=limit, dimension="width", line_color=GUIDE, line_width=1.2))
    finish_legend(output)
    finish_legend(effort)
    for legend in effort.legend:
        legend.visible = False
    effort.toolbar_location = None
    return [output, effort]


def line(
    plot: Any, time: np.ndarray, values: np.ndarray, label: str, *, color: str, dash: Any = "solid", width: float = 2.0,
    steps: bool = False,
) -> Any:  # fmt: skip
    """A curve with its legend and what hovering tells of it; returns Bokeh's renderer."""
    from bokeh.models import ColumnDataSource

    x, y = thinned(time, values)
    if steps:
        x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    source = ColumnDataSource({"x": x, "y": y}, name=label)
    return plot.line(
        "x", "y", source=source, legend_label=label, name=label, color=color, line_dash=dash, line_width=width
    )


def thinned(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve without what no screen shows: of one that only steps, its corners; of a long one, each stretch's ends."""
    keep = np.flatnonzero(np.isfinite(values))
    if keep.size > 2:
        steps = np.flatnonzero(np.diff(values[keep])) + 1
        if steps.size < keep.size // 10:
            keep = keep[np.unique(np.concatenate([[0], steps - 1, steps, [keep.size - 1]]))]
    if keep.size > MOST_POINTS:
        stretches = np.array_split(keep, MOST_POINTS // 2)
        ends = [(part[np.argmin(values[part])], part[np.argmax(values[part])]) for part in stretches]
        keep = np.unique(np.array(ends))
    return time[keep], values[keep]


def _at_limit(panel: Panel, time: np.ndarray, effort: np.ndarray) -> list[tuple[float, float]]:
    """Stretches (s) of an effort at its limits; those of a few samples only are left out where there are many."""
    at = np.concatenate([[False], (effort <= panel.limits[0]) | (effort >= panel.limits[1]), [False]])
    first, last = (np.flatnonzero(np.diff(at.astype(int)) == sign).tolist() for sign in (1, -1))
    stretches = [(float(time[a]), float(time[min(b, len(time) - 1)])) for a, b in zip(first, last, strict=True)]
    return sorted(stretches, key=lambda one: one[0] - one[1])[:100]
