"""Detect effects of the library in data that no set of them explains."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.candidate import Candidate, columns_of, within_bounds
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.stats.look_elsewhere import Calibration

Matrix = NDArray[np.float64]
Exact = Callable[[Matrix, tuple[int, ...], Fit], Matrix | None]
"""Return templates that hold for members together at about their fitted amplitudes, from templates, members, fit."""


@dataclass(frozen=True)
class PartialExplanation:
    """Hold effects that are detected without explaining all of the excess chi^2.

    ``members`` are the indices of the candidates, in the order in which they were detected, and ``fit`` the amplitudes
    of their columns; ``left`` is the share of the excess chi^2 that they leave. The ``templates``, shape (p_raw, K),
    hold for the members together.
    """

    members: tuple[int, ...]
    fit: Fit
    left: float
    templates: Matrix


@dataclass(frozen=True)
class Detection:
    """Add the most significant candidate beside those that are detected already, until none is significant.

    ``null`` is the distribution of the data vector ``x``, shape (p_raw,), without an effect. ``exact`` simulates
    members at their amplitudes; None from it says that they cannot have them.
    """

    null: SimulatedGaussian
    x: NDArray[np.float64]
    candidates: Sequence[Candidate]
    calibration: Calibration
    exact: Exact
    settings: DiagnosisSettings

    def run(self, t: Matrix) -> PartialExplanation | None:
        """Return what is detected with templates ``t``, shape (p_raw, K); None if nothing is significant.

        Each member is significant beside those before it, before and after it is simulated at its amplitude; of two
        similar effects the one that is not there may be the first.
        """
        null, settings = self.null, self.settings
        members: tuple[int, ...] = ()
        refused: set[int] = set()
        before = null.fit(self.x, t[:, :0])
        total = before.chi2
        while len(members) < settings.partial_effects and len(refused) < settings.partial_refusals:
            chosen = self._most_significant(t, members, refused, before)
            if chosen is None:
                break
            together = (*members, chosen[0])
            straight = self.exact(t, together, chosen[1])
            if straight is not None:
                after = self._fit(straight, together)
                if within_bounds(self.candidates, together, after) and self._significant(self._pvalue(before, after)):
                    members, t, before = together, straight, after
                    continue
            refused.add(chosen[0])
        if not members:
            return None
        excess = null.hartlap_factor * total - null.dimension
        left = null.hartlap_factor * before.chi2 - before.dimension
        return PartialExplanation(members, before, min(max(left / excess, 0.0), 1.0) if excess > 0.0 else 1.0, t)

    def _most_significant(
        self, t: Matrix, members: tuple[int, ...], refused: set[int], before: Fit
    ) -> tuple[int, Fit] | None:
        """Return the most significant candidate beside the members, and their fit; None if none is significant."""
        options: list[tuple[float, int, Fit]] = []
        taken = {self.candidates[member].identity for member in members}
        for index, candidate in enumerate(self.candidates):
            if candidate.identity not in taken and index not in refused:
                after = self._fit(t, (*members, index))
                if within_bounds(self.candidates, (*members, index), after):
                    options.append((self._pvalue(before, after), index, after))
        best = min(options, key=lambda option: option[0], default=None)
        return best[1:] if best is not None and self._significant(best[0]) else None

    def _fit(self, t: Matrix, members: tuple[int, ...]) -> Fit:
        return self.null.fit(self.x, t[:, columns_of(self.candidates, members)])

    def _pvalue(self, before: Fit, after: Fit) -> float:
        columns, fitted = before.dimension - after.dimension, self.null.dimension - before.dimension
        return float(self.null.nested_test(before.chi2 - after.chi2, before.chi2, columns, fitted))

    def _significant(self, pvalue: float) -> bool:
        return float(self.calibration.global_pvalue(pvalue)) <= self.settings.partial_level
