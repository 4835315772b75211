"""Maps of the data in the filter: their weights, and what their preparation has subtracted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan import Moments
from mcsim.simulation.survey import Survey
from mcsim.support.arrays import Map

LEFT = 0.01  #: share of what was subtracted from maps that stays in :meth:`Part.without_response`
RANK = 1e-10  #: smallest eigenvalue over the largest of templates that are fitted and subtracted


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

    def without_subtracted(self, map_uk: Map) -> Map:
        """Return a map from which all is subtracted once more: observed ones may have some of it, simulated none."""
        for columns, used, normal in self._weighted:
            map_uk = map_uk - np.linalg.lstsq(normal, used @ map_uk, rcond=RANK)[0] @ columns
        return map_uk

    def without_response(self, residual: Map) -> Map:
        """Return a residual whose products with signals are those with what the preparation leaves of these, uK^-1.

        But for a share LEFT: scores of what is subtracted are small, and not mere rounding.
        """
        for columns, used, normal in reversed(self._weighted):
            residual = residual - (1.0 - LEFT) * np.linalg.lstsq(normal, columns @ residual, rcond=RANK)[0] @ used
        return residual

    @property
    def _weighted(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """Return columns, columns with weights, and their normal matrix."""
        used = [np.where(self.moments.hits > 0, weight, 0.0) * columns for columns, weight in self.subtracted]
        return [(columns, own, own @ columns.T) for (columns, _), own in zip(self.subtracted, used, strict=True)]


def keeps_pixels(survey: Survey) -> bool:
    """Return True if no map is prepared but by fits that are subtracted and by masks: its pixels and noise stay."""
    maps = [m for channel in survey.channels for m in channel.maps]
    return all(m.preparation is None or m.preparation.subtracts for m in maps)


def regressions(survey: Survey) -> list[list[tuple[NDArray[np.float64], Map]]]:
    """Return what is fitted and subtracted from every map, with which weights; what is the same is kept once."""
    known, found = list[tuple[NDArray[np.float64], Map]](), []
    for m in (m for channel in survey.channels for m in channel.maps):
        own = []
        for one in () if m.preparation is None else m.preparation.regressions():
            same = (other for other in known if all(map(np.array_equal, one, other)))
            own.append(next(same, one))
            known.append(own[-1])
        found.append(own)
    return found


def marginalised(survey: Survey, parts: Sequence[Part]) -> tuple[Part, ...]:
    """Return parts of maps that know nothing of what was subtracted from them.

    With the noise as weights the residual then has none of it, whatever the weights of the preparation were.
    """
    return tuple(
        replace(part, subtracted=tuple((columns, part.precision) for columns, _ in own))
        for part, own in zip(parts, regressions(survey), strict=True)
    )
