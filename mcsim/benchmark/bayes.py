"""Classify data vectors in the best possible way: with the prior of a challenge and the likelihood of the data."""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mcsim.benchmark.case import Answer, Identity
from mcsim.benchmark.sampler import CaseSampler
from mcsim.sphere import rng
from mcsim.stats.detection import posterior

Vector = NDArray[np.float64]

DRAWS = 256
NEGLIGIBLE = 15.0
"""Pairs whose best fit is less likely than the best pair's by more than this, in the logarithm, are left out."""


@dataclass(frozen=True, eq=False)
class BayesClassifier:
    """Posterior probability of no effect, of each effect, and of each pair of effects that a sampler can draw.

    Notes
    -----
    One effect: :func:`mcsim.stats.detection.posterior`. Two: the integral of likelihood times prior over the
    amplitudes of both, by importance sampling from the Gaussian about their joint best fit with 256 antithetic draws.
    The prior density of K amplitudes with expected S/N s, uniform in log s, is 1/(s^K A_K log(s_max/s_min)), A_K the
    area of the unit sphere. Directions are taken to be isotropic, also where parameters reach only some. Effects that
    were left out, or that no library has, are no hypotheses. Checked by brute force: tests/unit/test_challenge.py.
    """

    sampler: CaseSampler

    def probabilities(self, x: Vector) -> dict[Answer, float]:
        """Return the posterior of sets of effects, shape (p_raw,) to a dict without those below 1e-13 of the best."""
        y, prior = self.sampler.library.null.whiten(x), self.sampler.prior
        logs: dict[Answer, float] = {}

        def add(answer: Answer, value: float) -> None:
            logs[answer] = float(np.logaddexp(logs.get(answer, -np.inf), value))

        total = float(y @ y)
        none = float(self.sampler.library.null.log_likelihood(total))
        if prior.none > 0.0:
            add(frozenset(), none + np.log(prior.none))
        if prior.one > 0.0:
            for identity, value in zip(self._identities, self._singles(x, y), strict=True):
                if np.isfinite(value):
                    add(frozenset([identity]), none + value + np.log(prior.one))
        if prior.two > 0.0:
            for (i, j), value in self._pairs(y, total):
                add(frozenset([self._identities[i], self._identities[j]]), value + np.log(prior.two))
        top = max(logs.values())
        scale = sum(np.exp(value - top) for value in logs.values())
        return {answer: float(np.exp(value - top) / scale) for answer, value in logs.items() if value > top - 30.0}

    def best(self, x: Vector) -> tuple[Answer, float]:
        """Return the most probable set of effects, and its probability."""
        probabilities = self.probabilities(x)
        answer = max(probabilities, key=lambda one: probabilities[one])
        return answer, probabilities[answer]

    @cached_property
    def _identities(self) -> list[Identity]:
        return self.sampler.library.identities

    @cached_property
    def _weights(self) -> Vector:
        return self.sampler.weights()

    @cached_property
    def _ends(self) -> Vector:
        """Smallest and largest whitened norm of an effect."""
        prior = self.sampler.prior
        return np.array([prior.weakest, prior.strongest]) / np.sqrt(self.sampler.library.null.hartlap_factor)

    def _singles(self, x: Vector, y: Vector) -> Vector:
        """Return the log marginal likelihood of each candidate relative to no effect, prior weight included."""
        library, groups = self.sampler.library, self.sampler.library.groups
        # Where an effect is strong, the probability of none would underflow: its scale is free.
        boost = min(0.5 * float(np.max(groups.delta_chi2(y), initial=0.0)), 600.0)
        edges = np.geomspace(self._ends[0], self._ends[1], 61)
        scale = np.concatenate([[np.exp(boost)], self._weights])
        found = posterior(library.null, x, groups, np.sqrt(edges[1:] * edges[:-1]), scale)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(found[1:]) - np.log(found[0]) + boost)

    @cached_property
    def _pair_list(self) -> list[tuple[int, int]]:
        possible = np.flatnonzero((self.sampler.library.groups.sizes > 0) & (self._weights > 0.0))
        return [(i, j) for i, j in combinations(map(int, possible), 2) if self._identities[i] != self._identities[j]]

    @cached_property
    def _normals(self) -> Vector:
        columns = 2 * int(self.sampler.library.groups.sizes.max())
        half = rng.generator(0, 0, "challenge/bayes").standard_normal((DRAWS // 2, columns))
        return np.concatenate([half, -half])

    @cached_property
    def _distinct(self) -> float:
        """Probability that two draws have different identities; others are repeated."""
        found: dict[Identity, float] = {}
        for identity, weight in zip(self._identities, self._weights, strict=True):
            found[identity] = found.get(identity, 0.0) + float(weight)
        return max(1.0 - sum(value**2 for value in found.values()), 1e-300)

    def _pairs(self, y: Vector, total: float) -> list[tuple[tuple[int, int], float]]:
        """Return pairs of candidates with their log marginal likelihood, prior weight included."""
        groups = self.sampler.library.groups
        along, gram, start = groups.basis.T @ y, groups.basis.T @ groups.basis, groups.start
        fits = []
        for i, j in self._pair_list:
            columns = np.r_[start[i] : start[i + 1], start[j] : start[j + 1]]
            matrix = gram[np.ix_(columns, columns)] + 1e-9 * np.eye(len(columns))
            theta = np.linalg.solve(matrix, along[columns])
            fits.append((i, j, matrix, theta, max(total - float(along[columns] @ theta), 0.0)))
        if not fits:
            return []
        likelihoods = self.sampler.library.null.log_likelihood(np.array([fit[4] for fit in fits]))
        found = []
        for (i, j, matrix, theta, chi2), likelihood in zip(fits, likelihoods, strict=True):
            if likelihood > likelihoods.max() - NEGLIGIBLE:
                weight = 2.0 * self._weights[i] * self._weights[j] / self._distinct
                value = float(likelihood) + self._log_volume(matrix, theta, chi2, int(groups.sizes[i])) + np.log(weight)
                if np.isfinite(value):
                    found.append(((i, j), value))
        return found

    def _log_volume(self, matrix: Vector, theta: Vector, chi2: float, first: int) -> float:
        """Return the log of the integral of likelihood over its maximum times the prior of both amplitudes."""
        null, K = self.sampler.library.null, len(theta)
        root = np.linalg.cholesky(matrix * (null.dof - null.dimension + 2.0) / (null.dof + chi2))
        drawn = theta + np.linalg.solve(root.T, self._normals[:, :K].T).T
        density = self._log_prior(drawn[:, :first]) + self._log_prior(drawn[:, first:])
        size = 0.5 * K * np.log(2.0 * np.pi) - float(np.sum(np.log(np.diag(root))))
        with np.errstate(divide="ignore"):
            return float(special.logsumexp(density)) - np.log(len(drawn)) + size

    def _log_prior(self, theta: Vector) -> Vector:
        """Return the log prior density of amplitudes in whitened coordinates, shape (draws, K) to (draws,)."""
        K, s, (low, high) = theta.shape[1], np.linalg.norm(theta, axis=1), self._ends
        area = np.log(2.0) + 0.5 * K * np.log(np.pi) - special.gammaln(0.5 * K)
        value = -K * np.log(np.maximum(s, 1e-300)) - area - np.log(np.log(high / low))
        return np.where((s >= low) & (s <= high), value, -np.inf)
