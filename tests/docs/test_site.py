"""The documentation: it builds without a warning, and what its marked blocks and examples say is true."""

from __future__ import annotations

import doctest
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import tdof_npid_ros
from tdof_npid_ros.cli import main

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"


@pytest.mark.timeout(300)
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        str(DOCS),
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "tdof-npid simulate" in (tmp_path / "site" / "commands.html").read_text(encoding="utf-8")


def marked_blocks() -> dict[str, list[str]]:
    """Commands of the blocks that are marked `<!-- run: name -->`, by name, in order, without those that need ROS 2."""
    found: dict[str, list[str]] = {}
    for page in [*sorted(DOCS.glob("*.md")), REPOSITORY / "README.md"]:
        for name, block in re.findall(r"<!-- run: (\w+) -->\n```\w*\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            found.setdefault(name, []).extend(block.replace("\\\n", " ").strip().splitlines())
    return found


OVER_ROS = ("run", "analyze", "verify", "live", "commission")  # what tests/graph runs


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", marked_blocks())
def test_marked_commands_run_one_after_the_other(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    commands = [shlex.split(line, comments=True) for line in marked_blocks()[name]]
    assert commands
    for words in commands:
        assert words[0] == "tdof-npid"
        if words[1] not in OVER_ROS:
            assert main(words[1:]) == 0, words


MODULES = [
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
    for path in sorted((REPOSITORY / "tdof_npid_ros").rglob("*.py"))
    if ">>> " in path.read_text("utf-8") and path.name != "__init__.py"
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_are_true(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    module = importlib.import_module(name)
    failed, tried = doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert tried and not failed


def test_importing_the_package_loads_neither_numpy_nor_numba() -> None:
    code = "import sys, tdof_npid_ros; sys.exit(bool({'numpy', 'numba', 'scipy', 'rclpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("name", tdof_npid_ros.__all__)
def test_each_public_name_is_documented(name: str) -> None:
    assert getattr(tdof_npid_ros, name).__doc__
    assert name in (DOCS / "python.md").read_text("utf-8")


@pytest.mark.parametrize("node", ["scenario_node", "recorder.node"])
def test_a_node_that_computes_nothing_does_without_numba(node: str) -> None:
    code = f"import sys, tdof_npid_ros.graph.{node}; sys.exit(bool({{'numba', 'scipy', 'mpmath'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
