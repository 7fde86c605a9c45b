"""The tuner node and the loops that it tunes through."""
