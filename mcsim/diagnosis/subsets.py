"""Fit and test subsets of the candidates."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import special

from mcsim.datavector.candidate import Candidate, crossed_by
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.stats.detection import log_evidence
from mcsim.stats.gaussian import COLLINEAR, SimulatedGaussian, Tolerated, WhitenedTemplates
from mcsim.stats.look_elsewhere import Calibration
from mcsim.stats.scattered import Beside
from mcsim.support.arrays import Rows, Vector

# Relative to columns of norm one: keeps the normal equations of degenerate effects solvable, far below any noise.
RIDGE = 1e-9

# Subsets that are solved at once; bounds the memory to some 100 MB.
CHUNK = 1000

EXHAUSTIVE = 2  #: largest number of members, beside those whose scatter is known, of which all subsets are tried
KEPT = 300  #: larger subsets of one size that are tried, the most probable ones


@dataclass(frozen=True)
class Solved:
    """Hold the fits of M subsets, shape (M,) each.

    ``allowance`` is the squared error of their templates, ``parts`` the squared amplitude of each member over that at
    which it was simulated, at most 1, shape (M, size).
    """

    chi2: Vector
    pvalue: Vector
    evidence: Vector
    allowance: Vector
    parts: Vector


@dataclass(frozen=True, eq=False)
class Subsets:
    """Solve the normal equations of subsets of the C candidates, in white orthonormal coordinates."""

    null: SimulatedGaussian  # distribution of the data vector, with the scatter of the candidates ``scattered``
    y: Vector  # the data in its white coordinates, (p,)
    groups: WhitenedTemplates  # bases of the candidates
    candidates: Sequence[Candidate]
    calibration: Calibration
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    # Candidates whose scatter is in ``null``: subsets have these, and no other one whose scatter, alone or beside them,
    # is known.
    scattered: tuple[int, ...] = ()
    variance: Vector | None = None  # of held-out draws of these along each candidate, over what ``null`` says, (C,)

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
    def _gram(self) -> Vector:
        """Return the matrix of the normal equations."""
        return np.asarray(self.groups.basis.T @ self.groups.basis)

    @cached_property
    def _projection(self) -> Vector:
        """Return their right-hand side."""
        return np.asarray(self.groups.basis.T @ self.y)

    @cached_property
    def _errors(self) -> Vector:
        """Return the relative error of each candidate's templates."""
        default = self.settings.template_error
        return np.array([default if c.shape_error is None else c.shape_error for c in self.candidates])

    @cached_property
    def _beside(self) -> Beside:
        """Return how much the candidates that act scatter the data."""
        return Beside.of([candidate.acting for candidate in self.candidates], self.variance)

    @cached_property
    def _identity(self) -> Rows:
        """Return a number of each candidate; those that exclude each other share it."""
        names = [candidate.identity for candidate in self.candidates]
        return np.array([names.index(name) for name in names])

    @cached_property
    def _free(self) -> Rows:
        """Return the candidates whose scatter is not known, alone or beside those that are in all subsets."""
        unknown = np.flatnonzero([candidate.scatter is None for candidate in self.candidates])
        return np.setdiff1d(unknown, crossed_by(self.candidates, self.scattered))

    def rows(self, size: int) -> Iterator[Rows]:
        """Yield all subsets without exclusive members, shape (M, size), all of the same ranks."""
        more = size - len(self.scattered)
        found = [(*self.scattered, *rest) for rest in combinations(self._free.tolist(), more)] if more >= 0 else []
        return self._alike(np.array(found, dtype=np.int64).reshape(-1, size))

    def grown(self, subsets: Iterable[Rows]) -> Iterator[Rows]:
        """Yield the most probable subsets of one more member, which is significant beside the others.

        In a subset whose members are all needed each is significant beside the others: nothing else can be sufficient.
        """
        more = []
        for rows in (part for group in subsets for part in chunks(group)):
            row, new = np.nonzero(self.beside(rows)[:, self._free] <= self.settings.further_level)
            more.append(np.sort(np.column_stack([rows[row], self._free[new]]), axis=1))
        groups = list(self._alike(np.unique(np.concatenate(more), axis=0))) if more else []
        evidence = [np.concatenate([self.solve(part).evidence for part in chunks(group)]) for group in groups]
        every = np.concatenate([np.empty(0), *evidence])
        least = np.partition(every, -KEPT)[-KEPT] if len(every) > KEPT else -np.inf
        for group, own in zip(groups, evidence, strict=True):
            if np.any(own >= least):
                yield group[own >= least]

    def _alike(self, rows: Rows) -> Iterator[Rows]:
        """Yield subsets of possible members in order, all of the same ranks; none of as many columns as elements."""
        kept = np.all(self.groups.sizes[rows] > 0, axis=1)
        for i, j in combinations(range(rows.shape[1]), 2):
            kept &= self._identity[rows[:, i]] != self._identity[rows[:, j]]
        rows = rows[kept]
        few_columns_first = np.lexsort((rows, self.groups.sizes[rows]), axis=1)
        rows = np.take_along_axis(rows, few_columns_first, axis=1)
        pattern, which = np.unique(self.groups.sizes[rows], axis=0, return_inverse=True)
        for index, ranks in enumerate(pattern):
            if ranks.sum() < self.null.dimension:
                yield rows[which.ravel() == index]

    def _columns(self, subsets: Rows) -> tuple[Rows, Rows]:
        """Return the columns of each subset, shape (M, K), and the member to which each belongs, shape (K,)."""
        ranks = self.groups.sizes[subsets[0]]
        parts = [self.groups.start[subsets[:, i], None] + np.arange(rank) for i, rank in enumerate(ranks)]
        return np.concatenate([subsets[:, :0], *parts], axis=1), np.repeat(np.arange(len(ranks)), ranks)

    def _matrix(self, columns: Rows) -> Vector:
        return self._gram[columns[:, :, None], columns[:, None, :]] + RIDGE * np.eye(columns.shape[1])

    def solve(self, subsets: Rows) -> Solved:
        """Fit subsets, all of the same ranks."""
        columns, place = self._columns(subsets)
        count, size = subsets.shape
        K, null = columns.shape[1], self.null
        score = self._projection[columns]
        fitted = np.linalg.solve(self._matrix(columns), score[:, :, None])[:, :, 0]
        delta_chi2 = np.minimum(np.sum(score * fitted, axis=1), self.total)
        part = np.zeros((count, size))
        np.add.at(part.T, place, fitted.T**2)
        part = np.minimum(part, delta_chi2[:, None])
        allowance = np.sum(self._errors[subsets] ** 2 * part, axis=1)
        parts = part / self._beside.size[subsets]
        scatter = np.sum(self._beside.chi2[subsets] * parts, axis=1)
        spread = np.sum(self._beside.spread[subsets] * parts**2, axis=1)
        left = self.total - delta_chi2
        evidence = log_evidence(null, self.total, delta_chi2, K, self.settings.prior_snr)
        wide = scatter > 0.0
        evidence[wide] += null.log_odds_of_scatter(left[wide], K, scatter[wide], spread[wide])
        prior = special.gammaln(size + 1) - size * np.log(len(self.candidates))
        return Solved(
            chi2=left,
            pvalue=null.residual_test(left, K, allowance + scatter, spread),
            evidence=evidence + prior,
            allowance=allowance,
            parts=np.minimum(parts, 1.0),
        )

    def least_needed(self, subsets: Rows) -> Vector:
        """Return the global p-value of each subset's least significant member beside its others, shape (M,)."""
        if not len(subsets):
            return np.empty(0)
        whole = self.solve(subsets)
        largest = np.zeros(len(subsets))
        for place in range(subsets.shape[1]):
            others = np.delete(subsets, place, axis=1)
            rank = self.groups.sizes[subsets[:, place]]
            chi2, tolerated = np.full(len(subsets), self.total), Tolerated()
            if others.shape[1]:
                without = self.solve(others)
                own = self._beside.tolerated(without.allowance, others, without.parts, subsets[:, place, None])
                chi2, tolerated = without.chi2, Tolerated(*(np.asarray(one)[:, 0] for one in own))
            fitted = self.groups.sizes[subsets].sum(axis=1) - rank
            pvalues = self.null.nested_test(chi2 - whole.chi2, chi2, rank, fitted, tolerated)
            largest = np.maximum(largest, self.calibration.global_pvalue(pvalues))
        return largest

    def beside(self, subsets: Rows, lost: Vector | float = 0.0) -> Vector:
        """Return the global p-value of each candidate beside each subset, shape (M, C); 1 if members exclude it.

        ``lost``, shape (C,), is by how much less chi^2 falls than by the free fit of a candidate.
        """
        solved = self.solve(subsets)
        columns, _ = self._columns(subsets)
        count, K = columns.shape
        across = self._gram[columns]
        weights = np.linalg.solve(self._matrix(columns), across)
        left = self._projection - np.einsum("mk,mkj->mj", self._projection[columns], weights)
        found = np.ones((count, len(self.candidates)))
        for rank in np.unique(self.groups.sizes[self.groups.sizes > 0]):
            others = np.flatnonzero(self.groups.sizes == rank)
            index = self.groups.start[others, None] + np.arange(rank)
            block = self._gram[index[:, :, None], index[:, None, :]] - np.einsum(
                "mkci,mkcj->mcij", across[:, :, index], weights[:, :, index]
            )
            values, vectors = np.linalg.eigh(block)
            along = np.einsum("mcij,mci->mcj", vectors, left[:, index])
            kept = values > COLLINEAR
            free = np.sum(np.where(kept, along**2 / np.where(kept, values, 1.0), 0.0), axis=-1)
            delta_chi2 = np.maximum(free - np.broadcast_to(lost, len(self.candidates))[others], 0.0)
            added = kept.sum(axis=-1)
            tolerated = self._beside.tolerated(solved.allowance, subsets, solved.parts, others[None, :])
            pvalues = self.null.nested_test(delta_chi2, solved.chi2[:, None], added, K, tolerated)
            exclusive = np.any(self._identity[subsets][:, :, None] == self._identity[others], axis=1)
            found[:, others] = np.where(exclusive, 1.0, pvalues)
        return self.calibration.global_pvalue(found)


def chunks(rows: Rows) -> Iterator[Rows]:
    """Yield parts that are solved at once."""
    return (rows[first : first + CHUNK] for first in range(0, len(rows), CHUNK))
