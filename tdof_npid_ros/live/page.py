"""One browser's page: plots that scroll, gains to move, what the nodes say. Built on Bokeh; no script of ours."""

from __future__ import annotations

import html
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJSTickFormatter,
    Div,
    NumericInput,
    Select,
    Slider,
    Span,
    Toggle,
)

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import PER_LANE, TUNED
from tdof_npid_ros.graph.observer import LoopObserver, Row
from tdof_npid_ros.interactive import CSS, finish_legend, new_plot
from tdof_npid_ros.live.steering import Steering
from tdof_npid_ros.live.step import Steps
from tdof_npid_ros.parameters import CONTROLLER_TYPES
from tdof_npid_ros.plotting import GUIDE, PALETTE

REFRESH_MS = 50  # plots
LOOK_MS = 500  # numbers, widgets and diagnostics
WINDOW = 20.0  # s that scroll by, at first, of a loop of which no case is known
ROLLOVER = 4000  # points of a curve that a browser holds
MOST_AT_ONCE = 400  # points that one refresh sends; a faster loop is thinned
DECADES = 2.0  # of a slider to either side of a gain that has no bounds
LINEAR = ("alpha", "beta")  # gains whose sliders are linear, from 0 to 1
SMALL_CSS = """
.loop { display: grid; grid-template-columns: minmax(0, 1fr) 22rem; gap: 1rem; }
@media (max-width: 800px) { .loop { grid-template-columns: minmax(0, 1fr); } }
.bk-input { font-size: 15px; } .refused { color: #d55e00; font-size: 14px; }
"""
TEMPLATE = (
    "{% block title %}Live loop{% endblock %}{% block postamble %}<style>"
    + CSS
    + SMALL_CSS
    + "</style>{% endblock %}{% block contents %}<h1>Live loop</h1>{{ embed(roots.numbers) }}"
    '<div class="loop"><div>{{ embed(roots.plots) }}</div><div>{{ embed(roots.controls) }}</div></div>'
    "{{ embed(roots.nodes) }}{% endblock %}"
)
Handler = Callable[[str, Any, Any], None]
DOWN = "the loop stands still: no answers come"


class LivePage:
    """What one browser shows; all of them share the observer and the steering.

    Args:
        document: of this browser.
        observer, steering: of the loop.
        case: its parameter file, where the user named one: for the ranges of the sliders.
        keep_in: folder that kept gains are written to.
        record: begins or ends a recording, and says where it goes; None: there is none.
    """

    def __init__(
        self,
        document: Document,
        observer: LoopObserver,
        steering: Steering,
        case: Case | None,
        keep_in: Path,
        record: Callable[[bool], str] | None = None,
    ) -> None:
        self._document, self._observer, self._steering, self._case = document, observer, steering, case
        self._keep_in, self._record = keep_in, record
        self._lane = 0
        self._seen = observer.count
        self._steps = Steps()
        self._shown: dict[str, Any] = {}
        self._period = 0.01
        self._make_plots()
        self._make_controls()
        self._numbers = Div(text="", name="numbers", sizing_mode="stretch_width")
        self._nodes = Div(text="", name="nodes", sizing_mode="stretch_width")
        document.template = TEMPLATE
        document.title = "Live loop"
        for root in (self._plots, self._controls, self._numbers, self._nodes):
            document.add_root(root)
        document.add_periodic_callback(self.refresh, REFRESH_MS)
        document.add_periodic_callback(self.look, LOOK_MS)
        self.look()

    # Plots

    def _make_plots(self) -> None:
        self._signals = ColumnDataSource({name: [] for name in ("t", "r", "y", "u", "applied")})
        self._terms = ColumnDataSource({name: [] for name in ("t", "p", "i", "d")})
        self._latest_step = ColumnDataSource({"t": [], "y": []})
        self._previous_step = ColumnDataSource({"t": [], "y": []})
        output = new_plot("output", 260)
        effort = new_plot("effort", 190, x_range=output.x_range)
        terms = new_plot("P, I, D", 170, x_range=output.x_range)
        step = new_plot("latest step", 220)
        output.line(
            "t", "r", source=self._signals, legend_label="setpoint", name="setpoint", color=GUIDE, line_dash="dashed"
        )
        output.line(
            "t", "y", source=self._signals, legend_label="output", name="output", color=PALETTE[0], line_width=2
        )
        effort.step(
            "t",
            "u",
            source=self._signals,
            legend_label="effort",
            name="effort",
            color=PALETTE[1],
            line_width=2,
            mode="after",
        )
        effort.step(
            "t",
            "applied",
            source=self._signals,
            legend_label="applied",
            name="applied",
            color=PALETTE[2],
            line_dash="dotted",
            mode="after",
        )
        for name, colour in zip("pid", PALETTE, strict=False):
            terms.line("t", name, source=self._terms, legend_label=name.upper(), name=name.upper(), color=colour)
        step.line(
            "t",
            "y",
            source=self._previous_step,
            legend_label="the one before",
            name="the one before",
            color=GUIDE,
            line_dash="dashed",
        )
        step.line(
            "t",
            "y",
            source=self._latest_step,
            legend_label="latest step",
            name="latest step",
            color=PALETTE[0],
            line_width=2,
        )
        step.xaxis.axis_label = "time since the step (s)"
        self._limits = [Span(location=math.nan, dimension="width", line_color=GUIDE, line_width=1) for _ in range(2)]
        for span in self._limits:
            effort.add_layout(span)
        for plot in (output, effort, terms, step):
            finish_legend(plot)
        for plot in (effort, terms):
            plot.toolbar_location = None
        output.x_range.follow, output.x_range.follow_interval, output.x_range.range_padding = "end", self._window(), 0.0
        self._plots = column(output, effort, terms, step, name="plots", sizing_mode="stretch_width")

    # Controls

    def _make_controls(self) -> None:
        steering = self._steering
        self._sliders: dict[str, Slider] = {}
        self._fields: dict[str, NumericInput] = {}
        self._reasons = {
            name: Div(text="", css_classes=["refused"], visible=False) for name in (*PER_LANE, "type", "other")
        }
        rows: list[Any] = []
        self._type = Select(title="controller", options=list(CONTROLLER_TYPES), value="tdof_npid2", name="type")
        self._type.on_change("value", lambda _, __, new: self._ask({"type": new}))
        rows += [self._type, self._reasons["type"]]
        for name in PER_LANE:
            slider = self._slider(name)
            given = NumericInput(value=None, mode="float", width=110, name=f"{name}_field")
            slider.on_change(
                "value_throttled", lambda _, __, new, name=name: self._ask({name: self._of_slider(name, new)})
            )
            given.on_change("value", self._asking(name))
            self._sliders[name], self._fields[name] = slider, given
            rows += [row(slider, given, sizing_mode="stretch_width"), self._reasons[name]]
        undo, redo = Button(label="undo", name="undo"), Button(label="redo", name="redo")
        keep, self._kept = Button(label="keep", name="keep"), Div(text="", name="kept")
        undo.on_click(steering.undo)
        redo.on_click(steering.redo)
        keep.on_click(self._keep)
        rows += [row(undo, redo, keep), self._kept]
        begins = 0.0 if self._case is None else self._case.plant.initial_output
        size = 1.0 if self._case is None else self._case.largest_step or 1.0
        self._setpoint = NumericInput(title="setpoint", value=begins, mode="float", width=110, name="setpoint_field")
        self._size = NumericInput(title="step by", value=size, mode="float", width=110, name="size")
        up, down = Button(label="step up", name="step_up"), Button(label="step down", name="step_down")
        self._setpoint.on_change("value", _given(steering.setpoint))
        up.on_click(lambda: self._step(1.0))
        down.on_click(lambda: self._step(-1.0))
        rows += [row(self._setpoint, self._size), row(up, down)]
        disturbance = NumericInput(title="disturbance", value=0.0, mode="float", width=110, name="disturbance_field")
        disturbance.on_change("value", _given(steering.disturbance))
        self._manual = Toggle(label="by hand", name="manual")
        self._manual.on_change("active", self._on_manual)
        self._by_hand = NumericInput(title="effort by hand", value=0.0, mode="float", width=110, name="by_hand")
        self._by_hand.on_change("value", self._asking("manual_effort"))
        reset = Button(label="reset the plant", name="reset")
        reset.on_click(steering.reset)
        rows += [row(disturbance, self._by_hand), row(self._manual, reset), self._reasons["other"]]
        if self._record is not None:
            self._recording = Toggle(label="record", name="record")
            self._recorded = Div(text="", name="recorded")
            self._recording.on_change("active", self._on_record)
            rows += [self._recording, self._recorded]
        self._controls = column(*rows, name="controls", sizing_mode="stretch_width")

    def _slider(self, name: str) -> Slider:
        if name in LINEAR:
            look: dict[str, Any] = {"title": name, "name": name, "format": "0.000", "sizing_mode": "stretch_width"}
            return Slider(start=0.0, end=1.0, step=0.001, value=0.0, **look)
        shown = CustomJSTickFormatter(code="return (10 ** tick).toPrecision(4)")
        return Slider(
            start=-3.0, end=3.0, step=0.001, value=0.0, title=name, format=shown, name=name, sizing_mode="stretch_width"
        )

    def _fit_slider(self, name: str, value: float) -> None:
        """A slider's ends: the tuner's bounds, or some decades around the value; its value."""
        slider, bounds = self._sliders[name], self._case.bounds.get(name) if self._case else None
        if name in LINEAR:
            slider.update(start=min(0.0, value), end=max(1.0, value), value=value)
            return
        size = abs(value)
        if bounds is not None and max(map(abs, bounds)) > 0:
            most = max(map(abs, bounds))
            least = min(map(abs, bounds)) or most * 1e-4
        else:
            most, least = (size or 1.0) * 10**DECADES, (size or 1.0) * 10**-DECADES
        least, most = min(least, size or least), max(most, size)
        at = math.log10(size) if size else math.log10(least)
        slider.update(start=math.log10(least), end=math.log10(most), value=at)

    def _of_slider(self, name: str, at: float) -> float:
        if name in LINEAR:
            return round(at, 6)
        sign = -1.0 if any((self._scalar(gain) or 0.0) < 0 for gain in ("kp", "ki", "kd")) and name != "sigma" else 1.0
        return float(f"{sign * 10**at:.4g}")

    def _scalar(self, name: str) -> float | None:
        value = self._steering.values.get(name)
        if isinstance(value, (list, tuple)):
            value = value[min(self._lane, len(value) - 1)]
        return None if value is None else float(value)

    def _asking(self, name: str) -> Handler:
        return _given(lambda value: self._ask({name: value}))

    def _ask(self, values: dict[str, Any]) -> None:
        """Ask for a change by hand; what the loop has already is none."""
        now = self._steering.values
        if now and any(now.get(name) != value for name, value in values.items()):
            self._steering.change(values)

    def _on_manual(self, _: str, __: bool, active: bool) -> None:
        rows, _count = self._observer.rows_since(self._observer.count - 1)
        values: dict[str, Any] = {"manual": active}
        if active and rows:
            values["manual_effort"] = float(rows[-1].effort[self._lane])  # from where the effort is
        self._ask(values)

    def _window(self) -> float:
        """How many seconds scroll by: an episode, or as much of it as a browser holds."""
        if self._case is None or not self._case.plans:
            return WINDOW
        shortest = min(plan.end_ns for plan in self._case.plans.values()) / 1e9
        return min(shortest, ROLLOVER * self._case.sample_period)

    def _step(self, sign: float) -> None:
        rows, _ = self._observer.rows_since(self._observer.count - 1)
        now = float(rows[-1].setpoint[self._lane]) if rows else float(self._setpoint.value or 0.0)
        self._setpoint.value = now + sign * float(self._size.value or 0.0)

    def _keep(self) -> None:
        path = _free(self._keep_in, "gains", ".yaml")
        try:
            self._steering.keep(path)
        except ValueError as error:
            self._kept.text = f'<span class="refused">{html.escape(str(error))}</span>'
        else:
            self._kept.text = f"written: {html.escape(str(path))}"

    def _on_record(self, _: str, __: bool, active: bool) -> None:
        assert self._record is not None
        try:
            self._recorded.text = html.escape(self._record(active))
        except (ValueError, OSError, RuntimeError) as error:
            self._recorded.text = f'<span class="refused">{html.escape(str(error))}</span>'

    # Now and then

    def refresh(self) -> None:
        """Send what has come since."""
        rows, self._seen = self._observer.rows_since(self._seen)
        if not rows:
            return
        lane = min(self._lane, len(rows[-1].output) - 1)
        for one in rows:
            self._steps.take(one.time, one.episode, _at(one.setpoint, lane), _at(one.output, lane))
        if len(rows) > 1:
            self._period = max((rows[-1].time - rows[0].time) / (len(rows) - 1), 1e-9)
        self._signals.stream(_columns(_some(rows), lane), rollover=ROLLOVER)

    def look(self) -> None:
        """Bring numbers, widgets and diagnostics up to date."""
        self._show_values()
        self._show_step()
        self._numbers.text = self._numbers_text()
        self._nodes.text = self._nodes_text()
        terms = list(self._observer.terms)[-ROLLOVER // 4 :]
        if terms:
            lane = min(self._lane, terms[-1][1].shape[1] - 1)
            p, i, d = (np.array([values[k, lane] for _, values in terms]) for k in (2, 3, 4))
            self._terms.data = {"t": np.array([time for time, _ in terms]), "p": p, "i": i, "d": d}

    def _show_values(self) -> None:
        """Set widgets to what the controller has, and reasons beside what it refused."""
        steering = self._steering
        for name, reason in self._reasons.items():
            names = [name] if name != "other" else [n for n in steering.problems if n not in self._reasons]
            found = "; ".join(steering.problems[n] for n in names if n in steering.problems)
            reason.update(text=html.escape(found), visible=bool(found))
        if not steering.values:
            return
        for name in PER_LANE:
            value = self._scalar(name)
            refused = name in steering.problems
            if value is not None and (self._shown.get(name) != value or refused):
                self._shown[name] = value
                self._fit_slider(name, value)
                self._fields[name].value = value
            used = name == "sigma" if steering.values["type"] != "pid" else False
            self._sliders[name].disabled = not (name in TUNED[steering.values["type"]] or used)
        for widget, attribute, name in (
            (self._type, "value", "type"),
            (self._manual, "active", "manual"),
        ):
            if self._shown.get(name) != steering.values[name] or name in steering.problems:
                self._shown[name] = steering.values[name]
                setattr(widget, attribute, steering.values[name])
        for span, limit in zip(self._limits, ("effort_min", "effort_max"), strict=True):
            value = self._scalar(limit)
            span.location = value if value is not None and math.isfinite(value) else math.nan

    def _show_step(self) -> None:
        for source, one in ((self._latest_step, self._steps.latest), (self._previous_step, self._steps.previous)):
            if one is None:
                continue
            stride = max(1, len(one.time) // 1000)
            source.data = {"t": one.time[::stride], "y": one.output[::stride]}

    def _numbers_text(self) -> str:
        parts = []
        step = self._steps.latest
        measured = step and step.metrics(self._period * self._steps.stride)
        if measured:
            settled = "not settled yet" if measured.settling_time_s is None else f"{measured.settling_time_s:.3g} s"
            parts.append(
                f"<b>latest step</b> overshoot {measured.overshoot_percent:.1f} %, settling time {settled}, "
                f"IAE {measured.iae:.4g}"
            )
        margins = self._steering.margins
        if margins is not None and margins.stable:
            delay = "no limit" if margins.delay_margin_s is None else f"{margins.delay_margin_s:.3g} s"
            parts.append(f"<b>margins</b> M_s {margins.m_s:.2f}, delay margin {delay}")
        elif margins is not None:
            parts.append(f'<b>margins</b> <span class="refused">{html.escape(str(margins.reason))}</span>')
        else:
            parts.append(f"<b>margins</b> {html.escape(self._steering.why_no_margins)}")
        if not self._observer.runs:
            parts.insert(0, f'<span class="refused">{DOWN}</span>')
        return " · ".join(parts)

    def _nodes_text(self) -> str:
        lines = [
            f"<b>{html.escape(name)}</b> {html.escape(state.text)}"
            for name, state in sorted(self._observer.nodes.items())
        ]
        return "<br>".join(lines) or "No node of this loop has said anything yet."


def _given(take: Callable[[float], None]) -> Handler:
    """What a field does with a new value; an empty field means nothing."""

    def on_change(_: str, __: Any, new: float | None) -> None:
        if new is not None:
            take(new)

    return on_change


def _some(rows: list[Row]) -> list[Row]:
    stride = -(-len(rows) // MOST_AT_ONCE)
    return rows[-1::-stride][::-1]


def _at(values: np.ndarray, lane: int) -> float:
    """A lane's value; a single one stands for all lanes; nan where there is none."""
    if not len(values):
        return math.nan
    return float(values[lane] if lane < len(values) else values[-1])


def _columns(rows: list[Row], lane: int) -> dict[str, list[float]]:
    return {
        "t": [one.time for one in rows],
        "r": [_at(one.setpoint, lane) for one in rows],
        "y": [_at(one.output, lane) for one in rows],
        "u": [_at(one.effort, lane) for one in rows],
        "applied": [_at(one.applied, lane) for one in rows],
    }


def _free(folder: Path, name: str, ending: str) -> Path:
    """A file that is not there yet."""
    for number in range(1, 10_000):
        path = folder / f"{name}-{number}{ending}"
        if not path.exists():
            return path
    raise FileExistsError(f"{folder}: there are too many {name}-….{ending} already")
