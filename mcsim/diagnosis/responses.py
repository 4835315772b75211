"""Simulate how the data vector responds to effects, over skies that agree with the observed one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.campaign import Ask, after_jobs, constrained_jobs

Rows = NDArray[np.float64]


class Responses:
    """Simulate responses to effects for one set of maps.

    Parameters
    ----------
    run, analysis
        Fiducial model and its analysis.
    reference
        Data vectors of the skies with which templates are measured, shape (skies, p).
    observed
        Filtered sky of the data.
    ask
        Runs simulations.
    """

    def __init__(
        self, run: config.RunConfig, analysis: Analysis, reference: Rows, observed: NDArray[np.complex128], ask: Ask
    ) -> None:
        self._run, self._analysis, self._reference, self._observed, self._ask = run, analysis, reference, observed, ask
        self._without: Rows = np.zeros((0, len(analysis.elements)))

    def __call__(self, found: Sequence[config.Effect], skies: int) -> Rows:
        """Return changes of the data vector in ``skies`` constrained skies, shape (rows, p).

        Effects with a mean response are simulated in typical skies instead: the observed sky has its power already.
        """
        typical = [effect for effect in found if self._is_typical(effect)]
        others = [effect for effect in found if not self._is_typical(effect)]
        shift = np.zeros((1, self._without.shape[1]))
        if typical:
            shift = self._typical(typical) - self._reference
        if not others:
            return shift
        return shift.mean(axis=0) + self._constrained(others, range(skies)) - self._before(skies)

    def pair(self, found: Sequence[config.Effect]) -> tuple[Rows, Rows]:
        """Return data vectors of the same skies without the effects and with them, shape (rows, p) each."""
        if any(self._is_typical(effect) for effect in found):
            return self._reference, self._typical(found)
        skies = self._analysis.settings.constrained_skies
        return self._before(skies), self._constrained(found, range(skies))

    def _typical(self, found: Sequence[config.Effect]) -> Rows:
        return np.concatenate(self._ask(after_jobs(self._run, self._analysis, found)))

    def _constrained(self, found: Sequence[config.Effect], realizations: range) -> Rows:
        jobs = constrained_jobs(self._run, self._analysis, found, self._observed, realizations)
        return np.concatenate(self._ask(jobs))

    def _before(self, skies: int) -> Rows:
        if len(self._without) < skies:
            more = self._constrained((), range(len(self._without), skies))
            self._without = np.concatenate([self._without, more])
        return self._without[:skies]

    def _is_typical(self, effect: config.Effect) -> bool:
        kind = next(one.effect for one in self._analysis.candidates if one.name == effect.name)
        return kind.parametrization.mean_response and not kind.parametrization.stochastic
