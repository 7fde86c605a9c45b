"""`tdof-npid set`: parameters of a running node, or the setpoint of a running loop."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

import yaml

from tdof_npid_ros.cli.loop_client import add_loop_arguments, client_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("values", nargs="*", metavar="NAME=VALUE", help="parameters, set together: all or none of them")
    parser.add_argument("--setpoint", type=float, metavar="R", help="publish this setpoint")
    parser.add_argument("--step", type=float, metavar="S", help="publish a setpoint so much above the present one")
    parser.add_argument("--disturbance", type=float, metavar="D", help="publish this disturbance")
    add_loop_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Set and publish what was asked for."""
    values = dict(_parsed(text) for text in arguments.values)
    topics = [name for name in ("setpoint", "step", "disturbance") if getattr(arguments, name) is not None]
    if not values and not topics:
        raise ValueError("nothing to set: give NAME=VALUE, as kp=5, or --setpoint, --step, --disturbance")
    if "setpoint" in topics and "step" in topics:
        raise ValueError("--setpoint and --step do not go together")
    with client_of(arguments) as client:
        if values:
            client.set_parameters(arguments.node, values)
        done: dict[str, Any] = dict(values)
        if arguments.step is not None:
            arguments.setpoint = client.setpoint() + arguments.step
        for topic in ("setpoint", "disturbance"):
            value = getattr(arguments, topic)
            if value is not None:
                client.publish(topic, value)
                done[topic] = value
    print(json.dumps(done) if arguments.json else "\n".join(f"{name} = {value}" for name, value in done.items()))
    return 0


def _parsed(text: str) -> tuple[str, Any]:
    """A name and its value, which is read as ROS reads one: numbers, true, text, lists, inf.

    Raises:
        ValueError: it is no NAME=VALUE.
    """
    name, equals, written = text.partition("=")
    if not equals or not name or not written:
        raise ValueError(f"{text!r}: it must be NAME=VALUE, as kp=5")
    if written.lstrip("+-").lower() in ("inf", ".inf"):
        return name, math.copysign(math.inf, -1.0 if written.startswith("-") else 1.0)
    try:
        value = yaml.safe_load(written)
    except yaml.YAMLError:
        raise ValueError(f"{text!r}: {written!r} is no value") from None
    try:
        return name, float(value) if isinstance(value, str) else value  # 1e-3, which YAML takes for text
    except ValueError:
        return name, value
