"""Closed, broken and full streams, places that cannot be written, names that are not text: a result is not lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "analysis"))
from loop_bags import LoopBag

from tdof_npid_ros.case import load_case
from tdof_npid_ros.checkpoint import VERSIONS, CheckpointError, read_checkpoint, write_checkpoint

PROGRAM = [sys.executable, "-m", "tdof_npid_ros"]
TUNE = [*PROGRAM, "tune", "p3-c1", "--controller", "pid", "--population", "10", "--generations", "3"]


def shell(
    line: str, *arguments: str, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        ["sh", "-c", line, "sh", *arguments], cwd=cwd, env={**os.environ, **environment}, capture_output=True,
        timeout=110,
    )  # fmt: skip


@pytest.mark.parametrize("streams", ["2>&-", ">&-", ">&- 2>&-", "<&- >&- 2>&-", "2>/dev/full", "2>&1 | true"])
def test_a_result_is_written_whatever_becomes_of_the_streams(tmp_path: Path, streams: str) -> None:
    out = tmp_path / "gains.yaml"
    done = shell(f'"$@" {streams}', *TUNE, "--out", str(out), "--checkpoint", str(tmp_path / "c"))
    assert done.returncode == 0, done.stderr
    assert "kp:" in out.read_text()
    assert read_checkpoint(tmp_path / "c", "tuning")["optimizer"]
    assert b"Traceback" not in done.stderr


ONE_AFTER_THE_OTHER = """
import json, sys
from tdof_npid_ros.streams import prepare_streams
prepare_streams()  # as the console script does
from tdof_npid_ros.cli import main
sys.exit(max(main(command) for command in json.loads(sys.argv[1])))
"""


def test_every_subcommand_that_writes_files_does_so_without_streams(tmp_path: Path) -> None:
    with LoopBag(tmp_path / "bag") as bag:
        case = load_case("p3-c1")
        bag.configuration(case, case.gains)
        bag.episode(case, case.gains, "setpoint", 1)
    written = [str(tmp_path / name) for name in ("s.csv", "m.png", "a.csv", "new", "n.yaml")]
    commands = (
        ["simulate", "p3-c1", "--csv", written[0]],
        ["margins", "p3-c1", "--plot", written[1]],
        ["analyze", str(tmp_path / "bag"), "--csv", written[2]],
        ["recover", str(tmp_path / "bag"), written[3]],
        ["new", written[4], "--gain", "1", "--time-constant", "1", "--step", "1"],
    )
    done = shell('"$@" <&- >&- 2>&-', sys.executable, "-c", ONE_AFTER_THE_OTHER, json.dumps(commands))
    assert done.returncode == 0
    assert all(Path(path).exists() for path in written)


def test_a_full_standard_output_is_told_of_but_the_result_is_there(tmp_path: Path) -> None:
    out = tmp_path / "gains.yaml"
    done = shell('"$@" >/dev/full', *TUNE, "--out", str(out))
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == b"tdof-npid tune: [Errno 28] No space left on device"
    assert "kp:" in out.read_text()


def test_paths_need_not_be_text(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/gr\xfc\xdfe"))
    folder.mkdir()
    (folder / "case.yaml").write_bytes((Path(__file__).parents[2] / "config" / "p3-c1.yaml").read_bytes())
    for line in ('"$@" --out x.yaml', '"$@" --out x.yaml --json', 'LC_ALL=C "$@" --out x.yaml'):
        arguments = [*PROGRAM, "tune", str(folder / "case.yaml"), *TUNE[5:]]
        done = shell(line, *arguments, cwd=folder)
        assert done.returncode == 0, done.stderr
        assert b"Traceback" not in done.stderr
    done = shell('"$@"', *PROGRAM, "simulate", str(folder / "missing.yaml"))
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1 and b"\\udcfc" in done.stderr


def test_neither_home_nor_installation_need_be_writable(tmp_path: Path) -> None:
    """Machine code is then not kept: never in a folder that is not its own."""
    (tmp_path / "file").touch()
    nowhere = {"XDG_CACHE_HOME": str(tmp_path / "file"), "HOME": "/proc/none", "NUMBA_CACHE_DIR": ""}
    done = shell('"$@"', *PROGRAM, "simulate", "p3-c1", "--json", **nowhere)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(b"\n") == 1
    assert b"machine code cannot be kept" in done.stderr


def test_two_runs_do_not_share_a_checkpoint(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c"
    holder = "import sys; from pathlib import Path; from tdof_npid_ros.output_file import hold; " + (
        "hold(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", holder, str(checkpoint)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert first.stdout is not None and first.stdout.readline() == "held\n"
    second = shell('"$@"', *TUNE, "--checkpoint", str(checkpoint))
    assert second.returncode == 2 and b"is being written by another run" in second.stderr
    first.kill()
    first.communicate()
    third = shell('"$@"', *TUNE, "--checkpoint", str(checkpoint))
    assert third.returncode == 0, third.stderr


@pytest.mark.parametrize("version", ["true", "null", '"1"', "1.5", "[1]", "0", "-1", "{}"])
def test_a_version_that_is_none_is_refused(tmp_path: Path, version: str) -> None:
    path, known = tmp_path / "c", VERSIONS["tuning"]
    write_checkpoint(path, "tuning", {})
    assert read_checkpoint(path, "tuning") == {}
    path.write_text(path.read_text().replace(f'"version": {known}', f'"version": {version}'))
    with pytest.raises(CheckpointError, match="its version is"):
        read_checkpoint(path, "tuning")
