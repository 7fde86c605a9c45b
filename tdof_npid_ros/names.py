"""Names: of nodes, topics and services in their namespaces, and the one that a misspelt one stands for."""

from __future__ import annotations

from collections.abc import Iterable


def in_namespace(namespace: str, name: str = "") -> str:
    """The full name of what is called `name` in a namespace; without a name, what all names there begin with.

    >>> in_namespace("/", "output"), in_namespace("/left/", "output"), in_namespace("left")
    ('/output', '/left/output', '/left/')
    """
    inner = namespace.strip("/")
    return f"/{inner}/{name}" if inner else f"/{name}"


def namespace_of(full_name: str) -> str:
    """The namespace of a full name, with a slash at its end.

    >>> namespace_of("/left/output"), namespace_of("/output")
    ('/left/', '/')
    """
    return f"{full_name.rpartition('/')[0]}/"


def meant_hint(name: str, known: Iterable[str]) -> str:
    """What to add to the message about a name that is not known; nothing if none of the known ones is like it.

    >>> meant_hint("simulat", ["simulate", "tune"]), meant_hint("kpp", ["kp", "ki"]), meant_hint("xyz", ["kp"])
    (': simulate is meant?', ': kp is meant?', '')
    """
    from difflib import get_close_matches  # only where something is misspelt: it takes its time to import

    like = get_close_matches(name, known, 1)
    return f": {like[0]} is meant?" if like else ""
