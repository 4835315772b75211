"""Bad pixels: which of what stands out is left out, and how they are said."""

from types import SimpleNamespace

import healpy
import numpy as np
import pytest

from mcsim.datavector.bad_pixels import BadPixels, _largest, standing_out
from mcsim.diagnosis import verdict

NSIDE = 16


def of(places):
    return BadPixels(places, NSIDE, ("V1", "W1"), "ecliptic")


def test_what_stands_out_in_several_maps_is_left_out_of_that_where_it_is_largest():
    """Pixel 5 is bad in the third map, and through the sky in the others; 7 is small beside it."""
    maps = np.zeros((4, 9))
    maps[:, 5], maps[1, 7] = (4.2, 10.5, -12.1, 10.5), 5.0
    found = {1: {5: 10.5, 7: 5.0}, 2: {5: 11.6}, 3: {5: 10.2}}
    assert _largest(found, maps) == {2: {5: 11.6}}


def test_what_two_maps_show_alike_is_left_out_of_both():
    maps = np.zeros((2, 9))
    maps[:, 5] = 8.0, -7.9
    assert _largest({0: {5: 8.0}, 1: {5: 7.9}}, maps) == {0: {5: 8.0}, 1: {5: 7.9}}


def test_nothing_is_the_largest_of_nothing():
    assert _largest({}, np.zeros((2, 9))) == {}


def test_pixels_beside_a_larger_one_are_one_place():
    near = [int(one) for one in healpy.get_all_neighbours(NSIDE, 1000)[:2]]
    bad = of({1: {1000: 20.0, near[0]: 9.0, near[1]: 8.0, 40: 10.0}, 0: {7: 8.0}})
    assert (bad.number, bad.size) == (5, 20.0)
    assert bad.left_out == "5 pixels of nside 16 are left out"
    assert of({0: {7: 8.0}}).left_out == "one pixel of nside 16 is left out"
    first, second = bad.sentences
    assert first.startswith("One place of the residual of V1 stands out, 8 times")
    assert second.startswith("2 places of the residual of W1 stand out, up to 20 times")
    lon, lat = healpy.pix2ang(NSIDE, 1000, lonlat=True)
    assert f"longitude {lon:.0f}°, latitude {lat:.0f}°; " in second.replace("−", "-")


def test_no_more_places_are_said_than_a_sentence_has_room_for():
    (said,) = of({0: dict.fromkeys(range(100, 3000, 400), 9.0)}).sentences
    assert said.count("longitude") == 5
    assert "3 more (ecliptic)" in said


@pytest.mark.parametrize(("nside", "hidden"), [(16, 1), (64, 16), (8, 1)])
def test_whole_pixels_are_left_out_of_their_maps_alone(nside, hidden):
    maps = [np.zeros(healpy.nside2npix(nside)) for _ in range(2)]
    left = of({1: {1000: 20.0}}).without(maps, nside)
    assert np.all(left[0] == 0.0)
    assert np.sum(left[1] == healpy.UNSEEN) == hidden
    assert not maps[1].any()


@pytest.mark.parametrize("nside", [16, 32])
def test_beside_nuisances_residuals_count_over_the_noise_of_all_pixels_in_a_coarse_one(nside):
    """Over the mean weight of fine pixels, maps of nside 32 were twice as wide as the noise that they hold."""
    rng, precision = np.random.default_rng(1), 0.04
    coarse = rng.normal(size=(1, 3072)) * np.sqrt(precision * (nside / NSIDE) ** 2)
    model = SimpleNamespace(parts=[SimpleNamespace(precision=np.full(12 * nside**2, precision))])
    none = np.zeros((1, 3072))
    ensemble = SimpleNamespace(residual_mean=none, residual_scatter=none + 1.0, bipolar_scan=range(300), nuisances=1)
    found, maps = standing_out(model, ensemble, coarse)
    assert found == {}
    assert np.std(maps) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("explanations", "partial", "made"), [((), None, False), ((1,), None, True), ((), 1, True)])
def test_what_is_neither_named_nor_detected_makes_no_bad_pixels(monkeypatch, explanations, partial, made):
    """Noise with strong glitches, nearest of all candidates but not named, left bad pixels in, without a word."""
    refined = SimpleNamespace(attribution=SimpleNamespace(explanations=explanations), partial=partial)
    found = SimpleNamespace(refined=refined)
    monkeypatch.setattr(verdict, "_unrefined", lambda _: found)
    monkeypatch.setattr(verdict, "inferred", lambda _: found)
    monkeypatch.setattr(verdict, "_left_beside", lambda *_: 0.0)
    assert verdict._made(None, None) is (found if made else None)


def test_no_more_is_looked_for_where_the_model_fits_the_rest(monkeypatch):
    """Effects that fit chance best were simulated without a sky, for perfect maps as well."""
    left = SimpleNamespace(refined=SimpleNamespace(attribution=SimpleNamespace(verdict="none")))
    monkeypatch.setattr(verdict, "inferred", lambda _: left)
    data = SimpleNamespace(bad_pixels=lambda _: pytest.fail("nothing is left to explain"))
    assert verdict._without(data, None) == (None, data, left)
