"""Simulate data vectors of the same skies without effects and with them: in typical skies, or in constrained ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mcsim import config
from mcsim.datavector.analysis import Analysis, Job
from mcsim.datavector.campaign import Ask, after_jobs, constrained_jobs
from mcsim.datavector.wiener_filter import shared_sky
from mcsim.support.arrays import Alm, Map, Matrix, Vector


@dataclass(frozen=True, eq=False)
class SameSkies:
    """Simulate pairs for observed maps, in the order of the model's, which constrain the skies on request.

    All data vectors have the numbers beside them behind them: shape (skies, p + E).
    """

    analysis: Analysis
    ask: Ask
    maps: Sequence[Map]

    @cached_property
    def observed(self) -> Alm:
        """Return the filtered sky of the maps, uK, shape (size,)."""
        return shared_sky(self.analysis.model, self.maps)

    @cached_property
    def _before(self) -> dict[tuple[bool, bool], list[Vector]]:
        """Return data vectors without any effect, as many as were needed so far.

        Keys are True for constrained skies, and for an external simulator.
        """
        return {(constrained, external): [] for constrained in (False, True) for external in (False, True)}

    def of_reference(self, found: Sequence[config.Effect], skies: int | None = None) -> Matrix:
        """Return data vectors with effects, of the first or all of the skies with which responses are measured."""
        return self._extended(after_jobs(self.analysis, found, skies))

    def pair(self, found: Sequence[config.Effect], skies: int, constrained: bool) -> tuple[Matrix, Matrix]:
        """Return data vectors of the same skies without effects and with them."""
        source = self.analysis.source_of(found, given_sky=constrained)

        def simulated(found: Sequence[config.Effect], first: int) -> Matrix:
            if constrained:
                jobs = constrained_jobs(self.analysis, found, self.observed, range(first, skies))
            else:
                jobs = after_jobs(self.analysis, found, skies)
            return self._extended([replace(job, source=source) for job in jobs])[first - skies :]

        after, before = simulated(found, 0), self._before[constrained, source is not None]
        if len(before) < skies:
            before.extend(simulated((), len(before)))
        return np.stack(before[:skies]), after

    def _extended(self, jobs: Sequence[Job]) -> Matrix:
        return np.concatenate(self.ask([replace(job, slices=True) for job in jobs]))
