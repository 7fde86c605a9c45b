"""What arrives while the executor arms itself, so that no event tells of it, is served all the same."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

LISTENER = """
import sys
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tdof_npid_ros.graph.runtime.node import LoopNode
from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS
from tdof_npid_ros.graph.runtime.run import run_node

class Listener(LoopNode):
    def activate(self):
        self.create_subscription(String, "word", lambda message: print(message.data, flush=True), LATCHED_QOS)
        self.create_service(Trigger, "ask", self.on_ask)

    def on_ask(self, request, response):
        print("asked", flush=True)
        return response

run_node(lambda: Listener("listener"), sys.argv)
"""


@pytest.mark.parametrize(("topic", "word"), [("rt/word", "heard"), ("rq/askRequest", "asked")])
def test_what_comes_while_no_event_tells_of_it_is_served_within_a_second(
    graph: Any, tmp_path: Path, topic: str, word: str
) -> None:
    from std_msgs.msg import String
    from std_srvs.srv import Trigger

    from tdof_npid_ros.graph.runtime.qos import LATCHED_QOS

    compiler, library, log = shutil.which("cc"), tmp_path / "widened_window.so", tmp_path / "log.txt"
    if compiler is None:
        pytest.skip("no C compiler here")
    source = Path(__file__).with_name("widened_window.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    environment = {**graph.environment, "LD_PRELOAD": str(library), "WINDOW_TOPIC": topic}
    publisher = graph.node.create_publisher(String, "word", LATCHED_QOS)
    client = graph.node.create_client(Trigger, "ask")
    with log.open("w") as stream:
        process = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=stream, env=environment)
    try:
        graph.wait_until(lambda: log.read_text() == "window\n", 60, "the window")
        graph.wait_until(lambda: client.service_is_ready() and publisher.get_subscription_count(), 3, "the listener")
        if topic == "rt/word":
            publisher.publish(String(data=word))
        else:
            client.call_async(Trigger.Request())
        graph.wait_until(lambda: word in log.read_text(), 10, f"{word!r} in the log")
    finally:
        process.terminate()
        assert process.wait(20) == 0
