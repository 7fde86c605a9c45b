"""The page's gains: the controller's type, a slider and a field for each gain, and the reason where one is refused."""

from __future__ import annotations

import html
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, CustomJSTickFormatter, Div, NumericInput, Select, Slider

from tdof_npid_ros.control.gains import PER_LANE, TUNED
from tdof_npid_ros.live.view import View
from tdof_npid_ros.parameters import CONTROLLER_TYPES

DECADES = 2.0  # of a slider to either side of a gain that has no bounds
LINEAR = ("alpha", "beta")  # gains whose sliders are linear, from 0 to 1
ZERO = ("kp", "ki", "kd")  # gains that may be 0, which has a place of its own below the least of a scale in decades
ROOM_FOR_ZERO = 0.08  # of the slider
# A slider tells its value from its place: tags are the gain's sign, and the place below which it is 0.
TOLD = "const [sign, zero] = slider.tags; return tick < zero ? '0' : (sign * 10 ** tick).toPrecision(4)"
DIGITS = "return Number(tick.toPrecision(6)).toString()"  # what a field shows of a number; it keeps all of it
Handler = Callable[[str, Any, Any], None]


class GainControls:
    """What sets gains.

    Args:
        view: what the page looks at.
        keep_in: folder that kept gains are written to.

    Attributes:
        layout: what the page shows.
    """

    def __init__(self, view: View, keep_in: Path) -> None:
        self._view, self._keep_in = view, keep_in
        self._shown: dict[str, Any] = {}
        self._sliders: dict[str, Slider] = {}
        self._fields: dict[str, NumericInput] = {}
        self._reasons = {
            name: Div(text="", css_classes=["refused"], visible=False) for name in (*PER_LANE, "type", "undo")
        }
        self._type = Select(title="controller", options=list(CONTROLLER_TYPES), value="tdof_npid2", name="type")
        self._type.on_change("value", lambda _, __, new: ask(view, {"type": new}))
        rows: list[Any] = [self._type, self._reasons["type"]]
        for name in PER_LANE:
            slider = _slider(name)
            digits = CustomJSTickFormatter(code=DIGITS)
            field = NumericInput(value=None, mode="float", format=digits, width=110, name=f"{name}_field")
            slider.on_change("value_throttled", self._moved(name))
            field.on_change("value", given(lambda value, name=name: self._set(name, value)))  # type: ignore[misc]
            self._sliders[name], self._fields[name] = slider, field
            rows += [row(slider, field, sizing_mode="stretch_width"), self._reasons[name]]
        undo, redo = Button(label="undo", name="undo"), Button(label="redo", name="redo")
        keep, self._kept = Button(label="keep", name="keep"), Div(text="", name="kept")
        undo.on_click(lambda: view.loop.steering.undo())
        redo.on_click(lambda: view.loop.steering.redo())
        keep.on_click(self._keep)
        self.layout = column(*rows, row(undo, redo, keep), self._reasons["undo"], self._kept, name="gains")

    @property
    def told(self) -> tuple[str, ...]:
        """Whose refusals are told here."""
        return tuple(self._reasons)

    def forget(self) -> None:
        """Show everything anew: another loop or lane is looked at."""
        self._shown.clear()
        self._kept.text = ""

    def look(self) -> None:
        """Show what the controller has, and reasons beside what it refused."""
        steering = self._view.loop.steering
        for name, reason in self._reasons.items():
            text = html.escape(steering.problems.get(name, ""))
            reason.update(text=text, visible=bool(text))
        if not steering.values:
            return
        kind = steering.values["type"]
        for name in PER_LANE:
            value = self._view.parameter(name)
            if value is not None and (self._shown.get(name) != value or name in steering.problems):
                self._shown[name] = value
                self._fit(name, float(value))
                self._fields[name].value = float(value)
            self._sliders[name].disabled = not (name in TUNED[kind] or (name == "sigma" and kind != "pid"))
        if self._shown.get("type") != kind or "type" in steering.problems:
            self._shown["type"] = kind
            self._type.value = kind

    def _moved(self, name: str) -> Handler:
        return lambda _, __, place: self._set(name, self._of_place(name, place))

    def _set(self, name: str, value: float) -> None:
        if value != self._view.parameter(name):
            ask(self._view, {name: self._view.for_lane(name, value)})

    def _fit(self, name: str, value: float) -> None:
        """A slider's ends: the tuner's bounds, or some decades around the value; its place."""
        slider, case = self._sliders[name], self._view.loop.case
        if name in LINEAR:
            slider.update(start=min(0.0, value), end=max(1.0, value), value=value)
            return
        size, bounds = abs(value), case.bounds.get(name) if case else None
        if bounds is not None and max(map(abs, bounds)) > 0:
            most = max(map(abs, bounds))
            least = min(map(abs, bounds)) or most * 1e-4
        else:
            most, least = (size or 1.0) * 10**DECADES, (size or 1.0) * 10**-DECADES
        start, end = math.log10(min(least, size or least)), math.log10(max(most, size))
        zero, begin = start, start
        if name in ZERO:
            begin = start - ROOM_FOR_ZERO * (end - start)
            zero = 0.5 * (begin + start)
        slider.update(start=begin, end=end, tags=[self._sign(name), zero], value=math.log10(size) if size else begin)

    def _sign(self, name: str) -> float:
        """-1 for the gains of a reverse-acting controller."""
        reverse = any((self._view.parameter(gain) or 0.0) < 0 for gain in ZERO)
        return -1.0 if reverse and name in ZERO else 1.0

    def _of_place(self, name: str, place: float) -> float:
        if name in LINEAR:
            return round(place, 6)
        _, zero = self._sliders[name].tags
        return 0.0 if place < zero else float(f"{self._sign(name) * 10**place:.4g}")

    def _keep(self) -> None:
        path = _free(self._keep_in, "gains", ".yaml")
        try:
            self._view.loop.steering.keep(path)
        except ValueError as error:
            self._kept.text = f'<span class="refused">{html.escape(str(error))}</span>'
        else:
            self._kept.text = f"written: {html.escape(str(path))}"


def ask(view: View, values: dict[str, Any]) -> None:
    """Ask for a change by hand; what the loop has already is none."""
    now = view.loop.steering.values
    if now and any(now.get(name) != value for name, value in values.items()):
        view.loop.steering.change(values)


def given(take: Callable[[float], None]) -> Handler:
    """What a field does with a new value; an empty field means nothing."""

    def on_change(_: str, __: Any, new: float | None) -> None:
        if new is not None:
            take(new)

    return on_change


def _slider(name: str) -> Slider:
    look: dict[str, Any] = {"title": name, "name": name, "step": 0.001, "value": 0.0, "sizing_mode": "stretch_width"}
    if name in LINEAR:
        return Slider(start=0.0, end=1.0, format="0.000", **look)
    slider = Slider(start=-3.0, end=3.0, tags=[1.0, -3.0], **look)
    slider.format = CustomJSTickFormatter(args={"slider": slider}, code=TOLD)
    return slider


def _free(folder: Path, name: str, ending: str) -> Path:
    """A file that is not there yet."""
    for number in range(1, 10_000):
        path = folder / f"{name}-{number}{ending}"
        if not path.exists():
            return path
    raise FileExistsError(f"{folder}: there are too many {name}-….{ending} already")
