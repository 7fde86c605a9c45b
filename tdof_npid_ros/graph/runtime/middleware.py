"""What the loop needs of Fast DDS beyond ROS's quality of service; other middlewares do not look at it."""

from __future__ import annotations

import os

from tdof_npid_ros.parameter_file import config_folder

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"  # environment variable


def use_fast_dds_profile() -> None:
    """Let this process take `config/fastdds.xml`, unless its environment names a profile; before `rclpy.init`."""
    profile = config_folder() / "fastdds.xml"
    if profile.is_file():
        os.environ.setdefault(PROFILE, str(profile))
