"""Losses by the publishers' counts, of which nobody says whose they are."""

from __future__ import annotations

import random

import pytest

from tdof_npid_ros.graph.runtime.sequences import REMEMBERED, Sequences


@pytest.mark.parametrize(
    ("counts", "lost", "missed"),
    [
        ([1, 2, 3, 4], 0, 0),
        ([5, 6, 7], 0, 4),  # the recorder came late
        ([1, 2, 5, 6], 2, 0),
        ([1, 2, 5, 6, 9], 4, 0),
        ([1, 2, 1, 2, 3], 0, 0),  # the publisher was started again
        ([5836, 1, 5837, 2, 5838, 3], 0, 5835),  # a second publisher
        ([1, 2, 41, 3, 42, 4], 0, 40),  # … whose first messages came before the recorder knew of it
        ([1, 2, 41, 42, 3, 45], 2, 40),
        ([1, 1, 2, 2, 3, 3, 4, 4], 0, 0),
        ([7, 1, 9, 2, 10, 3], 1, 6),
        ([0, 0, 0], 0, 0),  # of a middleware that does not count
    ],
)
@pytest.mark.parametrize("at_once", [1, 100])
def test_losses_and_what_was_missed(counts: list[int], lost: int, missed: int, at_once: int) -> None:
    seen = Sequences()
    for first in range(0, len(counts), at_once):
        seen.take(counts[first : first + at_once])
    assert (seen.lost(), seen.missed) == (lost, missed)


def test_the_first_message_of_a_publisher_that_was_not_heard_before_shows_no_loss() -> None:
    """Nothing came of the first publisher since: the second one's count may go on from it, after a gap, or not."""
    seen = Sequences()
    seen.take([6, 7, 9])
    assert seen.lost(publishers=2) == 0 and seen.lost(publishers=1) == 1
    seen.take([10, 13])
    assert seen.lost(publishers=2) == 1  # one of the two gaps is a loss, the smaller one at least
    seen.take([8])  # so the count of 9 was the second one's
    assert seen.lost(publishers=2) == 2


def test_three_publishers_with_losses_interleaved_at_random() -> None:
    """No count of one is near another's, so every loss can be told."""
    rng, seen, lost = random.Random(1), Sequences(), 0
    next_ = {publisher: 1 + publisher * 1_000_000 for publisher in range(3)}
    for step in range(30_000):
        publisher = rng.randrange(3)
        gap = rng.randrange(1, 9) if step > 100 and rng.random() < 0.005 else 0
        lost += gap
        next_[publisher] += gap
        seen.take([next_[publisher]])
        next_[publisher] += 1
    assert lost > 10 * REMEMBERED / 3 and seen.lost(publishers=3) == lost
