"""The page's plots: signals that scroll, the law's terms, the latest step beside the one before it."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Sequence
from itertools import repeat
from typing import Any

import numpy as np
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, CustomJS, Range1d, Span, Title

from tdof_npid_ros.control.law import TERMS as LAW_TERMS
from tdof_npid_ros.graph.observer import Row, Terms
from tdof_npid_ros.interactive import INK, corners, draw, finish_legend, new_plot
from tdof_npid_ros.live.step import StepResponse
from tdof_npid_ros.plotting import GUIDE, PALETTE, Curve, Panel, effort_notes, effort_range, shown_until
from tdof_npid_ros.units import Units

ROLLOVER = 4000  # points of a curve that a browser holds
MOST_AT_ONCE = 400  # points that one refresh sends; a faster loop is thinned
LEAST_SHOWN = 0.02  # of a step: an output at rest is a line, not its last digits
MOST_ROOM = 1.5  # of what is to be shown: a range that is larger is fitted anew, others stay as they are
MOST_OF_STEP = 1000  # points of a step that are drawn
SIGNALS = ("setpoint", "output")
EFFORTS = ("effort", "applied")
TERMS = ("P", "I", "D")
STEPS = ("latest step", "the one before")
# A browser follows the newest, unless its user has moved the plots elsewhere; "reset" brings them back. (With Bokeh's
# own following every plot is painted twice.) It tells how far it is, once that has been painted.
FOLLOW = """
const at = cb_obj.data.time.at(-1)
const newest = {reset_start: at - span, reset_end: at}
range.setv(range.end === range.reset_end ? {start: at - span, end: at, ...newest} : newest)
requestAnimationFrame(() => setTimeout(() => { far.tags = [at] }))
"""
PATIENCE = 1.0  # s without a word from a browser, after which it is sent more all the same
REST = 3.0  # times as long as it painted last, it may do something else: on few cores the loop runs there, too
JUMP = 0.1  # of its plot's range: an effort that moves so far is shown at once, as is another setpoint


class LivePlots:
    """The plots of one page.

    Args:
        window: s that scroll by.
        step: how large a step of the output is, by and large.
        units: of output and effort.

    Attributes:
        layout: what the page shows.
    """

    def __init__(self, window: float, step: float, units: Units) -> None:
        self._least = LEAST_SHOWN * step
        self._signals, self._terms = map(_empty, ((*SIGNALS, *EFFORTS), TERMS))
        self._steps = [_empty([name]) for name in STEPS]
        self._far = ColumnDataSource()  # its tags: the time that the browser has painted last; nothing is drawn of it
        self._far.on_change("tags", lambda _, __, new: self._painted(new))
        self._last: Row | None = None
        self._sent_at = self._rest_until = 0.0
        self._limits = (-math.inf, math.inf)
        time = Range1d(-window, 0.0, reset_start=-window, reset_end=0.0, syncable=False)  # each browser's own matter
        follow = CustomJS(args={"range": time, "span": window, "far": self._far}, code=FOLLOW)
        self._signals.js_on_change("streaming", follow)
        output = new_plot(units.titled("output", "{output}"), 270, x_label="", x_range=time, name="output_plot")
        self._effort = effort = new_plot(units.titled("effort", "{effort}"), 190, x_label="", x_range=time)
        terms = new_plot(units.titled("P, I, D", "{effort}"), 190, x_range=time)
        self._output, self._parts = output, terms
        output.y_range, effort.y_range, terms.y_range = (Range1d(-1.0, 1.0) for _ in range(3))
        after_step = new_plot("part of the step", 240, x_label="time since the step (s)")
        draw(output, self._signals, "setpoint", color=GUIDE, dash="dashed", width=1.4)
        draw(output, self._signals, "output", color=PALETTE[0])
        draw(effort, self._signals, "effort", color=PALETTE[1])
        draw(effort, self._signals, "applied", color=PALETTE[2], dash="dotted", width=1.6)
        for name, colour in zip(TERMS, PALETTE, strict=False):
            draw(terms, self._terms, name, color=colour, width=1.6)
        draw(after_step, self._steps[1], STEPS[1], color=GUIDE, dash="dashed", width=1.6)
        draw(after_step, self._steps[0], STEPS[0], color=PALETTE[0])
        after_step.add_layout(Span(location=1.0, dimension="width", line_color=GUIDE, line_dash="dashed"))
        self._spans = [Span(location=math.nan, dimension="width", line_color=GUIDE, line_width=1.2) for _ in range(2)]
        for span in self._spans:
            effort.add_layout(span)
        self._note = Title(text="", text_color=INK, text_font_size="12px", text_font_style="normal")
        effort.add_layout(self._note, "above")
        for plot in (output, effort, terms, after_step):
            finish_legend(plot)
        for plot in (effort, terms, after_step):
            plot.toolbar_location = None
        self.layout = column(output, effort, terms, after_step, name="plots", sizing_mode="stretch_width")

    def _painted(self, tags: list[Any]) -> None:
        if self._last is not None and tags == [self._last.time]:
            now = clock.monotonic()
            self._rest_until = now + REST * (now - self._sent_at)

    def waits(self, latest: Row | None, lane: int) -> bool:
        """Whether the browser is to be sent nothing yet.

        It is still at what it was sent last, and on a busy machine more would only wait in a queue; or it has just
        painted, and nothing has happened since.
        """
        now = clock.monotonic()
        if self._last is None or latest is None or now - self._sent_at > PATIENCE:
            return False
        if self._far.tags and self._far.tags != [self._last.time]:
            return True
        moved, kicked = (
            abs(at_lane(getattr(latest, name), lane) - at_lane(getattr(self._last, name), lane))
            for name in ("setpoint", "effort")
        )
        shown = self._effort.y_range
        return now < self._rest_until and not (moved > 0.0 or kicked > JUMP * (shown.end - shown.start))

    def clear(self) -> None:
        """Begin anew, with another loop or lane."""
        for source in (self._signals, self._terms, *self._steps):
            source.data = {name: [] for name in source.data}
        self._last = None

    def add(self, rows: Sequence[Row], lane: int) -> None:
        """Go on with answers; of many at once, some."""
        rows = _some(rows)
        held = rows if self._last is None else [self._last, *rows]
        times = np.array([one.time for one in held])
        streamed: dict[str, Any] = {}
        for name in (*SIGNALS, *EFFORTS):
            values = np.array([at_lane(getattr(one, name), lane) for one in held])
            ends = (np.repeat(times, 2)[1:], np.repeat(values, 2)[1:]) if name == "output" else corners(times, values)
            streamed["time"], streamed[name] = ends
        begun = 0 if self._last is None else 1  # the last answer's own point is there already
        # As lists, they are one message, as arrays one more for each; and one source, as each makes the browser draw.
        self._signals.stream(
            {name: values[begun:].tolist() for name, values in streamed.items()}, rollover=2 * ROLLOVER
        )
        both = np.array([self._signals.data[name] for name in SIGNALS], dtype=float)
        _fit(self._output, float(np.nanmin(both)), float(np.nanmax(both)), self._least)
        self._last, self._sent_at = rows[-1], clock.monotonic()

    def add_terms(self, terms: Sequence[Terms], lane: int) -> None:
        """Go on with the law's terms."""
        terms = _some(terms)
        columns = {"time": [one.time for one in terms]}
        for name, term in zip(TERMS, ("proportional", "integral", "derivative"), strict=True):
            columns[name] = [at_lane(one.values[LAW_TERMS.index(term)], lane) for one in terms]
        self._terms.stream(columns, rollover=ROLLOVER)

    def show_steps(self, latest: StepResponse | None, previous: StepResponse | None) -> None:
        """The latest step and the one before it, each as a part of its size, so that they can be compared."""
        for source, name, one in zip(self._steps, STEPS, (latest, previous), strict=True):
            if one is not None and one.time:
                stride = max(1, len(one.time) // MOST_OF_STEP)
                time = np.array(one.time[::stride])
                part = (np.array(one.output[::stride]) - one.before) / (one.after - one.before)
                shown = time <= shown_until(Panel("", [Curve("", time, part, part)]))
                data = {"time": time[shown], name: part[shown]}
                if not all(np.array_equal(values, source.data[key]) for key, values in data.items()):
                    source.data = data

    def fit_effort(self, limits: tuple[float, float], gain: float) -> None:
        """Show the effort's limits where there are any, and a range that a kick of few samples does not flatten.

        Args:
            gain: from output to effort, by and large.
        """
        if limits != self._limits:
            self._limits = limits
            for span, limit in zip(self._spans, limits, strict=True):
                span.location = limit if math.isfinite(limit) else math.nan
        panel = _panel(self._signals, ("effort",), limits)
        if panel is None:
            return
        low, high, _ = effort_range(panel, math.inf)
        _fit(self._effort, low, high, abs(gain) * self._least)
        note = "; ".join(effort_notes(panel, math.inf))
        if note != self._note.text:
            self._note.text = note
        if (panel := _panel(self._terms, TERMS, limits)) is not None:
            low, high, _ = effort_range(panel, math.inf)
            _fit(self._parts, low, high, abs(gain) * self._least)


def _panel(source: ColumnDataSource, names: Sequence[str], limits: tuple[float, float]) -> Panel | None:
    """What has been streamed, to find its range; None: nothing yet."""
    data = {name: np.array(source.data[name], dtype=float) for name in ("time", *names)}
    curves = [Curve(name, data["time"], data[name], data[name]) for name in names]
    return Panel("", curves, limits) if len(data["time"]) else None


def _fit(plot: Any, low: float, high: float, least: float) -> None:
    """Show from `low` to `high`, at least so much of it, and a little more."""
    if not math.isfinite(low + high):
        return
    room = max(0.1 * (high - low), 0.5 * (least - (high - low)))
    shown = plot.y_range
    if low < shown.start or shown.end < high or shown.end - shown.start > MOST_ROOM * (high - low + 2.0 * room):
        shown.update(start=low - room, end=high + room)


def _empty(columns: Sequence[str]) -> ColumnDataSource:
    return ColumnDataSource(dict(zip(("time", *columns), repeat([]), strict=False)), name="+".join(columns))


def _some(items: Sequence[Any]) -> Sequence[Any]:
    """All of a few, or some of many, the last one among them."""
    stride = -(-len(items) // MOST_AT_ONCE) if len(items) < ROLLOVER else 1
    return items[-1::-stride][::-1]


def at_lane(values: np.ndarray, lane: int) -> float:
    """A lane's value; a single one stands for all lanes; nan where there is none."""
    if not len(values):
        return math.nan
    return float(values[lane] if lane < len(values) else values[-1])
