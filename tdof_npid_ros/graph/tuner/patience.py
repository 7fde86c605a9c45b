"""How long a tuner waits for its loops, and how it waits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

POLL = 0.02  # s between two looks at what is waited for


@dataclass(frozen=True)
class Patience:
    """What a tuner's loops are waited for with.

    Attributes:
        for_a_loop: s without any loop until tuning gives up.
        for_an_answer: s until a silent loop counts as lost.
        check: called while waiting; raises to give up.
    """

    for_a_loop: float
    for_an_answer: float
    check: Callable[[], None]
