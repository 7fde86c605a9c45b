"""`tdof-npid live`: a loop seen and steered in the browser."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import webbrowser
from contextlib import ExitStack, closing
from pathlib import Path
from types import FrameType

from tdof_npid_ros.cli.gains import add_gain_arguments, asked_for

NAMESPACE = "/live"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument(
        "case", nargs="?", help="a case (p1-c0.5, …, sprott) or the path of a parameter file, whose nodes are started"
    )
    parser.add_argument(
        "--join",
        nargs="+",
        metavar="NAMESPACE",
        help="look on loops that run already, started by anybody; with a case, it is theirs",
    )
    add_gain_arguments(parser)
    parser.add_argument("--mode", choices=("realtime", "lockstep"), default="realtime", help="default: realtime")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="simulated seconds a second (default: 1)")
    parser.add_argument("--bag", type=Path, metavar="DIR", help="record to this new folder from the start")
    parser.add_argument("--port", type=int, default=0, help="of the page, on this machine alone (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="only print the page's address")


def run(arguments: argparse.Namespace) -> int:
    """Start or join a loop, serve its page until Ctrl-C, and stop what was started."""
    if arguments.case is None and arguments.join is None:
        raise ValueError("give a case to start, or --join NAMESPACE for a loop that runs")
    from tdof_npid_ros.case import load_case
    from tdof_npid_ros.graph.processes import NodeProcesses
    from tdof_npid_ros.graph.running import start_nodes
    from tdof_npid_ros.graph.runtime.middleware import stay_on_this_machine
    from tdof_npid_ros.live.page import LivePage
    from tdof_npid_ros.live.server import LiveServer
    from tdof_npid_ros.live.view import LiveLoop
    from tdof_npid_ros.parameter_file import find_parameter_file, read_parameters

    case = None if arguments.case is None else load_case(arguments.case)
    path = None if arguments.case is None else find_parameter_file(arguments.case)
    given = {} if arguments.case is None else asked_for(arguments)
    if given and arguments.join:
        raise ValueError("gains of a loop that runs are set in it: tdof-npid set, or on the page")
    namespaces = arguments.join or [NAMESPACE]
    stopped: list[int] = []

    def stop(number: int, _: FrameType | None) -> None:
        stopped.append(number)

    with ExitStack() as stack:
        loops: list[LiveLoop] = []
        server = LiveServer(lambda document: LivePage(document, loops, Path.cwd()), arguments.port)
        processes: NodeProcesses | None = None
        if arguments.join is None and case is not None and path is not None:
            stay_on_this_machine()
            processes = stack.enter_context(NodeProcesses(path, NAMESPACE))
            given |= {"mode": arguments.mode, "speed": arguments.speed}
            plays = arguments.mode == "lockstep"
            # Until somebody steps the setpoint, the loop stays where the plant begins.
            stays = not plays and "setpoint" not in read_parameters(path, "controller")
            given |= {"setpoint": case.plant.initial_output} if stays else {}
            start_nodes(processes, case, path, arguments.bag, given, play=plays)
        loops += [stack.enter_context(closing(LiveLoop(namespace, case, path))) for namespace in namespaces]
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        print(
            json.dumps({"url": server.url, "namespace": namespaces[0]})
            if arguments.json
            else _told(server.url, ", ".join(namespaces))
        )
        if not (arguments.no_browser or arguments.json or _opened(server.url)):
            print("No browser could be opened: open the address yourself.", flush=True)

        def until() -> bool:
            if processes is not None:
                processes.check()
            return bool(stopped)

        server.run(until)
    return 0


def _told(url: str, namespace: str) -> str:
    return f"The loop in {namespace} is at\n\n    {url}\n\nWhoever knows this address may steer it. Ctrl-C ends it."


def _opened(url: str) -> bool:
    """Whether a browser shows the page; one for the terminal, which could not, is not asked."""
    needs_display = sys.platform.startswith("linux") and "BROWSER" not in os.environ
    if needs_display and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    return webbrowser.open(url)
