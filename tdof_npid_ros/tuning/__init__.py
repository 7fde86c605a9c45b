"""Optimisers in ask/tell form and the objective that they minimise."""


class TuningError(ValueError):
    """What is wrong with a tuning problem, the values told, or a saved state, and what to do."""
