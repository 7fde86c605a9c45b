"""A path is bytes: files and folders whose names are no UTF-8 are read and written by whatever takes them."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import LoopBag

from tdof_npid_ros.case import load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.parameter_file import ParameterFileError, config_folder, for_ros

NAME = os.fsdecode(b"n\xe4me")  # Latin-1


def called(*arguments: str) -> tuple[int, str]:
    """Exit status and what is printed, on streams as `prepare_streams` makes them."""
    content = io.BytesIO()
    stream = io.TextIOWrapper(content, "utf-8", "backslashreplace")
    with redirect_stdout(stream), redirect_stderr(stream):
        status = main(arguments)
    stream.flush()
    return status, content.getvalue().decode()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a parameter file and a bag of that name."""
    folder = tmp_path_factory.mktemp("paths") / NAME
    folder.mkdir()
    (folder / f"{NAME}.yaml").write_bytes((config_folder() / "p3-c1.yaml").read_bytes())
    case = load_case("p3-c1")
    with LoopBag(folder / NAME) as bag:
        bag.configuration(case, case.gains)
        bag.episode(case, case.gains, "setpoint", 1)
    return folder


COMMANDS = {  # what each writes, by its option
    "simulate": ("{case}", {"--plot": "s.png", "--html": "s.html", "--csv": "s.csv"}),
    "margins": ("{case}", {"--plot": "m.png"}),
    "certify": ("{case}", {"--plot": "c.png", "--html": "c.html"}),
    "check": ("{case}", {}),
    "tune": ("{case} --controller pid --population 10 --generations 2", {"--out": "t.yaml", "--checkpoint": "t.json"}),
    "analyze": ("{bag} {bag}", {"--plot": "a.png", "--html": "a.html", "--csv": "a.csv"}),
    "verify": ("{bag} --case {case}", {}),
    "recover": ("{bag} {new}", {}),
    "new": ("{file} --gain 2 --time-constant 3 --step 1", {}),
}


@pytest.mark.parametrize("subcommand", COMMANDS)
def test_a_path_need_not_be_text(subcommand: str, folder: Path) -> None:
    words, writes = COMMANDS[subcommand]
    names = {"case": f"{NAME}.yaml", "bag": NAME, "new": f"{NAME}2", "file": f"{NAME}n.yaml"}
    places = {key: folder / name for key, name in names.items()}
    arguments = [word.format(**places) for word in words.split()]
    written = {option: folder / f"{NAME}-{name}" for option, name in writes.items()}
    arguments += [str(word) for pair in written.items() for word in pair]
    status, told = called(subcommand, *arguments)
    assert status == 0, told
    assert all(path.stat().st_size for path in written.values())
    if subcommand == "recover":
        assert called("verify", str(places["new"]))[0] == 0


@pytest.mark.parametrize("subcommand", ["simulate", "check", "analyze", "verify", "recover", "identify", "replay"])
def test_a_path_that_is_no_text_is_missed_in_one_line(subcommand: str, tmp_path: Path) -> None:
    status, told = called(subcommand, str(tmp_path / f"{NAME}.yaml"))
    assert status == 2 and told.count("\n") == 1 and told.startswith(f"tdof-npid {subcommand}: ")


def test_ros_takes_text_alone_and_so_it_is_said() -> None:
    assert for_ros("größe") == "größe"
    with pytest.raises(ParameterFileError, match="ROS takes names in UTF-8 alone"):
        for_ros(Path(NAME))


def test_a_pipe_is_no_place_for_a_result(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    status, told = called("simulate", "p3-c1", "--csv", str(tmp_path / "pipe"))
    assert status == 2 and "pipe cannot be written: it is a pipe or the like: give a file" in told
