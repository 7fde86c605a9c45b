"""Message definitions (`ros2msg` text) as a tree of fields."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from tdof_npid_ros.bag.errors import BagError

# NumPy's code of each primitive type. `string` has none.
PRIMITIVES: Final = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
STRING: Final = "string"
TIMES: Final = ("builtin_interfaces/Time", "builtin_interfaces/Duration")

MAX_FIELDS: Final = 4096  # flattened; a recursive or exploding definition is refused long before memory ends
MAX_TEXT_BYTES: Final = 1 << 20
_MAX_DEPTH: Final = 32

_SEPARATOR: Final = re.compile(r"^={20,}[ \t]*\r?\nMSG:[ \t]*(\S+)[ \t]*\r?$", re.MULTILINE)
_FIELD: Final = re.compile(
    r"([A-Za-z][\w/]*)(?:<=\d+)?"  # type, bounded string
    r"(\[(?:<=)?(\d*)\])?"  # array
    r"\s+([A-Za-z]\w*)"
    r"(\s*=|\s|$)"  # a constant, a default value, or the end
)


@dataclass(frozen=True)
class Field:
    """One field: `count` is None for a single value, -1 for a sequence, else the length of a fixed array."""

    name: str
    type: str
    count: int | None


@dataclass(frozen=True)
class Definition:
    """A message type: its fields and those of all types within, by "package/Type"."""

    root: str
    types: Mapping[str, tuple[Field, ...]]
    least: Mapping[str, int]  # bytes that a value of each type takes at least, padding left out

    def fields(self, type_name: str | None = None) -> tuple[Field, ...]:
        """Return the fields of a type, by default of the message itself."""
        return self.types[type_name or self.root]

    def paths(self) -> list[str]:
        """Return the flattened field paths, such as "header.frame_id", in order.

        A stamp has a path of its own before those of its seconds and nanoseconds. Arrays of messages end a
        path.
        """
        found: list[str] = []
        for path in self._paths(self.root, ""):
            found.append(path)
            if len(found) > MAX_FIELDS:
                raise BagError(f"type {self.root}: more than {MAX_FIELDS} fields: read its messages with `decode`")
        return found

    def _paths(self, type_name: str, prefix: str) -> Iterator[str]:
        for field in self.types[type_name]:
            path = prefix + field.name
            if field.type in self.types and field.count is None:
                if field.type in TIMES:
                    yield path
                yield from self._paths(field.type, path + ".")
            else:
                yield path


def short_name(type_name: str) -> str:
    """Return "package/Type" for "package/msg/Type"."""
    parts = type_name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _parse_line(line: str, package: str, where: str) -> Field | None:
    match = _FIELD.match(line)
    if match is None:
        raise BagError(f"{where}: not a field: {line[:80]!r}: the bag's definition is damaged or no ros2msg")
    type_name, array, size, name, after = match.groups(default="")
    if after.endswith("="):
        return None
    if type_name not in PRIMITIVES and type_name != STRING:
        if type_name == "wstring":
            raise BagError(f"{where}: wide strings are not supported: leave this topic out")
        type_name = short_name(type_name if "/" in type_name else f"{package}/{type_name}")
    if not array:
        return Field(name, type_name, None)
    return Field(name, type_name, -1 if not size or "<=" in array else int(size))


def _parse_fields(text: str, type_name: str) -> tuple[Field, ...]:
    fields = []
    for line in text.splitlines():
        content = line.split("#", 1)[0].strip()
        if content:
            field = _parse_line(content, type_name.split("/")[0], f"type {type_name}")
            if field is not None:
                fields.append(field)
    if len({field.name for field in fields}) < len(fields):
        raise BagError(f"type {type_name}: two fields bear one name: the definition is damaged")
    if type_name in TIMES and [(field.name, field.count) for field in fields] != [
        ("sec", None),
        ("nanosec", None),
    ]:
        raise BagError(f"type {type_name}: its fields are not sec and nanosec: the definition is damaged")
    return tuple(fields)


def _least_sizes(root: str, types: Mapping[str, tuple[Field, ...]]) -> dict[str, int]:
    """Return the least size of each type in use, and so find out whether all are there and none holds itself."""
    least: dict[str, int] = {name: int(code[1]) for name, code in PRIMITIVES.items()}
    least[STRING] = 4

    def measure(name: str, path: tuple[str, ...]) -> int:
        if name in least:
            return least[name]
        if name in path or len(path) > _MAX_DEPTH:
            raise BagError(f"type {root}: {name} contains itself or is nested too deeply: the definition is damaged")
        if name not in types:
            raise BagError(f"type {root}: the definition of {name} is missing in the bag: record it again")
        size = 0
        for field in types[name]:
            element = measure(field.type, (*path, name))
            size += 4 if field.count == -1 else element * (1 if field.count is None else field.count)
        least[name] = max(size, 1)  # an empty message is sent as one byte
        return least[name]

    measure(root, ())
    return least


@lru_cache(maxsize=256)
def parse(type_name: str, text: str) -> Definition:
    """Parse a full definition as bags hold it: the type itself, then each nested type after its `MSG:` line.

    Raises
    ------
    BagError
        The text is no such definition, lacks a type, or holds one that contains itself.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise BagError(f"type {type_name[:80]}: its definition is longer than {MAX_TEXT_BYTES >> 20} MiB")
    root = short_name(type_name)
    pieces = _SEPARATOR.split(text)
    types = {root: _parse_fields(pieces[0], root)}
    for name, body in zip(pieces[1::2], pieces[2::2], strict=True):
        types.setdefault(short_name(name), _parse_fields(body, short_name(name)))
    return Definition(root, types, _least_sizes(root, types))
