import pytest
from bag_samples import JOINT_STATE, TYPES
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from tdof_npid_ros.bag import BagError, schema

LOGGED = [
    JOINT_STATE,
    "rcl_interfaces/msg/ParameterEvent",
    "rcl_interfaces/msg/Log",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rosgraph_msgs/msg/Clock",
    "trajectory_msgs/msg/JointTrajectory",
]


@pytest.mark.parametrize("type_name", LOGGED)
def test_hash_is_that_of_rosbags(type_name: str) -> None:
    assert schema.type_hash(type_name) == TYPES.hash_rihs01(type_name)


@pytest.mark.parametrize("type_name", LOGGED)
def test_definition_holds_all_nested_types(type_name: str) -> None:
    theirs = Schema(id=1, name=type_name, encoding="ros2msg", data=schema.definition(type_name).encode())
    assert callable(DecoderFactory().decoder_for("cdr", theirs))


def test_definition_has_rosbag2s_separators() -> None:
    text = schema.definition(JOINT_STATE)
    assert [line for line in text.splitlines() if line.startswith("MSG: ")] == [
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
    ]
    assert f"\n{'=' * 80}\nMSG: std_msgs/Header\n" in text


@pytest.mark.parametrize("type_name", ["no_such_msgs/msg/Thing", "sensor_msgs/msg/Nothing"])
def test_missing_type_says_which_package_to_install(type_name: str) -> None:
    with pytest.raises(BagError, match=f"{type_name}.*install the package"):
        schema.definition(type_name)


@pytest.mark.parametrize(
    "type_name",
    [
        "",
        "JointState",
        "../../etc/passwd",
        "a/b/c/d",
        "/msg/X",
        "std_msgs/msg/",
        "std_msgs/msg/String ",
        "x" * 100_000,
        "std_msgs/../std_msgs/msg/String",
        "std__msgs/msg/String",
        "std_msgs\n/msg/String",
    ],
)
def test_name_that_is_no_type_is_refused(type_name: str) -> None:
    with pytest.raises(BagError, match="no message type"):
        schema.definition(type_name)


def test_sourced_workspace_comes_first(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "share" / "my_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Pair.msg").write_text("Single first\nSingle second\n")
    (folder / "Single.msg").write_text("float64 value\n")
    index = tmp_path / "share" / "ament_index" / "resource_index" / "rosidl_interfaces"
    index.mkdir(parents=True)
    (index / "my_msgs").write_text("msg/Pair.idl\nmsg/Pair.msg\nmsg/Single.idl\nmsg/Single.msg")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    text = schema.definition("my_msgs/msg/Pair")
    assert text == f"Single first\nSingle second\n\n{'=' * 80}\nMSG: my_msgs/Single\nfloat64 value\n"
