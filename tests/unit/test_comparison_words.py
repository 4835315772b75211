"""A comparison in words."""

import pytest

from mcsim.comparison.result import DifferenceResult


@pytest.mark.parametrize(
    ("amplitude", "unit", "words"),
    [
        (1.0, "1 = opposite m", "one (opposite m)"),
        (-40.0, "deg", "one = −40 deg"),
        (0.01, "fraction", "one = 0.01 fraction"),
    ],
)
def test_amplitude_that_can_be_one_alone_is_its_meaning(amplitude, unit, words) -> None:
    assert DifferenceResult("one", "W", amplitude, unit, 1.0, {}, "").words == words
