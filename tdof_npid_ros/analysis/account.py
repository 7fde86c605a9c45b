"""The account of a verification: what is equal, what differs, and what could not be checked, by cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

VERIFIED, DIFFERENT, UNCHECKED = 0, 1, 3  # exit statuses


@dataclass(frozen=True)
class Difference:
    """A message that is not what its inputs give.

    Attributes:
        what: `control effort`, `setpoint` for one that is not the plan's, `plant output`, …
        step: index of the message in the topic.
        inputs: what went in, by name, for people.
        recorded, expected: (lanes,).
    """

    what: str
    topic: str
    step: int
    stamp_ns: int
    episode: str
    inputs: Mapping[str, Any]
    recorded: tuple[Any, ...]
    expected: tuple[Any, ...]

    def lines(self) -> list[str]:
        """The difference for people, numbers in full."""
        stamp = "{}.{:09}".format(*divmod(self.stamp_ns, 10**9)).rstrip("0").rstrip(".")  # as exact as in ROS time
        place = f"{self.topic}, message {self.step}, at {stamp} s of {self.episode or 'the recording'}"
        return [
            f"first difference: {self.what} in {place}",
            *(f"  {name:22} {value}" for name, value in self.inputs.items()),
            f"  {'recorded':22} {numbers(self.recorded)}",
            f"  {'expected':22} {numbers(self.expected)}",
        ]


@dataclass
class Check:
    """How many messages of a kind are, and are not, what they must be."""

    equal: int = 0
    different: int = 0


@dataclass
class Verification:
    """The account of one bag.

    Attributes:
        equal, different: answers that were computed again.
        unverifiable: answers that could not be, by reason.
        missing: what a bag that was cut off lacks, a line for each thing.
        first: the first difference.
        checks: of what else is in the bag, by kind.
        unchecked: messages other than answers that could not be checked, by reason.
    """

    bag: str
    missing: tuple[str, ...] = ()
    equal: int = 0
    different: int = 0
    unverifiable: Counter[str] = field(default_factory=Counter)
    first: Difference | None = None
    checks: dict[str, Check] = field(default_factory=dict)
    unchecked: Counter[str] = field(default_factory=Counter)

    @property
    def differs(self) -> bool:
        """Whether anything is not what it must be."""
        return self.different > 0 or any(check.different for check in self.checks.values())

    @property
    def sound(self) -> bool:
        """Whether something was verified and all of it is equal."""
        return self.equal > 0 and not self.differs

    @property
    def status(self) -> int:
        """The exit status: all was checked, something differs, or something could not be checked."""
        if self.differs:
            return DIFFERENT
        return VERIFIED if self.equal and not self.unverifiable and not self.unchecked else UNCHECKED

    def note(self, what: str, difference: Difference | None = None) -> None:
        """A message of a kind that is what it must be, or is not."""
        check = self.checks.setdefault(what, Check())
        if difference is None:
            check.equal += 1
            return
        check.different += 1
        self.first = self.first or difference

    def lines(self) -> list[str]:
        """The account for people."""
        found = [f"{self.bag}: {self.equal} control efforts verified bit for bit, {self.different} differ"]
        found += [f"  {count} not verifiable: {reason}" for reason, count in self.unverifiable.items()]
        if not self.equal and not self.different:
            found.append("  nothing was verified")
        found += [f"  {what}: {one.equal} as they must be, {one.different} differ" for what, one in self.checks.items()]
        found += [f"  {count} not checked: {reason}" for reason, count in self.unchecked.items()]
        found += [f"  missing: {line}" for line in self.missing]
        return [*found, *(self.first.lines() if self.first else [])]


def numbers(values: Sequence[Any]) -> str:
    """Numbers in full, to the last bit and to read; anything else as it is."""
    return ", ".join(f"{value.hex()} ({value!r})" if isinstance(value, float) else str(value) for value in values)
