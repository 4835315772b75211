"""Fit and test all subsets of the candidates."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mcsim.diagnosis.candidate import Candidate
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.stats.detection import log_evidence
from mcsim.stats.gaussian import COLLINEAR, SimulatedGaussian, WhitenedTemplates
from mcsim.stats.look_elsewhere import Calibration

# Relative to columns of norm one: keeps the normal equations of degenerate effects solvable, far below any noise.
RIDGE = 1e-9


@dataclass(frozen=True)
class Solved:
    """Hold the fits of M subsets, shape (M,) each."""

    chi2: NDArray[np.float64]
    pvalue: NDArray[np.float64]
    evidence: NDArray[np.float64]
    allowance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Subsets:
    """Solve the normal equations of subsets of the candidates, in white orthonormal coordinates.

    Attributes
    ----------
    null, y
        Distribution of the data vector, with the scatter of the candidates ``scattered``, and the data in its white
        coordinates, shape (p,).
    groups, candidates, calibration
        Bases of the C candidates, the candidates, and their calibration.
    settings
        Of the diagnosis.
    scattered
        Candidates whose scatter is in ``null``: subsets contain these, and no other one whose scatter is known.
    """

    null: SimulatedGaussian
    y: NDArray[np.float64]
    groups: WhitenedTemplates
    candidates: Sequence[Candidate]
    calibration: Calibration
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    scattered: tuple[int, ...] = ()

    @cached_property
    def total(self) -> float:
        """Return chi^2 of the data."""
        return float(self.y @ self.y)

    @cached_property
    def unknown(self) -> float:
        """Return the log-evidence of an unknown effect of the same prior S/N in an isotropic direction."""
        spread = np.array(self.settings.prior_snr) / np.sqrt(self.null.dimension)
        return float(log_evidence(self.null, self.total, self.total, self.null.dimension, tuple(spread)))

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """Return the first column of each candidate."""
        return self.groups.start

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Return the rank of each candidate."""
        return self.groups.sizes

    @cached_property
    def gram(self) -> NDArray[np.float64]:
        """Return the matrix of the normal equations."""
        return np.asarray(self.groups.basis.T @ self.groups.basis)

    @cached_property
    def score(self) -> NDArray[np.float64]:
        """Return their right-hand side."""
        return np.asarray(self.groups.basis.T @ self.y)

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Return the relative error of each candidate's templates."""
        default = self.settings.template_error
        return np.array([default if c.shape_error is None else c.shape_error for c in self.candidates])

    @cached_property
    def identity(self) -> NDArray[np.int64]:
        """Return a number for each candidate; those that exclude each other share it."""
        names = [candidate.identity for candidate in self.candidates]
        return np.array([names.index(name) for name in names])

    @cached_property
    def log_prior(self) -> NDArray[np.float64]:
        """Return the logarithm of each candidate's share of the prior weight."""
        prior = np.array([candidate.prior for candidate in self.candidates])
        return np.asarray(np.log(prior / prior.sum()))

    def rows(self, size: int, accepted: Sequence[tuple[int, ...]]) -> Iterator[NDArray[np.int64]]:
        """Yield subsets without exclusive members or an accepted part, shape (M, size), all of the same ranks."""
        present = np.flatnonzero(self.sizes > 0)
        present = present[np.argsort(self.sizes[present], kind="stable")]
        rows = np.array(list(combinations(present, size)), dtype=np.int64).reshape(-1, size)
        kept = np.ones(len(rows), dtype=bool)
        for i, j in combinations(range(size), 2):
            kept &= self.identity[rows[:, i]] != self.identity[rows[:, j]]
        for member, candidate in enumerate(self.candidates):
            if candidate.scatter is not None:
                kept &= np.any(rows == member, axis=1) == (member in self.scattered)
        for part in accepted:
            kept &= ~np.all([np.any(rows == member, axis=1) for member in part], axis=0)
        rows = rows[kept]
        pattern, which = np.unique(self.sizes[rows], axis=0, return_inverse=True)
        for index, ranks in enumerate(pattern):
            if ranks.sum() < self.null.dimension:
                yield rows[which.ravel() == index]

    def _columns(self, subsets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the columns of each subset, shape (M, K), and the member to which each belongs, shape (K,)."""
        ranks = self.sizes[subsets[0]]
        parts = [self.start[subsets[:, i], None] + np.arange(rank) for i, rank in enumerate(ranks)]
        return np.concatenate(parts, axis=1), np.repeat(np.arange(len(ranks)), ranks)

    def _matrix(self, columns: NDArray[np.int64]) -> NDArray[np.float64]:
        return self.gram[columns[:, :, None], columns[:, None, :]] + RIDGE * np.eye(columns.shape[1])

    def solve(self, subsets: NDArray[np.int64]) -> Solved:
        """Fit subsets, all of the same ranks."""
        columns, place = self._columns(subsets)
        count, size = subsets.shape
        K, null = columns.shape[1], self.null
        score = self.score[columns]
        fitted = np.linalg.solve(self._matrix(columns), score[:, :, None])[:, :, 0]
        delta_chi2 = np.minimum(np.sum(score * fitted, axis=1), self.total)
        part = np.zeros((count, size))
        np.add.at(part.T, place, fitted.T**2)
        allowance = np.sum(self.errors[subsets] ** 2 * np.minimum(part, delta_chi2[:, None]), axis=1)
        prior = special.gammaln(size + 1) + self.log_prior[subsets].sum(axis=1)
        return Solved(
            chi2=self.total - delta_chi2,
            pvalue=null.residual_test(self.total - delta_chi2, K, allowance),
            evidence=log_evidence(null, self.total, delta_chi2, K, self.settings.prior_snr) + prior,
            allowance=allowance,
        )

    def least_needed(self, subsets: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the global p-value of each subset's least significant member beside its others, shape (M,)."""
        if not len(subsets):
            return np.empty(0)
        whole = self.solve(subsets)
        largest = np.zeros(len(subsets))
        for place in range(subsets.shape[1]):
            others = np.delete(subsets, place, axis=1)
            chi2, allowance = np.full(len(subsets), self.total), np.zeros(len(subsets))
            if others.shape[1]:
                without = self.solve(others)
                chi2, allowance = without.chi2, without.allowance
            rank = self.sizes[subsets[:, place]]
            fitted = self.sizes[subsets].sum(axis=1) - rank
            pvalues = self.null.nested_test(chi2 - whole.chi2, chi2, rank, fitted, allowance)
            largest = np.maximum(largest, self.calibration.global_pvalue(pvalues))
        return largest

    def further(
        self, subsets: NDArray[np.int64], chi2: NDArray[np.float64], allowance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the global p-value of the most significant candidate beside each subset, shape (M,)."""
        if not len(subsets):
            return np.empty(0)
        columns, _ = self._columns(subsets)
        count, K = columns.shape
        across = self.gram[columns]
        solved = np.linalg.solve(self._matrix(columns), across)
        left = self.score - np.einsum("mk,mkj->mj", self.score[columns], solved)
        smallest = np.ones(count)
        for rank in np.unique(self.sizes[self.sizes > 0]):
            others = np.flatnonzero(self.sizes == rank)
            index = self.start[others, None] + np.arange(rank)
            block = self.gram[index[:, :, None], index[:, None, :]] - np.einsum(
                "mkci,mkcj->mcij", across[:, :, index], solved[:, :, index]
            )
            values, vectors = np.linalg.eigh(block)
            along = np.einsum("mcij,mci->mcj", vectors, left[:, index])
            kept = values > COLLINEAR
            delta_chi2 = np.sum(np.where(kept, along**2 / np.where(kept, values, 1.0), 0.0), axis=-1)
            ranks = kept.sum(axis=-1)
            pvalues = self.null.nested_test(delta_chi2, chi2[:, None], ranks, K, allowance[:, None])
            exclusive = np.any(self.identity[subsets][:, :, None] == self.identity[others], axis=1)
            smallest = np.minimum(smallest, np.where(exclusive, 1.0, pvalues).min(axis=1))
        return self.calibration.global_pvalue(smallest)
