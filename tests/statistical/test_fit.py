"""Fits are calibrated: uniform probabilities and pulls of unit width, with few simulations and on simulated skies."""

import numpy as np
import pytest
from scipy import stats

from mcsim import config
from mcsim.beamfit import Measurement, compare, fit, fit_each, solve
from mcsim.beamfit.data import QUADRUPOLE, SUMMARY, Row, project
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

SEED = 20121024


@pytest.fixture(scope="module")
def few_simulations() -> dict[str, np.ndarray]:
    """Fits of 2000 Gaussian data vectors of 12, each with its own covariance from 24 simulations."""
    rng = np.random.default_rng(SEED)
    p, N, draws = 12, 24, 2000
    root = np.tril(rng.normal(size=(p, p))) + 2.0 * np.eye(p)
    design = np.stack([np.ones(p), np.linspace(0.0, 1.0, p)], axis=1)
    truth = np.array([1.0, 0.0])
    found: dict[str, list] = {name: [] for name in ("probability", "chi2", "pulls", "comparison", "plain")}
    for _ in range(draws):
        data = design @ truth + root @ rng.normal(size=p)
        simulated = rng.normal(size=(N, p)) @ root.T
        covariance = np.cov(simulated.T)
        large = solve(data, design, covariance, N)
        found["probability"].append(large.probability)
        found["chi2"].append(large.chi2)
        found["pulls"].append((large.parameters - truth) / large.errors)
        found["comparison"].append(compare(solve(data, design[:, :1], covariance, N), large).probability)
        found["plain"].append(stats.chi2.sf(large.square, large.dof))
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize("name", ["probability", "comparison"])
def test_probabilities_are_uniform(name, few_simulations):
    assert stats.kstest(few_simulations[name], "uniform").pvalue > 0.01


def test_an_uncorrected_chi2_would_not_be(few_simulations):
    """The test above can fail: a plain chi^2 of the same fits calls most of them bad."""
    assert np.mean(few_simulations["plain"] < 0.05) > 0.4


def test_chi2_has_the_expectation_of_its_degrees_of_freedom(few_simulations):
    """With n = 23 and q = 10 the square is n q/(n - q + 1) F(q, n - q + 1), of expectation n q/(n - q - 1) = 19."""
    chi2 = few_simulations["chi2"]
    n, q = 23, 10
    width = q * (n - q - 1) / (n - q + 1) * stats.f(q, n - q + 1).std()
    assert abs(chi2.mean() - q) < 4.0 * width / np.sqrt(len(chi2))


def test_pulls_have_unit_width(few_simulations):
    pulls = few_simulations["pulls"]
    count = len(pulls)
    # Student's t with n - q = 23 - 10 = 13 degrees of freedom, scaled to unit variance: kurtosis excess 6/9.
    assert np.all(np.abs(pulls.mean(axis=0)) < 4.0 / np.sqrt(count))
    assert np.all(np.abs(np.mean(pulls**2, axis=0) - 1.0) < 4.0 * np.sqrt((2.0 + 6.0 / 9.0) / count))


@pytest.fixture(scope="module")
def skies():
    """A survey of an elliptical beam and the binned A^{20} of 240 skies through it."""
    run = config.load(
        {
            "schema": 1,
            "name": "skies",
            "sky": {"spectrum": "wmap7", "lmax": 64},
            "map": {"nside": 32},
            "channel": [
                {
                    "name": "W1",
                    "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 210.0, "fwhm_minor_arcmin": 190.0},
                    "scan": {"kind": "parallel_transport"},
                }
            ],
            "biposh": {"summary_bin": 8},
            "ensemble": {"realizations": 240, "seed": SEED, "paired": False},
        }
    )
    shared = survey(run)
    modes = {mode.name: number for number, mode in enumerate(shared.estimator.modes)}
    rows = tuple(
        Row(shared.estimator.modes[modes[name]], a, a + 7, False) for name in QUADRUPOLE for a in range(0, 64, 8)
    )
    biposh = np.array([simulate.realize(shared, r)["biposh"][0] for r in range(240)])
    drawn = project(rows, SUMMARY, {row.mode: biposh[:, modes[row.mode.name]] for row in rows})
    value, covariance = drawn.mean(axis=0), np.cov(drawn.T) / len(drawn)
    return shared, Measurement("240 skies", None, "plain", rows, SUMMARY, value, covariance, len(drawn), drawn)


@pytest.mark.parametrize(("name", "truth"), [("constant", [1.0]), ("linear", [1.0, 0.0])])
def test_pulls_over_simulated_skies(name, truth, skies):
    """Each sky fitted on its own, all with the true beam: width within 0.9 ... 1.1, as within 3 of its errors."""
    shared, measured = skies
    found = fit_each(fit(measured, shared, name))
    pulls = found.pulls(truth)
    width = pulls.std(axis=0, ddof=1)
    assert np.all(np.abs(width - 1.0) < 0.1)
    assert np.all(np.abs(width - 1.0) < 3.0 / np.sqrt(2.0 * len(pulls)))
    assert np.all(np.abs(pulls.mean(axis=0)) < 4.0 / np.sqrt(len(pulls)))
    assert stats.kstest([one.probability for one in found.each], "uniform").pvalue > 0.01
    assert found.solution.probability > 0.01
    assert np.all(np.abs(found.solution.parameters - truth) < 4.0 * found.solution.errors)
