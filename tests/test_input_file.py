"""What is read from files: ordinary files only, within limits, and YAML as plain values."""

import os
import socket
import time

import pytest

from tdof_npid_ros.input_file import InputError, check_file, read_file, read_yaml
from tdof_npid_ros.one_line import one_line
from tdof_npid_ros.yaml_text import DEEPEST, YamlTextError, load_yaml

BOMB = "a: &a [0, 0, 0, 0, 0, 0, 0, 0, 0]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)


def _pipe(path):
    os.mkfifo(path)


def _socket(path):
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(path))


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (_pipe, "a pipe"),
        (_socket, "a socket"),
        (lambda path: path.mkdir(), "a folder"),
        (lambda path: path.symlink_to("/dev/zero"), "a device"),
        (lambda path: path.symlink_to(path), "symbolic links"),
        (lambda path: None, "No such file"),
    ],
)
def test_what_is_no_file_is_told_from_one_without_opening_it(tmp_path, monkeypatch, make, kind):
    monkeypatch.chdir(tmp_path)
    path = tmp_path.relative_to(tmp_path) / "x"
    make(path)
    for read in (check_file, read_file, read_yaml):
        with pytest.raises(InputError, match=kind):
            read(path)


def test_a_link_to_a_file_serves(tmp_path):
    (tmp_path / "file").write_text("a: 1")
    (tmp_path / "link").symlink_to("file")
    assert read_yaml(tmp_path / "link") == {"a": 1}


def test_a_file_too_large_is_not_read(tmp_path):
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="larger than 4 MiB"):
        read_file(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (BOMB, "aliases expanded"),
        ("[" * 100_000, "nest"),
        ("- " * 100_000, f"deeper than {DEEPEST} levels"),
        ("? " * 100_000, f"deeper than {DEEPEST} levels"),
        ("&a [*a]", "contains itself"),
        ("&a {b: {<<: *a}}", "contains itself"),
        ("[" + "0," * 300_000 + "]", "more than 200,000 values"),
        ("a: " + "9" * 310, "310 digits"),
        ("a: 0x" + "f" * 80, "too large"),
        ("a: " + "9" * 5000, "5000 digits"),
        ("a: 1" + ":59" * 5000, "digits"),
        ("*" + "x" * 100_000, "alias"),
        ("!" + "x" * 100_000 + " 1", "tag"),
        ("!!python/object/apply:os.system [exit]", "python/object"),
        ("!!timestamp tomorrow", "timestamp"),
        ("!!bool maybe", "maybe"),
        ("!!int [1]", "scalar"),
        ("{[1]: 2}", "unhashable"),
        ("a: 1\n---\nb: 2", "another document"),
        ("a\0b", "control characters"),
        ("\ud800", "surrogates"),
    ],
)
def test_hostile_yaml_is_refused_at_once_in_one_short_line(text, reason):
    began = time.monotonic()
    with pytest.raises(YamlTextError, match=reason) as refused:
        load_yaml(text)
    assert time.monotonic() - began < 5.0
    assert len(str(refused.value)) <= 500
    assert str(refused.value).isprintable()


def test_plain_values_are_read_as_ros_reads_them():
    assert load_yaml("{a: [1, -2.5, .inf, true, null, 'x'], b: 2026-11-26, c: 18446744073709551615}") == {
        "a": [1, -2.5, float("inf"), True, None, "x"],
        "b": "2026-11-26",
        "c": 2**64 - 1,
    }
    assert load_yaml("a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}") == {"a": {"x": 1}, "b": {"x": 1}, "c": {"x": 1, "y": 2}}


def test_a_line_stays_one_line():
    assert one_line("a\nb\t c") == "a b c"
    assert one_line("\x1b[2J\u202e\udcff") == "\\x1b[2J\\u202e\\udcff"
    assert len(one_line("x" * 10_000_000)) <= 500
