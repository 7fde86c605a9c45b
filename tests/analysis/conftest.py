"""The folder's helpers are imported by name."""
