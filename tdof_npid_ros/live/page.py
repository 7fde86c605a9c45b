"""One browser's page: plots that scroll, gains to move, what the nodes say. Built on Bokeh; no script of ours."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import Checkbox, Div, Select

from tdof_npid_ros.control.gains import LIMITS_PER_LANE
from tdof_npid_ros.interactive import CSS, TABLES, fit_to_screen
from tdof_npid_ros.live.gain_controls import GainControls
from tdof_npid_ros.live.hand import Hand
from tdof_npid_ros.live.plots import ROLLOVER, LivePlots, at_lane
from tdof_npid_ros.live.step import Steps
from tdof_npid_ros.live.tune_controls import TuneControls
from tdof_npid_ros.live.view import LiveLoop, View, of_lane
from tdof_npid_ros.units import Units

REFRESH_MS = 20  # plots, at most so often
LOOK_MS = 500  # numbers, widgets and diagnostics
WINDOW = 20.0  # s that scroll by, at first, of a loop of which no case is known
LOOP_CSS = """
.loop { display: grid; grid-template-columns: minmax(0, 1fr) 22rem; grid-template-rows: min-content 1fr; gap: 0 1rem; }
.controls { grid-column: 2; grid-row: 1 / 3; } .proposal, .plots { grid-column: 1; }
@media (max-width: 800px) { .loop { display: flex; flex-direction: column; } .plots { order: -1; } }
"""
REFUSED_CSS = ".refused, :host(.refused) { color: #d55e00; font-size: 14px; }"
TEMPLATE = (
    '{% block preamble %}<meta name="viewport" '
    'content="width=device-width, initial-scale=1">{% endblock %}{% block postamble %}<style>'
    + CSS
    + LOOP_CSS
    + "</style>{% endblock %}{% block contents %}<h1>{{ title | e }}</h1>"
    "{{ embed(roots.choice) }}{{ embed(roots.numbers) }}"
    '<div class="loop"><div class="controls">{{ embed(roots.controls) }}</div>'
    '<div class="proposal">{{ embed(roots.proposal) }}</div><div class="plots">{{ embed(roots.plots) }}'
    "{{ embed(roots.nodes) }}</div></div>{% endblock %}"
)
DOWN = "the loop stands still: no answers come"


class LivePage:
    """What one browser shows; all of them share the loops.

    Args:
        document: of this browser.
        loops: to choose from; the first one is shown.
        keep_in: folder that kept gains are written to.
    """

    def __init__(self, document: Document, loops: Sequence[LiveLoop], keep_in: Path) -> None:
        self._loops = {loop.namespace: loop for loop in loops}
        self._view = view = View(loops[0])
        case = view.loop.case
        step, units = (1.0, Units()) if case is None else (case.largest_step or 1.0, case.units)
        self._plots = LivePlots(self._window(), step, units)
        self._gains = GainControls(view, keep_in)
        self._hand = Hand(view, self._gains.told)
        self._tune = TuneControls(view)
        names = list(self._loops)
        self._which_loop = Select(title="loop", options=names, value=names[0], name="loop", visible=len(names) > 1)
        self._which_lane = Select(title="lane", options=["0"], value="0", name="lane", visible=False)
        self._alone = Checkbox(label="gains of this lane alone", name="alone", visible=False)
        self._which_loop.on_change("value", lambda _, __, new: self._choose(self._loops[new], 0))
        self._which_lane.on_change("value", lambda _, __, new: self._choose(view.loop, int(new)))
        self._alone.on_change("active", lambda _, __, new: setattr(view, "alone", new))
        self._numbers = Div(text="", name="numbers", sizing_mode="stretch_width")
        self._nodes = Div(text="", name="nodes", sizing_mode="stretch_width")
        controls = (self._gains.layout, self._hand.layout, self._tune.layout)
        for part in controls:
            part.sizing_mode = "stretch_width"
        document.template = TEMPLATE
        document.title = "Live loop" + (f": {case.name}" if case is not None else "")
        for root in (
            row(self._which_loop, self._which_lane, self._alone, name="choice"),
            self._numbers,
            self._tune.look_layout,
            self._plots.layout,
            column(*controls, name="controls", sizing_mode="stretch_width"),
            self._nodes,
        ):
            for div in root.select({"type": Div}):
                div.stylesheets = [*div.stylesheets, TABLES, REFUSED_CSS]
            document.add_root(root)
        fit_to_screen(document)
        self._begin()
        document.add_periodic_callback(self.refresh, REFRESH_MS)
        document.add_periodic_callback(self.look, LOOK_MS)
        self.refresh()
        self.look()

    def _begin(self) -> None:
        """Show what has been heard of the loop lately, and go on from there."""
        observer = self._view.loop.observer
        self._seen, self._seen_terms = observer.count - ROLLOVER, observer.term_count - ROLLOVER
        self._steps, self._period = Steps(), 0.01
        self._plots.clear()

    def _choose(self, loop: LiveLoop, lane: int) -> None:
        if (loop, lane) == (self._view.loop, self._view.lane):
            return
        self._view.loop, self._view.lane = loop, lane
        self._which_lane.value = str(lane)
        self._begin()
        self._gains.forget()
        self._hand.forget()
        self.refresh()
        self.look()

    def _window(self) -> float:
        """How many seconds scroll by: an episode, or as much of it as a browser holds."""
        case = self._view.loop.case
        if case is None or not case.plans:
            return WINDOW
        shortest = min(plan.end_ns for plan in case.plans.values()) / 1e9
        return min(shortest, ROLLOVER * case.sample_period)

    # Now and then

    def refresh(self) -> None:
        """Send what has come since, unless the browser is not there yet with what it has."""
        observer, lane = self._view.loop.observer, self._view.lane
        if self._plots.waits(observer.latest, lane):
            return
        rows, self._seen = observer.rows_since(self._seen)
        terms, self._seen_terms = observer.terms_since(self._seen_terms)
        if terms:
            self._plots.add_terms(terms, lane)
        if not rows:
            return
        for one in rows:
            self._steps.take(one.time, one.episode, at_lane(one.setpoint, lane), at_lane(one.output, lane))
        if len(rows) > 1:
            self._period = max((rows[-1].time - rows[0].time) / (len(rows) - 1), 1e-9)
        self._plots.add(rows, lane)

    def look(self) -> None:
        """Bring numbers, widgets and diagnostics up to date."""
        view, names = self._view, self._view.loop.observer.lane_names
        self._which_lane.visible = self._alone.visible = len(names) > 1
        options: list[Any] = [(str(lane), name) for lane, name in enumerate(names)]
        if options and self._which_lane.options != options:
            self._which_lane.options = options
        for part in (self._gains, self._hand, self._tune):
            part.look()
        low, high = LIMITS_PER_LANE
        limits = [(view.parameter(name), view.loop.steering.plant.get(name)) for name in (low, high)]
        lower, upper = ([float(one) for one in found if one is not None] for found in limits)
        limited = max(lower, default=-math.inf), min(upper, default=math.inf)
        self._plots.fit_effort(limited, view.parameter("kp") or 1.0)
        self._plots.show_steps(self._steps.latest, self._steps.previous)
        self._numbers.text = self._numbers_text()
        self._nodes.text = self._nodes_text()

    def _numbers_text(self) -> str:
        parts = []
        steering, step = self._view.loop.steering, self._steps.latest
        measured = step and step.metrics(self._period * self._steps.stride)
        if measured:
            settled = "not settled yet" if measured.settling_time_s is None else f"{measured.settling_time_s:.3g} s"
            parts.append(
                f"<b>latest step</b> overshoot {measured.overshoot_percent:.1f} %, settling time {settled}, "
                f"IAE {measured.iae:.4g}"
            )
        margins = of_lane(steering.margins, self._view.lane) if steering.margins else None
        if margins is not None and margins.stable:
            delay = "no limit" if margins.delay_margin_s is None else f"{margins.delay_margin_s:.3g} s"
            parts.append(f"<b>margins</b> M_s {margins.m_s:.2f}, delay margin {delay}")
        elif margins is not None:
            parts.append(f'<b>margins</b> <span class="refused">{html.escape(str(margins.reason))}</span>')
        else:
            parts.append(f"<b>margins</b> {html.escape(steering.why_no_margins)}")
        if not self._view.loop.observer.runs:
            parts.insert(0, f'<span class="refused">{DOWN}</span>')
        return " · ".join(parts)

    def _nodes_text(self) -> str:
        lines = [
            f"<b>{html.escape(name)}</b> {html.escape(state.text)}"
            for name, state in sorted(self._view.loop.observer.nodes.items())
        ]
        return "<br>".join(lines) or "No node of this loop has said anything yet."
