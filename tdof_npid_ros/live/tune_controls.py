"""The page's tuning: begin it, see how far it is, look at what it found, and only then apply it."""

from __future__ import annotations

import html
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, Div

from tdof_npid_ros.control.gains import PER_LANE, GainsError
from tdof_npid_ros.interactive import TABLES, fit_elements, response_plots, table_html
from tdof_npid_ros.live.gain_controls import ask
from tdof_npid_ros.live.tuning import Failure, Progress, Proposal
from tdof_npid_ros.live.view import View


class TuneControls:
    """What finds gains.

    Args:
        view: what the page looks at.

    Attributes:
        layout: buttons and progress.
        look_layout: the predicted responses, while there is something to look at.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._shown: Any = None
        self._tune = Button(label="tune", name="tune")
        self._stop = Button(label="stop", name="stop_tuning", visible=False)
        self._apply = Button(label="apply", name="apply", visible=False)
        self._discard = Button(label="discard", name="discard", visible=False)
        self._told = Div(text="", name="tuning")
        self._tune.on_click(self._start)
        self._apply.on_click(self._on_apply)
        for button in (self._stop, self._discard):
            button.on_click(lambda: view.loop.tuning.stop())
        self.layout = column(row(self._tune, self._stop, self._apply, self._discard), self._told, name="tune_controls")
        self._nothing = Div(text="")
        self.look_layout = column(self._nothing, name="proposal", visible=False, sizing_mode="stretch_width")

    def look(self) -> None:
        """Show how far the search is, or what it found."""
        state = self._view.loop.tuning.state
        if state is self._shown:
            return
        self._shown = state
        found = isinstance(state, Proposal)
        self._tune.visible = state is None or isinstance(state, Failure)
        self._stop.visible = isinstance(state, Progress)
        self._apply.visible = self._discard.visible = found
        self._told.text = _told(state)
        children: list[Any] = [self._nothing]
        if isinstance(state, Proposal):
            children = [_div("<h2>Tuned gains, simulated; not applied yet</h2>" + table_html(state.numbers))]
            for panel in state.panels:
                children += [_div(f"<b>{html.escape(panel.title)}</b>"), *response_plots(panel)]
            children.append(_div(table_html(state.values)))
            for child in children:
                child.sizing_mode = "stretch_width"
                fit_elements(child)
        self.look_layout.update(children=children, visible=found)

    def _start(self) -> None:
        view = self._view
        try:
            view.loop.tuning.start(view.gains())
        except GainsError as error:
            self._told.text = _told(Failure(str(error)))

    def _on_apply(self) -> None:
        view, state = self._view, self._view.loop.tuning.state
        if isinstance(state, Proposal):
            gains = state.gains.as_dict()
            ask(view, {"type": state.gains.type} | {name: view.for_lane(name, gains[name]) for name in PER_LANE})
            view.loop.tuning.stop()


def _div(text: str) -> Div:
    return Div(text=text, stylesheets=[TABLES])


def _told(state: object) -> str:
    if isinstance(state, Failure):
        return f'<span class="refused">{html.escape(state.reason)}</span>'
    if isinstance(state, Progress):
        part = f"{state.evaluations} of {state.budget} evaluations, " if state.budget else ""
        bar = f'<progress max="{state.budget or 1}" value="{state.evaluations}"></progress>'
        return f"{bar} {part}{html.escape(state.best)}"
    return "Look at the predicted responses, then apply or discard." if isinstance(state, Proposal) else ""
