"""The one error of the package, and names from outside as it may show them."""

from collections.abc import Sequence
from typing import Final

from tdof_npid_ros.one_line import one_line

_LONGEST_ERROR: Final = 600  # characters
_LONGEST_NAME: Final = 120
_MOST_CHOICES: Final = 20


class BagError(RuntimeError):
    """A bag cannot be written or read. The message is one line: what, where, what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message, _LONGEST_ERROR))


def shown(name: object) -> str:
    """A name that a file holds, as it may stand within a line: it may have any length and any characters."""
    return one_line(name, _LONGEST_NAME)


def choices(names: Sequence[str]) -> str:
    """The names to choose from, the first of them where there are many."""
    listed = ", ".join(map(shown, names[:_MOST_CHOICES]))
    more = len(names) - _MOST_CHOICES
    return (f"{listed} and {more} more" if more > 0 else listed) or "none"
