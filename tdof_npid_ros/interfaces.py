"""The message types that are installed here: the one place where a type's name, also one from outside, is looked up.

A name is compared with ROS's grammar and with the ament index, in which each interface package registers its types.
Nothing is imported for a name that is not there.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from tdof_npid_ros.one_line import one_line

_INDEX: Final = Path("share/ament_index/resource_index/rosidl_interfaces")
_NAME: Final = re.compile(r"([a-z](?:_?[a-z0-9])*)(?:/(msg|srv|action))?/([A-Z][A-Za-z0-9]*)")


class InterfaceError(ValueError):
    """A type that is no message type, or not installed. The message is one line: which, what to do."""


def installed_file(type_name: str, suffix: str) -> Path:
    """The file of an installed message type: `.msg` holds its definition, `.json` its hashes.

    Raises:
        InterfaceError: no message type's name, or not installed.
    """
    prefix, package, kind, name = _installed(type_name)
    path = prefix / "share" / package / kind / f"{name}{suffix}"
    if not path.is_file():
        raise InterfaceError(f"{path} is missing: install the package {package} again")
    return path


def message_class(type_name: str) -> Any:
    """The class of an installed message type, such as `sensor_msgs/msg/JointState`.

    Raises:
        InterfaceError: no message type's name, not installed, a part of a service or an action, or what Python would
            import by the package's name is not the installed package.
    """
    prefix, package, kind, name = _installed(type_name)
    if kind != "msg":
        raise InterfaceError(f"the type {type_name} belongs to a service or an action: it is no message")
    try:
        if package not in sys.modules and not _is_of(package, prefix):
            raise InterfaceError(
                f"the Python package {package} is not the one installed in {prefix}: start from another folder, "
                "or set PYTHONPATH as the installation does"
            )
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise InterfaceError(
            f"the message type {type_name} cannot be loaded ({one_line(error)}): install the package {package} again"
        ) from None


def _installed(type_name: str) -> tuple[Path, str, str, str]:
    """Prefix of the installation, package, kind and name of a type."""
    match = _NAME.fullmatch(type_name) if len(type_name) <= 256 else None
    if match is None:
        raise InterfaceError(f"{one_line(type_name, 100)!r} is no message type: write it as package/msg/Type")
    package, kind, name = match[1], match[2] or "msg", match[3]
    for prefix in _prefixes():
        try:
            registered = (prefix / _INDEX / package).read_text(encoding="utf-8").split()
        except OSError:
            continue
        if f"{kind}/{name}.msg" in registered or f"{kind}/{name}.idl" in registered:
            return prefix, package, kind, name
    raise InterfaceError(f"the message type {type_name} is not installed here: install the package {package}")


def _prefixes() -> Iterator[Path]:
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix)
    yield Path(sys.prefix)


def _is_of(package: str, prefix: Path) -> bool:
    """Whether Python would import a package from an installation, and not from a folder that happens to bear its
    name; found out without importing it."""
    spec = importlib.machinery.PathFinder.find_spec(package)
    if spec is None:
        raise ImportError(f"Python does not find {package}")
    if not spec.origin:
        return False
    return any(where(prefix) in where(Path(spec.origin)).parents for where in (Path.absolute, Path.resolve))
