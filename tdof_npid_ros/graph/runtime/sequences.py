"""How many messages of a topic are missing, by its publishers' counts."""

from __future__ import annotations

from collections.abc import Sequence

REMEMBERED = 64  # runs; the gaps before older ones are final


class _Run:
    """Counts without a gap, of one publisher.

    Attributes:
        first, next: the first count, and the one after the latest.
        before: the run that it goes on from after a gap, as far as is known.
    """

    __slots__ = ("before", "first", "next")

    def __init__(self, first: int, before: _Run | None) -> None:
        self.first, self.next, self.before = first, first + 1, before

    @property
    def gap(self) -> int:
        return self.first - self.before.next if self.before else 0


class Sequences:
    """The counts of a topic's messages: each is by 1 larger than the one before of the same publisher.

    Which publisher has sent a message, the middleware does not say. So a count that goes on from no other counts as one
    after a gap, until what seems to be missing comes all the same: then it was another publisher's. As long as fewer
    publishers have been heard than there are, it may as well be the first that came of another one's.

    Attributes:
        missed: messages that publishers had sent before the first that came of theirs.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._heard = 0  # publishers
        self._final = 0
        self._runs: list[_Run] = []  # that which went on last is the last one

    def lost(self, publishers: int = 1) -> int:
        """Messages that are missing between others, of so many publishers."""
        gaps = sorted((run.gap for run in self._runs if run.before), reverse=True)
        return self._final + sum(gaps[max(publishers - self._heard, 0) :])

    def take(self, counts: Sequence[int]) -> None:
        """Take what has come, in order; 0 is a count that is not known."""
        latest = self._runs[-1] if self._runs else None
        if latest is not None and latest.next == counts[0] and counts[-1] - counts[0] == len(counts) - 1:
            latest.next = counts[-1] + 1  # nothing missing; no run follows the last one
            return
        for count in counts:
            if count:
                self._take(count)

    def _take(self, count: int) -> None:
        run = next((run for run in reversed(self._runs) if run.next == count), None)
        if run is not None:
            run.next = count + 1
            for other in self._runs:
                if other.before is run:  # this one goes on by itself
                    other.before = None
                    self._heard += 1
                    self.missed += other.first - 1
            self._runs.remove(run)
            self._runs.append(run)
            return
        earlier = [run for run in self._runs if run.next < count] if count > 1 else []
        before = max(earlier, key=lambda run: run.next, default=None)
        if before is None:
            self._heard += 1
            self.missed += count - 1
        self._runs.append(_Run(count, before))
        if len(self._runs) > REMEMBERED:
            gone = self._runs.pop(0)
            self._final += gone.gap
            for other in self._runs:
                if other.before is gone:
                    self._final += other.gap
                    other.before = None
