"""What the parameters of the loop's nodes are called, to tell of misspelt ones also where no node runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import fields
from difflib import get_close_matches

from tdof_npid_ros.control.gains import GAIN_NAMES, PER_LANE
from tdof_npid_ros.control.options import ControllerOptions

# What a file may give to all nodes of a loop, and so to a node that needs only some of them.
OF_ANY_NODE = ("sample_period", "mode", "speed", "lanes", "joint_names", "lossless", "autostart",
               "deadline", "lease", "request_deadline", "priority", "cpu", "use_sim_time",
               "start_type_description_service")  # fmt: skip
OF_NODE = {  # besides; the parameters of the plant's model come to this
    "plant": ("model", "effort_min", "effort_max", "reply_timeout", "retries", "publish_clock", "effort_timeout",
              "fallback", "fallback_effort", "return_time"),
    "controller": (*GAIN_NAMES, *(field.name for field in fields(ControllerOptions)),
                   "setpoint", "hold_output", "output_timeout", "save_i_term"),
    "scenario": ("play", "episodes"),
    "tuner": (*(f"bounds.{gain}" for gain in PER_LANE), "case", "type", "free", "weight", "algorithm", "seed",
              "population", "generations", "polish", "loops", "loop_timeout", "answer_timeout", "checkpoint", "resume",
              "result", "stay", "episode", "levels", "safe_range.output", "safe_range.effort", "settle_band",
              "settle_time", "time_limit"),
}  # fmt: skip
WITH_ANY_END = ("plan.", "qos_overrides.")


def unknown_parameters(given: Iterable[str], known: Collection[str]) -> list[str]:
    """What to warn of: names that a file gives to a node that does not know them, and that are none of
    `OF_ANY_NODE`."""
    warnings = []
    for name in given:
        if name not in known and name not in OF_ANY_NODE and not name.startswith(WITH_ANY_END):
            meant = get_close_matches(name, known, 1)
            hint = f": {meant[0]} is meant?" if meant else ""
            warnings.append(f"parameter {name} is not one of this node's, and does nothing{hint}")
    return warnings
