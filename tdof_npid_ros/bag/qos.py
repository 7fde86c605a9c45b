"""Quality of service as bags tell it: YAML, in words since Jazzy, in the middleware's numbers before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import yaml

from tdof_npid_ros.yaml_text import YamlTextError, load_yaml

_FOREVER: Final = {"sec": 9223372036, "nsec": 854775807}
# The words of each policy, in the order of the numbers in which rosbag2 wrote them until Iron.
_WORDS: Final = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available"),
}
_MOST_DEPTH: Final = 2**31 - 1


@dataclass(frozen=True)
class QosProfile:
    """The quality of service that a publisher offers, in rosbag2's words. Deadline and lifespan are infinite."""

    reliability: str = "reliable"  # reliable, best_effort
    durability: str = "volatile"  # volatile, transient_local
    history: str = "keep_last"  # keep_last, keep_all
    depth: int = 10

    def as_dict(self) -> dict[str, Any]:
        """Return the profile as rosbag2 writes it."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }


def qos_text(profiles: Sequence[QosProfile]) -> str:
    """Return QoS profiles as the YAML text that MCAP channels carry."""
    if not profiles:
        return ""
    return yaml.safe_dump([profile.as_dict() for profile in profiles], sort_keys=False).strip()


def qos_dicts(text: str) -> list[dict[str, Any]]:
    """Return the profiles in a channel's text as rosbag2 writes them now, in words; none where none can be read."""
    try:
        profiles = load_yaml(text)
    except YamlTextError:
        return []
    if not isinstance(profiles, list):
        return []
    return [_in_words(profile) for profile in profiles if isinstance(profile, dict)]


def qos_profiles(text: str) -> list[QosProfile]:
    """Return the profiles in a channel's text; what one does not tell is as by default."""
    return [_profile(profile) for profile in qos_dicts(text)]


def _in_words(profile: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key): _word(str(key), value) for key, value in profile.items()}


def _word(policy: str, value: Any) -> Any:
    words = _WORDS.get(policy, ())
    is_number = isinstance(value, int) and not isinstance(value, bool)
    if is_number and words:
        return words[value] if 0 <= value < len(words) else "unknown"
    return value


def _profile(told: Mapping[str, Any]) -> QosProfile:
    default = QosProfile()
    words = {
        policy: told[policy] if told.get(policy) in _WORDS[policy][1:3] else getattr(default, policy)
        for policy in ("reliability", "durability", "history")
    }
    depth = told.get("depth")
    if isinstance(depth, bool) or not isinstance(depth, int) or not 0 < depth <= _MOST_DEPTH:
        depth = default.depth
    return QosProfile(**words, depth=depth)
