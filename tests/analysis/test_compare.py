"""A live controller beside the recorded one: which differences count."""

import numpy as np
import pytest

from tdof_npid_ros.analysis.compare import Comparison, Recorded
from tdof_npid_ros.wire import EpisodeLabel

FIRST, SECOND = EpisodeLabel("aa", "11", 1), EpisodeLabel("aa", "11", 2)
SAME, OTHER = "0123", "4567"  # digests of parameters


def compared(*answers: tuple[EpisodeLabel, int, str, float]) -> Comparison:
    """Live answers, beside recorded ones that were all 1 with the parameters SAME."""
    one = np.array([1.0])
    recorded = Recorded("/", "/output", "/setpoint", {(label, stamp): (SAME, one) for label, stamp, *_ in answers})
    comparison = Comparison()
    for label, stamp, digest, effort in answers:
        comparison.take(recorded, (label, stamp), digest, np.array([effort]))
    return comparison


@pytest.mark.parametrize(
    ("answers", "sound"),
    [
        ([(FIRST, 0, SAME, 1.0), (FIRST, 1, SAME, 1.0)], True),
        ([(FIRST, 0, SAME, 1.0), (FIRST, 1, SAME, 2.0)], False),
        ([(FIRST, 0, OTHER, 2.0), (FIRST, 1, OTHER, 2.0)], True),
        ([(FIRST, 0, OTHER, 2.0), (FIRST, 1, SAME, 2.0)], True),  # the controller's state still is another
        ([(FIRST, 0, SAME, 2.0), (FIRST, 1, OTHER, 2.0)], False),  # the first difference was before that
        ([(FIRST, 0, OTHER, 2.0), (SECOND, 0, SAME, 2.0)], False),  # it began anew
        ([], False),
    ],
)
def test_what_differs_must_be_explained_by_other_parameters(
    answers: list[tuple[EpisodeLabel, int, str, float]], sound: bool
) -> None:
    assert compared(*answers).sound is sound
