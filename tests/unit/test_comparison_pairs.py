"""Two sets of maps in pairs: holes, maps that differ, and what a set of differences must explain."""

from pathlib import Path

import healpy
import numpy as np
import pytest

from mcsim.comparison.frames import common_frame
from mcsim.comparison.pairs import ChannelPair, _pair, _without_holes
from mcsim.comparison.prediction import Prediction, Set
from refusals import refused

NPIX = 12


def a_pair(*rests: float) -> ChannelPair:
    """Return maps whose differences have these rms, of which ten pixels are seen."""
    sign = np.where(np.arange(NPIX) % 2 == 0, 1.0, -1.0)
    a = np.zeros((len(rests), NPIX))
    seen = np.tile(np.arange(NPIX) < 10, (len(rests), 1))
    names = tuple(f"map {number}" for number in range(len(rests)))
    return ChannelPair("W", names, a, a + np.array(rests)[:, None] * sign, seen)


def test_maps_whose_difference_is_small_are_left_out_unless_all_are() -> None:
    assert a_pair(3.0, 0.4).where_different(0.5).differing == ("map 0",)
    assert a_pair(3.0, 0.6).where_different(0.5).differing == ("map 0", "map 1")
    assert a_pair(2.4, 2.6).where_different(2.5).differing == ("map 1",)
    assert a_pair(0.1, 0.4).where_different(0.5).differing == ("map 0", "map 1")


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_pixels_without_data_are_told_in_any_unit(unit: float) -> None:
    values = np.arange(1.0, NPIX + 1.0)
    values[[2, 5]] = np.nan, unit * healpy.UNSEEN
    found = _without_holes(values)
    assert np.flatnonzero(found == healpy.UNSEEN).tolist() == [2, 5]
    np.testing.assert_array_equal(np.delete(found, [2, 5]), np.delete(values, [2, 5]))


@pytest.mark.parametrize(("zeros", "holes"), [([3], []), ([3, 4], [3, 4]), (list(range(NPIX)), [])])
def test_several_zeros_are_holes_but_one_is_a_value(zeros: list[int], holes: list[int]) -> None:
    values = np.arange(1.0, NPIX + 1.0)
    values[zeros] = 0.0
    assert np.flatnonzero(_without_holes(values) == healpy.UNSEEN).tolist() == holes


@pytest.mark.parametrize(("a", "b", "one_sided"), [([1, 2], [], 2), ([], [1, 2, 3], 3), ([1, 2], [2, 3, 4], 3)])
def test_pixels_that_either_side_alone_observed_are_counted(a: list[int], b: list[int], one_sided: int) -> None:
    sides = []
    for missing in (a, b):
        sides.append({"W": np.arange(1.0, NPIX + 1.0)})
        sides[-1]["W"][missing] = np.nan
    found = _pair("W", ["W"], sides, None, 1)
    assert found.one_sided == one_sided
    assert found.seen.sum() == NPIX - len({*a, *b})


class Hiding(Prediction):
    """Noise hides a tenth of the variance, or what is given."""

    share = 0.1

    def hidden(self, found: Set) -> float:
        return self.share

    def out_of_sight(self, found: Set) -> float:
        return self.share


def test_a_set_leaves_what_is_beyond_the_noise_or_its_uncertainty() -> None:
    problem = Hiding(a_pair(2.0), (), 0.0)
    assert problem.excess(Set((), 0.3)) == pytest.approx(0.2)
    assert problem.excess(Set((), 0.11)) == pytest.approx(0.025)  # a quarter of what noise hides
    assert problem.unexplained(Set((), 0.3)) == pytest.approx(0.175)
    assert problem.unexplained(Set((), 0.11)) == 0.0


@pytest.mark.parametrize(
    ("left", "hidden", "named"),
    [
        (0.04, 0.0, True),
        (0.06, 0.0, False),
        (0.19, 0.1, True),
        (0.21, 0.1, False),
        (0.45, 0.3, True),
        (0.45, 0.51, False),
    ],
)
def test_a_set_is_named_if_it_explains_all_but_what_noise_hides(monkeypatch, left, hidden, named) -> None:
    """All but a twentieth, and one and a half times what noise hides, which is half at most."""
    monkeypatch.setattr(Hiding, "share", hidden)
    assert Hiding(a_pair(2.0), (), 0.0).suffices(Set((), left)) == named


@pytest.mark.parametrize(("scale", "named"), [(0.1, True), (0.3, True), (0.4, False)])
def test_maps_that_share_nothing_are_not_explained(scale: float, named: bool) -> None:
    """Side B has a mean square of 1, of which a set leaves 0.04 times that of the difference."""
    pair, size = a_pair(1.0), scale * 10.0
    pair.a[:] = pair.b - size
    assert Prediction(pair, (), 0.0).suffices(Set((), 0.04)) == named


def test_nothing_is_looked_for_in_what_is_smaller_than_identical_maps() -> None:
    """A tenth of an rms of 0.5 uK, over 20 uK."""
    problem = Prediction(a_pair(20.0), (), 0.5)
    least = (0.05 / 20.0) ** 2
    assert problem.enough == pytest.approx(least)
    assert [problem.complete(Set((), share * least)) for share in (0.9, 1.1)] == [True, False]


@pytest.mark.parametrize(
    ("one", "other", "frame"), [("G", "G", "galactic"), ("E", None, "ecliptic"), (None, None, None)]
)
def test_maps_without_a_model_are_in_the_frame_of_their_headers(
    one: str | None, other: str | None, frame: str | None, tmp_path: Path
) -> None:
    assert common_frame(None, two_sides(tmp_path, one, other)) == frame


def test_maps_of_two_frames_are_not_compared_pixel_by_pixel(tmp_path: Path) -> None:
    """They were called identical, without a word on their headers; a map that one side lacks does not count."""
    sides = two_sides(tmp_path, "G", "E")
    with refused(*(side / "W.fits" for side in sides), "galactic", "ecliptic", "COORDSYS"):
        common_frame(None, sides)
    (sides[1] / "W.fits").rename(sides[1] / "V.fits")
    assert common_frame(None, sides) is None
    # Maps of two channels are not compared, and each may be in a frame of its own.
    for number, name in ((0, "V.fits"), (1, "W.fits")):
        (sides[number] / name).write_bytes((sides[1 - number] / name).read_bytes())
    assert common_frame(None, sides) is None


def two_sides(folder: Path, *coordinates: str | None) -> list[Path]:
    sides = [folder / "one", folder / "other"]
    for side, coordinate in zip(sides, coordinates, strict=True):
        side.mkdir()
        healpy.write_map(side / "W.fits", np.arange(float(NPIX)), coord=coordinate, column_units="uK", dtype=float)
    return sides
