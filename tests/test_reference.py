"""A node's `--help` and the reference page, which are made from the tables of parameters."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tdof_npid_ros.parameter import Parameter, Range
from tdof_npid_ros.parameters import MODELS, NODES
from tdof_npid_ros.reference import node_help, page

PAGE = Path(__file__).parents[1] / "docs" / "parameters.md"


def test_the_page_is_as_the_tables_are() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run: make docs/parameters.md"


@pytest.mark.parametrize("node", NODES)
def test_help_tells_every_parameter_and_starts_nothing_nor_needs_ros(node: str, tmp_path: Path) -> None:
    (tmp_path / "rclpy.py").write_text("raise ImportError('no ROS here')\n")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "tdof_npid_ros.graph", node, "--help"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == ""
    shown = {line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ") and line[2] != " "}
    assert shown >= NODES[node].keys()
    if node == "plant":
        assert shown >= {name for its in MODELS.values() for name in its}


def test_a_parameter_added_to_the_table_alone_is_documented(monkeypatch: pytest.MonkeyPatch) -> None:
    added = Parameter("patience", 1.5, "how long it waits", "s", Range(0.0, 9.0), fixed=True)
    monkeypatch.setitem(NODES["scenario"], "patience", added)
    assert "  patience = 1.5  [s]\n      how long it waits (from 0 to 9; start)" in node_help("scenario")
    assert "| `patience` | `1.5` | s | from 0 to 9; start | how long it waits |" in page()
