"""Bags: rosbag2 folders of MCAP files, written, read and recovered without ROS.

`writer.BagWriter` records, `reader.BagReader` reads messages or NumPy columns, `recover.recover` makes a
crashed bag whole. Every failure is a `BagError`.
"""

from tdof_npid_ros.bag.errors import BagError

__all__ = ["BagError"]
