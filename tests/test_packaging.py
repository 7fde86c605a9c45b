"""The package installs with colcon as an ament_python package, and a node starts from the installed tree."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parent.parent
NODES = {"plant", "controller", "scenario", "tuner", "recorder", "replay", "tdof-npid"}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prefix of a colcon build of a clone of the package."""
    colcon = shutil.which("colcon", path=str(Path(sys.executable).parent))
    if colcon is None:
        pytest.skip("colcon is not installed beside this Python (pip install -e '.[test]')")
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / "tdof_npid_ros"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    built = subprocess.run([colcon, "build"], cwd=workspace, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return workspace / "install" / "tdof_npid_ros"


def test_colcon_installs_what_ros2_run_and_launch_look_for(installed: Path) -> None:
    assert {path.name for path in (installed / "lib" / "tdof_npid_ros").iterdir()} == NODES
    share = installed / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "tdof_npid_ros").is_file()
    assert (share / "tdof_npid_ros" / "package.xml").is_file()
    launch = {path.name for path in (share / "tdof_npid_ros" / "launch").iterdir()}
    assert launch == {f"{name}.launch.py" for name in ("loop", "controller", "tuner", "replay")}
    assert len(list((share / "tdof_npid_ros" / "config").glob("*.yaml"))) >= 7


def test_a_node_starts_from_the_installed_tree(installed: Path) -> None:
    site = next((installed / "lib").glob("python*/site-packages"))
    environment = {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    environment |= {
        "PYTHONPATH": str(site),
        "PYTHONUNBUFFERED": "1",
        "ROS_DOMAIN_ID": "88",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    parameters = installed / "share" / "tdof_npid_ros" / "config" / "p1-c0.5.yaml"
    command = [sys.executable, str(installed / "lib" / "tdof_npid_ros" / "recorder")]
    bag = installed.parent / "bag"
    node = subprocess.Popen(
        [*command, "--ros-args", "--params-file", str(parameters), "-p", f"bag:={bag}"],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=installed,
    )  # fmt: skip
    try:
        assert node.stdout is not None
        first = node.stdout.readline()
        assert "recording to" in first, first + node.stdout.read()
        node.send_signal(signal.SIGINT)
        assert node.wait(20) == 0
    finally:
        node.kill()


def test_the_program_finds_the_cases_of_an_installed_tree(installed: Path) -> None:
    site = next((installed / "lib").glob("python*/site-packages"))
    done = subprocess.run(
        [sys.executable, str(installed / "lib" / "tdof_npid_ros" / "tdof-npid"), "simulate", "p1-c4", "--json"],
        env={**os.environ, "PYTHONPATH": str(site)}, capture_output=True, text=True, cwd=installed,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert '"case": "p1-c4"' in done.stdout


def test_a_source_distribution_is_whole_and_passes_twine(tmp_path: Path) -> None:
    pytest.importorskip("twine", reason="twine is not installed: pip install -e '.[test]'")
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path)]
    command += ["sdist", "--dist-dir", str(tmp_path)]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    for folder in ("config", "launch", "examples", "examples/arm"):
        files = [f"{folder}/{path.name}" for path in (ROOT / folder).iterdir() if path.is_file()]
        assert files and set(files) <= names, folder
    checked = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", str(archive)], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout


def test_pip_installs_ros_only_when_asked() -> None:
    text = (ROOT / "setup.py").read_text()
    required = text[text.index("install_requires") : text.index("extras_require")]
    assert "ros-jazzy" not in required


def test_the_package_names_what_its_messages_and_launch_files_need() -> None:
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    needed = {one.text for one in package.iter("exec_depend")}
    imported = re.compile(r"^from (\w+_msgs|launch|launch_ros|std_srvs|rclpy)\b", re.MULTILINE)
    sources = [*(ROOT / "tdof_npid_ros").rglob("*.py"), *(ROOT / "launch").glob("*.py")]
    assert {name for source in sources for name in imported.findall(source.read_text())} <= needed
    for name in ("url", "author", "maintainer", "license", "test_depend"):
        assert package.findtext(name), name
