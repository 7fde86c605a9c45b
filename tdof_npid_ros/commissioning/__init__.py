"""From an experiment's record to gains that may be trusted, and whether the loop does with them what was predicted."""
