"""The program itself: its version, misspelt names, what it says without ROS 2, and what it does not say to a log."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import tdof_npid_ros
from tdof_npid_ros.cli import main
from tdof_npid_ros.graph import NEEDS_ROS

ROOT = Path(__file__).parents[2]


def test_its_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"tdof-npid {tdof_npid_ros.__version__}\n"
    assert f'version="{tdof_npid_ros.__version__}"' in (ROOT / "setup.py").read_text()
    assert f"<version>{tdof_npid_ros.__version__}</version>" in (ROOT / "package.xml").read_text()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("simulat", "there is no subcommand 'simulat': simulate is meant?: see tdof-npid --help"),
        ("analyse", "there is no subcommand 'analyse': analyze is meant?: see tdof-npid --help"),
        ("fly", "there is no subcommand 'fly': see tdof-npid --help"),
    ],
)
def test_the_subcommand_that_is_meant_is_named(given: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([given, "p1-c4"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"tdof-npid: {said}\n"


def test_an_argument_that_a_subcommand_does_not_have_is_told_with_the_one_that_is_meant(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "p1-c4", "--plto", "x.png"])
    assert ended.value.code == 2
    said = "tdof-npid simulate: unrecognized arguments: --plto x.png: --plot is meant?: see tdof-npid simulate --help\n"
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ("line", "found"), [("tdof-npid simul", {"simulate"}), ("tdof-npid simulate p1-c4 --ki", {"--ki"})]
)
def test_a_shell_is_told_how_a_line_may_go_on(line: str, found: set[str], tmp_path: Path) -> None:
    pytest.importorskip("argcomplete", reason="completion is optional: pip install argcomplete")
    answer = tmp_path / "answer"
    environment = {
        **os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
    }  # fmt: skip
    code = "from tdof_npid_ros.cli import entry; entry()"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert {word.strip() for word in answer.read_text().split("\n")} == found


@pytest.mark.parametrize("node", ["controller", "plant", "tuner", "recorder"])
def test_a_node_without_ros_names_the_remedy(node: str) -> None:
    code = (
        "import runpy, sys; sys.modules['rclpy'] = None; sys.argv = ['graph', sys.argv[1]]; "
        "runpy.run_module('tdof_npid_ros.graph', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code, node], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, f"{node}: {NEEDS_ROS}\n")


def test_tuning_shows_no_progress_without_a_terminal() -> None:
    command = [sys.executable, "-m", "tdof_npid_ros", "tune", "p3-c1", "--controller", "pid", "--population", "10"]
    done = subprocess.run([*command, "--generations", "3"], capture_output=True, text=True, timeout=110)
    assert (done.returncode, done.stderr) == (0, "")
    assert "objective" in done.stdout
