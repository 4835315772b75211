"""Estimate the covariance of a random pattern from a few draws of it, for data that hold one more draw beside noise."""

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector

LEAST = 4
"""Draws that it needs at least."""

_WEIGHTS = np.logspace(-4.0, 0.0, 13)
_STEPS = 20
_LOG_RANGE = 12.0


def covariance_of_draws(deviations: Matrix) -> tuple[Matrix, float]:
    """Return the covariance R of a pattern, shape (p, p), and the variance of a factor by which its errors scale chi^2.

    ``deviations``, shape (p, draws), are those of the draws from their mean, in coordinates in which the noise beside
    them has covariance one: S = deviations @ deviations.T is their sample covariance. Raise InputError if there are
    fewer than four.

    Notes
    -----
    There are fewer draws than elements. R = b [(1 - w) S + w tr(S)/p 1] is judged by data that it does not know: each
    draw, with noise, by the covariance 1 + R of all others (leave-one-out cross-validation; Stone, JRSS B 36, 111,
    1974). For every w, b is such that the mean chi^2 of the held-out draws is p; w maximises their likelihood (Hoffbeck
    & Landgrebe, IEEE Trans. PAMI 18, 763, 1996). The weight of Ledoit & Wolf (2004) minimises the squared error of R
    instead, which is that of its largest eigenvalues: it makes R far too wide in all other directions.

    Directions in which R is too small or too large remain, so that chi^2 scatters by more than 2 p. The excess, also
    that of the held-out draws, over p (p + 2) is the variance that is returned (:mod:`mcsim.stats.elliptical`).
    P-values of further draws are uniform: tests/statistical/test_few_draws.py.
    """
    p, count = deviations.shape
    if count < LEAST:
        raise InputError(f"{count} draws of a pattern do not tell its covariance; give at least {LEAST}.")
    total = float(np.sum(deviations**2))
    if total == 0.0:
        return np.zeros((p, p)), 0.0
    # Along the eigenvectors of S: its eigenvalues (q,), and the squares of the draws (k, q).
    _, singular, right = np.linalg.svd(deviations, full_matrices=False)
    values, squares, rest = singular**2, (singular[:, None] * right).T ** 2, p - len(singular)
    # The scatter of all but draw z is S - less z z', times more.
    less, more = count / (count - 1.0), (count - 1.0) / (count - 2.0)
    flat = more * (total - less * squares.sum(axis=1)) / p

    def variances(scale: Vector) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return those without the downdate along (W, k, q) and off the draws (W, k), and the weight of z z' (W, 1)."""
        same, own = (scale * _WEIGHTS)[:, None] * flat, (scale * (1.0 - _WEIGHTS))[:, None] * more
        return 1.0 + same[..., None] + own[..., None] * values, 1.0 + same, own * less

    def chi2(scale: Vector) -> NDArray[np.float64]:
        """Return that of every held-out draw, averaged over noise, shape (W, k) (Sherman & Morrison 1950)."""
        inside, outside, own = variances(scale)
        first, second = (np.sum(squares / inside**n, axis=-1) for n in (1, 2))
        along = (own * second + count * first) / (1.0 - own * first)
        return np.asarray(np.sum(1.0 / inside, axis=-1) + rest / outside + along)

    low, high = np.full(len(_WEIGHTS), -_LOG_RANGE), np.full(len(_WEIGHTS), _LOG_RANGE)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        narrow = chi2(np.exp(middle)).mean(axis=1) > p
        low, high = np.where(narrow, middle, low), np.where(narrow, high, middle)
    scale = np.exp(high)
    inside, outside, own = variances(scale)
    first, second, third = (np.sum(squares / inside**n, axis=-1) for n in (1, 2, 3))
    left, each = 1.0 - own * first, chi2(scale)
    volume = np.sum(np.log(inside), axis=-1) + rest * np.log(outside) + np.log(left)
    likelihood = -0.5 * (volume + each).mean(axis=1)
    best = int(np.argmax(np.where(high < _LOG_RANGE, likelihood, -np.inf)))
    flatter = np.sum(1.0 / inside**2, axis=-1) + rest / outside**2
    flatter += 2.0 * own * third / left + (own * second / left) ** 2 + 2.0 * count * second / left**2
    variance = float(2.0 * flatter[best].mean() + np.var(each[best], ddof=1))
    weight = _WEIGHTS[best]
    found = (1.0 - weight) * deviations @ deviations.T + weight * total / p * np.eye(p)
    return scale[best] * found, max(variance - 2.0 * p, 0.0) / (p * (p + 2.0))


def without(deviations: Matrix, k: int) -> Matrix:
    """Return the deviations of all draws but one from their own mean, shape (p, draws) to (p, draws - 1)."""
    count = deviations.shape[1]
    # The deviations of all draws add up to zero.
    others = np.delete(deviations, k, axis=1) + deviations[:, [k]] / (count - 1.0)
    return np.asarray(others * np.sqrt((count - 1.0) / (count - 2.0)))
