"""Generalised least squares and its tests, exact also where the covariance comes from few simulations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from mcsim.errors import InputError


@dataclass(frozen=True)
class Solution:
    """Best fit of data = design @ parameters.

    Attributes
    ----------
    parameters, covariance
        Shape (K,) and (K, K): estimates, and the covariance of their distribution about the truth.
    chi2, dof
        r'C^-1 r of the residual r, and the number of data less K.
    probability
        Of a chi2 as large as this or larger where the model holds.
    residual
        Shape (p,).
    simulations
        Behind the covariance of the data; ``None``: that is known.
    """

    parameters: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi2: float
    dof: int
    probability: float
    residual: NDArray[np.float64]
    simulations: int | None

    @property
    def errors(self) -> NDArray[np.float64]:
        """Standard deviations of the parameters, shape (K,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Correlation of the parameters, shape (K, K)."""
        return self.covariance / np.outer(self.errors, self.errors)

    @property
    def reduced_chi2(self) -> float:
        """chi2 over its expectation: dof where the covariance is known, n dof/(n - dof - 1) for n = simulations - 1."""
        if self.simulations is None:
            return self.chi2 / self.dof
        n = self.simulations - 1
        return self.chi2 * (n - self.dof - 1) / (n * self.dof)


def solve(
    data: NDArray[np.float64],
    design: NDArray[np.float64],
    covariance: NDArray[np.float64],
    simulations: int | None = None,
) -> Solution:
    """Fit a linear model by generalised least squares.

    Parameters
    ----------
    data
        Shape (p,).
    design
        Shape (p, K), of rank K < p.
    covariance
        Of the data, shape (p, p); with ``simulations`` proportional to a sample covariance.
    simulations
        Number N of independent draws behind it, their mean subtracted, and the data independent of it; ``None``: it is
        known.

    Raises
    ------
    InputError
        For fewer than p + 3 simulations, data without scatter, or a design whose columns are not independent.

    Notes
    -----
    With n = N - 1, q = p - K, R = chi2/n and H = T'C^-1 T/n: (n - q + 1)/q R ~ F(q, n - q + 1), Hotelling's T^2 of the
    residual (Ann. Math. Stat. 2, 360, 1931). The residual acts as q covariates of the parameters, so that each of them
    over sqrt((1 + R) (H^-1)_kk/(n - q)) is a Student t with n - q degrees of freedom (Rao, Biometrika 46, 49, 1959),
    whose standard deviation is quoted. A plain chi2 and its errors are wrong by factors of order 1 + p/N (Hartlap et
    al., A&A 464, 399, 2007). Probabilities are uniform and pulls of unit width: tests/statistical/test_fit.py.
    """
    p, K = design.shape
    if p <= K:
        raise InputError(f"{p} data cannot be fitted with {K} parameters; give more bins or a simpler model.")
    if simulations is not None and simulations < p + 3:
        raise InputError(
            f"{simulations} realizations are too few for the covariance of {p} binned data; give wider bins, fewer "
            f"modes, a narrower range of ell or at least {p + 3} realizations."
        )
    scale = np.sqrt(np.diag(covariance))
    if not np.all(scale > 0.0):
        raise InputError(f"datum {int(np.argmin(scale))} has no scatter, so it cannot be weighted; leave its bin out.")
    try:
        root = cholesky(covariance / np.outer(scale, scale), lower=True)
    except LinAlgError:
        raise InputError("the covariance of the data is not positive definite; leave out bins that repeat.") from None
    white = solve_triangular(root, design / scale[:, None], lower=True)
    size = np.linalg.norm(white, axis=0)
    unit = white / np.where(size > 0.0, size, 1.0)
    if np.any(size == 0.0) or np.linalg.svd(unit, compute_uv=False)[-1] < 1e-7:
        raise InputError("the data cannot tell the parameters of the model apart; choose a simpler model or more data.")
    orthogonal, triangle = np.linalg.qr(unit)
    target = solve_triangular(root, data / scale, lower=True)
    parameters = solve_triangular(triangle, orthogonal.T @ target) / size
    inverse = solve_triangular(triangle, np.eye(K)) / size[:, None]
    residual = data - design @ parameters
    chi2 = float(np.sum((target - orthogonal @ (orthogonal.T @ target)) ** 2))
    q = p - K
    if simulations is None:
        return Solution(parameters, inverse @ inverse.T, chi2, q, float(stats.chi2.sf(chi2, q)), residual, None)
    n = simulations - 1
    student = n - q
    widening = n * (1.0 + chi2 / n) / student * (student / (student - 2.0))
    probability = float(stats.f.sf((n - q + 1) / q * chi2 / n, q, n - q + 1))
    return Solution(parameters, widening * inverse @ inverse.T, chi2, q, probability, residual, simulations)


@dataclass(frozen=True)
class Comparison:
    """Test of a model against one that contains it: drop of chi2, parameters added, and its probability by chance."""

    drop: float
    added: int
    probability: float


def compare(small: Solution, large: Solution) -> Comparison:
    """Whether a model is worth the parameters that it adds to one that it contains, fitted to the same data.

    Raises
    ------
    InputError
        If the models are not of different size, in this order.

    Notes
    -----
    The drop of chi2 is a chi^2 of as many degrees of freedom as there are added parameters. With n = N - 1 of a sample
    covariance, nu = n - q + 1 and q of the smaller model, nu/added (R_small - R_large)/(1 + R_large) ~ F(added, nu),
    R = chi2/n (Rao 1959).
    """
    added = small.dof - large.dof
    if added <= 0:
        raise InputError("a comparison needs a model and another one that adds parameters to it; exchange them.")
    drop = small.chi2 - large.chi2
    if small.simulations is None:
        return Comparison(drop, added, float(stats.chi2.sf(drop, added)))
    n = small.simulations - 1
    nu = n - small.dof + 1
    return Comparison(drop, added, float(stats.f.sf(nu / added * drop / (n + large.chi2), added, nu)))


def solve_each(realizations: NDArray[np.float64], design: NDArray[np.float64]) -> list[Solution]:
    """Fit every realization with the covariance of all the others, so that each is independent of its own weights.

    Parameters
    ----------
    realizations
        Shape (N, p).
    design
        Shape (p, K).
    """
    count = len(realizations)
    deviation = realizations - realizations.mean(axis=0)
    scatter = deviation.T @ deviation
    solutions = []
    for data, own in zip(realizations, deviation, strict=True):
        others = scatter - count / (count - 1.0) * np.outer(own, own)
        solutions.append(solve(data, design, others / (count - 2.0), count - 1))
    return solutions
