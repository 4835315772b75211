"""Classify data vectors in the best possible way: with the prior of a challenge and the likelihood of the data."""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from scipy import special

from mcsim.benchmark.case import IN_LIBRARY, Answer, Drawn
from mcsim.benchmark.models import EffectsLibrary
from mcsim.benchmark.sampler import CaseSampler
from mcsim.sphere import rng
from mcsim.stats.detection import log_marginals, pair_log_marginals
from mcsim.support.arrays import Vector


@dataclass(frozen=True, eq=False)
class BayesClassifier:
    """Posterior probability of no effect, of each effect, and of each pair of effects that a sampler can draw.

    Notes
    -----
    One effect: :func:`mcsim.stats.detection.log_marginals`. Two: :func:`mcsim.stats.detection.pair_log_marginals`, with
    256 antithetic draws. Directions are taken to be isotropic, also where parameters reach only some. Effects that were
    left out, or that no library has, are no hypotheses. Checked by brute force: tests/unit/test_challenge.py.
    """

    sampler: CaseSampler

    def probabilities(self, x: Vector) -> dict[Answer, float]:
        """Return the posterior of sets of effects, shape (p_raw,) to a dict without those below 1e-13 of the best."""
        library, prior = self.sampler.effects_library, self.sampler.prior
        null, groups, identities = library.null, library.groups, library.identities
        scale = float(np.sqrt(null.hartlap_factor))
        norms = prior.weakest / scale, prior.strongest / scale
        edges = np.geomspace(*norms, 61)
        none, *alone = log_marginals(null, x, groups, np.sqrt(edges[1:] * edges[:-1]))
        with np.errstate(divide="ignore"):  # what the prior excludes has a logarithm of minus infinity
            shares, weights = np.log([prior.none, prior.one, prior.two]), np.log(self.sampler.weights)
        terms: list[tuple[Answer, float]] = [(frozenset(), none + shares[0])]
        for identity, value in zip(identities, alone + weights, strict=True):
            terms.append((frozenset([identity]), value + shares[1]))
        if prior.two > 0.0:
            pairs, chances = list(self._pairs), np.log(list(self._pairs.values()))
            found = pair_log_marginals(null, null.whiten(x), groups, pairs, norms, self._normals) + chances
            for (i, j), value in zip(pairs, found, strict=True):
                terms.append((frozenset([identities[i], identities[j]]), value + shares[2]))
        logs: dict[Answer, float] = {}
        for answer, value in terms:
            logs[answer] = float(np.logaddexp(logs.get(answer, -np.inf), value))
        found = special.softmax(list(logs.values()))
        return {answer: float(p) for answer, p in zip(logs, found, strict=True) if p > np.exp(-30.0) * found.max()}

    @cached_property
    def _pairs(self) -> dict[tuple[int, int], float]:
        """Pairs of candidates that can be drawn together, and their probabilities."""
        identities, weights = self.sampler.effects_library.identities, self.sampler.weights
        own = [sum(weights[[one == other for other in identities]]) for one in identities]
        # The second is drawn until it is another one than the first.
        return {
            (i, j): float(weights[i] * weights[j] * (1.0 / (1.0 - own[i]) + 1.0 / (1.0 - own[j])))
            for i, j in combinations(np.flatnonzero(weights).tolist(), 2)
            if identities[i] != identities[j]
        }

    @cached_property
    def _normals(self) -> Vector:
        """Antithetic standard normals, shape (256, columns)."""
        columns = 2 * int(self.sampler.effects_library.groups.sizes.max())
        half = rng.generator(0, 0, "challenge/bayes").standard_normal((128, columns))
        return np.concatenate([half, -half])


def facts(drawn: Drawn, x: Vector, response: Vector, library: EffectsLibrary, bayes: BayesClassifier) -> dict[str, Any]:
    """Return what a record says of the truth, and of the best possible answer.

    Data vector and response of the effects are those of the case's library, shape (p_raw,).
    """
    known: dict[Answer, float] = bayes.probabilities(x) if drawn.kind in IN_LIBRARY else {}
    best, probability = max(known.items(), key=lambda item: item[1], default=(None, np.nan))
    members, cosines = drawn.members, []
    for member in members:
        others = [identity != member.identity for identity in library.identities]
        alone = response if len(members) == 1 else library.response([member])
        cosines.append(float(np.max(library.cosines(alone)[others], initial=0.0)))
    return {
        "kind": drawn.kind,
        "truth": drawn.identities,
        "columns": len(members[0].coordinates) if len(members) == 1 else 0,
        "weakest": min((member.strength for member in members), default=0.0),
        "rival": max(cosines, default=0.0),
        "distances": () if drawn.kind in IN_LIBRARY else library.distances(response),
        "bayes": best,
        "bayes_right": probability,
    }
