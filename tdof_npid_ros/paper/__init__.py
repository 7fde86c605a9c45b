"""The paper's numbers, and their reproduction."""
