"""Least squares for beam fits, with a known covariance or one of simulations (:mod:`mcsim.stats.gaussian`)."""

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from mcsim.errors import InputError
from mcsim.stats import gaussian
from mcsim.support.arrays import Matrix, Vector


@dataclass(frozen=True)
class Solution:
    """Best fit of data = design @ parameters."""

    #: parameters, covariance: estimates and the covariance of their distribution about the truth, shape (K,) and (K, K)
    parameters: Vector
    covariance: Matrix
    #: square, dof, probability: r'C^-1 r of the residual r with the given covariance C, the number of data minus K, and
    #: the p-value: the probability of a square at least as large if the model is true
    square: float
    dof: int
    probability: float
    residual: Vector  #: data minus best fit, shape (p,)
    simulations: int | None  #: number of simulations that C was estimated from; ``None``: C is known

    @property
    def errors(self) -> Vector:
        """Standard deviations of the parameters, shape (K,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Matrix:
        """Correlation of the parameters, shape (K, K)."""
        return self.covariance / np.outer(self.errors, self.errors)

    @property
    def chi2(self) -> float:
        """Chi^2, with expectation ``dof``; that of ``square`` is n/(n - dof - 1) larger for n + 1 simulations."""
        if self.simulations is None:
            return self.square
        n = self.simulations - 1
        return self.square * (n - self.dof - 1) / n

    @property
    def reduced_chi2(self) -> float:
        """Chi^2 per degree of freedom."""
        return self.chi2 / self.dof


def solve(data: Vector, design: Matrix, covariance: Matrix, simulations: int | None = None) -> Solution:
    """Fit templates, the columns of ``design``, shape (p, K), to data, shape (p,), by generalised least squares.

    The design has rank K < p. With ``simulations`` the covariance, shape (p, p), is proportional to the sample
    covariance of so many independent draws, which subtracts their mean and is independent of the data; ``None``: it is
    known. Raise InputError for arrays of other shapes, values that are not finite, fewer than p + 3 simulations, data
    without scatter, or a design whose columns are not independent.

    Notes
    -----
    The estimates, their Student t errors and the F test of the residual are those of
    :meth:`mcsim.stats.gaussian.SimulatedGaussian.fit`; a plain chi^2 and its errors are wrong by factors of order
    1 + p/N (Hartlap et al., A&A 464, 399, 2007). Probabilities are uniform and pulls of unit width:
    tests/statistical/test_fit.py.
    """
    white = whitening(data, design, covariance, simulations)
    K = design.shape[1]
    if simulations is None:
        basis, back = gaussian.orthonormal(white @ design)
        along = basis.T @ (white @ data)
        rank, parameters, spread = basis.shape[1], back @ along, back @ back.T
        q = len(data) - rank
        square = float(np.sum((white @ data - basis @ along) ** 2))
        probability = float(stats.chi2.sf(square, q))
    else:
        # The fit allows for the error of the simulations' mean; here the mean is a model's, without error.
        null = gaussian.SimulatedGaussian(np.zeros(len(data)), np.sqrt(1.0 + 1.0 / simulations) * white, simulations)
        found = null.fit(data, design)
        parameters, spread, square = found.amplitudes, found.covariance, found.chi2
        q, probability = found.dimension, found.pvalue
        rank = len(data) - q
    if rank < K:
        raise InputError("the data cannot tell the parameters of the model apart; choose a simpler model or more data.")
    return Solution(parameters, spread, square, q, probability, data - design @ parameters, simulations)


def whitening(data: Vector, design: Matrix, covariance: Matrix, simulations: int | None) -> Matrix:
    """Check the arguments of :func:`solve`; return the inverse Cholesky factor of the covariance, shape (p, p)."""
    p, K = design.shape
    if data.shape != (p,) or covariance.shape != (p, p):
        raise InputError(
            f"data of shape {data.shape}, a design of {design.shape} and a covariance of {covariance.shape} do not "
            f"belong together; give shapes ({p},), ({p}, {K}) and ({p}, {p})."
        )
    if not (np.isfinite(data).all() and np.isfinite(design).all() and np.isfinite(covariance).all()):
        raise InputError("data, design or covariance hold values that are not finite; leave those bins out.")
    if p <= K:
        raise InputError(f"{p} data cannot be fitted with {K} parameters; give more bins or a simpler model.")
    if simulations is not None and simulations < p + 3:
        raise InputError(
            f"{simulations} realizations are too few for the covariance of {p} binned data; give wider bins, fewer "
            f"modes, a narrower range of ell or at least {p + 3} realizations."
        )
    variance = np.diag(covariance)
    if not np.all(variance > 0.0):
        raise InputError(
            f"datum {int(np.argmin(variance))} has no scatter, so it cannot be weighted; leave its bin out."
        )
    scale = np.sqrt(variance)
    try:
        root = cholesky(covariance / np.outer(scale, scale), lower=True)
    except LinAlgError:
        raise InputError("the covariance of the data is not positive definite; leave out bins that repeat.") from None
    return solve_triangular(root, np.diag(1.0 / scale), lower=True)


def size(change: Vector, covariance: Matrix, simulations: int | None) -> float:
    """Return the length of a change of the data, shape (p,), in sigma: no parameter shifts by more of its errors."""
    white = whitening(change, np.zeros((len(change), 0)), covariance, simulations) @ change
    n = np.inf if simulations is None else simulations - 1.0
    return float(np.linalg.norm(white) * np.sqrt(1.0 - (len(change) + 1.0) / n))


@dataclass(frozen=True)
class Comparison:
    """Test of a model against one that contains it and adds ``added`` parameters.

    ``drop`` is the decrease of chi^2, for an estimated covariance ``added`` times the F statistic; ``probability`` the
    p-value: the probability of at least this decrease if the smaller model is true.
    """

    drop: float
    added: int
    probability: float


def compare(small: Solution, large: Solution) -> Comparison:
    """Test a model against a smaller one that it contains, fitted to the same data.

    Raise InputError if ``large`` does not have more parameters than ``small``, or their covariances differ.

    Notes
    -----
    With a known covariance the decrease of chi^2 has a chi^2 distribution with as many degrees of freedom as there are
    added parameters; otherwise the test is :func:`mcsim.stats.gaussian.nested_pvalue` (Rao, Biometrika 46, 49, 1959).
    """
    added = small.dof - large.dof
    if added <= 0:
        raise InputError("a comparison needs a model and another one that adds parameters to it; exchange them.")
    if small.simulations != large.simulations:
        raise InputError("the models were fitted with different covariances; fit both to the same data.")
    drop = small.square - large.square
    if small.simulations is None:
        return Comparison(drop, added, float(stats.chi2.sf(drop, added)))
    n = small.simulations - 1
    probability = float(gaussian.nested_pvalue(drop, small.square, added, small.dof, n))
    return Comparison((n - small.dof + 1) * drop / (n + large.square), added, probability)


def solve_each(realizations: Matrix, design: Matrix) -> list[Solution]:
    """Fit every realization, shape (N, p), with the covariance of all the others, which is independent of it."""
    count = len(realizations)
    deviation = realizations - realizations.mean(axis=0)
    scatter = deviation.T @ deviation
    others = (scatter - count / (count - 1.0) * np.outer(own, own) for own in deviation)
    return [solve(data, design, s / (count - 2.0), count - 1) for data, s in zip(realizations, others, strict=True)]
