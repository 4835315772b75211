"""What data choose from a continuum: a period, or the place of a compact source; the choice is charged."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Choice:
    """What stands out most of a continuum."""

    kind: str  #: of the structures of the grammar that it makes: "period 3600.0" (s), "source 120.0 -5.0" (deg)
    fall: float  #: of chi^2

    @property
    def family(self) -> str:
        """Return of which continuum it is."""
        return self.kind.partition(" ")[0]

    @property
    def numbers(self) -> tuple[float, ...]:
        """Return what is chosen: the period, seconds; longitude and latitude, degrees."""
        return tuple(map(float, self.kind.split()[1:]))


def frequency_apart(one: Choice, other: Choice) -> float:
    """Return the difference of the frequencies of two periods, Hz."""
    return abs(1.0 / one.numbers[0] - 1.0 / other.numbers[0])


def angle_apart(one: Choice, other: Choice) -> float:
    """Return the angle between two places, radians."""
    (a, b), (c, d) = np.deg2rad([one.numbers, other.numbers])
    return float(np.arccos(np.clip(np.sin(b) * np.sin(d) + np.cos(b) * np.cos(d) * np.cos(a - c), -1.0, 1.0)))
