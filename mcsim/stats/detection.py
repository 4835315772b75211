"""Power of the tests, separation of similar effects, and Bayesian model comparison."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats
from scipy.optimize import brentq, newton

from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates
from mcsim.support.arrays import Matrix, Vector

# Nodes of the average over the part of the data outside the span of the templates.
NODES = 40

NEGLIGIBLE = 15.0
"""Pairs whose best fit is less likely than the best pair's by more than this, in the logarithm, are left out."""


def power(strength: float, columns: int, threshold: float, dimension: int, simulations: int | None) -> float:
    """Return the power of the nested test of one candidate of K columns.

    ``strength`` is the signal-to-noise ratio s = sqrt(theta'F theta), F with the true covariance; ``threshold`` the
    p-value below which the candidate is detected (0.05/20 for Bonferroni over 20 candidates); ``dimension`` p;
    ``simulations`` N, ``None`` for a known covariance.

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
    columns: int, tests: int, dimension: int, simulations: int | None, alpha: float = 0.05, target: float = 0.9
) -> float:
    """Return the signal-to-noise ratio at which one of ``tests`` candidates is detected with power ``target``.

    ``alpha`` is the global level, divided among the tests (Bonferroni). With a known covariance s = 3.24 for one
    template, 4.30 for one of 20, 7.2 for an omnibus test (K = 110).
    """
    high = 4.0
    while power(high, columns, alpha / tests, dimension, simulations) < target:
        high *= 1.5
    return float(brentq(lambda s: power(s, columns, alpha / tests, dimension, simulations) - target, 0.0, high))


def detectable(null: SimulatedGaussian, t: Matrix, tests: int, typical: Matrix | None = None) -> float:
    """Return the smallest amplitude at which a candidate with columns ``t``, shape (p_raw, K), in one unit is detected.

    It is that of the root mean square response to ``typical``, coordinates of unit amplitudes, shape (K, j); left out:
    all directions of the columns. It is infinite if the data do not respond. The Fisher matrix is that of the sample
    covariance without its bias: F = (n - p - 1)/n t_w't_w. Level and power are those of :func:`snr_needed`.
    """
    white = null.whiten_templates(t)
    response = null.hartlap_factor * np.linalg.eigvalsh(white.T @ white)
    # The data may have fewer elements than the effect has components.
    columns = max(int(np.sum(response > 1e-12 * response[-1])), 1)
    seen = white if typical is None else white @ typical
    mean = float(np.sqrt(null.hartlap_factor * np.sum(seen**2) / seen.shape[1]))
    return snr_needed(columns, tests, null.dimension, null.dof + 1) / mean if mean else np.inf


def confusion(strength: ArrayLike, cosine: ArrayLike) -> NDArray[np.float64]:
    """Return the probability that an effect is mistaken for another of white cosine ``cosine``.

    Notes
    -----
    The larger |t'C^-1 x| wins. Q(a) Phi(b) + Phi(a) Q(b), a = s sqrt((1 - |rho|)/2), b = s sqrt((1 + |rho|)/2),
    Q = 1 - Phi: the sum and the difference of the two matched filters are independent.
    """
    s, rho = np.asarray(strength), np.minimum(np.abs(cosine), 1.0)
    a, b = s * np.sqrt((1.0 - rho) / 2.0), s * np.sqrt((1.0 + rho) / 2.0)
    return special.ndtr(-a) * special.ndtr(b) + special.ndtr(a) * special.ndtr(-b)


def snr_to_separate(cosine: ArrayLike, target: float = 0.95) -> NDArray[np.float64]:
    """Return the signal-to-noise ratio at which :func:`confusion` falls to 1 - target; infinite for a cosine of 1."""
    nearest = 1.0 - 1e-12
    rho = np.minimum(np.abs(np.asarray(cosine, dtype=float)), nearest)
    scale, ratio = np.sqrt(2.0 / (1.0 - rho)), np.sqrt((1.0 + rho) / (1.0 - rho))

    def slope(a: NDArray[np.float64]) -> NDArray[np.float64]:
        own, other = stats.norm.pdf(a), ratio * stats.norm.pdf(ratio * a)
        return -own * (2.0 * special.ndtr(ratio * a) - 1.0) - other * (2.0 * special.ndtr(a) - 1.0)

    # In a = s sqrt((1 - rho)/2) the curve is convex, and all roots are close above that of rho = 1.
    first = np.full_like(rho, -special.ndtri(1.0 - target))
    root = newton(lambda a: confusion(a * scale, rho) - (1.0 - target), first, slope)
    return np.where(rho < nearest, root * scale, np.inf)


def cosines(candidates: WhitenedTemplates) -> Matrix:
    """Return the largest canonical correlation of each pair of candidates, shape (C, C); 0 for an empty one."""
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


def log_evidence(
    null: SimulatedGaussian, total: ArrayLike, delta_chi2: ArrayLike, columns: ArrayLike, widths: Sequence[float]
) -> NDArray[np.float64]:
    """Return the log-evidence (marginal likelihood) under a broad prior of the amplitudes.

    ``total`` is chi^2 of the data, ``delta_chi2`` its fall when templates of rank K, ``columns``, are fitted. In
    orthonormal white coordinates the amplitudes are normal with one of the standard deviations ``widths``, all equally
    probable; powers of two are flat in the logarithm of the signal-to-noise ratio.

    Notes
    -----
    log of the mean over j of (1 + w g_j^2)^(-K/2) L(chi2 + T/(1 + w g_j^2)), T = delta_chi2, chi2 what it leaves, L
    that of :meth:`SimulatedGaussian.log_likelihood` and w its curvature at chi2 + T/(1 + g_j^2), where fit and prior
    meet: Occam's factor of K columns, without the limit that a single width sets to strong effects.
    """
    T, K = np.asarray(delta_chi2), np.asarray(columns)
    chi2 = np.asarray(total) - T
    g = np.asarray(widths).reshape((-1,) + (1,) * T.ndim) ** 2
    wide = 1.0 + null.curvature(chi2 + T / (1.0 + g)) * g
    each = null.log_likelihood(chi2 + T / wide) - 0.5 * K * np.log(wide)
    return np.asarray(np.logaddexp.reduce(each, axis=0) - np.log(len(widths)))


def log_marginals(null: SimulatedGaussian, x: Matrix, candidates: WhitenedTemplates, strengths: Vector) -> Matrix:
    """Return the log marginal likelihood of none and of each candidate.

    With the logarithm of a prior it classifies in the best possible way.

    ``null``, ``x``: distribution of the data vector without an effect, and data, shape (..., p_raw); the result is
    (..., 1 + C). ``candidates``: bases of C hypotheses; a mixture is one whose group has the columns of all its
    effects. ``strengths``: white norms that the prior allows, equally, for all candidates, in steps of less than 1.

    Notes
    -----
    The direction of an effect of K columns is isotropic in white coordinates, so that the marginal over it is closed:
    exp(-w s^2/2) 0F1(K/2, w^2 s^2 T/4). Against brute force: tests/unit/test_diagnose_attribute.py.
    """
    y = null.whiten(x)
    total = np.sum(y**2, axis=-1, keepdims=True)
    T, K = candidates.delta_chi2(y), candidates.sizes
    w = null.curvature(total - T)[..., None]
    root = np.sqrt(T)[..., None]
    order = np.maximum(K, 1)[:, None] / 2.0
    z = np.maximum(w * strengths * root, 1e-8)
    log_sphere = special.gammaln(order) + (1.0 - order) * np.log(z / 2.0) + np.log(special.ive(order - 1.0, z)) + z
    above = -0.5 * w * (strengths**2 + root**2) + log_sphere
    marginal = null.log_likelihood(total - T) + special.logsumexp(above, b=1.0 / len(strengths), axis=-1)
    none = null.log_likelihood(total)
    return np.concatenate([none, np.where(K > 0, marginal, none)], axis=-1)


def pair_log_marginals(
    null: SimulatedGaussian,
    y: Vector,
    groups: WhitenedTemplates,
    pairs: Sequence[tuple[int, int]],
    norms: tuple[float, float],
    normals: Matrix,
) -> Vector:
    """Return the log marginal likelihood of pairs of groups, shape (pairs,), minus infinity for negligible ones.

    White data ``y`` have shape (p,). The white norm s of each effect is uniform in log s within ``norms``, and its
    direction isotropic: the prior density of K amplitudes is 1/(s^K A_K log(s_max/s_min)), A_K the area of the unit
    sphere. The integral over the amplitudes of both is by importance sampling from the Gaussian about their joint best
    fit, with standard ``normals`` of shape (draws, columns of a pair or more). Checked by brute force:
    tests/unit/test_challenge.py.
    """
    total, along, gram = float(y @ y), groups.basis.T @ y, groups.basis.T @ groups.basis
    fits = []
    for i, j in pairs:
        columns = np.r_[groups.start[i] : groups.start[i + 1], groups.start[j] : groups.start[j + 1]]
        matrix = gram[np.ix_(columns, columns)] + 1e-9 * np.eye(len(columns))
        theta = np.linalg.solve(matrix, along[columns])
        fits.append((matrix, theta, max(total - float(along[columns] @ theta), 0.0)))
    likelihoods = null.log_likelihood(np.array([chi2 for _, _, chi2 in fits]))
    found = np.full(len(fits), -np.inf)
    for number in np.flatnonzero(likelihoods > np.max(likelihoods, initial=-np.inf) - NEGLIGIBLE).tolist():
        (matrix, theta, chi2), first = fits[number], groups.sizes[pairs[number][0]]
        root = np.linalg.cholesky(matrix * null.curvature(chi2))
        drawn = theta + np.linalg.solve(root.T, normals[:, : len(theta)].T).T
        density = _log_prior(drawn[:, :first], norms) + _log_prior(drawn[:, first:], norms)
        volume = 0.5 * len(theta) * np.log(2.0 * np.pi) - np.sum(np.log(np.diag(root)))
        with np.errstate(divide="ignore"):  # no draw is within the norms
            mean = special.logsumexp(density) - np.log(len(drawn))
        found[number] = likelihoods[number] + mean + volume
    return found


def _log_prior(theta: Matrix, norms: tuple[float, float]) -> Vector:
    """Return the log prior density of amplitudes in orthonormal white coordinates, shape (draws, K) to (draws,)."""
    K, s, (low, high) = theta.shape[1], np.linalg.norm(theta, axis=1), norms
    area = np.log(2.0) + 0.5 * K * np.log(np.pi) - special.gammaln(0.5 * K)
    value = -K * np.log(np.maximum(s, 1e-300)) - area - np.log(np.log(high / low))
    return np.where((s >= low) & (s <= high), value, -np.inf)
