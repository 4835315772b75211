"""Estimate a covariance from little more simulations than elements, and measure by cross-validation how good it is."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.support.arrays import Matrix, Vector

WIDTHS = np.concatenate([[0.0], np.geomspace(0.02, 0.6, 7)])  #: of the normal distributions of true correlations
ROUNDS = 60  #: in which the shares of these distributions are found

LEAST = 0.5
"""Smallest eigenvalue of the target over that of the sample correlation: a target found pair by pair may have none."""

FOLDS = 20  #: at most, with two simulations in each
MOST = 10  #: simulations of a sample covariance that one may be worth: of few the measured number scatters to infinity


class Fold(NamedTuple):
    """Hold simulations in coordinates in which the covariance of all others is one.

    ``white``: shape (count, p_f). ``turn``: from the white coordinates of all to these, shape (p_f, p).
    """

    white: Matrix
    turn: Matrix


class Shrunk(NamedTuple):
    """Hold a whitening, shape (p, p_raw), and what it is worth.

    ``dof``: degrees of freedom of the sample covariance that would be as good. ``folds``: simulation i is in fold i
    modulo their number.
    """

    whitening: Matrix
    dof: int
    folds: tuple[Fold, ...]


def shrunk(simulations: Matrix, floor: float, classes: NDArray[np.int64] | None = None) -> Shrunk:
    """Return a shrunk covariance of simulations, shape (N, p_raw), N > p, with its worth.

    ``floor``: eigenvalues of the correlation matrix below this fraction of the largest are left out. ``classes``: the
    number of a class for each pair of elements, shape (p_raw, p_raw); correlations of one class are expected to be
    similar. None: nothing is known of them.

    Notes
    -----
    With A = C^-1/2 C_true C^-1/2, held-out simulations in white coordinates have mean square tr A, and mean squared
    products tr A^2. A sample covariance with n degrees of freedom has p tr A^2/(tr A)^2 = (n - 1)/(n - p - 3) and
    tr A = n p/(n - p - 1) (moments of the inverse Wishart and F distributions): the first says n, the second the scale.
    The tests of Hotelling and Rao with this n are then right for mean and variance of chi^2, and for the mean square
    of the amplitude of an average template. Figures: docs/science/statistics.md.
    """
    spread = simulations.std(axis=0)
    z = simulations / spread
    values, vectors = np.linalg.eigh(np.corrcoef(z.T))
    basis = vectors[:, values > floor * values[-1]].T
    whitening, folds = _whitening(z, basis, classes), []
    p, count, back = len(whitening), len(simulations), np.linalg.pinv(whitening)
    total, products, pairs, parts = 0.0, 0.0, 0, min(FOLDS, count // 2)
    for number in range(parts):
        out = np.arange(count) % parts == number
        rest = z[~out]
        own = _whitening(rest, basis, classes)
        white = (z[out] - rest.mean(axis=0)) @ own.T / np.sqrt(1.0 + 1.0 / len(rest))
        gram = white @ white.T
        total += float(np.trace(gram))
        products += float(np.sum(gram**2) - np.sum(np.diag(gram) ** 2))
        pairs += len(white) * (len(white) - 1)
        folds.append(Fold(white, own @ back))
    ratio = p * products / pairs / (total / count) ** 2
    dof = int(min(max((ratio * (p + 3) - 1.0) / max(ratio - 1.0, 1e-9), p + 7), MOST * count))
    scale = float(np.sqrt(dof * p / (dof - p - 1.0) / (total / count)))
    return Shrunk(scale * whitening / spread, dof, tuple(Fold(scale * one.white, one.turn) for one in folds))


def _whitening(z: Matrix, basis: Matrix, classes: NDArray[np.int64] | None) -> Matrix:
    """Return coordinates in which the shrunk covariance is one, shape (p, p_raw).

    ``z``: simulations of unit variance, shape (N, p_raw); ``basis``: directions that are not redundant, (p, p_raw).

    Notes
    -----
    In coordinates in which the target is one, eigenvalues are shrunk by the formula of Ledoit & Wolf.
    """
    n, centred = len(z) - 1, z - z.mean(axis=0)
    sample = centred.T @ centred / n
    smallest = float(np.linalg.eigvalsh(basis @ sample @ basis.T)[0])
    values, vectors = np.linalg.eigh(basis @ _target(sample, n, classes) @ basis.T)
    first = (vectors / np.sqrt(np.maximum(values, LEAST * smallest))).T @ basis
    values, vectors = np.linalg.eigh(first @ sample @ first.T)
    return np.asarray((vectors / np.sqrt(shrunk_eigenvalues(values, n))).T @ first)


def _target(sample: Matrix, n: int, classes: NDArray[np.int64] | None) -> Matrix:
    """Return what the true correlations are expected to be, one by one, given the sample ones, shape (p_raw, p_raw).

    The mean of each class is estimated, and the departure of each correlation from it.
    """
    pairs = np.tril_indices(len(sample), -1)
    found, expected = sample[pairs], np.zeros(len(pairs[0]))
    if classes is not None:
        _, which, count = np.unique(classes[pairs], return_inverse=True, return_counts=True)
        means = np.bincount(which, found) / count
        expected = posterior_means(means, 1.0 / np.sqrt(n * count))[which]
    target = np.diag(np.diag(sample))
    target[pairs] = expected + posterior_means(found - expected, np.full(len(found), 1.0 / np.sqrt(n)))
    return np.asarray(np.tril(target) + np.tril(target, -1).T)


def posterior_means(values: Vector, errors: Vector) -> Vector:
    """Return the expected true values, given measured ones and their errors, shape (count,).

    Notes
    -----
    Empirical Bayes (Stephens, Biostatistics 18, 275, 2017): true values are zero, or of a normal distribution of one of
    the :data:`WIDTHS`; the shares of these are those of largest likelihood (expectation and maximisation).
    """
    variance = errors**2 + WIDTHS[:, None] ** 2
    likelihood = np.exp(-0.5 * values**2 / variance) / np.sqrt(variance)
    shares = np.full(len(WIDTHS), 1.0 / len(WIDTHS))
    for _ in range(ROUNDS):
        weights = shares[:, None] * likelihood
        weights /= weights.sum(axis=0)
        shares = weights.mean(axis=1)
    return np.asarray(values * np.sum(weights * WIDTHS[:, None] ** 2 / variance, axis=0))


def shrunk_eigenvalues(values: Vector, n: int) -> Vector:
    """Return the eigenvalues of a covariance that minimise the expected loss, given those of a sample one, shape (p,).

    ``n``: degrees of freedom of the sample covariance, >= p.

    Notes
    -----
    Ledoit & Wolf, Ann. Statist. 48, 3043 (2020), Eqs. 4.3, 4.7, 4.8 and 4.11: the density of the sample eigenvalues and
    its Hilbert transform, both from an Epanechnikov kernel of width n^(-1/3) in proportion to each eigenvalue.
    """
    width = n ** (-1.0 / 3.0) * values[None, :]
    x = (values[:, None] - values[None, :]) / width
    root = np.sqrt(5.0)
    density = np.mean(0.75 / root * np.maximum(1.0 - x**2 / 5.0, 0.0) / width, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        edge = 0.75 / (root * np.pi) * (1.0 - x**2 / 5.0) * np.log(np.abs((root - x) / (root + x)))
    hilbert = np.mean((np.where(np.isfinite(edge), edge, 0.0) - 0.3 / np.pi * x) / width, axis=1)
    share = len(values) / n
    real = 1.0 - share - np.pi * share * values * hilbert
    return np.asarray(values / ((np.pi * share * values * density) ** 2 + real**2))
