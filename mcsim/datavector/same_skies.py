"""Simulate data vectors of the same skies without effects and with them: in typical skies, or in constrained ones."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Literal

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.datavector.analysis import Analysis, Job
from mcsim.datavector.campaign import Ask, after_jobs, constrained_jobs
from mcsim.datavector.wiener_filter import inverse_of, shared_sky
from mcsim.support.arrays import Alm, Map, Matrix, Vector, divided

SMALL = 2e-3  #: gain of a channel that observed skies may have in them: responses are wrong by less than this share

BENT = 0.1  #: change of a beam at some degree, beside a gain, that observed skies may have in them

Factors = tuple[tuple[float, ...], ...]  #: by which channels see degrees otherwise, (channel, lmax + 1); (): not

Skies = Literal["reference", "typical", "constrained"]


@dataclass(frozen=True, eq=False)
class SameSkies:
    """Simulate pairs for observed maps, in the order of the model's, which constrain the skies on request.

    All data vectors have the numbers beside them behind them: shape (skies, p + E).
    """

    analysis: Analysis
    ask: Ask
    maps: Sequence[Map]

    @property
    def observed(self) -> Alm:
        """Return the filtered sky of the maps, uK, shape (size,)."""
        return self.observed_with(())

    def observed_with(self, found: Sequence[config.Effect]) -> Alm:
        """Return the filtered sky of the maps if they have effects: as the channels see it then.

        Notes
        -----
        A gain 1 + g of one channel is in the filtered sky with a weight w: its response there is 1 + w g times the true
        one, and a fit gives g/(1 + w g). So it is with each degree that a beam loses. Gains up to SMALL and beams up to
        BENT, the steps of linear responses among them, stay.
        """
        return self._skies(self.factors(found))

    @cached_property
    def _skies(self) -> Callable[[Factors], Alm]:
        @cache
        def sky(factors: Factors) -> Alm:
            model = self.analysis.model
            if not factors:
                return shared_sky(model, self.maps)
            rows = np.array(factors)
            gains = np.where(np.ptp(rows, axis=1) == 0.0, rows[:, 0], 1.0)
            pairs = zip(self.maps, gains[[part.channel for part in model.parts]], strict=True)
            given = [map_ if g == 1.0 else np.where(map_ == healpy.UNSEEN, map_, map_ / g) for map_, g in pairs]
            if np.any((shapes := rows / gains[:, None]) != 1.0):
                response = model.response * shapes
                inverse = None if model.inverse is None else inverse_of(model.cl, response, model.parts)
                model = replace(model, response=response, inverse=inverse)
            return shared_sky(model, given)

        return sky

    def factors(self, found: Sequence[config.Effect]) -> Factors:
        """Return by how much effects change what each channel sees, by degree; () if all is close to 1.

        It is one number for all degrees where the effects rescale the channel as a whole.
        """
        model, library, rows = self.analysis.model, dict(self.analysis.library), []
        for channel in model.survey.channels if found else ():
            own = [one for one in found if one.channel in (None, channel.name)]
            acting = [systematics.build(library[one.name], dict(one.parameters)) for one in own]
            row = np.full(model.lmax + 1, systematics.rescaling(acting, channel.site))
            before, after = (
                beam.blm[0, : model.lmax + 1].real
                for beam in (channel.site.beam, systematics.seen_through(acting, channel.site, displacing=()))
            )
            shape = np.where(before > 0.0, divided(after, before), 1.0)
            rows.append(shape if np.abs(shape / row - 1.0).max() > BENT else row)
        return (
            () if all(np.abs(row - 1.0).max() <= SMALL for row in rows) else tuple(tuple(row.tolist()) for row in rows)
        )

    @cached_property
    def _before(self) -> dict[tuple[bool, bool, Factors], list[Vector]]:
        """Return data vectors without any effect, as many as were needed so far.

        Keys are True for constrained skies, for an external simulator, and the factors that these skies are without.
        """
        return defaultdict(list)

    @cached_property
    def _ahead(self) -> dict[tuple[str, int, int, bytes], Matrix]:
        """Return what was simulated ahead, by all that tells such jobs apart."""
        return {}

    def skies_of(self, effect: config.Effect) -> Skies:
        """Return in which skies the response to an effect is measured.

        One with a mean response, or a drawn pattern, is of typical skies: the observed sky has its power already. So it
        has what a window does to it, if no other channel shows the sky.
        """
        how = dict(self.analysis.library)[effect.name].parametrization
        if how.stochastic:
            return "constrained" if how.mean_response else "typical"
        return "reference" if how.mean_response or self._changes_power(effect) else "constrained"

    def _changes_power(self, effect: config.Effect) -> bool:
        """Return True for what a beam, or a pixel, does to the power of the sky of the only channel."""
        kind, alone = dict(self.analysis.library)[effect.name], len(self.analysis.model.channels) == 1
        return alone and systematics.acts_through(kind, "beam", "spread")

    def ahead(self, each: Sequence[config.Effect], skies: int) -> None:
        """Simulate single effects at once that :meth:`of_reference` or :meth:`pair` will be asked for one by one.

        One by one they would leave workers waiting. InputError if one of them cannot be simulated.
        """
        kinds = [(effect, self.skies_of(effect)) for effect in each]
        sets = [([effect], kind == "constrained", None if kind == "reference" else skies) for effect, kind in kinds]
        jobs = [job for one in sets for job in self._jobs(*one, there=one[0])]
        self._ahead.update(zip(map(_key, jobs), self.ask(jobs) if jobs else [], strict=True))

    def of_reference(self, found: Sequence[config.Effect], skies: int | None = None) -> Matrix:
        """Return data vectors with effects, of the first or all of the skies with which responses are measured."""
        return self._simulated(self._jobs(found, False, skies))

    def pair(self, found: Sequence[config.Effect], skies: int, constrained: bool) -> tuple[Matrix, Matrix]:
        """Return data vectors of the same skies without effects and with them, which the observed maps have too."""
        jobs = self._jobs(found, constrained, skies, there=found)
        after, source = self._simulated(jobs), jobs[0].source
        before = self._before[constrained, source is not None, self.factors(found) if constrained else ()]
        if (first := len(before)) < skies:
            same = [replace(job, source=source) for job in self._jobs((), constrained, skies, first, found)]
            before.extend(self._simulated(same)[first - skies :])
        return np.stack(before[:skies]), after

    def _jobs(
        self,
        found: Sequence[config.Effect],
        constrained: bool,
        skies: int | None,
        first: int = 0,
        there: Sequence[config.Effect] = (),
    ) -> list[Job]:
        """List the jobs that simulate effects; of skies that are not constrained, always from the first one on."""
        if not constrained or skies is None:
            jobs = after_jobs(self.analysis, found, skies)
        else:
            jobs = constrained_jobs(self.analysis, found, self.observed_with(there), range(first, skies))
        source = self.analysis.source_of(found, given_sky=constrained)
        return [replace(job, slices=True, source=source) for job in jobs]

    def _simulated(self, jobs: Sequence[Job]) -> Matrix:
        known = {_key(job): self._ahead.pop(_key(job), None) for job in jobs}
        missing = [job for job in jobs if known[_key(job)] is None]
        known.update(zip(map(_key, missing), self.ask(missing) if missing else [], strict=True))
        return np.concatenate([rows for rows in known.values() if rows is not None])


def _key(job: Job) -> tuple[str, int, int, bytes]:
    return job.simulated, job.first, job.count, b"" if job.observed is None else job.observed.tobytes()
