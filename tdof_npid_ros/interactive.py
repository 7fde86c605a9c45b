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

from tdof_npid_ros.plotting import GUIDE, PALETTE, Panel, PlottingError, effort_notes, effort_range, shown_until

MOST_POINTS = 20_000  # of a curve; longer ones are thinned to the least and the largest value of each stretch
DASHES = ("solid", "dashed", "dashdot", "dotted", [10, 3], [3, 2], [8, 2, 2, 2])
LEGEND_COLUMNS, LEGEND_LETTERS = 3, 36  # most of a legend's columns, and of letters in a line: fits a phone
LEGEND_LINE = 16  # pixels
INK = "#808080"  # of axes and labels: readable on light and on dark
DARK = """
@media (prefers-color-scheme: dark) {
  :host { --color: #e6e6e6; --background-color: #22262c; --surface-background-color: #22262c; --border-color: #565d66;
    --divider-color: #3a4048; --hover-color: #2c323a; --default: #22262c; --default-border: #565d66;
    --default-hover: #2c323a; --default-hover-border: #808080; --default-active: #3a4048;
    --default-active-border: #808080; --default-disabled: #22262c; --icon-color: #a0a0a0; color-scheme: dark; }
  .noUi-target { background: #22262c; border-color: #565d66; box-shadow: none; }
  .noUi-handle { background: #a0a0a0; border-color: #565d66; box-shadow: none; }
  .noUi-connect { background: #565d66; }
  select.bk-input { background-image: none; appearance: auto; }
  .bk-active.bk-btn-default { background-color: #0072b2; }
}
"""  # Bokeh's widgets and tools, which know light alone
# A finger moves the page, not the plot, or nobody would come past a plot on a phone; two fingers zoom.
BY_FINGER = """
if (matchMedia("(pointer: coarse)").matches) {
  for (const pan of pans) pan.active = false
  for (const wheel of wheels) wheel.modifiers = {}
}
"""
_NUMBER = re.compile(r"[-+]?(inf|nan|[\d.]+(e[-+]?\d+)?)|-?")

TABLES = """
.table { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: .25rem .7rem; text-align: left; border-bottom: 1px solid var(--grid); white-space: nowrap; }
.number { text-align: right; }
@media (max-width: 600px) { table { font-size: 12px; } th, td { padding: .2rem .3rem; white-space: normal; }
  }
"""
CSS = (
    TABLES
    + """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --faint: #666; --grid: #8883; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e6e6; --paper: #16181c; --faint: #a0a0a0; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 80rem; padding: 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: 1.8rem 0 .3rem; }
.note { color: var(--faint); font-size: 14px; max-width: 60rem; }
"""
)


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
        self._parts.append(table_html(rows))

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
            from bokeh.document import Document
            from bokeh.embed import components
            from bokeh.resources import Resources

            document = Document()
            for model in self._models:
                document.add_root(model)
            fit_to_screen(document)
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


def table_html(rows: Sequence[Sequence[str]]) -> str:
    """A table, titles first; columns of numbers are aligned to the right; wide ones scroll."""
    numeric = [all(_NUMBER.fullmatch(cell) for cell in column) for column in zip(*rows[1:], strict=True)]
    if not numeric:
        return ""

    def line(cells: Sequence[str], tag: str) -> str:
        classes = (' class="number"' if is_number else "" for is_number in numeric)
        pairs = zip(cells, classes, strict=True)
        return "<tr>" + "".join(f"<{tag}{class_}>{_breakable(cell)}</{tag}>" for cell, class_ in pairs) + "</tr>"

    body = "".join(line(row, "td") for row in rows[1:])
    return f'<div class="table"><table><thead>{line(rows[0], "th")}</thead><tbody>{body}</tbody></table></div>'


def _breakable(text: str) -> str:
    """A cell's text, which a narrow screen may break after an underscore, too."""
    return html.escape(text).replace("_", "_<wbr>")


def fit_to_screen(document: Any) -> None:
    """Make all that is in a Bokeh document readable on a dark ground, and leave swiping on a phone to the page."""
    from bokeh.models import CustomJS, PanTool, WheelZoomTool

    for root in document.roots:
        fit_elements(root)
    tools = {"pans": list(document.select({"type": PanTool})), "wheels": list(document.select({"type": WheelZoomTool}))}
    document.js_on_event("document_ready", CustomJS(args=tools, code=BY_FINGER))


def fit_elements(root: Any) -> None:
    """Make what is in a Bokeh layout readable on a dark ground."""
    from bokeh.models import UIElement

    for element in root.select({"type": UIElement}):
        if DARK not in element.stylesheets:
            element.stylesheets = [*element.stylesheets, DARK]


def new_plot(y_label: str, height: int = 300, *, x_label: str = "time (s)", **options: Any) -> Any:
    """An empty Bokeh plot in the project's look: as wide as the page, readable on light and on dark ground.

    The wheel alone moves the page on; with Ctrl it zooms.
    """
    from bokeh.models import BoxZoomTool, PanTool, ResetTool, SaveTool, WheelZoomTool
    from bokeh.plotting import figure

    plot = figure(
        height=height, sizing_mode="stretch_width", toolbar_location="above", y_axis_label=y_label,
        x_axis_label=x_label, tools="", background_fill_color=None, border_fill_color=None, outline_line_color=None,
        min_width=260, min_border_left=74, **options,
    )  # fmt: skip
    wheel = WheelZoomTool(dimensions="width", modifiers="ctrl")
    plot.add_tools(PanTool(), BoxZoomTool(), wheel, ResetTool(), SaveTool())
    plot.toolbar.logo = None
    plot.toolbar.active_scroll = wheel
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_color = axis.major_label_text_color = INK
        axis.axis_line_color = axis.major_tick_line_color = INK
        axis.minor_tick_line_color = None
    for grid in (*plot.xgrid, *plot.ygrid):
        grid.grid_line_color, grid.grid_line_alpha = INK, 0.25
    return plot


def draw(
    plot: Any, source: Any, column: str, *, color: str, dash: Any = "solid", width: float = 2.0, unit: str = ""
) -> Any:
    """Draw a column of a source over its column `time`; its name is in the legend, and hovering tells its values.

    Returns:
        Bokeh's renderer.
    """
    from bokeh.models import HoverTool

    curve = plot.line(
        "time", column, source=source, legend_label=column, name=column, color=color, line_dash=dash, line_width=width
    )
    told = (
        f'<span style="color: {color}">&#9632;</span> {html.escape(column)}: '
        f"<b>@$name{{0.[000000]}}</b> {html.escape(unit)}<br>at @time{{0.[0000]}} s"
    )
    plot.add_tools(HoverTool(renderers=[curve], tooltips=told, mode="mouse", visible=False))
    return curve


def finish_legend(plot: Any) -> None:
    """Put the legend above the plot; a click hides a curve."""
    for legend in plot.legend:
        legend.click_policy = "hide"
        legend.orientation = "horizontal"
        legend.background_fill_color = legend.border_line_color = None
        legend.label_text_color = INK
        legend.label_text_font_size = "12px"
        legend.padding, legend.margin, legend.spacing = 0, 4, 8
        legend.glyph_height = legend.label_height = LEGEND_LINE
        longest = max((len(str(item.label.value)) for item in legend.items), default=0)
        legend.location, legend.ncols = "left", max(1, min(LEGEND_COLUMNS, LEGEND_LETTERS // max(longest, 1)))
        plot.height += (LEGEND_LINE + legend.spacing) * -(-len(legend.items) // legend.ncols)
    if plot.legend:
        plot.add_layout(plot.legend[0], "above")


def response_plots(panel: Panel) -> list[Any]:
    """The output and the effort of an episode, two plots that zoom together; limits drawn, saturation shaded."""
    from bokeh.models import BoxAnnotation, Range1d, Span, Title

    until = shown_until(panel)
    units = panel.units
    output = new_plot(units.titled("output", "{output}"), 300, x_label="")
    effort = new_plot(units.titled("effort", "{effort}"), 240, x_range=output.x_range)
    output.x_range.start, output.x_range.end = panel.begin, until
    drawn: set[bytes] = set()
    look: dict[str, Any]
    for number, curve in enumerate(panel.curves):
        given = (
            (output, curve.setpoint, "setpoint", "dashed", units.output),
            (effort, curve.disturbance, "disturbance", "dotted", units.effort),
        )
        for plot, values, name, dash, its_unit in given:
            if values is None or (key := name.encode() + values.tobytes()) in drawn or not _is_drawn(values, name):
                continue
            drawn.add(key)
            look = {"color": GUIDE, "dash": dash, "width": 1.4, "unit": its_unit}
            draw(plot, source_of(curve.time, values, name, steps=True), name, **look)
        name = curve.label
        look = {"color": PALETTE[number % len(PALETTE)], "dash": DASHES[number % len(DASHES)]}
        above = draw(output, source_of(curve.time, curve.output, name), name, unit=units.output, width=2.2, **look)
        its_effort = source_of(curve.time, curve.effort, name, steps=True)
        below = draw(effort, its_effort, name, unit=units.effort, width=1.8, **look)
        above.js_link("visible", below, "visible")
        for first, last in _at_limit(panel, curve.time, curve.effort):
            shade = {"fill_color": GUIDE, "fill_alpha": 0.15, "line_color": None}
            effort.add_layout(BoxAnnotation(left=first, right=last, **shade))
    if notes := effort_notes(panel, until):
        told = Title(text="; ".join(notes), text_color=INK, text_font_size="12px", text_font_style="normal")
        effort.add_layout(told, "above")
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


def _is_drawn(given: np.ndarray, name: str) -> bool:
    """Whether a setpoint or disturbance is worth a curve: one that never changes is told of a disturbance."""
    return bool(np.isfinite(given).any()) and (name == "setpoint" or bool(np.ptp(given[np.isfinite(given)])))


def source_of(time: np.ndarray, values: np.ndarray, name: str, *, steps: bool = False) -> Any:
    """A curve (samples,) as what a Bokeh plot draws: columns `time` and its name; of one in steps, their corners."""
    from bokeh.models import ColumnDataSource

    time, values = thinned(time, values)
    if steps:
        time, values = corners(time, values)
    return ColumnDataSource({"time": time, name: values}, name=name)


def corners(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A curve that holds each value until the next one comes, by its corners.

    Example:
        >>> corners(np.array([0.0, 1.0]), np.array([5.0, 6.0]))
        (array([0., 1., 1.]), array([5., 5., 6.]))
    """
    return np.repeat(time, 2)[1:], np.repeat(values, 2)[:-1]


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
