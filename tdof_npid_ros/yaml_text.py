"""The one place where YAML is read: plain values only, and within limits of depth and size."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import yaml

from tdof_npid_ros.one_line import one_line

DEEPEST: Final = 50  # levels; what walks over the values may be recursive
MOST_VALUES: Final = 200_000  # with each alias counted as all that it stands for
LONGEST_NUMBER: Final = 100  # characters
LARGEST_WHOLE_NUMBER: Final = 2**64  # in magnitude; ROS holds 64 bits


class YamlTextError(ValueError):
    """A text that is not YAML, or beyond the limits. The message is one line: where, what."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # C's is ten times as fast
    """YAML's safe loader without its dates, sets and bytes, which ROS does not know either: they stay text."""


def _whole_number(loader: Any, node: Any) -> int:
    digits = loader.construct_scalar(node)
    if len(digits) <= LONGEST_NUMBER:
        value = int(loader.construct_yaml_int(node))
        if abs(value) <= LARGEST_WHOLE_NUMBER:
            return value
    problem = f"a whole number of {len(digits)} digits is too large"
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


_TAG = "tag:yaml.org,2002:"
_KINDS: Final = tuple(_TAG + kind for kind in ("null", "bool", "int", "float", "str", "seq", "map"))
_Loader.yaml_constructors = {tag: made for tag, made in _Loader.yaml_constructors.items() if tag in (*_KINDS, None)}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _TAG + "timestamp"]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}
_Loader.add_constructor(_TAG + "int", _whole_number)


def load_yaml(text: str) -> Any:
    """The first document of a YAML text as plain values: dicts, lists, text, numbers; nothing is executed.

    Raises:
        YamlTextError: not YAML; nested deeper than `DEEPEST`, more than `MOST_VALUES` values with aliases expanded,
            a value that contains itself, or a whole number beyond 64 bits.
    """
    try:
        _check_limits(yaml.parse(text, Loader=_Loader))
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise YamlTextError(_described(error)) from None
    except (ValueError, ArithmeticError, LookupError, TypeError, RecursionError) as error:
        # What PyYAML does not turn into an error of its own: `!!bool maybe`, a lone surrogate, …
        raise YamlTextError(one_line(error)) from None


def _check_limits(events: Iterable[Any]) -> None:
    """Go through a text's events before any value is made of them."""
    open_collections: list[tuple[str | None, int]] = []  # their anchors, and how many values there were before each
    sizes: dict[str, int] = {}  # values that an anchor stands for
    count = 0
    for event in events:
        anchor = getattr(event, "anchor", None)
        if isinstance(event, yaml.CollectionStartEvent):
            if len(open_collections) == DEEPEST:
                raise YamlTextError(f"{_place(event.start_mark)}nested deeper than {DEEPEST} levels")
            open_collections.append((anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            its_anchor, before = open_collections.pop()
            if its_anchor is not None:
                sizes[its_anchor] = count - before
        elif isinstance(event, yaml.AliasEvent):
            if any(anchor == its for its, _ in open_collections):
                raise YamlTextError(f"{_place(event.start_mark)}a value that contains itself")
            count += sizes.get(anchor or "", 0)
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if anchor is not None:
                sizes[anchor] = 1
        if count > MOST_VALUES:
            raise YamlTextError(f"{_place(event.start_mark)}more than {MOST_VALUES:,} values, aliases expanded")


def _described(error: yaml.YAMLError) -> str:
    """In one line: where, and what is wrong there."""
    if isinstance(error, yaml.MarkedYAMLError):
        what = ", ".join(part for part in (error.context, error.problem) if part)
        return one_line(f"{_place(error.problem_mark or error.context_mark)}{what}")
    return one_line(error)


def _place(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else ""
