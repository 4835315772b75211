"""Maps of channels on which no effect acts, kept for the next effect that is simulated in the same skies."""

from collections.abc import Hashable
from dataclasses import replace
from functools import lru_cache

from mcsim import config
from mcsim.simulation import simulate
from mcsim.simulation.survey import Survey
from mcsim.support.arrays import Alm, Map

MEMORY = 1 << 27  #: bytes of maps that a process keeps, beyond which the oldest go
REALIZATIONS = 2  #: whose maps a process keeps, however large they are: those of a piece of a job at any resolution


class UntouchedMaps:
    """Simulate maps, and keep those of channels in which fewer effects act than in others.

    What a map depends on besides its channel's effects is the run without effects, its number, and the sky.
    """

    def __init__(self) -> None:
        self._kept: dict[Hashable, list[Map]] = {}
        self._bytes = 0

    def maps(self, survey: Survey, realization: int, sky: Alm | None, which: Hashable) -> list[Map]:
        """Return what :func:`mcsim.simulation.simulate.maps` does; ``which`` tells the run and the given sky apart."""
        if sky is None:
            sky = simulate.draw_sky(survey, realization)
        channels, made = survey.making.channels, simulate.circular_maps(survey)
        most, found = max(len(channel.effects) for channel in channels), list[Map]()
        for channel in channels:
            key = (which, realization, channel.name, repr(channel.effects))
            own = self._kept.pop(key, None)
            self._bytes -= _size(own or [])
            if own is None:
                own = simulate.maps_of(survey, channel, sky, realization, made)
            if len(channel.effects) < most:
                self._kept[key] = own
                self._bytes += _size(own)
            found += own
        while self._bytes > max(MEMORY, REALIZATIONS * _size(found)):
            self._bytes -= _size(self._kept.pop(next(iter(self._kept))))
        return found


def _size(maps: list[Map]) -> int:
    return sum(map_uk.nbytes for map_uk in maps)


@lru_cache(maxsize=2)
def without_effects(simulated: str) -> str:
    """Return a run without its effects, both as JSON."""
    return config.to_json(replace(config.from_json(simulated), effects=()))
