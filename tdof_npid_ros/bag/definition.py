"""Message definitions (`ros2msg` text) as a tree of fields."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

from tdof_npid_ros.bag.errors import BagError, shown

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
WIDE_STRING: Final = "wstring"  # has a place in the grammar, but cannot be decoded
TIMES: Final = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
SEPARATOR: Final = "=" * 80  # before the `MSG:` line of each nested type

MAX_FIELDS: Final = 4096  # flattened; a recursive or exploding definition is refused long before memory ends
MAX_TEXT_BYTES: Final = 1 << 20
_MAX_DEPTH: Final = 32
_TIME_FIELDS: Final = [("sec", None), ("nanosec", None)]

_NESTED: Final = re.compile(r"^={20,}[ \t]*\r?\nMSG:[ \t]*(\S+)[ \t]*\r?$", re.MULTILINE)
_FIELD: Final = re.compile(
    r"([A-Za-z][\w/]*)(?:<=\d+)?"  # type, bounded string
    r"(\[(?:<=)?(\d{0,10})\])?"  # array
    r"\s+([A-Za-z]\w*)"
    r"(\s*=|\s|$)"  # a constant, a default value, or the end
)


@dataclass(frozen=True)
class Field:
    """One field: `count` is None for a single value, -1 for a sequence, else the length of a fixed array."""

    name: str
    type: str
    count: int | None

    def __str__(self) -> str:
        """Its type as a definition has it, bounds left out."""
        array = "" if self.count is None else "[]" if self.count < 0 else f"[{self.count}]"
        return self.type + array


@dataclass(frozen=True)
class Definition:
    """A message type: its fields and those of all types within, by "package/Type"."""

    root: str
    types: Mapping[str, tuple[Field, ...]]
    least: Mapping[str, int]  # bytes that a value of each type takes at least, padding left out
    path_counts: Mapping[str, int]  # how many paths each type has, arrays of messages gone into

    def fields(self, type_name: str | None = None) -> tuple[Field, ...]:
        """The fields of a type, by default of the message itself."""
        return self.types[type_name or self.root]

    @property
    def has_sequence_of_messages(self) -> bool:
        """Whether a few bytes of a message can announce many messages within it."""
        return any(field.count == -1 and field.type in self.types for type_ in self.types.values() for field in type_)

    @cached_property
    def paths(self) -> dict[str, Field]:
        """The last field of each flattened path, such as "header.frame_id" or "points.positions", in order.

        A stamp has a path of its own before those of its seconds and nanoseconds. So has an array of messages; the
        paths beneath it stand for that field of each of its messages.

        Raises:
            BagError: there are more than `MAX_FIELDS`.
        """
        if self.path_counts[self.root] > MAX_FIELDS:
            raise BagError(f"type {self.root}: more than {MAX_FIELDS} fields: read its messages with `decode`")
        return dict(self._paths(self.root, ""))

    @cached_property
    def columns(self) -> list[str]:
        """The paths that make a message's columns: those that do not lead into arrays of messages."""
        found: list[str] = []
        arrays: tuple[str, ...] = ()
        for path, field in self.paths.items():
            if path.startswith(arrays):
                continue
            found.append(path)
            if field.type in self.types and field.count is not None:
                arrays = (*arrays, path + ".")
        return found

    def _paths(self, type_name: str, prefix: str) -> Iterator[tuple[str, Field]]:
        for field in self.types[type_name]:
            path = prefix + field.name
            if field.type not in self.types or field.count is not None or field.type in TIMES:
                yield path, field
            if field.type in self.types:
                yield from self._paths(field.type, path + ".")


def short_name(type_name: str) -> str:
    """Return "package/Type" for "package/msg/Type"."""
    parts = type_name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def parse_fields(text: str, package: str, where: str) -> tuple[Field, ...]:
    """The fields in the text of one type, those of the same package by their full names.

    Raises:
        BagError: a line is no field and no constant.
    """
    fields = []
    for line in text.splitlines():
        content = line.split("#", 1)[0].strip()
        if content:
            field = _parse_line(content, package, where)
            if field is not None:
                fields.append(field)
    return tuple(fields)


def is_nested(type_name: str) -> bool:
    """Whether a field's type is a message, not a number or a string."""
    return type_name not in PRIMITIVES and type_name not in (STRING, WIDE_STRING)


def _parse_line(line: str, package: str, where: str) -> Field | None:
    match = _FIELD.match(line)
    if match is None:
        raise BagError(f"{where}: not a field: {shown(line)!r}: the definition is damaged or no ros2msg")
    type_name, array, size, name, after = match.groups(default="")
    if after.endswith("="):
        return None
    if is_nested(type_name):
        type_name = short_name(type_name if "/" in type_name else f"{package}/{type_name}")
    if not array:
        return Field(name, type_name, None)
    return Field(name, type_name, -1 if not size or "<=" in array else int(size))


def _fields_of(text: str, type_name: str) -> tuple[Field, ...]:
    fields = parse_fields(text, type_name.split("/", maxsplit=1)[0], f"type {shown(type_name)}")
    if len({field.name for field in fields}) < len(fields):
        raise BagError(f"type {shown(type_name)}: two fields bear one name: the definition is damaged")
    if type_name in TIMES and [(field.name, field.count) for field in fields] != _TIME_FIELDS:
        raise BagError(f"type {type_name}: its fields are not sec and nanosec: the definition is damaged")
    return fields


class _Measure:
    """The least size and the number of paths of each type in use; so all are there and none holds itself."""

    def __init__(self, root: str, types: Mapping[str, tuple[Field, ...]]) -> None:
        self._root = root
        self._types = types
        self.least: dict[str, int] = {name: int(code[1]) for name, code in PRIMITIVES.items()}
        self.least[STRING] = 4
        self.path_counts: dict[str, int] = {}
        self._go_into(root, ())

    def _go_into(self, name: str, within: tuple[str, ...]) -> None:
        if name in self.least:
            return
        where = f"type {shown(self._root)}"
        if name == WIDE_STRING:
            raise BagError(f"{where}: wide strings are not supported: leave this topic out")
        if name in within or len(within) > _MAX_DEPTH:
            raise BagError(f"{where}: {shown(name)} contains itself or is nested too deeply: the definition is damaged")
        if name not in self._types:
            raise BagError(f"{where}: the definition of {shown(name)} is missing in the bag: record it again")
        size = paths = 0
        for field in self._types[name]:
            self._go_into(field.type, (*within, name))
            element = self.least[field.type]
            size += 4 if field.count == -1 else element * (1 if field.count is None else field.count)
            paths += 1 + self.path_counts.get(field.type, 0)
        self.least[name] = max(size, 1)  # an empty message is sent as one byte
        self.path_counts[name] = paths


@lru_cache(maxsize=256)
def parse(type_name: str, text: str) -> Definition:
    """Parse a full definition as bags hold it: the type itself, then each nested type after its `MSG:` line.

    Raises:
        BagError: the text is no such definition, lacks a type, or holds one that contains itself.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise BagError(f"type {shown(type_name)}: its definition is longer than {MAX_TEXT_BYTES >> 20} MiB")
    root = short_name(type_name)
    pieces = _NESTED.split(text)
    types = {root: _fields_of(pieces[0], root)}
    for name, body in zip(pieces[1::2], pieces[2::2], strict=True):
        if short_name(name) not in types:
            types[short_name(name)] = _fields_of(body, short_name(name))
    measure = _Measure(root, types)
    return Definition(root, types, measure.least, measure.path_counts)
