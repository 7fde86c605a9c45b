"""What the loop needs of Fast DDS beyond ROS's quality of service; other middlewares do not look at it."""

from __future__ import annotations

import os
from collections.abc import MutableMapping

from tdof_npid_ros.parameter_file import config_folder

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"  # environment variable
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"  # environment variable


def use_fast_dds_profile() -> None:
    """Let this process take `config/fastdds.xml`, unless its environment names a profile; before `rclpy.init`."""
    profile = config_folder() / "fastdds.xml"
    if profile.is_file():
        os.environ.setdefault(PROFILE, str(profile))


def stay_on_this_machine(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let this process and those that it starts be reached from this machine alone; before `rclpy.init`.

    Whoever has set another discovery range or named a profile is left to it. ROS's range LOCALHOST is not enough: it
    keeps others from being found, but the sockets are open on every interface. So `config/fastdds_loopback.xml` binds
    them to the loopback interface. With LOCALHOST, too, ROS would add a transport of its own that is on every
    interface; the profile says all that LOCALHOST does.
    """
    environment.setdefault(RANGE, "LOCALHOST")
    profile = config_folder() / "fastdds_loopback.xml"
    is_fast_dds = environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
    is_ours = environment.get(PROFILE, str(profile)) in (str(profile), str(config_folder() / "fastdds.xml"))
    if environment[RANGE] == "LOCALHOST" and is_fast_dds and is_ours and profile.is_file():
        environment[PROFILE] = str(profile)
        environment[RANGE] = "SYSTEM_DEFAULT"
