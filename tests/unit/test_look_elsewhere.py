"""Ranks of p-values beyond what was drawn or simulated, and deviations that are ranked among simulations."""

import numpy as np
import pytest
from scipy import special, stats

from mcsim.stats.look_elsewhere import TAIL, Calibration, deviates_of_means, scan_pvalues


def held_out_alone(pvalues: np.ndarray) -> Calibration:
    """A calibration of one candidate, whose p-values are changed by those of held-out simulations alone."""
    return Calibration(1, np.empty(0), np.empty(0), np.sort(pvalues))


def test_pvalues_below_the_ranks_go_on_from_them_without_a_step() -> None:
    calibration = held_out_alone(np.random.default_rng(3).random(1000))
    assert calibration.held_out_smallest is not None
    edge = calibration.held_out_smallest[TAIL - 1]
    at, below = calibration.global_pvalue([edge, edge * (1.0 - 1e-12)])
    assert at == pytest.approx((1.0 + TAIL) / 1001.0)
    assert below == pytest.approx(at, rel=1e-9)


def test_pvalues_below_the_ranks_are_no_smaller_than_gaussian_ones() -> None:
    """The ten lowest are alike by chance: their power of p would be the 160th."""
    calibration = held_out_alone(np.concatenate([np.linspace(0.0099, 0.01, TAIL), np.linspace(0.02, 1.0, 990)]))
    share = (1.0 + TAIL) / 1001.0
    assert calibration.global_pvalue(1e-4) == pytest.approx(share * 1e-4 / 0.01)


def test_the_smaller_of_two_pvalues_counts_twice_beyond_the_draws() -> None:
    draws = np.linspace(0.001, 1.0, 1000)
    assert Calibration(1, draws, draws).combine(1e-9, 1.0) == pytest.approx(2e-9)
    assert Calibration(1, draws, draws).combine(1.0, 1e-9) == pytest.approx(2e-9)


def test_simulations_are_ranked_by_their_deviations_from_all_others() -> None:
    """With mean and spread of the other 24, as numpy has them."""
    simulations, given = np.random.default_rng(5).normal(size=(25, 3)), []
    for place, one in enumerate(simulations):
        others = np.delete(simulations, place, axis=0)
        t = (one - others.mean(axis=0)) / others.std(axis=0, ddof=1) / np.sqrt(1.0 + 1.0 / 24.0)
        given.append(stats.norm.isf(stats.t.sf(t, 23)))
    x = np.linspace(-6.0, 6.0, 3)
    expected = scan_pvalues(x, simulations, np.array(given))
    np.testing.assert_allclose(scan_pvalues(x, simulations), expected, rtol=1e-9)


def test_deviates_are_those_of_probabilities_too_small_to_be_summed() -> None:
    """Of means of a thousand draws at p = 1e-300, which is still a number."""
    t = stats.t.isf(1e-300, 999)
    (found,) = deviates_of_means(np.array([t]), np.array([False]), 1000)
    assert found == pytest.approx(-special.ndtri(1e-300), abs=1e-3)
