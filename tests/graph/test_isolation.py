"""What stays on this machine: sockets on the loopback interface alone, and yet everybody here finds everybody."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
from conftest import REPOSITORY

from tdof_npid_ros.graph.runtime.middleware import PROFILE, RANGE, stay_on_this_machine

LOOPBACK = "0100007F"  # 127.0.0.1, as Linux writes it
PROCESSES = 20
# Each says its name as long as it lives, and prints how many it has heard: all, itself too, or those of a minute.
CHATTER = """
import sys, time
import rclpy
from std_msgs.msg import String

name, count = sys.argv[1], int(sys.argv[2])
rclpy.init()
node = rclpy.create_node(name)
publisher = node.create_publisher(String, "chatter", 10)
heard, told = set(), False
node.create_subscription(String, "chatter", lambda message: heard.add(message.data), 100)
began = time.monotonic()
while True:
    publisher.publish(String(data=name))
    end = time.monotonic() + 0.2
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.05)
    if not told and (len(heard) == count or time.monotonic() - began > 60):
        told = True
        print(len(heard), flush=True)
"""


def udp_addresses(process: int) -> list[str]:
    """The local addresses of a process's UDP sockets."""
    targets = [str(file.readlink()) for file in Path(f"/proc/{process}/fd").iterdir() if file.is_symlink()]
    own = {target[len("socket:[") : -1] for target in targets if target.startswith("socket:[")}
    rows = [
        line.split()
        for table in ("udp", "udp6")
        for line in Path(f"/proc/{process}/net/{table}").read_text().splitlines()[1:]
    ]
    return [row[1].partition(":")[0] for row in rows if row[9] in own]


@pytest.mark.skipif(not Path("/proc/net/udp").exists(), reason="needs Linux's list of sockets")
@pytest.mark.parametrize("node", ["plant", "controller", "recorder"])
def test_a_nodes_sockets_are_on_the_loopback_interface_alone(graph: Any, node: str, tmp_path: Path) -> None:
    arguments = ["-p", f"bag:={tmp_path / 'bag'}"] if node == "recorder" else []
    process = graph.start(node, *arguments)
    graph.wait_for_nodes(f"/{node}")
    addresses = udp_addresses(process.process.pid)
    assert addresses and set(addresses) == {LOOPBACK}


def test_twenty_processes_and_onlookers_without_profile_find_each_other(graph: Any) -> None:
    plain = {name: value for name, value in graph.environment.items() if name != PROFILE}
    environments = {
        **{f"inside{i}": graph.environment for i in range(PROCESSES)},
        **{discovery_range: {**plain, RANGE: discovery_range} for discovery_range in ("LOCALHOST", "SUBNET")},
    }
    chatters = [
        subprocess.Popen(
            [sys.executable, "-c", CHATTER, name, str(len(environments))],
            env=environment, stdout=subprocess.PIPE, text=True,
        )
        for name, environment in environments.items()
    ]  # fmt: skip
    try:
        heard = [int(chatter.stdout.readline()) for chatter in chatters if chatter.stdout is not None]
        assert heard == [PROCESSES + 2] * len(chatters)
    finally:
        for chatter in chatters:
            chatter.kill()
            chatter.communicate()


def test_whoever_has_chosen_otherwise_is_left_to_it() -> None:
    for chosen in ({RANGE: "SUBNET"}, {RANGE: "LOCALHOST", PROFILE: "mine.xml"}, {RANGE: "OFF"}):
        environment = dict(chosen)
        stay_on_this_machine(environment)
        assert environment == chosen
    other = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    stay_on_this_machine(other)
    assert other == {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", RANGE: "LOCALHOST"}


def test_the_two_profiles_differ_in_where_they_are_bound_alone() -> None:
    def content(name: str) -> list[tuple[str, str]]:
        root = ElementTree.parse(REPOSITORY / "config" / name).getroot()
        only = ("transport_descriptors", "userTransports", "useBuiltinTransports", "metatrafficUnicastLocatorList",
                "initialPeersList")  # fmt: skip
        for parent in list(root.iter()):
            for child in list(parent):
                if child.tag.rpartition("}")[2] in only:
                    parent.remove(child)
        return [(element.tag, (element.text or "").strip()) for element in root.iter()]

    assert content("fastdds.xml") == content("fastdds_loopback.xml")
