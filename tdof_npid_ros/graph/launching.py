"""What the launch files share: their arguments, and nodes that take what is given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import yaml
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from tdof_npid_ros.parameters import NODES

SWITCH = ("true", "false")


class Argument(NamedTuple):
    """An argument of a launch file.

    Attributes:
        default: None: it must be given; empty: what it sets is as in the parameter file.
        sets: nodes that have it as a parameter.
        choices: None: any text.
    """

    name: str
    default: str | None
    text: str
    sets: tuple[str, ...] = ()
    choices: tuple[str, ...] | None = None


NAMESPACE = Argument("namespace", "", "namespace of the nodes")
LOG_LEVEL = Argument("log_level", "info", "of all nodes", (), ("debug", "info", "warn", "error", "fatal"))


def description(arguments: Sequence[Argument], start: Any) -> LaunchDescription:
    """A launch description that declares arguments and calls `start` with their values by name."""
    declared = [
        DeclareLaunchArgument(one.name, default_value=one.default, choices=one.choices, description=one.text)
        for one in arguments
    ]

    def started(context: Any) -> list[Any]:
        return list(start({one.name: LaunchConfiguration(one.name).perform(context) for one in arguments}))

    return LaunchDescription([*declared, OpaqueFunction(function=started)])


def node(
    executable: str,
    value: Mapping[str, str],
    arguments: Iterable[Argument],
    files: Sequence[str] = (),
    **more: Any,
) -> Node:
    """One of our nodes.

    Args:
        value: of the arguments, by name.
        arguments: those that set one of its parameters hold over what its files say.
        files: parameter files.
        more: for `launch_ros.actions.Node`; the name, if it is not the executable's.
    """
    given = {
        one.name: _typed(executable, one.name, value[one.name])
        for one in arguments
        if executable in one.sets and value[one.name]
    }
    return Node(
        **{"name": executable, **more},
        package="tdof_npid_ros",
        executable=executable,
        namespace=value[NAMESPACE.name],
        parameters=[*files, *([given] if given else [])],
        ros_arguments=["--log-level", value[LOG_LEVEL.name]],
        output="screen",
    )


def ended(nodes: Iterable[Node]) -> list[EmitEvent]:
    """What ends these nodes, and no other: an including launch goes on, one with nothing else ends."""
    return [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(one))) for one in nodes]


def _typed(executable: str, name: str, text: str) -> Any:
    """An argument's text as its parameter's type has it."""
    parameter = NODES[executable][name]
    example = parameter.example if parameter.default is None else parameter.default
    return text if isinstance(example, str) else yaml.safe_load(text)
