"""All subsets of the candidates: their fits, their evidence, and whether anything else is significant beside them."""

from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mcsim.stats.detection import log_evidence
from mcsim.stats.gaussian import COLLINEAR, SimulatedGaussian, WhitenedTemplates, nested_pvalue, residual_pvalue
from mcsim.stats.look_elsewhere import Calibration

# Widths of the amplitudes' prior in standard deviations: flat in the logarithm, from what can hardly be seen to what
# outshines everything.
WIDTHS = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0)
# Relative to columns of length one: keeps the normal equations of twins solvable, and is far below any noise.
RIDGE = 1e-9


@dataclass(frozen=True)
class Solved:
    """Fits of many subsets, shape (M,) each."""

    chi2: NDArray[np.float64]
    pvalue: NDArray[np.float64]
    evidence: NDArray[np.float64]
    allowance: NDArray[np.float64]


class Subsets:
    """Normal equations of all candidates, in white orthonormal coordinates, and the tests of subsets of them.

    Parameters
    ----------
    null, y
        Null, and the evidence's white coordinates, shape (p,).
    groups, calibration
        Bases of the C candidates, and their calibration.
    names
        Identity of each: candidates that share it exclude each other.
    prior, errors
        Weight, and relative error of the templates, shape (C,).
    drawing, drawn
        Candidates that scatter the evidence, and those of them whose scatter is the null's: subsets are those that have
        the latter and none of the others.
    """

    def __init__(
        self,
        null: SimulatedGaussian,
        y: NDArray[np.float64],
        groups: WhitenedTemplates,
        names: Sequence[Hashable],
        prior: NDArray[np.float64],
        errors: NDArray[np.float64],
        calibration: Calibration,
        drawing: Collection[int] = (),
        drawn: Collection[int] = (),
    ) -> None:
        self.null, self.calibration = null, calibration
        self.drawing, self.drawn = drawing, drawn
        self.total = float(y @ y)
        self.start, self.sizes, self.errors = groups.start, groups.sizes, errors
        self.gram = groups.basis.T @ groups.basis
        self.score = groups.basis.T @ y
        self.identity = np.array([names.index(name) for name in names])
        self.log_prior = np.log(prior / prior.sum())
        # Something of the same strengths in any direction.
        spread = np.array(WIDTHS) / np.sqrt(null.dimension)
        self.unknown = float(log_evidence(null, self.total, self.total, null.dimension, tuple(spread)))

    def rows(self, size: int, accepted: Sequence[tuple[int, ...]]) -> Iterator[NDArray[np.int64]]:
        """Subsets without rivals or an accepted part, shape (M, size), all of the same ranks."""
        filtered = np.flatnonzero(self.sizes > 0)
        filtered = filtered[np.argsort(self.sizes[filtered], kind="stable")]
        rows = np.array(list(combinations(filtered, size)), dtype=np.int64).reshape(-1, size)
        kept = np.ones(len(rows), dtype=bool)
        for i, j in combinations(range(size), 2):
            kept &= self.identity[rows[:, i]] != self.identity[rows[:, j]]
        for member in self.drawing:
            kept &= np.any(rows == member, axis=1) == (member in self.drawn)
        for part in accepted:
            kept &= ~np.all([np.any(rows == member, axis=1) for member in part], axis=0)
        rows = rows[kept]
        pattern, which = np.unique(self.sizes[rows], axis=0, return_inverse=True)
        for index, ranks in enumerate(pattern):
            if ranks.sum() < self.null.dimension:
                yield rows[which.ravel() == index]

    def _columns(self, subsets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Columns of each subset, shape (M, K), and the place in the subset to which each belongs, shape (K,)."""
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
            pvalue=residual_pvalue(self.total - delta_chi2, null.dimension - K, null.dof, allowance),
            evidence=log_evidence(null, self.total, delta_chi2, K, WIDTHS) + prior,
            allowance=allowance,
        )

    def least_needed(self, subsets: NDArray[np.int64]) -> NDArray[np.float64]:
        """Probability, trials included, of each subset's least significant member beside its others, shape (M,)."""
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
            dimension = self.null.dimension - (self.sizes[subsets].sum(axis=1) - rank)
            scores = nested_pvalue(chi2 - whole.chi2, chi2, rank, dimension, self.null.dof, allowance)
            largest = np.maximum(largest, self.calibration.global_pvalue(scores))
        return largest

    def further(
        self, subsets: NDArray[np.int64], chi2: NDArray[np.float64], allowance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Probability, trials included, of the most significant candidate beside each subset, shape (M,)."""
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
            filtered = values > COLLINEAR
            delta_chi2 = np.sum(np.where(filtered, along**2 / np.where(filtered, values, 1.0), 0.0), axis=-1)
            scores = nested_pvalue(
                delta_chi2,
                chi2[:, None],
                filtered.sum(axis=-1),
                self.null.dimension - K,
                self.null.dof,
                allowance[:, None],
            )
            rivals = np.any(self.identity[subsets][:, :, None] == self.identity[others], axis=1)
            smallest = np.minimum(smallest, np.where(rivals, 1.0, scores).min(axis=1))
        return self.calibration.global_pvalue(smallest)
