"""The page's hand on the loop: setpoint, step, disturbance, manual and automatic, reset, record."""

from __future__ import annotations

import html
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, Div, NumericInput, Toggle

from tdof_npid_ros.graph.observer import Row
from tdof_npid_ros.live.gain_controls import ask, given
from tdof_npid_ros.live.view import View, of_lane


class Hand:
    """What moves the loop.

    Args:
        view: what the page looks at.
        told: whose refusals are told elsewhere.

    Attributes:
        layout: what the page shows.
    """

    def __init__(self, view: View, told: tuple[str, ...]) -> None:
        self._view, self._told = view, told
        self._shown: dict[str, Any] = {}
        self._disturbances: list[float] = []
        self._setpoint = _field("setpoint", "setpoint_field")
        self._size = _field("step by", "size")
        up, down = Button(label="step up", name="step_up"), Button(label="step down", name="step_down")
        self._disturbance = _field("disturbance", "disturbance_field")
        self._manual = Toggle(label="by hand", name="manual")
        self._by_hand = _field("effort by hand", "by_hand")
        reset = Button(label="reset the plant", name="reset")
        self._record = Toggle(label="record", name="record")
        self._recorded = Div(text="", name="recorded")
        self._reason = Div(text="", css_classes=["refused"], visible=False)
        self._setpoint.on_change("value", given(self._on_setpoint))
        up.on_click(lambda: self._step(1.0))
        down.on_click(lambda: self._step(-1.0))
        self._disturbance.on_change("value", given(self._on_disturbance))
        self._manual.on_change("active", self._on_manual)
        self._by_hand.on_change("value", given(self._on_effort))
        reset.on_click(lambda: view.loop.steering.reset())
        self._record.on_change("active", self._on_record)
        self.layout = column(
            row(self._setpoint, self._size),
            row(up, down),
            row(self._disturbance, self._by_hand),
            row(self._manual, reset, self._record),
            self._reason,
            self._recorded,
            name="hand",
        )
        self.forget()

    def forget(self) -> None:
        """Begin anew: another loop or lane is looked at."""
        case, rows = self._view.loop.case, self._latest()
        self._shown.clear()
        self._disturbances = []
        begins = 0.0 if case is None else case.plant.initial_output
        self._shown["setpoint"] = of_lane(rows[-1].setpoint.tolist(), self._view.lane) if rows else begins
        self._setpoint.value = self._shown["setpoint"]
        self._size.value = 1.0 if case is None else case.largest_step or 1.0
        self._disturbance.value = self._by_hand.value = 0.0

    def look(self) -> None:
        """Show what the controller has, and what was refused."""
        steering, recordings = self._view.loop.steering, self._view.loop.recordings
        found = "; ".join(reason for name, reason in list(steering.problems.items()) if name not in self._told)
        self._reason.update(text=html.escape(found), visible=bool(found))
        if steering.values and (
            self._shown.get("manual") != steering.values["manual"] or "manual" in steering.problems
        ):
            self._shown["manual"] = self._manual.active = steering.values["manual"]
        recordings.look()
        self._look_at_recordings()

    def _look_at_recordings(self) -> None:
        recordings = self._view.loop.recordings
        self._record.active = recordings.runs
        told = html.escape(recordings.told)
        self._recorded.text = f'<span class="refused">{told}</span>' if recordings.failed else told

    def _latest(self) -> list[Row]:
        observer = self._view.loop.observer
        return observer.rows_since(observer.count - 1)[0]

    def _on_setpoint(self, value: float) -> None:
        if value != self._shown.get("setpoint"):
            self._shown["setpoint"] = value
            rows = self._latest()
            self._view.loop.steering.setpoint(self._of_lanes(rows[-1].setpoint.tolist() if rows else [], value))

    def _on_disturbance(self, value: float) -> None:
        now = self._disturbances or [0.0] * self._view.lanes
        if value != of_lane(now, self._view.lane):
            self._disturbances = self._of_lanes(now, value)
            self._view.loop.steering.disturbance(self._disturbances)

    def _of_lanes(self, now: list[float], value: float) -> list[float]:
        """The values that stand, with this lane's changed."""
        lane = self._view.lane
        return [value if k == lane else now[k] for k in range(len(now))] if lane < len(now) else [value]

    def _step(self, sign: float) -> None:
        rows = self._latest()
        now = float(of_lane(rows[-1].setpoint.tolist(), self._view.lane)) if rows else float(self._setpoint.value or 0)
        self._setpoint.value = now + sign * float(self._size.value or 0.0)

    def _on_manual(self, _: str, __: bool, active: bool) -> None:
        rows = self._latest()
        values: dict[str, Any] = {"manual": active}
        if active and rows:  # from where the effort is
            efforts = rows[-1].effort.tolist()
            values["manual_effort"] = efforts if len(efforts) > 1 else efforts[0]
        if active != self._view.loop.steering.values.get("manual"):
            ask(self._view, values)

    def _on_effort(self, value: float) -> None:
        now = self._view.loop.steering.values.get("manual_effort")
        if value != of_lane(now, self._view.lane) and now is not None:
            lanes = [of_lane(now, lane) for lane in range(self._view.lanes)]
            ask(self._view, {"manual_effort": self._of_lanes(lanes, value) if len(lanes) > 1 else value})

    def _on_record(self, _: str, __: bool, active: bool) -> None:
        if active != self._view.loop.recordings.runs:
            self._view.loop.recordings.switch(active)
            self._look_at_recordings()


def _field(title: str, name: str) -> NumericInput:
    return NumericInput(title=title, value=0.0, mode="float", width=140, name=name)
