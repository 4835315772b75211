"""Test chi^2 of data vectors whose covariance is scaled, as a whole, by a random factor in each realization.

Elements that are products of noise and sky are large in all of a realization whose sky is bright. With a factor u of
mean one such data are x = mean + sqrt(u) C^(1/2) z, z standard normal: elliptical, and Gaussian if u does not vary.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from mcsim.support.arrays import Matrix, Vector


def leave_one_out(white: Matrix) -> Vector:
    """Return chi^2 of every simulation against all others, white coordinates (N, p) to (N,).

    Notes
    -----
    With c = x_i - mean, S the scatter of all N and a = N/(N - 1) c'S^-1 c, the scatter of the others is
    S - N/(N - 1) c c', and x_i less their mean is N/(N - 1) c: its square in their scatter, over 1 + 1/(N - 1), is
    a/(1 - a) (Sherman & Morrison, Ann. Math. Stat. 21, 124, 1950).
    """
    count = len(white)
    a = np.sum(white**2, axis=1) / (count - 1) * count / (count - 1)
    return np.asarray((count - 2) * a / np.maximum(1.0 - a, 1e-12))


def scale_variance(chi2: Vector, n: int, dimension: int) -> float:
    """Return the variance of the factor u from chi^2 of held-out simulations, shape (N,); 0 if they show none.

    Each chi^2 has ``dimension`` p and a covariance of ``n`` degrees of freedom that does not know the simulation.

    Notes
    -----
    For u = 1 a = chi^2/(n + chi^2) is Beta(p/2, (n - p + 1)/2) distributed, which is Hotelling's T^2. A small change of
    u changes a by a (1 - a) du, so that var u = (var a - its Beta variance)/<a^2 (1 - a)^2>. For n -> infinity this is
    (var chi^2 - 2 p)/(p (p + 2)): Mardia's measure of kurtosis (Biometrika 57, 519, 1970) over its Gaussian value, less
    one. Its standard error without a scale is about (2/p) sqrt(2/N); a negative estimate is 0.
    """
    a = chi2 / (n + chi2)
    one, two = dimension / 2.0, (n - dimension + 1.0) / 2.0
    both = one + two
    expected = one * two / (both**2 * (both + 1.0))
    response = one * (one + 1.0) * two * (two + 1.0) / (both * (both + 1.0) * (both + 2.0) * (both + 3.0))
    return max(float(np.var(a, ddof=1)) - expected, 0.0) / response


def f_tail(
    f: ArrayLike,
    d1: ArrayLike,
    d2: ArrayLike,
    noncentrality: ArrayLike = 0.0,
    scale: float = 0.0,
    spread: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return the probability of a larger f than that of a ratio of mean squares with ``d1`` and ``d2`` > 4 dof.

    ``noncentrality`` is that of the first, ``scale`` the variance of a factor u of mean one that multiplies what it is
    without, and ``spread`` half of what the variance of the first sum of squares has beyond that of the noncentrality.

    Notes
    -----
    A noncentrality l makes the first a central one, with (d1 + l)^2/(d1 + 2 l) degrees of freedom and (d1 + l)/d1 times
    the mean (Patnaik, Biometrika 36, 202, 1949). If a further covariance of trace l makes it, the trace q of its
    square, the spread, adds to the variance: (d1 + l)^2/(d1 + 2 l + q) degrees of freedom. A factor u multiplies the
    mean square of f by 1 + var(u) d1 (d1 + 2)/((d1 + l)^2 + 2 (d1 + 2 l + q)); f is then taken to have another d2, that
    with the same mean square over squared mean, and a scale that keeps the mean. Exact without these, and for a known
    covariance (d2 -> infinity) if 1/u is a chi^2 over its degrees of freedom: the data are then a multivariate Student
    t (Muirhead, Aspects of Multivariate Statistical Theory, 1982, section 1.5). Tests:
    tests/statistical/test_elliptical.py.
    """
    first, second, x = _central(f, d1, d2, noncentrality, scale, spread)
    return np.asarray(special.fdtrc(first, second, x))


def f_log_density(
    f: ArrayLike, d1: ArrayLike, d2: ArrayLike, noncentrality: ArrayLike = 0.0, spread: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Return the logarithm of the density of log f; arguments are those of :func:`f_tail`, without a scale."""
    a, b, x = _central(f, d1, d2, noncentrality, 0.0, spread)
    a, b, x = a / 2.0, b / 2.0, np.maximum(a * x / b, 1e-300)
    return np.asarray(a * np.log(x) - (a + b) * np.log1p(x) - special.betaln(a, b))


def _central(
    f: ArrayLike, d1: ArrayLike, d2: ArrayLike, noncentrality: ArrayLike, scale: float, spread: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the degrees of freedom of a central F distribution, and its variable in place of f."""
    d1, second, extra = (np.asarray(one, dtype=float) for one in (d1, d2, noncentrality))
    half = d1 + 2.0 * extra + np.asarray(spread, dtype=float)
    first = (d1 + extra) ** 2 / half
    x = np.maximum(np.asarray(f, dtype=float), 0.0) * d1 / (d1 + extra)
    if scale > 0.0:
        # Of Fisher's F the relative variance is 2 (d1 + d2 - 2)/(d1 (d2 - 4)).
        more = 1.0 + scale * d1 * (d1 + 2.0) / ((d1 + extra) ** 2 + 2.0 * half)
        variance = more * (1.0 + 2.0 * (first + second - 2.0) / (first * (second - 4.0))) - 1.0
        wide = (2.0 * first - 4.0 + 4.0 * variance * first) / (variance * first - 2.0)
        x, second = x * (second - 2.0) / second * wide / (wide - 2.0), wide
    return first, second, x
