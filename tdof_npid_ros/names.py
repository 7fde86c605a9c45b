"""Names of nodes, topics and services in their namespaces."""

from __future__ import annotations


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
