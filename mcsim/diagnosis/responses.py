"""How evidence changes when effects act, simulated over skies that are like the one that was observed."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.diagnosis.analysis import Analysis
from mcsim.diagnosis.knowledge import CONSTRAINED_SKIES, Ask, Knowledge, after_jobs, constrained_jobs

Rows = NDArray[np.float64]


class Responses:
    """Responses to effects, for one set of data.

    Parameters
    ----------
    run, asked, known
        What is believed, what is asked of it, what its simulations answered.
    observed
        The sky that the data show.
    ask
        Runs simulations.
    """

    def __init__(
        self, run: config.RunConfig, analysis: Analysis, known: Knowledge, observed: NDArray[np.complex128], ask: Ask
    ) -> None:
        self._run, self._asked, self._known, self._observed, self._ask = run, analysis, known, observed, ask
        self._without: Rows = np.zeros((0, len(analysis.elements)))

    def __call__(self, found: Sequence[config.Effect], skies: int) -> Rows:
        """Changes of the evidence, a row for every sky, shape (rows, entries).

        ``skies`` that agree with the observed one; of effects whose mean response counts, the mean of typical skies:
        the observed one has the power that it was given already.
        """
        on_average = [effect for effect in found if _is_typical(effect)]
        others = [effect for effect in found if not _is_typical(effect)]
        shift = np.zeros((1, self._without.shape[1]))
        if on_average:
            shift = self._typical(on_average) - self._known.reference
        if not others:
            return shift
        return shift.mean(axis=0) + self._constrained(others, skies) - self._before(skies)

    def pair(self, found: Sequence[config.Effect]) -> tuple[Rows, Rows]:
        """Evidence of the same skies without effects and with them, shape (rows, entries) each."""
        if any(_is_typical(effect) for effect in found):
            return self._known.reference, self._typical(found)
        return self._before(CONSTRAINED_SKIES), self._constrained(found, CONSTRAINED_SKIES)

    def _typical(self, found: Sequence[config.Effect]) -> Rows:
        return np.concatenate(self._ask(after_jobs(self._run, self._asked, found)))

    def _constrained(self, found: Sequence[config.Effect], last: int, first: int = 0) -> Rows:
        return np.concatenate(self._ask(constrained_jobs(self._run, self._asked, found, self._observed, first, last)))

    def _before(self, skies: int) -> Rows:
        if len(self._without) < skies:
            more = self._constrained((), skies, len(self._without))
            self._without = np.concatenate([self._without, more])
        return self._without[:skies]


def _is_typical(effect: config.Effect) -> bool:
    kind = systematics.get(effect.name)
    return kind.mean_response and not kind.draws
