"""What residual maps tell of the noise of pixels, and the degrees up to which the orders of a beam are measured."""

from dataclasses import replace

import numpy as np
import pytest

from mcsim import config
from mcsim.datavector import pixel_noise
from mcsim.datavector.filter_model import Model, model_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import blocks_of
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey


def test_squares_count_pixels_that_the_data_lack_like_the_mean() -> None:
    residual, precision = np.array([2.0, 0.0, 0.0, -4.0]), np.array([4.0, 4.0, 0.0, 2.0])
    total = np.array([1.0, 1.0, 1.0, 1.0])
    pixel_noise.add_squares([(residual, precision)], total)
    np.testing.assert_allclose(total, [2.0, 1.0 + (1.0 + 8.0) / 2.0, 1.0, 9.0])


def test_difference_is_of_the_first_two_maps_where_both_are_seen() -> None:
    """(d_1 - d_2)^2 / (N_1 + N_2) - 1 with d = r N."""
    first, second = (np.array([2.0, 0.0, 3.0]), np.array([4.0, 4.0, 2.0])), (np.array([1.0, 1.0, 0.0]), np.ones(3))
    found = np.zeros(3)
    pixel_noise.fill_difference([first, second, first], found)
    np.testing.assert_allclose(found, [(0.5 - 1.0) ** 2 / 1.25 - 1.0, 0.0, 0.0])
    pixel_noise.fill_difference([first], found)
    np.testing.assert_allclose(found, [0.0, 0.0, 3.5])


@pytest.fixture(scope="module")
def blurred() -> Model:
    """A sky of lmax 90 through a beam of 6 degrees: nothing is left of it beyond l = 60."""
    channel = {
        "name": "V",
        "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 360.0, "fwhm_minor_arcmin": 330.0},
        "noise": {"sigma0_uk": 2000.0},
        "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 25.0},
    }
    sections = {"sky": {"spectrum": "wmap7", "lmax": 90}, "map": {"nside": 32, "splits": ["half1", "half2"]}}
    run = config.load({"schema": 1, "name": "blurred", "channel": [channel], "ensemble": {"seed": 3}, **sections})
    return model_of(survey(run, orders=4), DiagnosisSettings())


def test_orders_end_where_a_thousandth_of_their_information_is_left(blurred: Model) -> None:
    assert blurred.lmax == 90
    ell = np.arange(91.0)
    for s, last in enumerate(blurred.last_degrees[0]):
        squared = (2.0 * ell + 1.0) * blurred.cl * blurred.sky_power * blurred.response[0] ** 2 * ell ** (2 * s)
        assert squared[last + 1 :].sum() < 1e-3 * squared.sum() <= squared[last:].sum()
    assert np.all(np.diff(blurred.last_degrees[0]) > 0)


def test_orders_are_those_of_whole_transforms_up_to_their_end(blurred: Model) -> None:
    maps = list(simulate.maps(blurred.survey, 0))
    found, last = wiener_filter(blurred, maps).orders, blurred.last_degrees[0]
    whole = replace(blurred)
    whole.__dict__["last_degrees"] = np.full_like(blurred.last_degrees, 90)
    expected = wiener_filter(whole, maps).orders
    for s in range(1, 5):
        scale = np.abs(expected[:, s]).max()
        np.testing.assert_allclose(
            found[:, s, : last[s] + 1], expected[:, s, : last[s] + 1], rtol=0.0, atol=1e-10 * scale
        )
        assert not found[:, s, last[s] + 1 :].any()


def test_transforms_that_would_hardly_be_shorter_are_whole(blurred: Model) -> None:
    sharp = replace(blurred, response=np.ones_like(blurred.response), sky_power=np.ones(91), cl=np.ones(91))
    np.testing.assert_array_equal(sharp.last_degrees, np.full((1, 5), 90))


def test_every_element_of_a_beam_varies_where_orders_end_early(blurred: Model) -> None:
    """The ranges of an order end with it: beyond, numbers would be zero in all simulations."""
    blocks = [block for block in blocks_of(blurred) if block.elements[0].kind == "beam"]
    filtered = [wiener_filter(blurred, list(simulate.maps(blurred.survey, realization))) for realization in range(3)]
    rows = [np.concatenate([block.values(one) for block in blocks]) for one in filtered]
    assert np.all(np.std(rows, axis=0) > 0.0)
    for element in (element for block in blocks for element in block.elements):
        assert element.ell is not None
        assert element.ell[1] <= (blurred.last_degrees[0, element.L] if element.L else 90)
