"""The parameters that nodes had, from a bag's `/parameter_events`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tdof_npid_ros.bag.reader import BagReader
from tdof_npid_ros.control.controller import parameters_digest
from tdof_npid_ros.control.gains import Gains, gains_from_mapping
from tdof_npid_ros.control.options import ControllerOptions, options_from_mapping
from tdof_npid_ros.parameters import sample_period_in_ns
from tdof_npid_ros.scenario import Plan, parse_plan, read_episodes

TOPIC = "/parameter_events"
TYPE = "rcl_interfaces/msg/ParameterEvent"
# The field of rcl_interfaces/msg/ParameterValue that holds the value, by its `type`.
VALUE_FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}


@dataclass(frozen=True)
class ParameterHistory:
    """What became of one node's parameters.

    Attributes:
        node: its full name.
        events: times (ns since the epoch) and what was set then, in the order of the times.
    """

    node: str
    events: tuple[tuple[int, Mapping[str, Any]], ...]

    def sets(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield each time something was set, with all that was known then."""
        values: dict[str, Any] = {}
        for time_ns, changes in self.events:
            values = {**values, **changes}
            yield time_ns, values

    def at(self, time_ns: int) -> dict[str, Any]:
        """All parameters at a time; what was asked for only later counts as having been so from the start."""
        known: dict[str, Any] = {}
        for when, changes in self.events:
            known = {**known, **changes} if when <= time_ns else {**changes, **known}
        return known


def read_histories(reader: BagReader) -> dict[str, ParameterHistory]:
    """The parameter history of each node in a bag, by the node's full name.

    Raises:
        BagError: the bag is damaged.
    """
    if TOPIC not in reader.topics or TOPIC in reader.unreadable or reader.topics[TOPIC].type != TYPE:
        return {}
    columns = reader.columns(TOPIC, ["node", "new_parameters", "changed_parameters"])
    events: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    # By publish time, not by arrival: a snapshot bears the time at which it was asked for.
    for i in np.argsort(columns["publish_time"], kind="stable"):
        set_ = [*columns["new_parameters"][i], *columns["changed_parameters"][i]]
        changes = {parameter["name"]: _value(parameter["value"]) for parameter in set_}
        events.setdefault(str(columns["node"][i]), []).append((int(columns["publish_time"][i]), changes))
    return {node: ParameterHistory(node, tuple(changes)) for node, changes in events.items()}


class Configuration(NamedTuple):
    """All that a controller's answers are computed with."""

    gains: Gains
    options: ControllerOptions
    sample_period_ns: int


def configurations(histories: Mapping[str, ParameterHistory]) -> dict[str, Configuration]:
    """Every set of controller parameters that a node had, by its digest."""
    found: dict[str, Configuration] = {}
    for history in histories.values():
        for _, values in history.sets():
            if "anti_windup" not in values or "sample_period" not in values:
                continue
            try:
                gains, options = gains_from_mapping(values), options_from_mapping(values)
                period_ns = sample_period_in_ns(values["sample_period"])
            except ValueError:
                continue  # the node declares its parameters one by one: not all of them yet
            found[parameters_digest(gains, period_ns, options)] = Configuration(gains, options, period_ns)
    return found


def _value(value: Mapping[str, Any]) -> Any:
    field = VALUE_FIELDS.get(int(value["type"]))
    content = value[field] if field else None
    return content.tolist() if isinstance(content, np.ndarray) else content


def scenario_plans(values: Mapping[str, object]) -> dict[str, Plan]:
    """The plans of a scenario's parameters; none while they come one by one and not all are there."""
    try:
        period_ns = sample_period_in_ns(values["sample_period"])
        return {name: parse_plan(lines, period_ns) for name, lines in read_episodes(values).items()}
    except (KeyError, ValueError):
        return {}
