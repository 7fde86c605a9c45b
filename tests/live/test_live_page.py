"""The page in a real browser, on a loop of real processes: seen, steered, refused, undone, kept, and ended."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import chromium_page
from live_program import CHROMIUM, Program, eventually, model, needs_chromium, opened

from tdof_npid_ros.case import load_case
from tdof_npid_ros.parameter_file import read_parameters

pytestmark = [pytest.mark.timeout(240), pytest.mark.alone]


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    one = Program(tmp_path, "p1-c0.5")
    yield one
    one.stop()


@pytest.mark.parametrize("asked", [("set", "kpp=5"), ("get", "kpp")])
def test_a_misspelt_parameter_is_told_of_with_the_one_that_is_meant(program: Program, asked: tuple[str, str]) -> None:
    command = [sys.executable, "-m", "tdof_npid_ros", *asked, "--namespace", "/live"]
    eventually(lambda: "controller" in program.tdof_npid("get", "--diagnostics"), "the controller is there")
    done = subprocess.run(command, env=program.environment, capture_output=True, text=True, timeout=60)
    said = f"tdof-npid {asked[0]}: controller has no parameter kpp: kp is meant?\n"
    assert (done.returncode, done.stderr) == (2, said)


@needs_chromium
def test_a_loop_begins_where_its_plant_rests_and_steps_by_its_own_step(tmp_path: Path) -> None:
    facts = ["--gain", "0.8", "--time-constant", "180", "--effort", "0", "100", "--at", "20", "--step", "40"]
    new = [sys.executable, "-m", "tdof_npid_ros", "new", "heater.yaml", *facts]
    assert subprocess.run(new, cwd=tmp_path, timeout=100).returncode == 0
    program = Program(tmp_path, "heater.yaml", "--speed", "20")
    try:
        assert CHROMIUM
        with chromium_page(CHROMIUM, width=1280) as page:
            opened(page, program.url)
            assert (model(page, "setpoint_field", "w.value"), model(page, "size", "w.value")) == (20.0, 40.0)
            assert program.tdof_npid("get", "setpoint")["setpoint"] == 20.0
            page.get_by_role("button", name="step up").click()
            numbers = lambda: str(model(page, "numbers", "w.text"))  # noqa: E731
            eventually(
                lambda: model(page, "setpoint_field", "w.value") == 60.0 and "overshoot 0.0 %" in numbers(), numbers
            )
    finally:
        program.stop()


@needs_chromium
def test_the_page_sees_and_steers_the_loop(program: Program) -> None:
    assert CHROMIUM
    with chromium_page(CHROMIUM, width=1280) as page:
        opened(page, program.url)
        assert model(page, "kp_field", "w.value") == load_case("p1-c0.5").gains.kp

        numbers = lambda: str(model(page, "numbers", "w.text"))  # noqa: E731
        said = lambda: numbers() + str(model(page, "nodes", "w.text"))  # noqa: E731
        eventually(lambda: "controller</b> running" in said(), said)  # a step is one from what was there before
        model(page, "setpoint_field", "w.value = 1.0")
        eventually(lambda: "overshoot" in numbers() and "M_s 2.3" in numbers(), said)

        model(page, "kp_field", "w.value = 5.0")
        eventually(lambda: program.tdof_npid("get", "kp")["kp"] == 5.0, "the controller's kp follows the field")
        eventually(lambda: abs(10 ** float(model(page, "kp", "w.value")) - 5.0) < 0.01, "the slider follows the field")

        model(page, "kp_field", "w.value = -5.0")  # against the other gains' signs
        eventually(
            lambda: (
                "differ in sign" in page.content()
                or "differ in sign" in str(page.evaluate("JSON.stringify(Bokeh.documents[0].to_json())"))
            ),
            "the reason stands on the page",
        )
        assert program.tdof_npid("get", "kp")["kp"] == 5.0
        eventually(lambda: model(page, "kp_field", "w.value") == 5.0, "the field shows what is in force")

        model(page, "undo", "w.trigger_event ? 0 : 0")
        page.get_by_role("button", name="undo").click()
        eventually(lambda: program.tdof_npid("get", "kp")["kp"] == load_case("p1-c0.5").gains.kp, "undo restores kp")

        page.get_by_role("button", name="keep").click()
        eventually(lambda: list(program.folder.glob("gains-*.yaml")), "keep writes a file")
        (kept,) = program.folder.glob("gains-*.yaml")
        assert read_parameters(kept, "controller")["kp"] == load_case("p1-c0.5").gains.kp
        simulate = [sys.executable, "-m", "tdof_npid_ros", "simulate", "p1-c0.5", "--gains", str(kept), "--json"]
        assert subprocess.run(simulate, capture_output=True, timeout=100).returncode == 0


@needs_chromium
def test_at_a_phones_width_everything_can_be_reached(program: Program) -> None:
    assert CHROMIUM
    with chromium_page(CHROMIUM, width=390, height=800, has_touch=True) as page:
        opened(page, program.url)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        for name in ("undo", "keep", "step up", "reset the plant", "by hand"):
            button = page.get_by_role("button", name=name)
            button.scroll_into_view_if_needed()
            box = button.bounding_box()
            assert box and box["x"] >= 0 and box["x"] + box["width"] <= 390, name


def test_without_the_token_nothing_is_served(program: Program) -> None:
    root, _, token = program.url.rstrip("/").rpartition("/")
    for path in ("/", "/static/js/bokeh.min.js", "/ws", f"/{token[:-1]}x/"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(root + path, timeout=10)
        assert refused.value.code in (404, 405)


def test_a_foreign_origin_is_refused(program: Program) -> None:
    address = urllib.parse.urlsplit(program.url)
    origins = {"http://evil.example": "403", f"http://{address.netloc}": ""}
    for origin, refused in origins.items():
        with socket.create_connection(("127.0.0.1", address.port or 0), timeout=30) as connection:
            lines = (
                f"GET {address.path}ws HTTP/1.1", f"Host: {address.netloc}", f"Origin: {origin}", "Upgrade: websocket",
                "Connection: Upgrade", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
            )  # fmt: skip
            connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
            status = connection.recv(64).split()[1].decode()
        assert (status == "403") == bool(refused), (origin, status)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_what_it_started_ends_with_it_however_it_ends(tmp_path: Path, number: int) -> None:
    program = Program(tmp_path, "p1-c0.5")
    eventually(lambda: len(program.nodes()) == 3, "three nodes run")
    program.stop(number)
    eventually(lambda: not program.nodes(), "no node is left", timeout=30)


def test_a_port_that_is_taken_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "tdof_npid_ros", "live", "--join", "/nobody", "--port", port, "--no-browser"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and f"port {port} cannot be had" in done.stderr


def test_without_a_display_the_address_is_told(tmp_path: Path) -> None:
    hidden = {"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"}
    environment = {name: value for name, value in os.environ.items() if name not in hidden} | {"TERM": "dumb"}
    command = [sys.executable, "-m", "tdof_npid_ros", "live", "--join", "/nobody"]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        lines = [program.stdout.readline() for _ in range(6)]
        program.send_signal(signal.SIGINT)
        assert program.wait(timeout=60) == 0
    assert lines[2].strip().startswith("http://127.0.0.1:")
    assert lines[5] == "No browser could be opened: open the address yourself.\n"
