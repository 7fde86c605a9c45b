"""What pages show: a loop with all that is known of it, which they share, and what one of them looks at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tdof_npid_ros.case import Case
from tdof_npid_ros.control.gains import Gains, GainsError, gains_from_mapping
from tdof_npid_ros.graph.observer import LoopObserver
from tdof_npid_ros.live.recordings import Recordings
from tdof_npid_ros.live.steering import Steering
from tdof_npid_ros.live.tuning import Tuning
from tdof_npid_ros.parameter_file import find_parameter_file
from tdof_npid_ros.stability.margins import one_lane

ANY_FILE = "p1-c0.5"  # for a recorder, which reads nothing of it


class LiveLoop:
    """One loop, watched and steered by any number of pages.

    Args:
        namespace: of its nodes.
        case: its parameter file's; None: not known.
        path: of that file.
    """

    def __init__(self, namespace: str, case: Case | None, path: Path | None) -> None:
        self.namespace, self.case = namespace, case
        self.observer = LoopObserver(namespace)
        self.steering = Steering(self.observer, case)
        self.tuning = Tuning(case, path)
        self.recordings = Recordings(namespace, path or find_parameter_file(ANY_FILE))

    def close(self) -> None:
        """Leave the loop as it is."""
        for part in (self.tuning, self.recordings, self.steering, self.observer):
            part.close()


@dataclass
class View:
    """What one page looks at.

    Attributes:
        loop: one of those there are.
        lane: one of its lanes.
        alone: whether gains are set for that lane only.
    """

    loop: LiveLoop
    lane: int = 0
    alone: bool = False

    @property
    def lanes(self) -> int:
        """How many the loop has, as far as it has been heard; at least 1."""
        return max(len(self.loop.observer.lane_names), 1)

    def parameter(self, name: str) -> Any:
        """A parameter of the controller, of this lane; None: not known."""
        return of_lane(self.loop.steering.values.get(name), self.lane)

    def gains(self) -> Gains:
        """The gains of this lane.

        Raises:
            GainsError: they are not known.
        """
        if not self.loop.steering.values:
            raise GainsError("the controller has not told its gains yet")
        gains = gains_from_mapping(self.loop.steering.values)
        return one_lane(gains, min(self.lane, gains.lanes - 1))

    def for_lane(self, name: str, value: float) -> Any:
        """What to set a parameter to, so that this lane has a value: the others keep theirs if it is set alone."""
        if not self.alone or self.lanes == 1:
            return value
        now = self.loop.steering.values.get(name)
        return [value if lane == self.lane else of_lane(now, lane) for lane in range(self.lanes)]


def of_lane(value: Any, lane: int) -> Any:
    """A lane's value of a parameter that is one number, or one for each lane."""
    return value[min(lane, len(value) - 1)] if isinstance(value, (list, tuple)) and value else value
