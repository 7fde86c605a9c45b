"""What a controller makes of an output's stamp."""

from __future__ import annotations

from typing import Literal

RESTART_NS = 1_000_000_000  # a stamp this far back is a restarted clock, not a late message
LATE_IN_A_ROW = 3  # late stamps that go forward among themselves: the clock was set back

Verdict = Literal["new", "same", "late", "restart"]


class Stamps:
    """The sequence of stamps of one stream of outputs.

    A stamp equal to the latest is the `same` output again. One that goes back is `late`, unless it goes back to the
    start of an episode (0), by more than a second or for several outputs in a row: then, and when the episode's name
    changes, it is a `restart`.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """As before the first stamp."""
        self.latest_ns: int | None = None
        self._episode = ""
        self._late: list[int] = []

    def take(self, stamp_ns: int, episode: str) -> Verdict:
        """Judge a stamp; new ones and restarts become the latest."""
        latest, before = self.latest_ns, self._episode
        if latest is None or episode != before:
            verdict: Verdict = "restart"
        elif stamp_ns == latest:
            return "same"
        elif stamp_ns > latest:
            verdict = "new"
        elif stamp_ns == 0 or latest - stamp_ns > RESTART_NS or self._clock_was_set_back(stamp_ns):
            verdict = "restart"
        else:
            return "late"
        self.latest_ns, self._episode = stamp_ns, episode
        if self._late:
            self._late.clear()
        return verdict

    def _clock_was_set_back(self, stamp_ns: int) -> bool:
        if self._late and stamp_ns <= self._late[-1]:
            self._late.clear()
        self._late.append(stamp_ns)
        return len(self._late) >= LATE_IN_A_ROW


def begins_from_nothing(stamp_ns: int, episode: str) -> bool:
    """Whether a loop that (re)starts at this stamp is at its start, rather than one that is running already."""
    return stamp_ns == 0 or (not episode and stamp_ns < RESTART_NS)
