"""The one error of the package."""


class BagError(RuntimeError):
    """A bag cannot be written or read. The message is one line: what, where, what to do."""
