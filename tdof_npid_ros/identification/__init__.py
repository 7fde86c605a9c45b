"""From a recording to a model of the plant: structures, their fit to a record, and what the record cannot tell."""


class IdentificationError(ValueError):
    """A record that cannot tell. The message is one line: what is wrong with it, and what to record instead."""
