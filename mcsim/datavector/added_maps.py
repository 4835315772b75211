"""Simulate what effects show in the maps where there is no sky, which must not be taken for sky."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.datavector.analysis import Analysis
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.shared_sky import shared_sky
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.support.arrays import Map, Maps, divided

TAKEN = 0.1  #: root of the power over the sky's, at any degree, up to which a filtered sky may have such signals in it

Added = str  #: run (JSON) whose effects show something without a sky; "": little or nothing


@dataclass(frozen=True, eq=False)
class AddedMaps:
    """Simulate what is added to the maps of a model."""

    analysis: Analysis

    def run_of(self, found: Sequence[config.Effect]) -> Added:
        """Return the run with those effects that add to maps; "" if little of what they add is taken for sky."""
        run = self.whole_run(found)
        return run if run and self._share(run) > TAKEN else ""

    def whole_run(self, found: Sequence[config.Effect]) -> Added:
        """Return the run with those effects that add to maps, if more than in a linear response; "" if none does."""
        own = [one for one in found if self._adds(one)]
        return config.to_json(with_effects(self.analysis.run, own)) if own else ""

    def less(self, maps: Sequence[Map], run: Added) -> list[Map]:
        """Return maps, uK, shape (npix,) each, without what the effects of a run add to them."""
        if not run:
            return list(maps)
        pairs = zip(maps, self._shown(run), strict=True)
        return [np.where((own == healpy.UNSEEN) | (m == healpy.UNSEEN), m, m - own) for m, own in pairs]

    def is_small(self, effect: config.Effect) -> bool:
        """Return True for an effect as small as in the simulations from which linear responses are measured."""
        kind = dict(self.analysis.library)[effect.name]
        amplitude = systematics.build(kind, dict(effect.parameters)).amplitude
        return abs(amplitude) <= self._steps.get((effect.name, effect.channel), 0.0)

    def _adds(self, effect: config.Effect) -> bool:
        """Return True if an effect can add to maps: to the sky, to samples, or as it changes how a dipole is seen.

        What is drawn anew in every realization is not known, and what is small is little.
        """
        kind = dict(self.analysis.library)[effect.name]
        if kind.parametrization.stochastic or self.is_small(effect):
            return False
        dipole = any(channel.site.dipole_uk.any() for channel in self.analysis.model.survey.channels)
        return systematics.acts_through(kind, "sky", "signal") or (dipole and not kind.parametrization.noise_alone)

    @cached_property
    def _steps(self) -> dict[tuple[str, str | None], float]:
        """Return the largest amplitude at which the linear response of each candidate is measured."""
        each = self.analysis.candidates
        return {one.identity: max(abs(basis.amplitude) for basis in one.basis) for one in each}

    @cached_property
    def _share(self) -> Callable[[Added], float]:
        return cache(self._taken)

    def _taken(self, run: Added) -> float:
        """Return the root of the power that is taken for sky over that of the sky, at the degree where it is most."""
        model = self.analysis.model
        power = alm_.power(shared_sky(model, list(self._shown(run))), model.lmax)
        return float(np.sqrt(divided(power, (2.0 * np.arange(model.lmax + 1) + 1.0) * model.cl).max()))

    @cached_property
    def _shown(self) -> Callable[[Added], Maps]:
        return lru_cache(maxsize=1)(self._without_sky)

    def _without_sky(self, run: Added) -> Maps:
        """Return what the effects of a run add to maps, uK, shape (map, npix); ``healpy.UNSEEN`` without hits.

        The model's own effects act with them and without them.
        """
        fiducial = self.analysis.model.survey
        changed = survey(config.from_json(run), library=dict(self.analysis.library))
        empty = np.zeros(alm_.size(fiducial.config.sky.lmax), dtype=np.complex128)
        before, after = (simulate.maps(one.without_noise, 0, sky=empty) for one in (fiducial, changed))
        return np.where(after == healpy.UNSEEN, after, after - before)
