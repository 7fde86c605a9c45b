"""What a terminal of 80 columns shows: nothing wider, no cell torn apart."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tdof_npid_ros.cli.terminal import broken


def test_a_line_is_broken_between_its_cells() -> None:
    assert broken("p1  kp 9.4  ki 9.4", 10) == ["p1  kp 9.4", "  ki 9.4"]
    assert broken("  name    1.5  2.5", 40) == ["  name    1.5  2.5"]


def test_a_text_beside_its_title_stays_there() -> None:
    line = "hint     a text that is longer than the terminal is wide"
    assert broken(line, 34) == ["hint     a text that is longer", "         than the terminal is wide"]
    assert " ".join(" ".join(broken(line, 34)).split()) == " ".join(line.split())


@pytest.mark.parametrize(
    "arguments",
    [
        ["certify", "p1-c0.5", "--controller", "pid"],
        ["margins", "p1-c0.5"],
        ["analyze", "bags/sample"],
        ["check", "p1-c0.5"],
        ["simulate", "p1-c0.5"],
    ],
)
def test_what_is_told_fits_80_columns(arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tdof_npid_ros", *arguments],
        env={**os.environ, "COLUMNS": "80"}, capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if len(line) > 80] == []
