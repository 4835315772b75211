"""Evidence, posterior, and what can be detected and told apart, against integrals and textbook figures."""

import numpy as np
import pytest
from scipy import special

from mcsim.stats.detection import (
    cosines,
    detectable,
    log_evidence,
    log_marginals,
    pair_log_marginals,
    snr_needed,
    snr_to_separate,
)
from mcsim.stats.gaussian import SimulatedGaussian


def test_evidence_is_the_integral_over_its_prior():
    """Against draws of the amplitudes, the covariance known."""
    rng = np.random.default_rng(20)
    known = SimulatedGaussian(np.zeros(6), np.eye(6), 10**9)
    y = rng.normal(size=6) + np.array([2.0, -1.0, 0.0, 0.0, 0.0, 0.0])
    for K in (1, 2):
        values = []
        for width in (1.0, 3.0):
            theta = np.zeros((400_000, 6))
            theta[:, :K] = width * rng.normal(size=(400_000, K))
            values.append(np.mean(np.exp(-0.5 * np.sum((y - theta) ** 2, axis=1))))
        found = log_evidence(known, y @ y, y[:K] @ y[:K], K, (1.0, 3.0))
        # Each mean of 400,000 draws is good to half a percent.
        assert found == pytest.approx(np.log(np.mean(values)), abs=0.02)


def test_posterior_is_bayes_theorem():
    rng = np.random.default_rng(21)
    t = rng.normal(size=(6, 5))
    known = SimulatedGaussian(np.zeros(6), np.eye(6), 10**9)
    groups, prior, strengths = [(0,), (1, 2), (3, 4)], np.array([0.4, 0.3, 0.2, 0.1]), np.array([1.0, 3.0])
    x = rng.normal(size=6) + t[:, 0]
    candidates = known.whiten_groups(t, groups)
    likelihood = [np.exp(-0.5 * x @ x)]
    for i, group in enumerate(groups):
        basis = candidates.basis[:, candidates.start[i] : candidates.start[i + 1]]
        direction = rng.normal(size=(200_000, len(group)))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        models = [s * direction @ basis.T for s in strengths]
        likelihood.append(np.mean([np.exp(-0.5 * np.sum((x - model) ** 2, axis=1)) for model in models]))
    expected = prior * likelihood / np.sum(prior * likelihood)
    logs = log_marginals(known, x, candidates, strengths)
    np.testing.assert_allclose(special.softmax(logs + np.log(prior)), expected, rtol=0.02)
    assert log_marginals(known, np.stack([x, -x]), candidates, strengths)[1] == pytest.approx(logs, rel=1e-9)


@pytest.mark.parametrize(("columns", "tests", "strength"), [(1, 1, 3.24), (1, 20, 4.30), (110, 1, 7.2)])
def test_strengths_of_known_covariance(columns, tests, strength):
    """The normal, Bonferroni's and the chi2's figures; few simulations need more."""
    assert snr_needed(columns, tests, 110, None) == pytest.approx(strength, abs=0.05)
    assert snr_needed(columns, tests, 110, 10**6) == pytest.approx(strength, abs=0.05)
    assert snr_needed(columns, tests, 110, 600) > 1.05 * snr_needed(columns, tests, 110, None)


def test_detectable_takes_the_rms_response_over_directions():
    known = SimulatedGaussian(np.zeros(4), np.eye(4), 10**6)
    t = np.zeros((4, 2))
    t[0, 0], t[1, 1] = 2.0, 0.5
    assert detectable(known, t, 1) == pytest.approx(snr_needed(2, 1, 4, 10**6) / np.sqrt(2.125), rel=1e-4)
    one = detectable(known, t * [1.0, 0.0], 1)
    assert one == pytest.approx(snr_needed(1, 1, 4, 10**6) / np.sqrt(2.0), rel=1e-4)
    assert detectable(known, 0.0 * t, 1) == np.inf
    typical = np.array([[1.0], [0.0]])
    assert detectable(known, t, 1, typical) == pytest.approx(snr_needed(2, 1, 4, 10**6) / 2.0, rel=1e-4)
    assert detectable(known, t, 1, np.eye(2)) == pytest.approx(detectable(known, t, 1))


def test_cosines_are_canonical_correlations():
    rng = np.random.default_rng(22)
    t = rng.normal(size=(9, 6))
    t[:, 5] = 0.0
    known = SimulatedGaussian(np.zeros(9), np.eye(9), 10**6)
    found = cosines(known.whiten_groups(t, [(0,), (1, 2), (3, 4), (5,)]))
    one, two = np.linalg.qr(t[:, 1:3])[0], np.linalg.qr(t[:, 3:5])[0]
    assert found[1, 2] == pytest.approx(np.linalg.svd(one.T @ two, compute_uv=False)[0])
    assert found[0, 1] == pytest.approx(np.linalg.norm(one.T @ t[:, 0]) / np.linalg.norm(t[:, 0]))
    assert np.all(found[3, :3] == 0.0)
    assert np.all(np.diag(found) == 1.0)


def test_isolation_needs_more_of_closer_effects():
    cosine = np.array([[1.0, 0.5], [-0.9, 0.0]])
    found = snr_to_separate(cosine)
    assert found[0, 0] == np.inf
    assert found[1, 0] > found[0, 1] > found[1, 1]
    # Close twins: only the difference counts, Q(a) = 0.05.
    close = snr_to_separate(0.99)
    assert close * np.sqrt(0.005) == pytest.approx(-special.ndtri(0.05), rel=1e-3)


def test_columns_that_are_multiples_of_one_are_one():
    """Round-off of the directions that they leave empty counted as columns: more S/N was needed."""
    known = SimulatedGaussian(np.zeros(4), np.eye(4), 10**6)
    for seed in range(6):
        column = np.random.default_rng(seed).normal(size=4)
        t = column[:, None] * [1.0, 1.0 / 3.0, 1.7]
        rms = np.sqrt(np.sum(t**2) / 3.0)
        assert detectable(known, t, 1) == pytest.approx(snr_needed(1, 1, 4, 10**6) / rms, rel=1e-4)


def test_marginal_of_a_pair_is_the_integral_over_both_amplitudes():
    """Far from orthogonal, and with amplitudes well within the prior, which is flat in the logarithm of each."""
    known, rng = SimulatedGaussian(np.zeros(5), np.eye(5), 10**9), np.random.default_rng(5)
    t = rng.normal(size=(5, 2))
    t[:, 1] += 1.5 * t[:, 0]
    groups = known.whiten_groups(t, [(0,), (1,)])
    a, b = groups.basis.T
    y = 6.0 * a - 5.0 * b + rng.normal(size=5)
    norms = 0.5, 50.0
    positive = np.geomspace(*norms, 500)
    of_each = np.concatenate([-positive, positive])
    one, other = np.meshgrid(of_each, of_each, indexing="ij")
    chi2 = y @ y - 2.0 * (one * (a @ y) + other * (b @ y)) + one**2 + other**2 + 2.0 * one * other * (a @ b)
    # Both signs are as probable: the prior is 1/2 ln(50/0.5) per unit of the logarithm.
    steps = len(positive) - 1
    expected = np.log(np.sum(np.exp(-0.5 * chi2)) / (2.0 * steps) ** 2)
    found = pair_log_marginals(known, y, groups, [(0, 1)], norms, rng.normal(size=(20_000, 2)))
    # The mean of 20,000 draws is good to 0.016: five sigma.
    assert found[0] == pytest.approx(expected, abs=0.08)
