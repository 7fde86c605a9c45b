"""`tdof-npid live`: a loop seen and steered in the browser."""

from __future__ import annotations

import argparse
import json
import signal
import time
import webbrowser
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any

NAMESPACE = "/live"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument(
        "case", nargs="?", help="a case (p1-c0.5, …, sprott) or the path of a parameter file, whose nodes are started"
    )
    parser.add_argument("--join", metavar="NAMESPACE", help="look on a loop that runs already, started by anybody")
    parser.add_argument("--mode", choices=("realtime", "lockstep"), default="realtime", help="default: realtime")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="simulated seconds a second (default: 1)")
    parser.add_argument("--bag", type=Path, metavar="DIR", help="record to this new folder from the start")
    parser.add_argument("--port", type=int, default=0, help="of the page, on this machine alone (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")


def run(arguments: argparse.Namespace) -> int:
    """Start or join a loop, serve its page until Ctrl-C, and stop what was started."""
    if (arguments.case is None) == (arguments.join is None):
        raise ValueError("give a case to start, or --join NAMESPACE for a loop that runs")
    from tdof_npid_ros.case import load_case
    from tdof_npid_ros.graph.observer import LoopObserver
    from tdof_npid_ros.graph.processes import NodeProcesses
    from tdof_npid_ros.graph.running import start_nodes
    from tdof_npid_ros.graph.runtime.middleware import stay_on_this_machine
    from tdof_npid_ros.live.page import LivePage
    from tdof_npid_ros.live.server import LiveServer
    from tdof_npid_ros.live.steering import Steering
    from tdof_npid_ros.parameter_file import find_parameter_file, read_parameters

    case = None if arguments.case is None else load_case(arguments.case)
    if case is not None:
        stay_on_this_machine()
    namespace = arguments.join or NAMESPACE
    stopped: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        stopped.append(number)

    with ExitStack() as stack:
        processes: NodeProcesses | None = None
        if case is not None:
            path = find_parameter_file(arguments.case)
            processes = stack.enter_context(NodeProcesses(path, namespace))
            common: dict[str, Any] = {"mode": arguments.mode, "speed": arguments.speed}
            plays = arguments.mode == "lockstep"
            # Until somebody steps the setpoint, the loop stays where the plant begins.
            stays = not plays and "setpoint" not in read_parameters(path, "controller")
            setpoint = {"setpoint": case.plant.initial_output} if stays else {}
            start_nodes(processes, case, path, arguments.bag, common, play=plays, controller=setpoint)
        observer = LoopObserver(namespace)
        stack.callback(observer.close)
        steering = Steering(observer, case)
        stack.callback(steering.close)
        recordings = Recordings(namespace, find_parameter_file(arguments.case or "p1-c0.5"))
        stack.callback(recordings.close)
        server = LiveServer(
            lambda document: LivePage(document, observer, steering, case, Path.cwd(), recordings.switch), arguments.port
        )
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        print(
            json.dumps({"url": server.url, "namespace": namespace}) if arguments.json else _told(server.url, namespace)
        )
        if not (arguments.no_browser or arguments.json or webbrowser.open(server.url)):
            print("No browser could be opened: open the address yourself.", flush=True)

        def until() -> bool:
            if processes is not None:
                processes.check()
            return bool(stopped)

        server.run(until)
    return 0


def _told(url: str, namespace: str) -> str:
    return f"The loop in {namespace} is at\n\n    {url}\n\nWhoever knows this address may steer it. Ctrl-C ends it."


class Recordings:
    """Recorders that the page begins and ends, one at a time.

    Args:
        namespace: of the loop.
        parameter_file: whatever the recorder reads of it.
    """

    def __init__(self, namespace: str, parameter_file: Path) -> None:
        self._namespace, self._file = namespace, parameter_file
        self._recorder: Any = None
        self._bag: Path | None = None

    def switch(self, on: bool) -> str:
        """Begin or end a recording; what to tell of it."""
        from tdof_npid_ros.graph.processes import NodeProcesses

        if on and self._recorder is None:
            self._bag = Path("bags") / f"live-{time.strftime('%Y%m%d-%H%M%S')}"
            self._recorder = NodeProcesses(self._file, self._namespace)
            self._recorder.start("recorder", {"bag": str(self._bag)})
            return f"recording to {self._bag}"
        if not on and self._recorder is not None:
            self.close()
            return f"recorded: {self._bag}; tdof-npid analyze {self._bag}"
        return ""

    def close(self) -> None:
        """End what records."""
        if self._recorder is not None:
            self._recorder.stop()
            self._recorder = None
