"""What a controller makes of an output's stamp."""

from __future__ import annotations

from typing import Literal

RESTART_NS = 1_000_000_000  # a stamp this far back is a restarted clock, not a late message

Verdict = Literal["new", "same", "late", "restart"]


class Stamps:
    """The sequence of stamps of one stream of outputs.

    A stamp equal to the latest is the `same` output again. One that goes back is `late`, unless it goes back to the
    start of an episode (0) or by more than a second: then, and when the episode's name changes, it is a `restart`.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """As before the first stamp."""
        self.latest_ns: int | None = None
        self._episode = ""

    def take(self, stamp_ns: int, episode: str) -> Verdict:
        """Judge a stamp; new ones and restarts become the latest."""
        latest, self._episode, before = self.latest_ns, episode, self._episode
        if latest is None or episode != before:
            verdict: Verdict = "restart"
        elif stamp_ns == latest:
            return "same"
        elif stamp_ns > latest:
            verdict = "new"
        elif stamp_ns == 0 or latest - stamp_ns > RESTART_NS:
            verdict = "restart"
        else:
            return "late"
        self.latest_ns = stamp_ns
        return verdict
