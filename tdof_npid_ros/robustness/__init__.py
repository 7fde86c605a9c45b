"""How gains do on many plants near the model: spreads of its parameters, sweeps over samples of them, their report."""

from __future__ import annotations


class RobustError(ValueError):
    """A spread or a sweep that cannot be; the message says what of it, and what to do."""
