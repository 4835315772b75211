"""What can be seen and told apart before any data, and the evidence that data give to each candidate."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats
from scipy.optimize import brentq

from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates

# Nodes of the average over the part of the data that no template hears.
NODES = 40


def power(strength: float, columns: int, threshold: float, dimension: int, simulations: int | None) -> float:
    """Probability that the score test of one candidate finds an effect of a given strength.

    Parameters
    ----------
    strength
        s = sqrt(theta'F theta), F with the true covariance.
    columns
        K of the candidate.
    threshold
        Probability below which the score counts as found, trials included: 0.05/20 for Bonferroni over 20.
    dimension
        p.
    simulations
        N; ``None``: the covariance is known.

    Notes
    -----
    F(K, n - p + 1) with noncentrality s^2/(1 + v'S^-1 v) of the q = p - K other data v, whose 1/(1 + v'S^-1 v) is
    Beta((n - q + 1)/2, q/2) distributed (Rao, Biometrika 46, 49, 1959).
    """
    if simulations is None:
        return float(stats.ncx2.sf(stats.chi2.isf(threshold, columns), columns, max(strength, 1e-9) ** 2))
    n, q = simulations - 1, dimension - columns
    d2 = n - dimension + 1
    level = stats.f.isf(threshold, columns, d2)
    middle = (np.arange(NODES) + 0.5) / NODES
    shrunk = special.betaincinv((n - q + 1) / 2, q / 2, middle) if q else np.ones(NODES)
    return float(np.mean(1.0 - special.ncfdtr(columns, d2, strength**2 * shrunk, level)))


def snr_needed(
    columns: int,
    tests: int,
    dimension: int,
    simulations: int | None,
    alpha: float = 0.05,
    target: float = 0.9,
) -> float:
    """Strength s that one of ``tests`` candidates needs to be found with power ``target`` at ``alpha`` overall.

    Bonferroni over the tests. With a known covariance 3.24 for one template, 4.30 for one of 20, 7.2 for an omnibus
    test (K = 110).
    """
    high = 4.0
    while power(high, columns, alpha / tests, dimension, simulations) < target:
        high *= 1.5
    return float(brentq(lambda s: power(s, columns, alpha / tests, dimension, simulations) - target, 0.0, high))


@dataclass(frozen=True)
class Detectable:
    """Smallest amplitude of a candidate that is found with the stated power.

    Attributes
    ----------
    amplitude, limit
        Norm of the amplitudes of the candidate's columns in their least favourable direction, with these simulations
        and with infinitely many; infinite where the evidence does not hear some direction.
    typical
        The same for the root mean square response over directions, with these simulations.
    strength
        s behind ``amplitude``.
    """

    amplitude: float
    limit: float
    typical: float
    strength: float


def detectable(
    null: SimulatedGaussian, t: NDArray[np.float64], tests: int, alpha: float = 0.05, target: float = 0.9
) -> Detectable:
    """Smallest amplitude of a candidate with columns ``t``, shape (p_raw, K), in one unit.

    The strength per amplitude is taken from the estimated metric, less its bias: F = (n - p - 1)/n t_w't_w.
    """
    white = null.whiten_templates(t)
    response = null.unbiased * np.linalg.eigvalsh(white.T @ white)
    # The evidence may have fewer numbers than the effect has components.
    columns = max(int(np.sum(response > 1e-12 * response[-1])), 1)
    finite = snr_needed(columns, tests, null.dimension, null.count, alpha, target)
    limit = snr_needed(columns, tests, null.dimension, None, alpha, target)
    deaf = response[0] <= 1e-12 * response[-1] or response[-1] == 0.0
    least = 0.0 if deaf else float(np.sqrt(response[0]))
    mean = float(np.sqrt(np.mean(np.maximum(response, 0.0))))
    return Detectable(
        amplitude=finite / least if least else np.inf,
        # The data's mean is known as well where simulations are many.
        limit=limit / (least * np.sqrt(1.0 + 1.0 / null.count)) if least else np.inf,
        typical=finite / mean if mean else np.inf,
        strength=finite,
    )


def confusion(strength: ArrayLike, cosine: ArrayLike) -> NDArray[np.float64]:
    """Probability that an effect is mistaken for another of white cosine ``cosine``, by the larger |score|.

    Notes
    -----
    Q(a) Phi(b) + Phi(a) Q(b), a = s sqrt((1 - |rho|)/2), b = s sqrt((1 + |rho|)/2), Q = 1 - Phi: the sum and the
    difference of the two scores are independent.
    """
    s, rho = np.asarray(strength), np.minimum(np.abs(cosine), 1.0)
    a, b = s * np.sqrt((1.0 - rho) / 2.0), s * np.sqrt((1.0 + rho) / 2.0)
    return special.ndtr(-a) * special.ndtr(b) + special.ndtr(a) * special.ndtr(-b)


def snr_to_separate(cosine: ArrayLike, target: float = 0.95) -> NDArray[np.float64]:
    """Strength at which :func:`confusion` falls to 1 - target; infinite for a cosine of 1."""
    rho = np.abs(np.asarray(cosine, dtype=float))
    far = 1.0 - rho < 1e-12
    low, high = np.zeros_like(rho), np.full_like(rho, 1e7)
    for _ in range(60):
        middle = (low + high) / 2.0
        failed = confusion(middle, rho) > 1.0 - target
        low, high = np.where(failed, middle, low), np.where(failed, high, middle)
    return np.where(far, np.inf, high)


def cosines(candidates: WhitenedTemplates) -> NDArray[np.float64]:
    """Largest canonical correlation of each pair of candidates, shape (C, C); 0 for one that is not heard."""
    parts = [candidates.basis[:, a:b] for a, b in pairwise(candidates.start)]
    found = np.eye(len(parts))
    for i, one in enumerate(parts):
        for j, other in enumerate(parts[:i]):
            block = one.T @ other
            if block.size:
                # Of a single row or column the norm is Euclid's, at a tenth of the cost.
                size = np.linalg.norm(block, 2 if min(block.shape) > 1 else None)
                found[i, j] = found[j, i] = min(float(size), 1.0)
    return found


def log_likelihood(null: SimulatedGaussian, chi2: ArrayLike) -> NDArray[np.float64]:
    """Logarithm of the likelihood of a white residual, up to a constant.

    Notes
    -----
    -(n - p + 2)/2 log(1 + chi2/n): the Student t that the exact tests imply, with the covariance marginalised under the
    prior whose intervals match them (Percival et al., MNRAS 510, 3207, 2022); Gaussian for infinitely many simulations.
    """
    return null.log_jacobian - 0.5 * (null.dof - null.dimension + 2.0) * np.log1p(np.asarray(chi2) / null.dof)


def _precision(null: SimulatedGaussian, chi2: ArrayLike) -> NDArray[np.float64]:
    """Curvature of the likelihood at a best fit, per white square: 1 for infinitely many simulations."""
    return (null.dof - null.dimension + 2.0) / (null.dof + np.asarray(chi2))


def log_evidence(
    null: SimulatedGaussian, total: ArrayLike, delta_chi2: ArrayLike, columns: ArrayLike, widths: Sequence[float]
) -> NDArray[np.float64]:
    """Logarithm of the marginal likelihood under a broad prior of the amplitudes.

    Parameters
    ----------
    null
        Of the evidence.
    total, drop
        White square of the data, and its fall when the templates are fitted.
    columns
        Rank K of the templates.
    widths
        The amplitudes, in orthonormal white coordinates, are normal with one of these standard deviations, all equally
        probable: a ladder of powers of two is flat in the logarithm of the strength.

    Notes
    -----
    log of the mean over j of (1 + w g_j^2)^(-K/2) L(chi2 + T/(1 + w g_j^2)), T the drop, chi2 what it leaves, L and its
    precision w those of :func:`log_likelihood`: Occam's factor of K columns, without the limit that a single width sets
    to strong effects.
    """
    T, K = np.asarray(delta_chi2), np.asarray(columns)
    chi2 = np.asarray(total) - T
    g = np.asarray(widths).reshape((-1,) + (1,) * T.ndim) ** 2
    wide = 1.0 + _precision(null, chi2 + T / (1.0 + g)) * g
    each = log_likelihood(null, chi2 + T / wide) - 0.5 * K * np.log(wide)
    return special.logsumexp(each, axis=0) - np.log(len(widths))


def posterior(
    null: SimulatedGaussian,
    x: NDArray[np.float64],
    candidates: WhitenedTemplates,
    strengths: NDArray[np.float64],
    prior: NDArray[np.float64],
    weights: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Probability of each candidate and of none: the Bayes-optimal classifier of a stated prior.

    Parameters
    ----------
    null
        Of the evidence.
    x
        Evidence, shape (..., p_raw).
    candidates
        Bases of C hypotheses; a mixture is one whose group has the columns of all its effects.
    strengths
        White lengths s of the effect that the prior allows, the same for all candidates, in steps of less than 1.
    prior
        Of none and each candidate, shape (1 + C,), >= 0, any scale.
    weights
        Of the strengths, any scale; equal by default.

    Returns
    -------
    ndarray
        Shape (..., 1 + C), none first.

    Notes
    -----
    The direction of an effect of K columns is isotropic in white coordinates, so that the marginal over it is closed:
    exp(-w s^2/2) 0F1(K/2, w^2 s^2 T/4). Against brute force: tests/unit/test_diagnose_attribute.py.
    """
    y = null.whiten(x)
    total = np.sum(y**2, axis=-1, keepdims=True)
    T, K = candidates.delta_chi2(y), candidates.sizes
    w = _precision(null, total - T)[..., None]
    share = np.ones(len(strengths)) if weights is None else np.asarray(weights)
    root = np.sqrt(T)[..., None]
    order = np.maximum(K, 1)[:, None] / 2.0
    z = np.maximum(w * strengths * root, 1e-8)
    log_sphere = special.gammaln(order) + (1.0 - order) * np.log(z / 2.0) + np.log(special.ive(order - 1.0, z)) + z
    above = -0.5 * w * (strengths**2 + root**2) + log_sphere
    marginal = log_likelihood(null, total - T) + special.logsumexp(above, b=share / share.sum(), axis=-1)
    logs = np.concatenate(
        [log_likelihood(null, total), np.where(K > 0, marginal, log_likelihood(null, total))], axis=-1
    )
    with np.errstate(divide="ignore"):  # what the prior excludes has a logarithm of minus infinity
        return special.softmax(logs + np.log(prior), axis=-1)
