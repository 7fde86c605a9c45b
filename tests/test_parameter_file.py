"""Parameter files, and which nodes their sections are for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tdof_npid_ros.parameter_file import is_for, sections_of


@pytest.mark.parametrize(
    ("section", "node", "gives"),
    [
        ("/controller", "/controller", True),
        ("controller", "/controller", True),
        ("/controller", "/left/controller", False),
        ("/**/controller", "/controller", True),
        ("/**/controller", "/left/arm/controller", True),
        ("/**/controller", "/arm_controller", False),
        ("/*/controller", "/left/controller", True),
        ("/*/controller", "/controller", False),
        ("/left/*", "/left/plant", True),
        ("/**", "/left/plant", True),
    ],
)
def test_a_section_is_for_the_nodes_that_ros_gives_it_to(section: str, node: str, gives: bool) -> None:
    assert is_for(section, node) == gives


def test_the_sections_of_a_file_are_named_as_it_nests_them(tmp_path: Path) -> None:
    file = tmp_path / "loop.yaml"
    file.write_text(
        "/**: {ros__parameters: {mode: lockstep}}\n/**/controller: {ros__parameters: {kp: 1.0}}\n"
        "left: {plant: {ros__parameters: {gain: 1.0}}}\n"
    )
    assert sections_of(file) == ["/**", "/**/controller", "/left/plant"]
