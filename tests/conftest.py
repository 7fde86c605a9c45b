"""The order of the files: those that take long begin first, so that no worker is left with one at the end."""

from __future__ import annotations

import pytest

LONG = (
    "graph/test_tuner.py",
    "live/",
    "graph/test_commission.py",
    "graph/test_operation.py",
    "graph/test_experiment.py",
    "paper/test_reproduce.py",
    "test_newcomer.py",
    "docs/test_site.py",
    "test_workers.py",
    "graph/",
    "examples/",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the files; within a file, tests stay as they are."""

    def rank(item: pytest.Item) -> int:
        path = item.path.as_posix()
        return next((i for i, part in enumerate(LONG) if f"/tests/{part}" in path), len(LONG))

    items.sort(key=rank)
