"""Test and fit a Gaussian data vector whose mean and covariance are known from a limited number of simulations.

With N simulations of p elements and S the scatter matrix (the sum of squares about their mean), the tests are those of
Hotelling (1931) and Rao (1959): exact for every N > p, and the usual chi^2 tests for N -> infinity. The tests of chi^2
allow for a factor that scales the covariance of each realization (:mod:`mcsim.stats.elliptical`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcsim.errors import InputError
from mcsim.stats.elliptical import f_log_density, f_tail, leave_one_out, scale_variance
from mcsim.stats.few_draws import covariance_of_draws
from mcsim.stats.shrinkage import Fold, shrunk
from mcsim.support.arrays import Matrix, Vector, divided

# A direction is empty if its variance, or its part outside a span, is below this fraction of its size.
COLLINEAR = 1e-6


@dataclass(frozen=True)
class Fit:
    """Hold templates fitted to a data vector."""

    #: amplitudes, covariance: Shape (K,), (K, K). A combination to which the data do not respond has amplitude 0 and
    #: variance 0.
    amplitudes: NDArray[np.float64]
    covariance: NDArray[np.float64]
    dof: int  #: degrees of freedom of the Student t that (estimate - truth)/scale follows; ``covariance`` is that t's
    #: delta_chi2, nested_pvalue: fall of chi^2 by the fit, and the probability of such a fall without the templates
    delta_chi2: float
    nested_pvalue: float
    #: chi2, dimension, pvalue: of the residual: its chi^2, its number of degrees of freedom, and the probability of a
    #: larger chi^2
    chi2: float
    dimension: int
    pvalue: float

    @property
    def errors(self) -> NDArray[np.float64]:
        """Return the standard deviations of the amplitudes, shape (K,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class WhitenedTemplates:
    """Hold orthonormal bases of groups of templates in white coordinates, side by side."""

    basis: NDArray[np.float64]  #: shape (p, r_1 + r_2 + ...)
    start: NDArray[np.int64]  #: first column of each group, and the end of the last

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Return the rank r_c of each group; 0 if the data do not respond to it."""
        return np.diff(self.start)

    def delta_chi2(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fall of chi^2 if each group is fitted alone, white data (..., p) to (..., groups)."""
        cumulative = np.cumsum((y @ self.basis) ** 2, axis=-1)
        padded = np.concatenate([np.zeros((*cumulative.shape[:-1], 1)), cumulative], axis=-1)
        return np.diff(padded[..., self.start], axis=-1)


@dataclass(frozen=True)
class SimulatedGaussian:
    """Describe a Gaussian data vector by the sample mean and sample covariance of simulations."""

    mean: NDArray[np.float64]  #: shape (p_raw,)
    #: Shape (p, p_raw), p <= p_raw: coordinates in which the sample covariance is one. Redundant elements are
    #: compressed.
    whitening: NDArray[np.float64]
    n_sims: int  #: number N of simulations
    #: logarithm of the factor by which :meth:`with_extra_covariance` has shrunk volumes in white coordinates
    log_jacobian: float = 0.0
    #: degrees of freedom n of the covariance if it is no sample covariance; None: N - 1
    covariance_dof: int | None = None
    #: then the simulations in white coordinates of others; simulation i is in fold i modulo their number
    folds: tuple[Fold, ...] = ()
    #: variance of a factor that scales the covariance of each realization; 0 if the data vector is Gaussian and its
    #: covariance known up to the error of the simulations
    scale_variance: float = 0.0

    @classmethod
    def from_simulations(
        cls,
        simulations: NDArray[np.float64],
        offset: NDArray[np.float64] | None = None,
        floor: float = 1e-8,
        shrink: bool = False,
        classes: NDArray[np.int64] | None = None,
    ) -> "SimulatedGaussian":
        """Estimate mean and covariance from simulations, shape (N, p_raw).

        ``offset``: known difference between the mean of the data and that of the simulations, shape (p_raw,).
        Eigenvalues of the correlation matrix below the fraction ``floor`` of the largest are left out. ``shrink``: a
        covariance from few simulations (:func:`mcsim.stats.shrinkage.shrunk`, also for ``classes``). Raise InputError
        if an element is not finite or constant, or there are fewer than p + 7 simulations.
        """
        mean = simulations.mean(axis=0)
        centred = simulations - mean
        scale = np.sqrt(np.mean(centred**2, axis=0))
        if not (np.isfinite(scale).all() and (scale > 0.0).all()):
            wrong = int(np.argmin(np.where(np.isfinite(scale), scale, -1.0)))
            raise InputError(f"element {wrong} of the data vector has no finite variance in the simulations; omit it.")
        _, singular, right = np.linalg.svd(centred / scale, full_matrices=False)
        kept = singular**2 > floor * singular[0] ** 2
        count, dimension = len(simulations), int(kept.sum())
        if count < dimension + 7:
            raise InputError(
                f"{count} simulations are too few for {dimension} independent elements; give at least {dimension + 7}, "
                f"better {10 * dimension}."
            )
        centre = mean if offset is None else mean + offset
        if shrink:
            found = shrunk(simulations, floor, classes)
            null = cls(centre, found.whitening, count, covariance_dof=found.dof, folds=found.folds)
        else:
            null = cls(centre, np.sqrt(count - 1.0) * right[kept] / singular[kept, None] / scale, count)
        return replace(null, scale_variance=scale_variance(*null.held_out(simulations), null.dimension))

    @property
    def dimension(self) -> int:
        """Return the number p of independent elements."""
        return len(self.whitening)

    @property
    def dof(self) -> int:
        """Return n, the degrees of freedom of the covariance: N - 1 of a sample covariance."""
        return self.n_sims - 1 if self.covariance_dof is None else self.covariance_dof

    @property
    def hartlap_factor(self) -> float:
        """Return (n - p - 1)/n, which makes the inverse sample covariance unbiased.

        Notes
        -----
        Hartlap, Simon & Schneider, A&A 464, 399 (2007), Eq. 17.
        """
        return (self.dof - self.dimension - 1) / self.dof

    def whiten(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return data less the mean in white coordinates, shape (..., p_raw) to (..., p).

        The factor (1 + 1/N)^(-1/2) accounts for the error of the mean.
        """
        return (x - self.mean) @ self.whitening.T / np.sqrt(1.0 + 1.0 / self.n_sims)

    def whiten_templates(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return templates in white coordinates, shape (p_raw, K) to (p, K), on the scale of :meth:`whiten`."""
        return self.whitening @ t / np.sqrt(1.0 + 1.0 / self.n_sims)

    def whiten_groups(self, t: NDArray[np.float64], groups: Sequence[Sequence[int]]) -> WhitenedTemplates:
        """Return orthonormal white bases of groups of columns of the templates ``t``, shape (p_raw, K)."""
        white = self.whiten_templates(t)
        bases = [orthonormal(white[:, list(group)])[0] for group in groups]
        return WhitenedTemplates(np.concatenate(bases, axis=1), np.cumsum([0] + [one.shape[1] for one in bases]))

    def chi2(self, x: NDArray[np.float64]) -> float:
        """Return chi^2 of data, shape (p_raw,): n (x - mean)' S^-1 (x - mean)/(1 + 1/N)."""
        y = self.whiten(x)
        return float(y @ y)

    def pvalue(self, x: NDArray[np.float64]) -> float:
        """Return the probability of a larger chi^2 than that of data, shape (p_raw,): Hotelling's T^2 test."""
        return float(self.residual_test(self.chi2(x)))

    def residual_test(
        self, chi2: ArrayLike, fitted: ArrayLike = 0, allowance: ArrayLike = 0.0, spread: ArrayLike = 0.0
    ) -> NDArray[np.float64]:
        """Return the p-value of chi^2 after ``fitted`` columns have been fitted; see :func:`residual_pvalue`."""
        dimension = self.dimension - np.asarray(fitted)
        return residual_pvalue(chi2, dimension, self.dof, allowance, self.scale_variance, spread)

    def log_odds_of_scatter(
        self, chi2: ArrayLike, fitted: ArrayLike, added: ArrayLike, spread: ArrayLike
    ) -> NDArray[np.float64]:
        """Return the log-odds for a further covariance of this trace, and this one of its square, from a chi^2.

        They are those of chi^2 after ``fitted`` columns have been fitted, whose distributions with the covariance and
        without it are those of :meth:`residual_test`, without a scale, of which :meth:`log_likelihood` knows nothing.
        """
        q = np.maximum(self.dimension - np.asarray(fitted, dtype=float), 1.0)
        d2 = self.dof - q + 1.0
        f = d2 / q * np.asarray(chi2) / self.dof
        return f_log_density(f, q, d2, added, spread) - f_log_density(f, q, d2)

    def nested_test(
        self,
        delta_chi2: ArrayLike,
        chi2: ArrayLike,
        columns: ArrayLike,
        fitted: ArrayLike = 0,
        tolerated: "Tolerated | None" = None,
    ) -> NDArray[np.float64]:
        """Return the p-value of ``columns`` further templates beside ``fitted`` ones; see :func:`nested_pvalue`."""
        return nested_pvalue(delta_chi2, chi2, columns, self.dimension - np.asarray(fitted), self.dof, tolerated)

    def delta_chi2(self, x: NDArray[np.float64], t: NDArray[np.float64]) -> float:
        """Return the fall of chi^2 if the templates ``t``, shape (p_raw, K), are fitted to ``x``."""
        along = orthonormal(self.whiten_templates(t))[0].T @ self.whiten(x)
        return float(along @ along)

    def fit(self, x: NDArray[np.float64], t: NDArray[np.float64]) -> Fit:
        """Fit templates ``t``, shape (p_raw, K), to data ``x``, shape (p_raw,), by generalised least squares.

        Notes
        -----
        With H = n t'S^-1 t/(1 + 1/N), chi^2 of the residual and q = p - K, (estimate - truth)/sqrt((n + chi^2)
        (H^-1)_kk/(n - q)) follows Student's t with n - q degrees of freedom (Rao, Biometrika 46, 49, 1959); the
        covariance is its variance, (n + chi^2)/(n - q - 2) H^-1. Pulls of unit width:
        tests/statistical/test_diagnose_statistics.py.
        """
        y = self.whiten(x)
        basis, back = orthonormal(self.whiten_templates(t))
        along = basis.T @ y
        total, n, rank = float(y @ y), self.dof, basis.shape[1]
        delta_chi2 = float(along @ along)
        chi2 = max(total - delta_chi2, 0.0)
        q = self.dimension - rank
        return Fit(
            amplitudes=back @ along,
            covariance=(n + chi2) / (n - q - 2) * back @ back.T,
            dof=n - q,
            delta_chi2=delta_chi2,
            nested_pvalue=float(self.nested_test(delta_chi2, total, rank)),
            chi2=chi2,
            dimension=q,
            pvalue=float(self.residual_test(chi2, rank)),
        )

    def log_likelihood(self, chi2: ArrayLike) -> NDArray[np.float64]:
        """Return the log-likelihood of chi^2, up to a constant.

        Notes
        -----
        -(n - p + 2)/2 log(1 + chi^2/n): a multivariate Student t, the covariance marginalised under the prior whose
        credible intervals match the frequentist ones (Percival et al., MNRAS 510, 3207, 2022). It is Gaussian for
        infinitely many simulations.
        """
        return self.log_jacobian - 0.5 * (self.dof - self.dimension + 2.0) * np.log1p(np.asarray(chi2) / self.dof)

    def curvature(self, chi2: ArrayLike) -> NDArray[np.float64]:
        """Return -2 d log L/d chi^2 of :meth:`log_likelihood`; 1 for infinitely many simulations."""
        return (self.dof - self.dimension + 2.0) / (self.dof + np.asarray(chi2))

    def expected_snr(self, change: NDArray[np.float64]) -> float:
        """Return sqrt(d'C^-1 d) of a change d of the mean, shape (p_raw,): its signal-to-noise ratio."""
        return float(np.sqrt(self.hartlap_factor) * np.linalg.norm(self.whiten_templates(change[:, None])))

    def shift(self, mean: NDArray[np.float64]) -> "SimulatedGaussian":
        """Return the same covariance about another mean, shape (p_raw,)."""
        return replace(self, mean=mean)

    def held_out(self, simulations: Matrix) -> tuple[Vector, int]:
        """Return chi^2 of every simulation, shape (N, p_raw), against all others, shape (N,), and its dof n.

        With a shrunk covariance the others are those of other folds. Against explicit refits:
        tests/unit/test_diagnosis_report.py.
        """
        if self.folds:
            square = np.empty(len(simulations))
            for number, fold in enumerate(self.folds):
                square[number :: len(self.folds)] = np.sum(fold.white**2, axis=1)
            return square, self.dof
        return leave_one_out((simulations - simulations.mean(axis=0)) @ self.whitening.T), self.dof - 1

    def with_extra_covariance(self, *draws: NDArray[np.float64]) -> "SimulatedGaussian":
        """Add independent Gaussian covariances, each known from a few draws.

        Each is given by deviations d with R = d @ d.T, shape (p_raw, n_draws): draws less their mean over
        sqrt(n_draws - 1).

        Notes
        -----
        White coordinates are multiplied by (1 + R)^(-1/2), so that all tests keep their form, and are exact if R is. By
        how much the errors of R scatter chi^2 adds to ``scale_variance``: :mod:`mcsim.stats.few_draws`.
        """
        wide = self
        for deviations in draws:
            covariance, error = covariance_of_draws(np.sqrt(self.hartlap_factor) * wide.whiten_templates(deviations))
            values, vectors = np.linalg.eigh(np.eye(self.dimension) + covariance)
            wide = replace(
                wide,
                whitening=(vectors / np.sqrt(values)) @ vectors.T @ wide.whitening,
                log_jacobian=wide.log_jacobian - 0.5 * float(np.sum(np.log(values))),
                scale_variance=wide.scale_variance + error,
            )
        return wide


def held_out_pvalues(simulations: Matrix, null: SimulatedGaussian) -> Vector:
    """Return the p-value of every simulation, shape (N, p_raw), against all others, shape (N,): uniform."""
    chi2, n = null.held_out(simulations)
    return residual_pvalue(chi2, null.dimension, n, scale=null.scale_variance)


def residual_pvalue(
    chi2: ArrayLike,
    dimension: ArrayLike,
    n: int,
    allowance: ArrayLike = 0.0,
    scale: float = 0.0,
    spread: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return the probability of a larger chi^2 of the residual after K columns have been fitted, or of the data.

    ``dimension`` is q = p - K, ``n`` the number of simulations less one, ``allowance`` the squared signal-to-noise
    ratio of an error of the model that is tolerated, or the trace of a covariance that effects add, ``spread`` the
    trace of its square, and ``scale`` the variance of a factor of mean one that scales the covariance of each
    realization.

    Notes
    -----
    (n - q + 1)/q chi^2/n ~ F(q, n - q + 1) (Hotelling, Ann. Math. Stat. 2, 360, 1931). For an error of the model and a
    scale see :func:`mcsim.stats.elliptical.f_tail`: exact without both.
    """
    q = np.asarray(dimension, dtype=float)
    f = (n - q + 1.0) / np.maximum(q, 1.0) * np.asarray(chi2) / n
    return np.where(q > 0.0, f_tail(f, np.maximum(q, 1.0), n - q + 1.0, allowance, scale, spread), 1.0)


class Tolerated(NamedTuple):
    """Say what a test of further templates has to tolerate.

    ``allowance`` is the squared signal-to-noise ratio of an error of the model, ``variance`` that of the data along the
    templates, with effects that act, over what it is without, and ``dof`` the degrees of freedom from which this is
    known.
    """

    allowance: ArrayLike = 0.0
    variance: ArrayLike = 1.0
    dof: ArrayLike = np.inf


def nested_pvalue(
    delta_chi2: ArrayLike,
    chi2: ArrayLike,
    columns: ArrayLike,
    dimension: ArrayLike,
    n: int,
    tolerated: Tolerated | None = None,
) -> NDArray[np.float64]:
    """Return the probability that templates absent from the data lower chi^2 by at least this much.

    chi^2 falls by ``delta_chi2`` from ``chi2`` when K further templates, ``columns``, are fitted; the probability is 1
    for none. ``dimension`` counts the degrees of freedom before: p, less the templates that have been fitted already.
    ``n`` is that of :func:`residual_pvalue`.

    Notes
    -----
    (n - p + 1)/K delta/(n + chi^2 - delta) ~ F(K, n - p + 1): the residual acts as covariates (Rao, Biometrika 46, 49,
    1959). Uniform: tests/statistical/test_diagnose_statistics.py. A ``variance`` divides F; one that is estimated adds
    its relative error to that of the covariance: the reciprocals of the degrees of freedom add (Satterthwaite,
    Biometrics Bulletin 2, 110, 1946).
    """
    known = tolerated or Tolerated()
    K, T = np.asarray(columns, dtype=float), np.asarray(delta_chi2)
    d2 = n - np.asarray(dimension, dtype=float) + 1.0
    f = d2 / np.maximum(K, 1.0) * T / (n + np.maximum(np.asarray(chi2) - T, 0.0)) / known.variance
    d2 = 1.0 / (1.0 / d2 + 1.0 / np.asarray(known.dof, dtype=float))
    return np.where(K > 0.0, f_tail(f, np.maximum(K, 1.0), d2, known.allowance), 1.0)


def orthonormal(white: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return an orthonormal basis (p, r) of the columns (p, K), and the matrix (K, r) from it to amplitudes."""
    size = np.linalg.norm(white, axis=0)
    inverse = divided(1.0, size)
    if len(size) == 1:  # most effects: no decomposition is needed
        return (white * inverse)[:, size > 0.0], inverse[:, None][:, size > 0.0]
    left, singular, right = np.linalg.svd(white * inverse, full_matrices=False)
    kept = singular > COLLINEAR
    return left[:, kept], inverse[:, None] * right[kept].T / singular[kept]
