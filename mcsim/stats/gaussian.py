"""Exact tests of a vector against few simulations: everything, a template, several, and what they leave."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from mcsim.errors import InputError

# A direction counts as empty where its scatter, or its part outside a span, is less than this fraction of its size.
COLLINEAR = 1e-6


@dataclass(frozen=True)
class SimulatedGaussian:
    """What simulations without the effect say: a mean, and the coordinates in which their scatter is n times one.

    Attributes
    ----------
    mean
        Shape (p_raw,).
    whitening
        Shape (p, p_raw), p <= p_raw: entries that repeat one another are compressed.
    count
        Number N of simulations; n = N - 1.
    log_volume
        Logarithm of the factor by which :meth:`widened` has shrunk volumes in white coordinates.
    """

    mean: NDArray[np.float64]
    whitening: NDArray[np.float64]
    count: int
    log_jacobian: float = 0.0

    @property
    def dimension(self) -> int:
        """Number p of independent data."""
        return len(self.whitening)

    @property
    def dof(self) -> int:
        """n = N - 1."""
        return self.count - 1

    @property
    def unbiased(self) -> float:
        """(n - p - 1)/n: squares in white coordinates times this have the expectation of those in the true metric."""
        return (self.dof - self.dimension - 1) / self.dof

    def whiten(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """White coordinates of evidence, shape (..., p_raw) to (..., p), less the mean and its own error."""
        return (x - self.mean) @ self.whitening.T / np.sqrt(1.0 + 1.0 / self.count)

    def whiten_templates(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """White coordinates of templates, shape (p_raw, K) to (p, K), on the scale of :meth:`whiten`."""
        return self.whitening @ t / np.sqrt(1.0 + 1.0 / self.count)

    def chi2(self, x: NDArray[np.float64]) -> float:
        """Square of evidence, shape (p_raw,), in white coordinates."""
        y = self.whiten(x)
        return float(y @ y)

    def pvalue(self, x: NDArray[np.float64]) -> float:
        """Probability of a square as large as that of evidence, shape (p_raw,): a test of everything at once."""
        return float(residual_pvalue(self.chi2(x), self.dimension, self.dof))

    def expected_snr(self, change: NDArray[np.float64]) -> float:
        """White length of a change of the evidence, shape (p_raw,), in standard deviations."""
        return float(np.sqrt(self.unbiased) * np.linalg.norm(self.whiten_templates(change[:, None])))

    def with_extra_covariance(self, *scatters: NDArray[np.float64]) -> "SimulatedGaussian":
        """With further Gaussian scatters, each known by draws.

        Parameters
        ----------
        scatters
            Deviations d with R = d @ d.T, shape (p_raw, draws): draws less their mean over sqrt(draws - 1).

        Notes
        -----
        Draws are fewer than entries: R is drawn towards its mean eigenvalue as far as minimises the expected error
        (Ledoit & Wolf, J. Multivariate Anal. 88, 365, 2004). White coordinates are turned by (1 + R)^(-1/2), so that
        all tests stay what they are, and exact where R is.
        """
        wide = self
        for deviations in scatters:
            white = np.sqrt(self.unbiased) * wide.whiten_templates(deviations)
            values, vectors = np.linalg.eigh(np.eye(self.dimension) + _shrunk(white))
            turn = (vectors / np.sqrt(values)) @ vectors.T
            volume = wide.log_jacobian - 0.5 * float(np.sum(np.log(values)))
            wide = replace(wide, whitening=turn @ wide.whitening, log_jacobian=volume)
        return wide


def null(
    simulations: NDArray[np.float64], offset: NDArray[np.float64] | None = None, floor: float = 1e-8
) -> SimulatedGaussian:
    """Null of an ensemble.

    Parameters
    ----------
    simulations
        Shape (N, p_raw).
    offset
        Known shift of the data's mean against that of the simulations, shape (p_raw,).
    floor
        Eigenvalues of the correlation matrix below this fraction of the largest are left out.

    Raises
    ------
    InputError
        An entry that is not finite or does not scatter, or fewer than p + 7 simulations.
    """
    mean = simulations.mean(axis=0)
    centred = simulations - mean
    scale = np.sqrt(np.mean(centred**2, axis=0))
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        wrong = int(np.argmin(np.where(np.isfinite(scale), scale, -1.0)))
        raise InputError(f"evidence {wrong} has no finite scatter in the simulations; leave it out.")
    _, singular, right = np.linalg.svd(centred / scale, full_matrices=False)
    kept = singular**2 > floor * singular[0] ** 2
    count, dimension = len(simulations), int(kept.sum())
    if count < dimension + 7:
        raise InputError(
            f"{count} simulations are too few for {dimension} independent data; give at least {dimension + 7}, better "
            f"{10 * dimension}."
        )
    whitening = np.sqrt(count - 1.0) * right[kept] / singular[kept, None] / scale
    return SimulatedGaussian(mean if offset is None else mean + offset, whitening, count)


def _shrunk(white: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of draws, shape (p, draws), between theirs and a multiple of one."""
    p, draws = white.shape
    found = white @ white.T
    mean = float(np.trace(found)) / p
    distance = float(np.sum(found**2)) - p * mean**2
    # Sum over draws z of |z z' - R|^2, with z = sqrt(draws - 1) times a column.
    sizes = np.sum(white**2, axis=0)
    own = (draws - 1.0) ** 2 * float(np.sum(sizes**2)) - (draws - 2.0) * float(np.sum(found**2))
    weight = min(max(own, 0.0) / draws**2 / distance, 1.0) if distance > 0.0 else 1.0
    return (1.0 - weight) * found + weight * mean * np.eye(p)


def residual_pvalue(chi2: ArrayLike, dimension: ArrayLike, n: int, allowance: ArrayLike = 0.0) -> NDArray[np.float64]:
    """Probability of a white square as large as this in ``dimension`` dimensions.

    Parameters
    ----------
    chi2
        Square of the residual in white coordinates, K columns fitted; of the data themselves for the omnibus test.
    dimension
        q = p - K.
    n
        Simulations less one.
    allowance
        Square of the white length of a model error that is forgiven.

    Notes
    -----
    (n - q + 1)/q chi2/n ~ F(q, n - q + 1) (Hotelling, Ann. Math. Stat. 2, 360, 1931). An error of the model makes it
    noncentral, whatever its direction; its tail is Patnaik's (Biometrika 36, 202, 1949), exact without the error.
    """
    q = np.asarray(dimension, dtype=float)
    f = (n - q + 1.0) / np.maximum(q, 1.0) * np.asarray(chi2) / n
    return np.where(q > 0.0, _tail(f, np.maximum(q, 1.0), n - q + 1.0, allowance), 1.0)


def nested_pvalue(
    delta_chi2: ArrayLike, chi2: ArrayLike, columns: ArrayLike, dimension: ArrayLike, n: int, allowance: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Probability that templates without a part in the data lower chi2 by as much as this.

    Parameters
    ----------
    drop
        Fall of the white square when ``columns`` further templates are fitted.
    chi2
        The square before.
    columns
        Number K of the further templates; the probability is 1 for none.
    dimension
        Dimensions before: p, less the templates that were fitted already.
    n, allowance
        As for :func:`residual_pvalue`.

    Notes
    -----
    (n - p + 1)/K drop/(n + chi2 - drop) ~ F(K, n - p + 1): the residual acts as covariates (Rao, Biometrika 46, 49,
    1959). Uniform: tests/statistical/test_diagnose_statistics.py.
    """
    K, T = np.asarray(columns, dtype=float), np.asarray(delta_chi2)
    d2 = n - np.asarray(dimension, dtype=float) + 1.0
    f = d2 / np.maximum(K, 1.0) * T / (n + np.maximum(np.asarray(chi2) - T, 0.0))
    return np.where(K > 0.0, _tail(f, np.maximum(K, 1.0), d2, allowance), 1.0)


def _tail(f: ArrayLike, d1: ArrayLike, d2: ArrayLike, noncentrality: ArrayLike) -> NDArray[np.float64]:
    d1, extra = np.asarray(d1), np.asarray(noncentrality)
    scale = (d1 + extra) / d1
    return special.fdtrc((d1 + extra) ** 2 / (d1 + 2.0 * extra), d2, np.maximum(f, 0.0) / scale)


@dataclass(frozen=True)
class Fit:
    """Templates fitted to evidence.

    Attributes
    ----------
    amplitudes, covariance
        Shape (K,), (K, K). A combination that the evidence does not contain has amplitude 0 and no variance.
    dof
        Of the Student t that each amplitude, less the truth, over its scale follows; the covariance is that t's.
    drop, score
        Fall of the white square, and the probability of such a fall without the templates.
    chi2, dimension, probability
        White square of what is left, its dimension, and the probability of a larger one.
    """

    amplitudes: NDArray[np.float64]
    covariance: NDArray[np.float64]
    dof: int
    delta_chi2: float
    nested_pvalue: float
    chi2: float
    dimension: int
    pvalue: float

    @property
    def errors(self) -> NDArray[np.float64]:
        """Standard deviations, shape (K,)."""
        return np.sqrt(np.diag(self.covariance))


def fit(null: SimulatedGaussian, x: NDArray[np.float64], t: NDArray[np.float64]) -> Fit:
    """Fit templates with the weight S^-1.

    Parameters
    ----------
    null
        Of the evidence.
    x
        Evidence, shape (p_raw,).
    t
        Templates, shape (p_raw, K), per unit of each amplitude.

    Notes
    -----
    With H = t'S^-1 t n and the residual's square chi2, (theta^ - theta)/sqrt((n + chi2) (H^-1)_kk/(n - q)) is a Student
    t with n - q degrees of freedom; the covariance has its variance, (n + chi2)/(n - q - 2) H^-1. Pulls of unit width:
    tests/statistical/test_diagnose_statistics.py.
    """
    y = null.whiten(x)
    basis, back = orthonormal(null.whiten_templates(t))
    along = basis.T @ y
    total, n = float(y @ y), null.dof
    delta_chi2 = float(along @ along)
    chi2 = max(total - delta_chi2, 0.0)
    q = null.dimension - basis.shape[1]
    return Fit(
        amplitudes=back @ along,
        covariance=(n + chi2) / (n - q - 2) * back @ back.T,
        dof=n - q,
        delta_chi2=delta_chi2,
        nested_pvalue=float(nested_pvalue(delta_chi2, total, basis.shape[1], null.dimension, n)),
        chi2=chi2,
        dimension=q,
        pvalue=float(residual_pvalue(chi2, q, n)),
    )


def orthonormal(white: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orthonormal basis (p, r) of the columns (p, K), and the matrix (K, r) from its coordinates to amplitudes."""
    size = np.linalg.norm(white, axis=0)
    inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    left, singular, right = np.linalg.svd(white * inverse, full_matrices=False)
    kept = singular > COLLINEAR
    return left[:, kept], inverse[:, None] * right[kept].T / singular[kept]


@dataclass(frozen=True)
class WhitenedTemplates:
    """White orthonormal bases of groups of templates, side by side.

    Attributes
    ----------
    basis
        Shape (p, r_1 + r_2 + ...).
    start
        First column of each group, and the end of the last.
    back
        Matrix of each group from basis coordinates to amplitudes, shape (K_c, r_c).
    """

    basis: NDArray[np.float64]
    start: NDArray[np.int64]
    back: tuple[NDArray[np.float64], ...]

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Rank r_c of each group; 0 where the evidence does not hear it."""
        return np.diff(self.start)

    def delta_chi2(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fall of the white square when each group is fitted alone, shape (..., p) to (..., groups)."""
        cumulative = np.cumsum((y @ self.basis) ** 2, axis=-1)
        padded = np.concatenate([np.zeros((*cumulative.shape[:-1], 1)), cumulative], axis=-1)
        return np.diff(padded[..., self.start], axis=-1)


def whitened_templates(
    null: SimulatedGaussian, t: NDArray[np.float64], groups: Sequence[Sequence[int]]
) -> WhitenedTemplates:
    """Bases of groups of columns of the templates ``t``, shape (p_raw, K)."""
    white = null.whiten_templates(t)
    pairs = [orthonormal(white[:, list(group)]) for group in groups]
    start = np.cumsum([0] + [basis.shape[1] for basis, _ in pairs])
    return WhitenedTemplates(
        np.concatenate([basis for basis, _ in pairs], axis=1), start, tuple(back for _, back in pairs)
    )
