"""A comparison in words."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from mcsim.comparison import report
from mcsim.comparison.effects import EffectDifference
from mcsim.comparison.missing import not_compared
from mcsim.comparison.result import ChannelResult, DifferenceResult, NotCompared
from mcsim.systematics.beams import BeamSidelobe


@pytest.mark.parametrize(
    ("amplitude", "unit", "words"),
    [
        (1.0, "1 = opposite m", "one (opposite m)"),
        (-1.0, "1 = NESTED for RING", "one (NESTED for RING in side A)"),
        (-40.0, "deg", "one = −40 deg"),
        (0.01, "fraction", "one = 0.01 fraction"),
    ],
)
def test_amplitude_that_can_be_one_alone_is_its_meaning(amplitude, unit, words) -> None:
    assert DifferenceResult("one", "W", amplitude, unit, 1.0, {}, "").words == words


def test_sign_that_misleads_is_explained() -> None:
    """A ring of the beam has a negative amplitude, and a negative ring a positive one."""
    ring = EffectDifference(BeamSidelobe, np.zeros((2, 1, 12)), None, np.zeros(1, dtype=complex))
    assert "ring" in ring.said(np.array([-1e-3, 0.0]))
    assert ring.said(np.array([1e-3, 0.0])) == ""
    assert DifferenceResult("one", "W", -1.0, "K", 1.0, {}, "", "cold").words == "one = −1 K (cold)"


@pytest.mark.parametrize(
    ("missing_on", "words"),
    [
        (("a",), "W1, which side A lacks"),
        (("a", "b"), "W1, which side A and side B lack"),
        (("model",), "W1, which the model lacks"),
    ],
)
def test_a_map_that_is_not_compared_is_said_to_lack_on_each_side(missing_on, words) -> None:
    assert NotCompared("W1", missing_on).words == words


def test_without_a_model_no_map_is_said_to_lack_in_it(tmp_path) -> None:
    sides = {"V1": np.zeros(12)}, {"V1": np.zeros(12), "W1": np.zeros(12)}
    with pytest.warns(UserWarning, match="W1, which side A lacks"):
        assert not_compared((tmp_path / "a.toml", tmp_path / "b.toml"), sides, None) == (NotCompared("W1", ("a",)),)


@pytest.mark.parametrize(
    ("rms", "words"), [(0.0, "in every pixel."), (1e-6, "to an accuracy of 1 × 10⁻⁸ (1 × 10⁻⁶ uK rms).")]
)
def test_maps_without_any_difference_are_not_called_accurate_to_zero(rms, words) -> None:
    maps = np.zeros((1, 12))
    found = ChannelResult(
        *("W", ("W",), "identical", (), (), (), 0.0),
        *(rms, 100.0, 0.0, 0.0, 0.0, (), 0.0),
        *(maps, maps, maps, maps == 0.0, 0, None, ("W",)),
    )
    assert found.sentence() == f"W: identical {words}"


@pytest.mark.parametrize(("number", "words"), [(1, "one pixel that"), (2, "2 pixels that")])
def test_one_pixel_that_is_left_out_is_one(number, words) -> None:
    """It was "1 pixels that one side alone observed are left out"."""
    maps = np.zeros((1, 12))
    found = ChannelResult(
        *("W", ("W",), "identical", (), (), (), 0.0),
        *(0.0, 100.0, 0.0, 0.0, 0.0, (), 0.0),
        *(maps, maps, maps, maps == 0.0, number, None, ("W",)),
    )
    assert words in found.sentence()


def test_names_with_the_signs_of_mathematics_are_drawn_as_they_are() -> None:
    """matplotlib failed on them, after all was computed: nothing was written."""
    one = DifferenceResult("one", "a$_$b", 1.0, "K", 1.0, {"at": "c$_$d"}, "")
    maps = np.arange(12.0)[None]
    found = ChannelResult(
        *("a$_$b", ("a$_$b",), "difference", (one,), (), (), 0.0),
        *(1.0, 100.0, 0.0, 0.0, 0.0, (), 0.0),
        *(maps, maps + 1.0, maps, maps >= 0.0, 0, None, ("a$_$b",)),
    )
    picture = report.figure(found, "galactic")
    picture.draw_without_rendering()
    assert "A, a$_$b, galactic:" in picture.axes[0].get_title()


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (2, 64, [2, 5, 10, 20, 50]),
        (2, 4096, [10, 100, 1000]),
        (3.0, 3e5, [10, 100, 1000, 10000, 100000]),
        (31.0, 42.0, [31.0, 42.0]),
    ],
)
def test_numbers_at_an_axis_stand_apart(low, high, ticks):
    """From nside 1024 on those of the last multipoles were written over each other, and of all hits."""
    axes = Figure().subplots()
    axes.semilogx([low, high], [1.0, 2.0])
    report._plain_ticks(axes, low, high)
    assert [*axes.get_xticks()] == ticks
