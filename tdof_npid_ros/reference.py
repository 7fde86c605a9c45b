"""What the tables of parameters say, for people: a node's `--help`, and the page `docs/parameters.md`.

`python -m tdof_npid_ros.reference FILE` writes the page.
"""

from __future__ import annotations

import math
import sys
import textwrap
from pathlib import Path
from typing import Any, Final

from tdof_npid_ros.parameter import ANY, Parameter, Table
from tdof_npid_ros.parameters import MODELS, NODES, PLAN, SUBSTEPS

ABOUT: Final = {
    "plant": "a simulated process that publishes its output and takes control effort",
    "controller": "answers each output with a control effort",
    "scenario": "plays the episodes of a parameter file: setpoint and disturbance",
    "tuner": "tunes the controllers of running loops",
    "recorder": "records every topic of its namespace in an MCAP bag",
    "replay": "publishes a bag again",
}
_WIDTH: Final = 100
_OF_CLASSES: Final = (
    "A class of one's own (`package.module:Class`) brings the parameters of its `parameters`, with the "
    "`descriptions` and `ranges` that it gives, `initial_state`, and"
)
_HEAD: Final = """\
# Parameters

Made from the tables in `tdof_npid_ros/parameters.py` by `make docs/parameters.md`.

Parameters are ordinary ROS parameters. A parameter file gives them (`--params-file`), the command line
(`-p kp:=2.0`), or, while a node runs, `ros2 param set`; `ros2 param describe` tells what stands here. A set of
changes is taken as a whole or refused with the reason. One marked *start* is read at the start only. What says
*per lane* takes one number for all lanes, or a list with one for each. Whole numbers and the word `inf` serve where
a number is asked for.
"""


def node_help(node: str) -> str:
    """The text that `--help` of a node prints."""
    lines = [
        f"usage: {node} [--ros-args [-p NAME:=VALUE ...] [--params-file FILE] [-r __ns:=/NAMESPACE] ...]",
        "",
        f"{node}: {ABOUT[node]}",
        "",
        "parameters = their defaults [unit], with the values that they take ('start': read at the start only):",
        *_help_of(NODES[node]),
    ]
    for title, its in _further(node):
        lines += ["", f"{title.replace('`', '')}:", *_help_of(its)]
    return "\n".join(lines)


def page() -> str:
    """The reference page, in Markdown."""
    parts = [_HEAD]
    for node, its in NODES.items():
        parts += [f"## {node}\n\n{node.capitalize()}: {ABOUT[node]}.\n", _markdown_table(its)]
        for title, further in _further(node):
            parts += [f"{title}:\n", _markdown_table(further)]
    return "\n".join(parts)


def _further(node: str) -> list[tuple[str, Table]]:
    """What a node has besides its table: a title, and the parameters."""
    if node == "plant":
        models = [(f"With `model: {model}`", its) for model, its in MODELS.items()]
        return [*models, (_OF_CLASSES, {SUBSTEPS.name: SUBSTEPS})]
    if node == "scenario":
        return [("For each episode in `episodes`", {f"{PLAN.name}EPISODE": PLAN})]
    return []


def _help_of(its: Table) -> list[str]:
    lines = []
    for name, parameter in its.items():
        unit = f"  [{parameter.unit}]" if parameter.unit else ""
        facts = "; ".join(_facts(parameter))
        about = f"{parameter.description} ({facts})" if facts else parameter.description
        lines.append(f"  {name} = {_default(parameter)}{unit}")
        lines += textwrap.wrap(about, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return lines


def _markdown_table(its: Table) -> str:
    rows = ["| name | default | unit | values | what it is |", "| --- | --- | --- | --- | --- |"]
    for name, parameter in its.items():
        default = parameter.otherwise if parameter.default is None else f"`{_default(parameter)}`"
        cells = (f"`{name}`", default, parameter.unit, "; ".join(_facts(parameter)), parameter.description)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def _facts(parameter: Parameter) -> list[str]:
    """Which values it takes, and when it is read; nothing for what a default already shows."""
    facts = []
    if parameter.choices:
        facts.append(", ".join(choice or "''" for choice in parameter.choices))
    elif parameter.within != ANY:
        facts.append(str(parameter.within))
    if parameter.is_interval:
        facts.append("[lower, upper]")
    if parameter.per_lane:
        facts.append("per lane")
    if parameter.fixed:
        facts.append("start")
    return facts


def _default(parameter: Parameter) -> str:
    return parameter.otherwise if parameter.default is None else _shown(parameter.default)


def _shown(value: Any) -> str:
    """A value as YAML has it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    if isinstance(value, list):
        return f"[{', '.join(_shown(one) for one in value)}]"
    return f'"{value}"' if isinstance(value, str) and not value.isidentifier() else str(value)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
