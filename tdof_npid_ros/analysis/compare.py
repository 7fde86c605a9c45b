"""A live controller's efforts beside the recorded ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tdof_npid_ros.analysis.errors import AnalysisError
from tdof_npid_ros.analysis.loops import recorded_loops
from tdof_npid_ros.analysis.recording import Loop
from tdof_npid_ros.analysis.sources import NOTHING_CHOSEN, Chosen, resolved
from tdof_npid_ros.bag import BagError
from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.names import in_namespace
from tdof_npid_ros.wire import JOINT_STATE, AnswerLabel, EpisodeLabel, SignalReader

Key = tuple[EpisodeLabel | None, int]  # episode and stamp in ns


@dataclass(frozen=True)
class Recorded:
    """What the controller of a recorded loop answered.

    Attributes:
        namespace: of the loop; ends with a slash.
        output: the topic that it answered.
        setpoint: the topic that it took its setpoints from.
        answers: by episode and stamp: digest of the parameters, and effort, (lanes,).
    """

    namespace: str
    output: str
    setpoint: str
    answers: Mapping[Key, tuple[str, np.ndarray]]

    @classmethod
    def read(cls, reader: BagReader, bag: str, chosen: Chosen = NOTHING_CHOSEN) -> Recorded:
        """The answers in a bag.

        Args:
            chosen: topics of output, setpoint and effort, where they are not called so.

        Raises:
            AnalysisError: what was chosen is not there, or is no signal that a controller takes.
            BagError: there are none, or several controllers', or the bag is damaged.
        """
        loops = [loop for loop in recorded_loops(reader, bag, chosen) if loop.control_effort is not None]
        recorder_namespace = in_namespace(reader.custom_data.get("namespace", "/"))
        loops = [loop for loop in loops if loop.namespace == recorder_namespace] or loops
        if not loops:
            raise BagError(f"{bag}: no control efforts in it to compare with: replay it without compare")
        if len(loops) > 1:
            topics = ", ".join(loop.topic for loop in loops)
            raise BagError(f"{bag}: several loops in it, {topics}: record the one to compare by itself")
        (loop,) = loops
        if reader.topics[loop.topic].type != JOINT_STATE:
            raise AnalysisError(f"{bag}: {loop.topic} is no {JOINT_STATE}, which a controller takes as its output")
        setpoint = in_namespace(loop.namespace, "setpoint")
        if chosen.setpoint is not None:
            setpoint = resolved(reader, bag, "setpoint", chosen.setpoint).topic
        return cls(loop.namespace, loop.topic, setpoint, _answers(loop))

    def key(self, output: bytes) -> Key | None:
        """Episode and stamp of a serialized output, if the recorded controller answered it."""
        try:
            sample = SignalReader().read(output)
        except ValueError:
            return None  # nobody could read it
        key = EpisodeLabel.parse(sample.frame_id), sample.stamp_ns
        return key if key in self.answers else None


@dataclass
class Comparison:
    """How live answers compare with the recorded ones.

    Attributes:
        equal, different: answers, bit for bit.
        largest: difference, in the effort's unit.
        unexplained: of the different ones, those before which no live answer of the episode had other parameters.
        other_parameters: digests of live answers that were not computed with the recorded parameters.
        failure: why the comparison ended early.
    """

    equal: int = 0
    different: int = 0
    unexplained: int = 0
    largest: float = 0.0
    first: str = ""
    other_parameters: set[str] = field(default_factory=set)
    failure: str = ""
    # episodes with such an answer
    _of_other_parameters: set[EpisodeLabel | None] = field(default_factory=set, init=False)

    @property
    def compared(self) -> int:
        """Number of answers that were compared."""
        return self.equal + self.different

    @property
    def sound(self) -> bool:
        """Whether something was compared, and differs only where the parameters do."""
        return not self.failure and self.compared > 0 and not self.unexplained

    def take(self, recorded: Recorded, key: Key, digest: str, effort: np.ndarray) -> None:
        """Compare one live answer, effort (lanes,)."""
        if key not in recorded.answers:
            return
        its_digest, expected = recorded.answers[key]
        if digest != its_digest:
            self.other_parameters.add(digest)
            self._of_other_parameters.add(key[0])
        if effort.tobytes() == expected.tobytes():
            self.equal += 1
            return
        self.different += 1
        self.unexplained += key[0] not in self._of_other_parameters
        if not self.first:
            place = f"at {key[1] / 1e9:.9g} s of {key[0] or 'the recording'}"
            self.first = f"{place}: {effort.tolist()}, recorded {expected.tolist()}"
        if effort.shape == expected.shape:
            self.largest = max(self.largest, float(np.abs(effort - expected).max()))

    def as_dict(self) -> dict[str, Any]:
        """For JSON and diagnostics."""
        return {
            "equal": self.equal,
            "different": self.different,
            "unexplained": self.unexplained,
            "largest_difference": self.largest,
            "first_difference": self.first,
            "other_parameters": sorted(self.other_parameters),
            "failure": self.failure,
        }

    def lines(self) -> list[str]:
        """For people; nothing where nothing was compared."""
        lines = [self.failure] if self.failure else []
        if self.compared:
            lines.append(
                f"{self.equal} control efforts equal bit for bit, {self.different} differ, by {self.largest:g} at most"
            )
        if self.first:
            lines.append(f"  first {self.first}")
        if self.other_parameters:
            lines.append(f"  the live controller has other parameters: {', '.join(sorted(self.other_parameters))}")
        return lines


def _answers(loop: Loop) -> dict[Key, tuple[str, np.ndarray]]:
    """By episode and stamp; of answers given twice the first, of stamps that come again the last episode."""
    signal = loop.control_effort
    assert signal is not None
    found: dict[Key, tuple[str, np.ndarray]] = {}
    for frame, stamp, effort in zip(signal.frame_id.tolist(), signal.stamp_ns.tolist(), signal.effort, strict=True):
        digest, episode = AnswerLabel.parse(frame)
        found[episode, stamp] = digest, np.asarray(effort, dtype=np.float64)
    return found
