"""Nuisances in a search for what is missing: taken from the maps as they fit, and marginalised in their scores.

In simulations that draw them, nuisances that the maps measure well would hide what is missing. They are taken from the
maps at the values that fit. To first order about these, scores are u = u0 + t z, with z the nuisances less their prior
means in prior widths, t their responses on this sky, and u0 the scores of a model without nuisances. The posterior
mean of z, G (u - <u0>) with G = (1 + t' C^-1 t)^-1 t' C^-1 from the scores that z changes most, is taken from them: in
u - t G (u - <u0>) nuisances are marginalised, and what a structure makes of its own is their variance as before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.datavector.analysis import simulated_maps
from mcsim.datavector.campaign import constrained_jobs
from mcsim.datavector.same_skies import SameSkies
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.search import SMALL, Search
from mcsim.reconstruction.simulated_scores import SEED, scores_of_maps
from mcsim.reconstruction.structure import Structure
from mcsim.simulation.channels import table_of
from mcsim.simulation.nuisance import REACH, Nuisance, draws
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Map, Matrix, Vector

SKIES = 4  #: skies, constrained by the data, on which nuisances and reconstructed effects are simulated
ENOUGH = 0.95  #: information of the scores that measure a nuisance, over that of the structure that tells most of it


@dataclass(frozen=True, eq=False)
class Marginal:
    """Scores without what looks like nuisances."""

    mean: Vector  # of all scores in maps of the model, (P,)
    responses: Matrix  # of all scores to nuisances in prior widths, (k, P)
    members: tuple[Structure, ...]  # whose scores measure them
    seen: Matrix  # what these scores say of each, (scores, k)

    def without(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return changes of scores, shape (..., P), less those that look like nuisances."""
        if not self.members:
            return change
        own = np.concatenate([one.of(change) for one in self.members], axis=-1)
        return np.asarray(change - own @ self.seen @ self.responses)

    def of(self, scores: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scores, shape (..., P), of maps from which nuisances z, shape (..., k), were taken."""
        if not self.members:
            return scores
        return np.asarray(self.mean + self.without(scores - self.mean + z @ self.responses))


@dataclass(frozen=True, eq=False)
class FittedNuisances:
    """The nuisances of a model that can be taken from observed maps, with what the data say of them.

    What is missing may look like a nuisance of any size: beyond REACH prior widths it is not taken for one.
    """

    skies: SameSkies  # of the observed maps
    nuisances: tuple[Nuisance, ...]
    fitted: Vector  # coordinates, (k,)
    errors: Vector  # (k,)

    @classmethod
    def of(cls, skies: SameSkies, found: Sequence[tuple[float, float]]) -> "FittedNuisances":
        """Part the nuisances of a model by whether they can be taken from maps.

        ``found`` has the amplitude and the error that the data give to each component of all.
        """
        every = skies.analysis.nuisances
        kept = np.repeat([one.subtractable for one in every], [len(one.widths) for one in every]).astype(bool)
        values = np.array(found).reshape(-1, 2)[kept]
        own = tuple(one for one in every if one.subtractable)
        most = REACH * _widths(own)
        return cls(skies, own, np.clip(values[:, 0], -most, most), values[:, 1])

    @property
    def z(self) -> Vector:
        """Return the fitted coordinates less their prior mean, in prior widths, shape (k,)."""
        return self.fitted / _widths(self.nuisances)

    @property
    def clean(self) -> SameSkies:
        """Return the same with the observed maps without the nuisances as they are fitted."""
        if not self.nuisances:
            return self.skies
        before, after = (self._simulated(one) for one in ([], self._tables(self.fitted)))
        change = np.mean([np.subtract(b, a) for a, b in zip(before, after, strict=True)], axis=0)
        pairs = zip(self.skies.maps, change, strict=True)
        return replace(self.skies, maps=[np.where(one == healpy.UNSEEN, one, one - more) for one, more in pairs])

    def _tables(self, coordinates: Vector) -> list[config.Effect]:
        parts = np.split(coordinates, np.cumsum([len(one.widths) for one in self.nuisances])[:-1])
        return [table_of(one.at(own), one.channel) for one, own in zip(self.nuisances, parts, strict=True) if own.any()]

    def _simulated(self, tables: list[config.Effect]) -> list[list[Map]]:
        """Return the maps of skies that the data constrain, with effects."""
        observed = self.skies.observed_with(self._tables(self.fitted))
        jobs = constrained_jobs(self.skies.analysis, tables, observed, range(SKIES))
        return [maps for job in jobs for maps in simulated_maps(job)]

    def drawn(self, count: int) -> Matrix:
        """Return draws of the nuisances in prior widths, shape (count, k)."""
        found = np.stack([draws(self.nuisances, SEED, realization)[0] for realization in range(count)])
        return np.asarray(found / _widths(self.nuisances))

    def marginal(self, search: Search, scene: Scene) -> Marginal:
        """Return what takes the nuisances out of scores; ``search`` has those of a model without them."""
        mean = search.simulations.mean(axis=0)
        if not self.nuisances:
            return Marginal(mean, np.zeros((0, len(mean))), (), np.zeros((0, 0)))
        model, steps = self.skies.analysis.model, np.diag(self.errors)

        def scores(tables: list[config.Effect]) -> Vector:
            return np.mean([scores_of_maps(model, scene, maps) for maps in self._simulated(tables)], axis=0)

        none = scores([])
        changes = np.stack([scores(self._tables(step)) - none for step in steps])
        responses = changes * (_widths(self.nuisances) / self.errors)[:, None]
        members = tuple(search.grammar[k] for k in dict.fromkeys(_telling(search, row) for row in responses))
        own = np.concatenate([one.of(search.simulations) for one in members], axis=-1)
        null = SimulatedGaussian.from_simulations(own, floor=SMALL)
        t = null.whitening @ np.concatenate([one.of(responses) for one in members], axis=-1).T
        seen = null.whitening.T @ t @ np.linalg.inv(np.eye(len(responses)) + t.T @ t)
        return Marginal(mean, responses, members, seen)

    def marginalised(self, search: Search, marginal: Marginal) -> Search:
        """Return the search with scores of maps in which nuisances are marginalised."""
        if not self.nuisances:
            return search
        return replace(search, simulations=marginal.of(search.simulations, self.drawn(len(search.simulations))))


def _widths(nuisances: Sequence[Nuisance]) -> Vector:
    """Return the prior standard deviation of every coordinate, shape (k,)."""
    return np.concatenate([np.zeros(0), *(one.sigma for one in nuisances)])


def _telling(search: Search, response: Vector) -> int:
    """Return the structure of fewest coordinates whose scores tell all of a nuisance but a share of 1 - ENOUGH."""
    told = np.full(len(search.grammar), -1.0)
    for k, (structure, null) in enumerate(zip(search.grammar, search.nulls, strict=True)):
        if null is not None and not structure.of_variances:
            told[k] = null.hartlap_factor * np.sum((null.whitening @ structure.of(response)) ** 2)
    enough = np.flatnonzero(told >= ENOUGH * told.max())
    return int(min(enough, key=lambda k: (search.grammar[k].size, -told[k])))
