"""Estimate the covariance of a random pattern from a few draws of it, for data that hold one more draw beside noise."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.support.arrays import Matrix, Vector

LEAST = 4  #: draws that it needs at least

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
    weight, scale, error = _HeldOut.of(deviations).best()
    covariance = scale * ((1.0 - weight) * deviations @ deviations.T + weight * total / p * np.eye(p))
    return covariance, error


def scores_of_draws(deviations: Matrix, t: Matrix) -> tuple[Matrix, Matrix]:
    """Return the normal matrix of templates t, shape (p, K), and the covariance of its right-hand side, (K, K) both.

    These are t'(1 + R)^-1 t, and the covariance of t'(1 + R)^-1 x for held-out draws x with noise: one and the same if
    R were that of the pattern. Each draw is judged by the covariance of all others, with weight and scale of all; both
    are means over draws. ``deviations`` are those of :func:`covariance_of_draws`.
    """
    count, gram = deviations.shape[1], t.T @ t
    if not deviations.any():
        return gram, gram
    held, normal, covariance = _HeldOut.of(deviations), np.zeros_like(gram), np.zeros_like(gram)
    weight, scale, _ = held.best()
    along = held.vectors.T @ t
    outside, less = gram - along.T @ along, count / (count - 1.0)
    for z in (held.vectors.T @ deviations).T:
        same, own = held.rest(float(z @ z), weight, scale)
        f, inverse = own * less, 1.0 / (1.0 + same + own * held.values)
        u = inverse * z
        left = 1.0 - f * float(z @ u)
        one, two = along.T @ u, along.T @ (inverse * u)
        first, second = (along.T @ (part[:, None] * along) for part in (inverse, inverse**2))
        normal += first + outside / (1.0 + same) + f / left * np.outer(one, one)
        covariance += second + outside / (1.0 + same) ** 2 + f / left * (np.outer(one, two) + np.outer(two, one))
        covariance += ((f / left) ** 2 * float(u @ u) + count / left**2) * np.outer(one, one)
    return normal / count, covariance / count


class _Judged(NamedTuple):
    """Hold what held-out draws say of W covariances.

    ``chi2`` is that of each of k draws, averaged over noise, shape (W, k), ``noise_variance`` the variance that noise
    gives it, averaged over draws, and ``log_likelihood`` the mean of theirs, up to a constant, shape (W,) both.
    """

    chi2: Matrix
    noise_variance: Vector
    log_likelihood: Vector


class _Solved(NamedTuple):
    """Hold chi^2 of each of k held-out draws in W covariances, shape (W, k), and what it is made of.

    ``inside`` are the covariances along the q eigenvectors of S, shape (W, k, q), and ``outside`` across them;
    ``f`` z z' is what the held-out draw z takes from them, and ``left`` the determinant of the rest over theirs.
    ``second`` is the square of z in the square of the inverse covariance.
    """

    chi2: Matrix
    inside: NDArray[np.float64]
    outside: Matrix
    f: Matrix  # (W, 1)
    left: Matrix
    second: Matrix


@dataclass(frozen=True)
class _HeldOut:
    """Judge covariances of p elements by draws that they do not know.

    ``vectors``, shape (p, q), and ``values`` are eigenvectors and eigenvalues of S, and ``squares``, shape (k, q),
    those of the deviations of k draws along them.
    """

    p: int
    vectors: Matrix
    values: Vector
    squares: Matrix

    @classmethod
    def of(cls, deviations: Matrix) -> "_HeldOut":
        """Take the draws' deviations from their mean, shape (p, k)."""
        vectors, singular, right = np.linalg.svd(deviations, full_matrices=False)
        return cls(len(deviations), vectors, singular**2, (singular[:, None] * right).T ** 2)

    def best(self) -> tuple[float, float, float]:
        """Return w and b of R, and the variance that :func:`covariance_of_draws` returns."""
        low, high = np.full(len(_WEIGHTS), -_LOG_RANGE), np.full(len(_WEIGHTS), _LOG_RANGE)
        for _ in range(_STEPS):
            middle = 0.5 * (low + high)
            narrow = self.solve(np.exp(middle)).chi2.mean(axis=1) > self.p
            low, high = np.where(narrow, middle, low), np.where(narrow, high, middle)
        found = self.judge(np.exp(high))
        best = int(np.argmax(np.where(high < _LOG_RANGE, found.log_likelihood, -np.inf)))
        variance = float(found.noise_variance[best] + np.var(found.chi2[best], ddof=1))
        error = max(variance - 2.0 * self.p, 0.0) / (self.p * (self.p + 2.0))
        return float(_WEIGHTS[best]), float(np.exp(high[best])), error

    def rest(self, square: Any, weight: Any, scale: Any) -> tuple[Any, Any]:
        """Return the factors of 1 and of S - k/(k - 1) z z' in the covariance R of all but the draw z of k.

        ``square`` is z'z; broadcast over weights w and scales b.
        """
        count = len(self.squares)
        more = (count - 1.0) / (count - 2.0)
        trace = more * (self.values.sum() - count / (count - 1.0) * square)
        return scale * weight * trace / self.p, more * scale * (1.0 - weight)

    def solve(self, scale: Vector) -> _Solved:
        """Return chi^2 in the covariances of all weights, each with its scale, shape (W,).

        Notes
        -----
        The covariance of all but the draw z is (k - 1)/(k - 2) (S - k/(k - 1) z z'). Inverse and determinant of a
        matrix D - f z z' are those of Sherman & Morrison (Ann. Math. Stat. 21, 124, 1950).
        """
        count, rest = len(self.squares), self.p - len(self.values)
        same, own = self.rest(self.squares.sum(axis=1), _WEIGHTS[:, None], scale[:, None])
        outside, f = 1.0 + same, own * count / (count - 1.0)
        inside = outside[..., None] + own[..., None] * self.values
        inverse = 1.0 / inside
        first, second = (np.einsum("kq,wkq->wk", self.squares, one) for one in (inverse, inverse * inverse))
        left = 1.0 - f * first
        # The trace of the inverse, which noise of variance one contributes.
        trace = np.sum(inverse, axis=-1) + rest / outside + f * second / left
        return _Solved(trace + count * first / left, inside, outside, f, left, second)

    def judge(self, scale: Vector) -> _Judged:
        """Judge the covariances of all weights, each with its scale, shape (W,)."""
        count, rest = len(self.squares), self.p - len(self.values)
        chi2, inside, outside, f, left, second = self.solve(scale)
        inverse = 1.0 / inside
        squared = inverse * inverse
        third = np.einsum("kq,wkq->wk", self.squares, squared * inverse)
        # Of the trace of the square of the inverse.
        square = np.sum(squared, axis=-1) + rest / outside**2
        square += 2.0 * f * third / left + (f * second / left) ** 2
        volume = np.sum(np.log(inside), axis=-1) + rest * np.log(outside) + np.log(left)
        noise = 2.0 * square + 4.0 * count * second / left**2
        return _Judged(chi2, noise.mean(axis=1), -0.5 * (volume + chi2).mean(axis=1))


def without(deviations: Matrix, k: int) -> Matrix:
    """Return the deviations of all draws but one from their own mean, shape (p, draws) to (p, draws - 1)."""
    count = deviations.shape[1]
    # The deviations of all draws add up to zero.
    others = np.delete(deviations, k, axis=1) + deviations[:, [k]] / (count - 1.0)
    return np.asarray(others * np.sqrt((count - 1.0) / (count - 2.0)))
