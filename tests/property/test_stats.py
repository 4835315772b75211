"""Tests of a data vector do not depend on its coordinates."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate, global_test


@st.composite
def problems(draw):
    """Simulations, data, templates and an invertible matrix of a condition number below 100."""
    p, n_templates = draw(st.integers(2, 8)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    left, right = (np.linalg.qr(rng.normal(size=(p, p)))[0] for _ in range(2))
    matrix = left * np.exp(rng.uniform(-2.0, 2.0, size=p)) @ right
    strength = draw(st.floats(0.0, 5.0))
    t = rng.normal(size=(p, min(n_templates, p - 1)))
    x = rng.normal(size=p) + strength * t[:, 0]
    return rng.normal(size=(6 * p + 10, p)), x, t, matrix


@settings(derandomize=True, deadline=None, max_examples=60)
@given(problems())
def test_p_values_under_an_invertible_linear_remixing(problem):
    simulations, x, t, matrix = problem
    plain = SimulatedGaussian.from_simulations(simulations)
    mixed = SimulatedGaussian.from_simulations(simulations @ matrix.T)
    mx, mt = matrix @ x, matrix @ t
    np.testing.assert_allclose(mixed.chi2(mx), plain.chi2(x), rtol=1e-8)
    np.testing.assert_allclose(mixed.pvalue(mx), plain.pvalue(x), rtol=1e-7, atol=1e-14)
    one, two = plain.fit(x, t), mixed.fit(mx, mt)
    np.testing.assert_allclose(two.amplitudes, one.amplitudes, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose([two.pvalue, two.nested_pvalue], [one.pvalue, one.nested_pvalue], rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(mixed.delta_chi2(mx, mt), one.delta_chi2, rtol=1e-7)
    np.testing.assert_allclose(mixed.log_likelihood(two.chi2), plain.log_likelihood(one.chi2), rtol=1e-7, atol=1e-9)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(problems())
def test_the_global_p_value_under_an_invertible_linear_remixing(problem):
    simulations, x, t, matrix = problem
    groups = [(k,) for k in range(t.shape[1])]
    plain = SimulatedGaussian.from_simulations(simulations)
    mixed = SimulatedGaussian.from_simulations(simulations @ matrix.T)
    calibration = calibrate(plain, plain.whiten_groups(t, groups), draws=2000)
    one = global_test(plain, x, plain.whiten_groups(t, groups), calibration)
    two = global_test(mixed, matrix @ x, mixed.whiten_groups(matrix @ t, groups), calibration)
    np.testing.assert_allclose([two.omnibus, two.maximum], [one.omnibus, one.maximum], rtol=1e-6, atol=1e-3)
    assert two.best == one.best


@settings(derandomize=True, deadline=None, max_examples=60)
@given(problems(), st.floats(-1e3, 1e3))
def test_a_shift_of_data_and_mean_changes_nothing(problem, shift):
    simulations, x, t, _ = problem
    plain = SimulatedGaussian.from_simulations(simulations)
    moved = plain.shift(plain.mean + shift)
    np.testing.assert_allclose(moved.chi2(x + shift), plain.chi2(x), rtol=1e-8)
    np.testing.assert_allclose(moved.fit(x + shift, t).amplitudes, plain.fit(x, t).amplitudes, rtol=1e-6, atol=1e-9)
