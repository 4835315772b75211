"""Generalised least squares against explicit formulas; its exactness with few simulations is in tests/statistical."""

import numpy as np
import pytest
from scipy import stats

from mcsim.beamfit import compare, solve, solve_each
from mcsim.beamfit.likelihood import size
from mcsim.errors import InputError
from refusals import refused

RNG = np.random.default_rng(11)
P, K = 8, 2
DESIGN = np.stack([np.ones(P), np.arange(P) * 1e-3], axis=1)
ROOT = np.tril(RNG.normal(size=(P, P))) + 3.0 * np.eye(P)
COVARIANCE = ROOT @ ROOT.T
DATA = DESIGN @ [2.0, 50.0] + ROOT @ RNG.normal(size=P)


def test_known_covariance_is_the_textbook_estimate():
    found = solve(DATA, DESIGN, COVARIANCE)
    weight = np.linalg.inv(COVARIANCE)
    covariance = np.linalg.inv(DESIGN.T @ weight @ DESIGN)
    expected = covariance @ DESIGN.T @ weight @ DATA
    residual = DATA - DESIGN @ expected
    np.testing.assert_allclose(found.parameters, expected, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-10)
    np.testing.assert_allclose(found.residual, residual, rtol=1e-9, atol=1e-12)
    assert found.chi2 == pytest.approx(residual @ weight @ residual, rel=1e-10)
    assert found.dof == P - K
    assert found.probability == pytest.approx(stats.chi2.sf(found.chi2, P - K))
    assert found.reduced_chi2 == pytest.approx(found.chi2 / (P - K))
    assert found.correlation[0, 1] == pytest.approx(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))


def test_many_simulations_give_the_known_covariance():
    found, known = solve(DATA, DESIGN, COVARIANCE, 10**7), solve(DATA, DESIGN, COVARIANCE)
    np.testing.assert_allclose(found.covariance, known.covariance, rtol=1e-5)
    assert found.probability == pytest.approx(known.probability, rel=1e-4)


def test_one_parameter_is_the_students_ratio_of_the_formula():
    """(theta^ - theta)/sqrt((1 + r'S^-1 r)/((n-p+1) t'S^-1 t)) is Student's with n-p+1: the error is its deviation."""
    N = 40
    n = N - 1
    scatter = n * COVARIANCE
    t = DESIGN[:, 0]
    found = solve(DATA, DESIGN[:, :1], COVARIANCE, N)
    weight = np.linalg.inv(scatter)
    residual = found.residual
    scale = np.sqrt((1.0 + residual @ weight @ residual) / ((n - P + 1) * (t @ weight @ t)))
    assert found.errors[0] == pytest.approx(scale * stats.t(n - P + 1).std(), rel=1e-10)
    q = P - 1
    assert found.probability == pytest.approx(
        stats.f.sf((n - q + 1) / q * residual @ weight @ residual, q, n - q + 1), rel=1e-10
    )


def test_comparison_of_nested_models():
    small, large = solve(DATA, DESIGN[:, :1], COVARIANCE), solve(DATA, DESIGN, COVARIANCE)
    test = compare(small, large)
    # Adding one parameter lowers chi2 by its squared significance.
    assert test.drop == pytest.approx((large.parameters[1] / large.errors[1]) ** 2, rel=1e-9)
    assert test.probability == pytest.approx(2.0 * stats.norm.sf(np.sqrt(test.drop)), rel=1e-9)
    with refused("parameters"):
        compare(large, small)


def test_the_drop_of_chi2_by_few_simulations_is_that_of_its_probability():
    """Of F with the parameters that are added, and with those of 30 simulations that the larger model leaves."""
    design = np.column_stack([DESIGN, np.arange(P) ** 2])
    small, large = (solve(DATA, design[:, :count], COVARIANCE, 30) for count in (1, 3))
    found = compare(small, large)
    assert stats.f.sf(found.drop / 2.0, 2, 29 - (P - 1) + 1) == pytest.approx(found.probability, rel=1e-9)


def test_each_realization_is_weighted_by_the_others():
    drawn = RNG.normal(size=(30, P)) @ ROOT.T
    found = solve_each(drawn, DESIGN)
    expected = solve(drawn[4], DESIGN, np.cov(np.delete(drawn, 4, axis=0).T), 29)
    np.testing.assert_allclose(found[4].parameters, expected.parameters, rtol=1e-9)
    assert found[4].probability == pytest.approx(expected.probability, rel=1e-9)


@pytest.mark.parametrize(
    ("design", "covariance", "simulations", "named"),
    [
        (np.eye(P), COVARIANCE, None, ("8 data", "8 parameters")),
        (DESIGN, COVARIANCE, P + 2, ("10 realizations", "11 realizations")),
        (DESIGN, np.diag([1.0] * (P - 1) + [0.0]), None, ("datum 7",)),
        (DESIGN, np.ones((P, P)), None, ("covariance", "definite")),
        (DESIGN[:, [0, 0]], COVARIANCE, None, ("parameters",)),
        (0.0 * DESIGN, COVARIANCE, None, ("parameters",)),
    ],
)
def test_refusals(design, covariance, simulations, named):
    with refused(*named):
        solve(DATA, design, covariance, simulations)


@pytest.mark.parametrize(
    ("data", "design", "covariance"),
    [
        (DATA[:-1], DESIGN, COVARIANCE),
        (DATA, DESIGN, COVARIANCE[:-1, :-1]),
        (DATA[:, None], DESIGN, COVARIANCE),
        (np.where(np.arange(P) == 2, np.nan, DATA), DESIGN, COVARIANCE),
        (DATA, DESIGN, np.where(np.eye(P) > 0, np.inf, COVARIANCE)),
        (DATA, DESIGN, -COVARIANCE),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(data, design, covariance):
    with pytest.raises(InputError):
        solve(data, design, covariance)


def test_chi2_of_few_simulations_is_scaled_to_expect_its_degrees_of_freedom():
    found = solve(DATA, DESIGN, COVARIANCE, 40)
    weight = np.linalg.inv(COVARIANCE)
    assert found.square == pytest.approx(found.residual @ weight @ found.residual, rel=1e-9)
    assert found.chi2 == pytest.approx(found.square * (39 - (P - K) - 1) / 39)
    assert found.reduced_chi2 == found.chi2 / found.dof


def test_size_bounds_the_shift_of_every_parameter():
    change = ROOT @ RNG.normal(size=P)
    shift = solve(DATA + change, DESIGN, COVARIANCE).parameters - solve(DATA, DESIGN, COVARIANCE).parameters
    errors = solve(DATA, DESIGN, COVARIANCE).errors
    assert np.all(np.abs(shift) <= size(change, COVARIANCE, None) * errors)
    assert size(change, COVARIANCE, None) == pytest.approx(np.sqrt(change @ np.linalg.inv(COVARIANCE) @ change))
    assert size(change, COVARIANCE, 10**8) == pytest.approx(size(change, COVARIANCE, None), rel=1e-6)
    # The inverse of a covariance of n + 1 simulations is too large by n/(n - P - 1) in the mean.
    assert size(change, COVARIANCE, 30) == pytest.approx(np.sqrt((29 - P - 1) / 29) * size(change, COVARIANCE, None))


def test_models_of_different_data_are_not_compared():
    with pytest.raises(InputError):
        compare(solve(DATA, DESIGN[:, :1], COVARIANCE), solve(DATA, DESIGN, COVARIANCE, 40))
