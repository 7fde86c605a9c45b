"""Margins of the sampled loop, and the certificate that it always comes to rest."""

from __future__ import annotations


class StabilityError(ValueError):
    """A loop whose margins are not defined here; the message says which feature is in the way and what to do."""
