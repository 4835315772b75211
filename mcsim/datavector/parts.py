"""Maps of the data in the filter: their weights, and what their preparation has subtracted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan import Moments
from mcsim.simulation.inverse_covariance import covariance_of_amplitudes
from mcsim.simulation.preparation import templates_of
from mcsim.simulation.survey import Survey
from mcsim.support.arrays import Map, Matrix

LEFT = 0.01  #: share of what was subtracted from maps that stays in :meth:`Part.without_response`

TRACE = 1e-6
"""The same where no map knows what was subtracted. The filtered sky has it, many times what the noise has of it."""


@dataclass(frozen=True)
class Part:
    """Describe one map of the data: its place in the survey, and its weights."""

    channel: int
    name: str  # in the survey
    split: str | None  # None if there are none
    moments: Moments  # of the orientations of its samples
    precision: Map  # inverse variance of the noise of every pixel, uK^-2, (npix,); 0 where unobserved or masked
    noise_power: float  # of the noise in the map's a_lm when its pixels count alike, uK^2 sr
    #: what its preparation fits and subtracts, shape (K, npix), and with which weights, if that counts
    subtracted: tuple[tuple[NDArray[np.float64], Map], ...] = ()
    left: float = LEFT  #: share of it that stays in residuals

    def without_subtracted(self, map_uk: Map) -> Map:
        """Return a map from which all is subtracted once more: observed ones may have some of it, simulated none."""
        for columns, weight, covariance in self._fits:
            map_uk = map_uk - covariance @ (columns @ (weight * map_uk)) @ columns
        return map_uk

    def without_response(self, residual: Map) -> Map:
        """Return a residual whose products with signals are those with what the preparation leaves of these, uK^-1.

        But for a share ``left``: scores of what is subtracted are small, and not mere rounding.
        """
        for columns, weight, covariance in reversed(self._fits):
            residual = residual - (1.0 - self.left) * weight * (covariance @ (columns @ residual) @ columns)
        return residual

    @cached_property
    def _fits(self) -> list[tuple[NDArray[np.float64], Map, Matrix]]:
        """Return columns, weights where the map was observed, and the covariance of amplitudes."""
        each = [(columns, np.where(self.moments.hits > 0, weight, 0.0)) for columns, weight in self.subtracted]
        return [(columns, weight, covariance_of_amplitudes(columns, weight)) for columns, weight in each]


def marginalised(survey: Survey, parts: Sequence[Part]) -> tuple[Part, ...]:
    """Return parts of maps that know nothing of what was subtracted from them.

    With the noise as weights the residual then has none of it, whatever the weights of the preparation were.
    """
    return tuple(
        replace(part, subtracted=() if own is None else ((own, part.precision),), left=TRACE)
        for part, own in zip(parts, templates_of(survey.preparations), strict=True)
    )
