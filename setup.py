"""Packaging, for colcon (ament_python) and for pip."""

import sys
from pathlib import Path

from setuptools import find_packages, setup

NAME = "tdof_npid_ros"
NODES = ["plant", "controller", "scenario", "tuner", "recorder", "replay"]

# `ros2 run` finds a node by the name of its executable in lib/tdof_npid_ros, where colcon puts it. Under pip such
# executables would land in bin/, where names like `plant` belong to nobody: there, `python -m tdof_npid_ros.graph
# plant`.
by_colcon = "install" in sys.argv or "develop" in sys.argv
node_scripts = [f"{node} = {NAME}.graph.__main__:{node}" for node in NODES] if by_colcon else []

ROS = ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"]
CLUSTER = ["dask>=2025.1", "distributed>=2025.1"]
PAPER = ["pymoo>=0.6,<0.7", "cma>=4,<5"]
BENCH = [
    "control==0.10.2",
    "simple-pid==2.0.1",
    "bdsim==1.4.0",
    "optuna==5.0.0",
    "cmaes==0.13.1",
    "pymoo==0.6.2",
    "cma==4.5.0",
    "mcap==1.6.0",
    "mcap-ros2-support==0.6.0",
    "rosbags==0.11.9",
]
EXAMPLES = ["mujoco-core>=4; python_version >= '3.11'"]  # without its viewers: 10 MB
TEST = [
    "argcomplete",
    "pytest>=8",
    "pytest-timeout",
    "pytest-xdist",
    "control>=0.10,<0.11",
    "hypothesis",
    "ruff",
    "mypy",
    "import-linter>=2.4",
    "types-PyYAML",
    "scipy-stubs",
    "rosbags",
    "mcap-ros2-support",
    "playwright",
    "sphinx>=7",
    "myst-nb>=1",
    "ipykernel<7",  # 7 warns of each kernel that its port is not encrypted
    "twine",
    "colcon-core",
    "colcon-ros",
    "colcon-package-selection",
    "colcon-bash",
    "colcon-recursive-crawl",
    "setuptools<80",
]

setup(
    name=NAME,
    version="0.1.0",
    description="Nonlinear two-degree-of-freedom PID control loops as ROS 2 nodes",
    long_description=Path(__file__).with_name("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="the tdof_npid_ros developers",
    maintainer_email="tdof-npid-ros@example.org",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "paper/*.csv"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", [str(path) for path in Path("config").glob("*.*")]),
        (f"share/{NAME}/config/sros2", [str(path) for path in Path("config/sros2").glob("*.xml")]),
        (f"share/{NAME}/examples", [str(path) for path in Path("examples").glob("*.*")]),
        (f"share/{NAME}/examples/arm", [str(path) for path in Path("examples/arm").glob("*.*")]),
        (f"share/{NAME}/launch", [str(path) for path in Path("launch").glob("*.launch.py")]),
    ],
    python_requires=">=3.10",
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "numba>=0.59",
        "mpmath>=1.3",
        "PyYAML>=6",
        "mcap>=1.1",
        "zstandard>=0.22",
        "lz4>=4",
        "matplotlib>=3.6",
        "bokeh>=3.4",
        "tqdm>=4.60",
    ],
    extras_require={
        "ros": ROS,
        "paper": PAPER,
        "cluster": CLUSTER,
        "examples": EXAMPLES,
        "test": [*TEST, *PAPER, *CLUSTER, *EXAMPLES],
        "bench": [*BENCH, *CLUSTER],
    },
    entry_points={"console_scripts": [f"tdof-npid = {NAME}.cli:entry", *node_scripts]},
    zip_safe=False,
)
