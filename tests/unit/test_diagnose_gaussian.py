"""Coordinates, fits and calibrations against explicit linear algebra."""

import numpy as np
import pytest
from scipy import stats

from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.summaries import Element
from mcsim.stats.gaussian import (
    SimulatedGaussian,
    Tolerated,
    held_out_pvalues,
    nested_pvalue,
    residual_pvalue,
)
from mcsim.stats.look_elsewhere import Calibration, calibrate, calibrate_in_folds, global_test, scan_pvalues
from refusals import refused

P, N = 12, 60


@pytest.fixture(scope="module")
def ensemble() -> np.ndarray:
    """Simulations with scales over six decades."""
    rng = np.random.default_rng(1)
    root = (np.tril(rng.normal(size=(P, P))) + 2.0 * np.eye(P)) * np.logspace(-3, 3, P)[:, None]
    return 5.0 + rng.normal(size=(N, P)) @ root.T


@pytest.fixture(scope="module")
def evidence(ensemble) -> np.ndarray:
    return ensemble.mean(axis=0) + np.random.default_rng(2).normal(size=P) * ensemble.std(axis=0)


@pytest.fixture(scope="module")
def templates(ensemble) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(P, 6)) * ensemble.std(axis=0)[:, None]


def test_scatter_is_n_times_one(ensemble):
    fiducial = SimulatedGaussian.from_simulations(ensemble)
    white = fiducial.whiten(ensemble) * np.sqrt(1 + 1 / N)
    np.testing.assert_allclose(white.T @ white, (N - 1) * np.eye(P), atol=1e-9)


def test_offset_moves_the_mean(ensemble, evidence):
    shift = np.arange(P, dtype=float)
    np.testing.assert_allclose(
        SimulatedGaussian.from_simulations(ensemble, shift).whiten(evidence + shift),
        SimulatedGaussian.from_simulations(ensemble).whiten(evidence),
        rtol=1e-9,
    )


def test_wider_null_is_that_of_both_scatters(ensemble):
    """Against the covariance itself, which is that of the draws, so many that nothing is drawn towards anything."""
    rng = np.random.default_rng(3)
    fiducial = SimulatedGaussian.from_simulations(ensemble)
    p = fiducial.dimension
    root = rng.normal(size=(p, p)) * np.sqrt(np.var(ensemble, axis=0))[:, None]
    draws = rng.normal(size=(p, 4000))
    draws -= draws.mean(axis=1, keepdims=True)
    draws = np.linalg.qr(draws.T)[0].T
    wide = fiducial.with_extra_covariance(root @ draws)
    S = np.cov(ensemble.T)
    scale = 1.0 + 1.0 / fiducial.n_sims
    x = rng.normal(size=p) * ensemble.std(axis=0) + fiducial.mean
    # S is too small by the factor that makes squares unbiased.
    expected = (x - fiducial.mean) @ np.linalg.solve(
        S + fiducial.hartlap_factor / scale * root @ root.T, x - fiducial.mean
    )
    assert wide.chi2(x) == pytest.approx(expected / scale, rel=0.01)
    volume = np.linalg.slogdet(np.eye(p) + fiducial.hartlap_factor / scale * np.linalg.solve(S, root @ root.T))[1]
    assert wide.log_jacobian == pytest.approx(-0.5 * volume, rel=0.01)


def test_statistics_equal_those_of_the_scatter(ensemble, evidence, templates):
    """The formulas of Hotelling and Rao written with S itself."""
    fiducial, n = SimulatedGaussian.from_simulations(ensemble), N - 1
    inverse = np.linalg.inv(np.cov(ensemble.T) * n)
    x = (evidence - ensemble.mean(axis=0)) / np.sqrt(1 + 1 / N)
    t = templates[:, :3]
    square = x @ inverse @ x
    y = fiducial.whiten(evidence)
    np.testing.assert_allclose(y @ y / n, square, rtol=1e-8)
    score, normal = t.T @ inverse @ x, t.T @ inverse @ t
    T = score @ np.linalg.solve(normal, score)
    found = fiducial.fit(evidence, t)
    expected = stats.f.sf((n - P + 1) / 3 * T / (1 + square - T), 3, n - P + 1)
    assert found.nested_pvalue == pytest.approx(expected, rel=1e-7)
    q = P - 3
    assert found.pvalue == pytest.approx(stats.f.sf((n - q + 1) / q * (square - T), q, n - q + 1), rel=1e-7)
    theta = np.linalg.solve(normal, score) * np.sqrt(1 + 1 / N)
    np.testing.assert_allclose(found.amplitudes, theta, rtol=1e-7)
    student = (1 + square - T) * np.linalg.inv(normal) * (1 + 1 / N) / (n - q) * stats.t.var(n - q)
    np.testing.assert_allclose(found.covariance, student, rtol=1e-7)
    assert found.errors == pytest.approx(np.sqrt(np.diag(student)), rel=1e-7)


def test_repeated_entries_change_nothing(ensemble, evidence, templates):
    """A sum of two entries, and a copy with rounding, carry nothing new."""
    mixing = np.vstack([np.eye(P), np.eye(P)[0] * 3.0, np.eye(P)[1] + np.eye(P)[2]])
    short, long = SimulatedGaussian.from_simulations(ensemble), SimulatedGaussian.from_simulations(ensemble @ mixing.T)
    assert long.dimension == P
    one, two = short.fit(evidence, templates[:, :2]), long.fit(mixing @ evidence, mixing @ templates[:, :2])
    np.testing.assert_allclose(one.amplitudes, two.amplitudes, rtol=1e-6)
    assert one.pvalue == pytest.approx(two.pvalue, rel=1e-6)


def test_a_repeated_column_has_no_amplitude_of_its_own(ensemble, evidence, templates):
    twice = np.column_stack([templates[:, 0], 2.0 * templates[:, 0]])
    one, two = (
        SimulatedGaussian.from_simulations(ensemble).fit(evidence, templates[:, :1]),
        SimulatedGaussian.from_simulations(ensemble).fit(evidence, twice),
    )
    assert two.dimension == one.dimension
    assert two.amplitudes @ [1.0, 2.0] == pytest.approx(one.amplitudes[0], rel=1e-8)


def test_probabilities_without_columns_or_dimensions_are_one():
    assert nested_pvalue(0.0, 5.0, 0, P, N) == 1.0
    assert residual_pvalue(0.0, 0, N) == 1.0


@pytest.mark.parametrize(("q", "allowance"), [(1, 4.0), (30, 9.0), (100, 100.0)])
def test_forgiven_errors_make_the_tail_noncentral(q, allowance):
    """Patnaik's approximation, within 10 % of the noncentral F at the 5 % level where it decides."""
    n = 1200
    chi2 = stats.ncf.isf(0.05, q, n - q + 1, allowance) * n * q / (n - q + 1)
    assert residual_pvalue(chi2, q, n, allowance) == pytest.approx(0.05, rel=0.1)


def test_bad_ensembles_say_what_to_do(ensemble):
    with refused(15, 12, 19):
        SimulatedGaussian.from_simulations(ensemble[:15])
    flat = ensemble.copy()
    flat[:, 4] = 1.0
    with refused("element 4"):
        SimulatedGaussian.from_simulations(flat)
    flat[0, 5] = np.nan
    with refused("element 5"):
        SimulatedGaussian.from_simulations(flat)


def test_gap_is_invariant_and_names_the_candidate(ensemble, evidence, templates):
    groups = [(0,), (1, 2), (3, 4, 5)]
    x = evidence + 20.0 * templates[:, 1]
    results = []
    for scale in (1.0, 1e-6):
        fiducial = SimulatedGaussian.from_simulations(ensemble * scale)
        candidates = fiducial.whiten_groups(templates * scale, groups)
        results.append(global_test(fiducial, x * scale, candidates, calibrate(fiducial, candidates, draws=2000)))
    assert results[0].best == 1
    assert results[0].pvalue == pytest.approx(results[1].pvalue, rel=1e-6)
    assert results[0].chi2 == pytest.approx(results[1].chi2, rel=1e-8)


def test_silent_candidates_count_for_nothing(ensemble, evidence, templates):
    fiducial = SimulatedGaussian.from_simulations(ensemble)
    silent = np.column_stack([templates, np.zeros(P)])
    filtered, all_of_them = (
        fiducial.whiten_groups(templates, [(0,), (1, 2)]),
        fiducial.whiten_groups(silent, [(0,), (1, 2), (6,)]),
    )
    one = global_test(fiducial, evidence, filtered, calibrate(fiducial, filtered, draws=2000))
    two = global_test(fiducial, evidence, all_of_them, calibrate(fiducial, all_of_them, draws=2000))
    assert one == two


def test_calibration_goes_on_beyond_its_draws():
    """Monotone, never above Bonferroni's bound, never zero."""
    draws = np.sort(np.random.default_rng(4).uniform(size=1000))
    calibration = Calibration(5, draws / 5, draws)
    p = np.logspace(-30, 0, 400)
    for values in (calibration.global_pvalue(p), calibration.combine(1.0, p), calibration.combine(p, 1.0)):
        assert np.all(np.diff(values) >= 0.0)
        assert values[0] > 0.0
        assert values[-1] <= 1.0
    assert np.all(calibration.global_pvalue(p) <= 5 * p)
    assert calibration.global_pvalue(1e-20) == pytest.approx(5e-20)


def test_atlas_deviations_are_those_of_left_out_simulations():
    """The data put among the simulations and left out again have the same deviation."""
    rng = np.random.default_rng(5)
    simulations, x = rng.normal(size=(40, 7)) * np.arange(1, 8), rng.normal(size=7)
    z, p = scan_pvalues(x, simulations)
    t = (x - simulations.mean(axis=0)) / simulations.std(axis=0, ddof=1) / np.sqrt(1 + 1 / 40)
    np.testing.assert_allclose(stats.norm.sf(z), stats.t.sf(t, 39), rtol=1e-9)
    assert np.all(p >= 2.0 * stats.norm.sf(np.abs(z)) * 0.999)
    order = np.argsort(np.abs(z))
    assert np.all(np.diff(p[order]) <= 0.0)


def test_atlas_reaches_beyond_the_ranks():
    rng = np.random.default_rng(6)
    simulations = rng.normal(size=(500, 20))
    _, p = scan_pvalues(np.array([8.0] + [0.0] * 19), simulations)
    # Student's tail with 499 degrees of freedom, times about 20 trials.
    assert 5 < p[0] / (2.0 * stats.t.sf(8.0 / simulations[:, 0].std(ddof=1), 499)) < 80
    assert p[1] == 1.0
    with refused(10, 20):
        scan_pvalues(np.zeros(20), simulations[:10])


@pytest.mark.parametrize("shrink", [False, True])
def test_candidates_that_data_do_not_respond_to_raise_no_alarm(shrink):
    """Of no test Bonferroni's bound would be zero: p = 0 for data of the model."""
    rng = np.random.default_rng(8)
    null = SimulatedGaussian.from_simulations(rng.normal(size=(200, 10)), shrink=shrink)
    groups = null.whiten_groups(np.zeros((10, 2)), [(0,), (1,)])
    calibration = calibrate(null, groups)
    if shrink:
        calibration = calibrate_in_folds(calibration, null, groups)
    p = [global_test(null, rng.normal(size=10), groups, calibration) for _ in range(300)]
    assert all(one.maximum == 1.0 for one in p)
    assert stats.kstest([one.pvalue for one in p], "uniform").pvalue > 1e-3


def test_calibration_with_nuisances_is_the_same_for_the_mean_of_any_number_of_skies():
    """Simulations, of one sky each, scatter in scale as one does: those for 16 had p below 0.05 in 8.5 of 100 cases."""
    rng = np.random.default_rng(2)
    count, p = 400, 6
    x = rng.normal(size=(count, p)) * np.exp(0.3 * rng.normal(size=(count, 1)))
    x -= x.mean(axis=0)
    drawn = rng.normal(size=(count, 1))
    drawn -= drawn.mean(axis=0)
    drawn -= x @ np.linalg.lstsq(x, drawn, rcond=None)[0]  # of which the data vector depends on nothing
    elements = tuple(Element(str(k), "map", ("A",)) for k in range(p))
    one = NullEnsemble(x, np.zeros(p), elements, x[:0], *[np.zeros((0, 0))] * 4, nuisances=drawn)
    found = []
    for ensemble in (one, one.of_mean(16)):
        null = ensemble.gaussian
        groups = null.whiten_groups(np.eye(p)[:, :2], [[0], [1]])
        found.append(ensemble.calibration(null, groups).held_out_combined)
    assert null.scale_variance > 0.02
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


def test_a_variance_that_is_estimated_adds_its_error_to_that_of_the_covariance():
    """Reciprocals of the degrees of freedom add: 40 and 40 are 20, and not the fewer of both."""
    n, dimension = 100, 61
    found = nested_pvalue(8.0, 60.0, 1, dimension, n, Tolerated(0.0, 1.5, 40.0))
    f = (n - dimension + 1.0) * 8.0 / (n + 60.0 - 8.0) / 1.5
    assert found == pytest.approx(stats.f.sf(f, 1, 20.0), rel=1e-9)


def test_pvalues_of_simulations_whose_scale_scatters_are_uniform():
    """Each against all others: the scatter of their scale, a tenth, makes large chi^2 more frequent."""
    rng, count, level = np.random.default_rng(4), 3000, 0.01
    x = rng.normal(size=(count, 30)) * np.sqrt(rng.gamma(10.0, 0.1, size=(count, 1)))
    null = SimulatedGaussian.from_simulations(x)
    # That of 3000 values has an error of 0.004: five sigma.
    assert null.scale_variance == pytest.approx(0.1, abs=0.02)
    share = np.mean(held_out_pvalues(x, null) < level)
    assert abs(share - level) < 4.0 * np.sqrt(level * (1.0 - level) / count)
