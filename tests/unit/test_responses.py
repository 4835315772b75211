"""Responses to a step of an effect, from skies with the opposite step and without."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mcsim.datavector.candidate import TemplateBank, signal_share
from mcsim.datavector.responses import responses, size_error
from mcsim.datavector.settings import DiagnosisSettings

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


def test_a_column_of_nothing_but_noise_says_nothing_of_the_scatter_among_skies():
    """However large it is in maps of little noise: of the others, 4 skies of 0.1 each are 0.2 about the mean."""
    clear, noise = np.full(3, 1e6), np.array([1e6, 1e5, 1e5])
    matrix, error = np.stack([clear, clear, noise], axis=1), np.stack([0.1 * clear, 0.1 * clear, 2.0 * noise], axis=1)
    bank = TemplateBank(matrix, error, np.zeros((3, 3)), (), np.ones(3), np.full(3, 4.0))
    candidates = [SimpleNamespace(columns=columns) for columns in ((0,), (1, 2), (2,))]
    found = bank.sky_scatter(np.full(3, 1e-4), candidates)
    np.testing.assert_allclose(found, [0.2 / np.sqrt(0.99)] * 2 + [np.inf])


@pytest.mark.parametrize(("strength", "of_whole", "of_cut"), [(0.0, 0.2, 1.01), (3.0, 1.0, 0.1)])
def test_a_noisy_template_keeps_of_its_faint_elements_what_is_no_noise(strength, of_whole, of_cut):
    """Nearest to the truth in the metric of elements that are correlated, if their mean is ``strength`` of its error.

    Squared distances are compared with those with all of the faint elements and with none.
    """
    rng, size, skies, settings = np.random.default_rng(8), 40, 12, replace(DiagnosisSettings(), noisy_share=0.0)
    root = np.linalg.cholesky(0.9 ** np.abs(np.subtract.outer(np.arange(size), np.arange(size))))
    whitening, spread = np.linalg.inv(root), np.ones(size)
    truth = strength / np.sqrt(skies) * root @ rng.normal(size=size)
    truth[:3] = 10.0
    distances = []
    for _ in range(200):
        each = truth + rng.normal(size=(skies, size)) @ root.T
        mean, error = each.mean(axis=0)[:, None], each.std(axis=0, ddof=1)[:, None] / np.sqrt(skies)
        bank = TemplateBank(mean, error, np.zeros((size, 1)), (), np.ones(1), np.full(1, skies))
        shares = signal_share(each, bank.faint(spread, settings)[:, 0], whitening), 1.0, 0.0
        found = [replace(bank, faint_share=np.array([one])).significant(spread, settings)[:, 0] for one in shares]
        distances.append([np.sum((whitening @ (one - truth)) ** 2) for one in found])
    shrunk, whole, cut = np.mean(distances, axis=0)
    assert shrunk < of_whole * whole
    assert shrunk < of_cut * cut


@pytest.mark.parametrize("skies", [4, 24])
def test_the_error_of_a_size_is_an_upper_limit(skies):
    """Of responses that scatter by 0.2 as a whole, and by elements that say little: too low in 10 % of 2,000 cases."""
    rng, size = np.random.default_rng(4), 30
    root = np.linalg.cholesky(0.9 ** np.abs(np.subtract.outer(np.arange(size), np.arange(size))))
    truth = 50.0 * root @ rng.normal(size=size)
    found = []
    for _ in range(2000):
        each = truth * (1.0 + 0.2 * rng.normal(size=(skies, 1))) + rng.normal(size=(skies, size)) @ root.T
        found.append(size_error(each, np.linalg.inv(root)))
    low = np.mean(np.array(found) < 0.2 / np.sqrt(skies))
    assert abs(low - 0.1) < 4.0 * np.sqrt(0.09 / 2000) + 0.02  # the mean itself scatters
    assert size_error(np.zeros((4, 3)), np.eye(3)) == 0.0
