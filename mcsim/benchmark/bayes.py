"""The best that any tool could do: the classifier that knows a challenge's prior and the likelihood of the evidence."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mcsim.benchmark.prior import Prior
from mcsim.benchmark.truth import Identity
from mcsim.sphere import rng
from mcsim.stats.detection import log_likelihood, posterior
from mcsim.stats.gaussian import SimulatedGaussian, WhitenedTemplates

Vector = NDArray[np.float64]
Answer = frozenset[Identity]

DRAWS = 256
LOST = 15.0
"""Pairs whose best fit is less likely than the best pair's by more than this, in the logarithm, are passed over."""


@dataclass(frozen=True, eq=False)
class Bayes:
    """Posterior of none, of every effect, and of every pair.

    Attributes
    ----------
    null, groups
        Of the evidence, and of the proposals.
    identities, weights
        Of every proposal, and its prior probability as the only effect.
    prior
        Of the challenge; what is left out or invented has no likelihood and is no hypothesis.

    Notes
    -----
    One effect: :func:`mcsim.stats.detection.posterior`. Two: the integral of likelihood times prior over the
    amplitudes of both by importance sampling from the Gaussian about their joint best fit, 256 antithetic draws; the
    prior density of K amplitudes with strength s, uniform in log s, is 1/(s^K A_K log(s_max/s_min)), A_K the area of
    the unit sphere. Directions are isotropic in it, also where parameters reach only some.
    """

    null: SimulatedGaussian
    groups: WhitenedTemplates
    identities: Sequence[Identity]
    weights: Vector
    prior: Prior

    def probabilities(self, x: Vector) -> dict[Answer, float]:
        """Posterior of sets of effects, those without any chance left out; the empty set is none."""
        y = self.null.whiten(x)
        logs: dict[Answer, float] = {}

        def add(answer: Answer, value: float) -> None:
            logs[answer] = float(np.logaddexp(logs.get(answer, -np.inf), value))

        total = float(y @ y)
        none = float(log_likelihood(self.null, total))
        if self.prior.none > 0.0:
            add(frozenset(), none + np.log(self.prior.none))
        if self.prior.one > 0.0:
            for index, value in enumerate(self._singles(x, y)):
                if np.isfinite(value):
                    add(frozenset([self.identities[int(index)]]), none + value + np.log(self.prior.one))
        if self.prior.two > 0.0:
            for (i, j), value in self._pairs(y, total):
                add(frozenset([self.identities[i], self.identities[j]]), value + np.log(self.prior.two))
        top = max(logs.values())
        scale = sum(np.exp(value - top) for value in logs.values())
        return {answer: float(np.exp(value - top) / scale) for answer, value in logs.items() if value > top - 30.0}

    @cached_property
    def _strengths(self) -> tuple[Vector, Vector]:
        edges = np.exp(np.linspace(np.log(self.prior.weakest), np.log(self.prior.strongest), 61))
        return np.sqrt(edges[1:] * edges[:-1]) / np.sqrt(self.null.unbiased), np.ones(60)

    def _singles(self, x: Vector, y: Vector) -> Vector:
        """Logarithm of evidence over that of none, prior weight included."""
        # Where an effect is strong, none would underflow: its scale is free.
        boost = min(0.5 * float(np.max(self.groups.delta_chi2(y), initial=0.0)), 600.0)
        strengths, shares = self._strengths
        scale = np.concatenate([[np.exp(boost)], self.weights])
        found = posterior(self.null, x, self.groups, strengths, scale, shares)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(found[1:]) - np.log(found[0]) + boost)

    @cached_property
    def _pair_list(self) -> list[tuple[int, int]]:
        filtered = np.flatnonzero((self.groups.sizes > 0) & (self.weights > 0.0))
        return [(i, j) for i, j in combinations(map(int, filtered), 2) if self.identities[i] != self.identities[j]]

    @cached_property
    def _normals(self) -> Vector:
        half = rng.generator(0, 0, "challenge/bayes").standard_normal((DRAWS // 2, 2 * int(self.groups.sizes.max())))
        return np.concatenate([half, -half])

    @cached_property
    def _same(self) -> float:
        """Chance that two draws have one identity and are repeated."""
        found: dict[Identity, float] = {}
        for identity, weight in zip(self.identities, self.weights, strict=True):
            found[identity] = found.get(identity, 0.0) + float(weight)
        return sum(value**2 for value in found.values())

    def _pairs(self, y: Vector, total: float) -> list[tuple[tuple[int, int], float]]:
        score, gram, start = self.groups.basis.T @ y, self.groups.basis.T @ self.groups.basis, self.groups.start
        fits = []
        for i, j in self._pair_list:
            columns = np.r_[start[i] : start[i + 1], start[j] : start[j + 1]]
            matrix = gram[np.ix_(columns, columns)] + 1e-9 * np.eye(len(columns))
            theta = np.linalg.solve(matrix, score[columns])
            fits.append((i, j, matrix, theta, max(total - float(score[columns] @ theta), 0.0)))
        if not fits:
            return []
        likelihoods = log_likelihood(self.null, np.array([fit[4] for fit in fits]))
        best = float(likelihoods.max())
        found = []
        for (i, j, matrix, theta, chi2), likelihood in zip(fits, likelihoods, strict=True):
            if likelihood > best - LOST:
                weight = 2.0 * self.weights[i] * self.weights[j] / max(1.0 - self._same, 1e-300)
                value = (
                    float(likelihood) + self._volume(matrix, theta, chi2, int(self.groups.sizes[i])) + np.log(weight)
                )
                if np.isfinite(value):
                    found.append(((i, j), value))
        return found

    def _volume(self, matrix: Vector, theta: Vector, chi2: float, first: int) -> float:
        """Logarithm of the integral of likelihood over its maximum times the prior of both amplitudes."""
        n, p = self.null.dof, self.null.dimension
        root = np.linalg.cholesky(matrix * (n - p + 2.0) / (n + chi2))
        K = len(theta)
        drawn = theta + np.linalg.solve(root.T, self._normals[:, :K].T).T
        density = np.zeros(len(drawn))
        for part in (drawn[:, :first], drawn[:, first:]):
            density += self._density(part)
        size = 0.5 * K * np.log(2.0 * np.pi) - float(np.sum(np.log(np.diag(root))))
        with np.errstate(divide="ignore"):
            return float(special.logsumexp(density)) - np.log(len(drawn)) + size

    def _density(self, theta: Vector) -> Vector:
        K = theta.shape[1]
        s = np.linalg.norm(theta, axis=1)
        ends = np.array([self.prior.weakest, self.prior.strongest]) / np.sqrt(self.null.unbiased)
        area = np.log(2.0) + 0.5 * K * np.log(np.pi) - special.gammaln(0.5 * K)
        inside = (s >= ends[0]) & (s <= ends[1])
        value = -K * np.log(np.maximum(s, 1e-300)) - area - np.log(np.log(ends[1] / ends[0]))
        return np.where(inside, value, -np.inf)
