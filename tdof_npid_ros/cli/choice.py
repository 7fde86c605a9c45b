"""The options that say which topics and fields of a bag are the loop's."""

from __future__ import annotations

import argparse

from tdof_npid_ros.analysis.sources import Chosen

_ROLES = {
    "output": "what is controlled, as /joint_states:position[elbow]",
    "setpoint": "what it is to be, as /reference:data",
    "effort": "what the controller does, as /command:data[0]",
}


def add_choice(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    for role, text in _ROLES.items():
        parser.add_argument(f"--{role}", metavar="TOPIC:FIELD", help=f"{text}; else it is guessed, and said")


def choice(arguments: argparse.Namespace) -> Chosen:
    """What was chosen.

    Raises:
        AnalysisError: a path cannot be read.
    """
    return Chosen.read(arguments.output, arguments.setpoint, arguments.effort)
