"""Types by name: only what is installed as an interface is imported."""

import sys
from pathlib import Path

import pytest

from tdof_npid_ros.interfaces import InterfaceError, message_class

EVIL = "from pathlib import Path\nPath({!r}).touch()\nclass X: pass\n"


def _package(folder: Path, name: str) -> Path:
    """A Python package that tells when it is imported."""
    executed = folder / "executed"
    (folder / name / "msg").mkdir(parents=True)
    for file in ("__init__.py", "msg/__init__.py"):
        (folder / name / file).write_text(EVIL.format(str(executed)))
    return executed


@pytest.mark.parametrize("name", ["evil/msg/X", "evil/X", "evil/msg/x", "evil.msg/msg/X", "/msg/X", "../evil/msg/X"])
def test_a_package_that_is_no_interface_is_not_imported(tmp_path, monkeypatch, name) -> None:
    executed = _package(tmp_path, "evil")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InterfaceError):
        message_class(name)
    assert not executed.exists()


def test_a_folder_named_as_an_installed_package_is_not_imported_in_its_place(tmp_path, monkeypatch) -> None:
    executed = _package(tmp_path, "nav_msgs")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "nav_msgs", raising=False)
    with pytest.raises(InterfaceError, match="is not the one installed"):
        message_class("nav_msgs/msg/Path")
    assert not executed.exists()


def test_parts_of_services_are_no_messages() -> None:
    with pytest.raises(InterfaceError, match="service or an action"):
        message_class("std_srvs/srv/Trigger")
