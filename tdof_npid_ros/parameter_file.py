"""ROS parameter files, read as ROS reads them."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from tdof_npid_ros.input_file import InputError, read_yaml
from tdof_npid_ros.one_line import as_text


class ParameterFileError(ValueError):
    """A parameter file that cannot be read or written; the message names the file and what is wrong with it."""


def read_parameters(path: Path, node: str) -> dict[str, Any]:
    """The parameters that a ROS parameter file gives to a node of that name, in any namespace.

    Nested names are joined by dots. Later and more exact entries win, as in ROS: first `/**`, then the node's own.

    Raises:
        ParameterFileError: no such file, not YAML, or not a ROS parameter file.
    """
    document = _load(path)
    shared: dict[str, Any] = {}
    own: dict[str, Any] = {}
    _collect(document, node, path, shared, own)
    return shared | own


def sections_of(path: Path) -> list[str]:
    """The nodes that a parameter file is for, as it writes them: `/**/controller`, `/left/plant`, `/**`.

    Raises:
        ParameterFileError: it cannot be read.
    """

    def found(tree: dict[str, Any], above: str) -> Iterator[str]:
        for key, value in tree.items():
            name = f"{above}/{str(key).strip('/')}"
            if isinstance(value, dict) and "ros__parameters" in value:
                yield name
            elif isinstance(value, dict):
                yield from found(value, name)

    return list(found(_load(path), ""))


def is_for(section: str, node: str) -> bool:
    """Whether ROS gives a section's parameters to a node.

    Args:
        section: `/**/controller`, with `*` for one name and `**` for any number of them.
        node: its full name.
    """
    pattern = re.escape("/" + section.strip("/")).replace(r"/\*\*", "(/[^/]+)*").replace(r"/\*", "/[^/]+")
    return re.fullmatch(pattern, node) is not None


def find_parameter_file(name: str | Path) -> Path:
    """Where the parameter file of a case lies: the path itself, or `config/<name>.yaml` of the package.

    Raises:
        ParameterFileError: there is none.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path
    folder = config_folder()
    found = folder / f"{name}.yaml"
    if not found.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml"))) or "none"
        raise ParameterFileError(f"no case {str(name)!r}: the cases are {known}, or give the path of a parameter file")
    return found


def config_folder() -> Path:
    """The folder of the package's parameter files: beside the package in a checkout, else under `share/`."""
    package = Path(__file__).parent
    candidates = [package.parent / "config"]
    candidates += [parent / "share" / "tdof_npid_ros" / "config" for parent in (*package.parents, Path(sys.prefix))]
    return next((folder for folder in candidates if folder.is_dir()), candidates[0])


def check_replaceable(path: Path, node: str, names: Collection[str]) -> None:
    """Make sure that a file, if it is there, is as `write_parameters` writes these parameters: nothing else is lost.

    Raises:
        ParameterFileError: it holds something else.
    """
    if not path.is_file() or not path.stat().st_size:
        return
    values = read_parameters(path, node)
    if not set(values) <= set(names) or path.read_text("utf-8") != _text({node: values}):
        raise ParameterFileError(f"{path} holds more than such a result, which would be lost: give another file")


def for_ros(path: str | Path) -> str:
    """A path as text that ROS takes.

    Raises:
        ParameterFileError: it does not: bytes in it are not UTF-8.
    """
    text = str(path)
    if as_text(text) != text:
        raise ParameterFileError(f"{as_text(text)}: ROS takes names in UTF-8 alone: rename the file or folder")
    return text


def write_parameters(path: Path, nodes: dict[str, dict[str, Any]]) -> None:
    """Write a ROS parameter file: parameters by node name, for nodes in any namespace.

    Raises:
        ParameterFileError: the file cannot be written.
    """
    try:
        path.write_text(_text(nodes), encoding="utf-8")
    except OSError as error:
        raise ParameterFileError(f"{path} cannot be written: {error.strerror}") from error


def _text(nodes: dict[str, dict[str, Any]]) -> str:
    document = {f"/**/{node}": {"ros__parameters": values} for node, values in nodes.items()}
    return str(yaml.safe_dump(document, sort_keys=False, allow_unicode=True))


def _load(path: Path) -> dict[str, Any]:
    try:
        document = read_yaml(path)
    except InputError as error:
        raise ParameterFileError(str(error)) from error
    if not isinstance(document, dict):
        raise ParameterFileError(f"{path} is not a ROS parameter file: it needs node names at the top")
    return document


def _collect(tree: dict[str, Any], node: str, path: Path, shared: dict[str, Any], own: dict[str, Any]) -> None:
    for key, value in tree.items():
        if not isinstance(value, dict):
            raise ParameterFileError(f"{path}: {key!r} stands where a node's name and ros__parameters belong")
        name = str(key).rsplit("/", 1)[-1]
        if "ros__parameters" in value:
            parameters = value["ros__parameters"] or {}
            if not isinstance(parameters, dict):
                raise ParameterFileError(f"{path}: ros__parameters of {key!r} is not a mapping of names to values")
            if name in ("**", "*"):
                shared.update(_flat(parameters))
            elif name == node:
                own.update(_flat(parameters))
        else:
            _collect(value, node, path, shared, own)


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat
