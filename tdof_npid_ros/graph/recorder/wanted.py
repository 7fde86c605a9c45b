"""Which topics are recorded: patterns of absolute names, and of names in the recorder's own loop."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from tdof_npid_ros.names import in_namespace, namespace_of
from tdof_npid_ros.wire import JOINT_STATE


def other_loops(topics: Iterable[tuple[str, Sequence[str]]], namespace: str) -> tuple[str, ...]:
    """Namespaces below this one in which there is a loop of its own: whatever is there is not of this loop.

    Args:
        topics: names with their types.

    Example:
        >>> there = [("/control_effort", [JOINT_STATE]), ("/left/control_effort", [JOINT_STATE])]
        >>> other_loops(there, "/"), other_loops(there, "/left")
        (('/left/',), ())
    """
    own = in_namespace(namespace)
    found = {namespace_of(name) for name, types in topics if name.endswith("/control_effort") and JOINT_STATE in types}
    return tuple(sorted(one for one in found if one.startswith(own) and one != own))


def is_wanted(
    topic: str, namespace: str, patterns: Iterable[str], exclude: Iterable[str], others: Sequence[str] = ()
) -> bool:
    """Whether a topic is recorded.

    Args:
        patterns, exclude: with a slash at the start of any topic; without, of this namespace.
        others: namespaces of other loops, of which only absolute patterns take topics.
    """
    own = in_namespace(namespace)
    is_other = any(topic.startswith(one) for one in others)

    def matches(pattern: str) -> bool:
        if pattern.startswith("/"):
            return fnmatchcase(topic, pattern)
        return bool(pattern) and not is_other and fnmatchcase(topic, own + pattern)

    return any(map(matches, patterns)) and not any(map(matches, exclude))
