"""Responses to a step of an effect, from skies with the opposite step and without."""

import numpy as np
import pytest

from mcsim.datavector.campaign import responses

STEP, SKIES = 0.3, 6


@pytest.fixture
def skies():
    """Data vectors of nine elements with their slopes, and one curvature for all skies."""
    rng = np.random.default_rng(3)
    start, slope, bent = rng.normal(size=(SKIES, 9)), rng.normal(size=(SKIES, 9)), rng.normal(size=9)
    return (lambda step, count=SKIES: (start + slope * step + bent * step**2)[:count]), slope, bent


@pytest.mark.parametrize("both", [SKIES, 2, 1])
def test_a_curvature_that_all_skies_share_is_taken_off_where_the_opposite_step_is_missing(skies, both):
    x, slope, bent = skies
    each, curvature = responses(STEP, x(STEP), x(-STEP, both), x(0.0))
    np.testing.assert_allclose(each, slope, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(curvature, bent, rtol=0.0, atol=1e-12)


def test_an_effect_of_one_sign_has_the_response_at_its_step(skies):
    x, slope, bent = skies
    each, curvature = responses(-STEP, x(-STEP), None, x(0.0))
    np.testing.assert_allclose(each, slope - STEP * bent, rtol=0.0, atol=1e-12)
    assert not curvature.any()
