"""Twelve systematics of published error budgets, written before the grammar was made general.

python budgets.py [A:B]     cases A to B - 1, one after the other at S/N 10, then at S/N 20

What is true of each is written beside it; where two descriptions say the same thing, both are right.
"""

from collections.abc import Callable
from dataclasses import dataclass

import healpy
import numpy as np
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix

YEAR_S, DAY_S, FINE = 365.25 * 86400.0, 86400.0, 128


@dataclass
class Seen:
    """What a channel sees: samples, unit vectors of their beams (x, y, outward; shape (3, n)), and the true sky."""

    time_s: np.ndarray
    psi: np.ndarray
    x: np.ndarray
    y: np.ndarray
    n: np.ndarray
    away: float  # angle of the line of sight from the spin axis, radians
    sky: np.ndarray  # sky and dipole through the beam, on pixels of nside FINE

    def at(self, n):
        """Return sky and dipole in directions, shape (3, n)."""
        return self.sky[healpy.vec2pix(FINE, *n)]

    def spun(self, angle):
        """Return the lines of sight as they were an angle of the spin before."""
        axis = np.cos(self.away) * self.n + np.sin(self.away) * self.y
        along = np.cross(axis, self.n, axis=0)
        above = axis * np.sum(axis * self.n, axis=0)
        return above + np.cos(angle) * (self.n - above) - np.sin(angle) * along


def adc(s):
    """Response of a converter that differs between positive and negative signals (HFI: arXiv:1502.01587, 2.3)."""
    return np.abs(s.at(s.n))


def gain_solutions(s):
    """Errors of gains that are solved for every 30 days (LFI: arXiv:1502.01574, 3.3)."""
    return np.random.default_rng(7).normal(size=13)[(s.time_s / (30.0 * DAY_S)).astype(int)] * s.at(s.n)


def long_tail(s):
    """A slow tail of the response, of 6 s, 17 degrees of the spin (HFI: arXiv:1502.01587, 2.4)."""
    angles = np.deg2rad([2.0, 6.0, 11.0, 17.0, 25.0, 35.0, 50.0, 70.0])
    weights = np.exp(-np.rad2deg(angles) / 17.0) * np.gradient(angles)
    return sum(w * s.at(s.spun(a)) for w, a in zip(weights / weights.sum(), angles, strict=True)) - s.at(s.n)


def ghost(s):
    """A reflection, mirrored through the middle of the focal plane, 25 degrees away (BICEP, Keck: arXiv:1502.00596)."""
    alpha, off = np.deg2rad(130.0), np.deg2rad(25.0)
    return s.at(np.cos(off) * s.n + np.sin(off) * (np.cos(alpha) * s.x + np.sin(alpha) * s.y))


def galaxy_in_lobe(s):
    """The Galaxy in a far sidelobe (WMAP: astro-ph/0302215; LFI and HFI: arXiv:1303.5063)."""
    off, alpha = np.deg2rad(80.0), np.deg2rad(75.0)
    lobe = np.cos(off) * s.n + np.sin(off) * (np.cos(alpha) * s.x + np.sin(alpha) * s.y)
    g = rotation_matrix("ecliptic", "galactic") @ lobe
    return np.exp(-np.abs(g[2]) / 0.15) * (1.0 + g[0])


def thermal_pointing(s):
    """Pointing that bends with the season, across the scan (HFI and LFI: arXiv:1303.5067, WMAP: astro-ph/0603452)."""
    off = np.deg2rad(0.5)
    moved = s.at(np.cos(off) * s.n + np.sin(off) * s.y) - s.at(np.cos(off) * s.n - np.sin(off) * s.y)
    return np.sin(2.0 * np.pi * s.time_s / YEAR_S) * moved


def solar_rotation(s):
    """Temperature of the instrument that follows the rotating Sun, 27 days (LFI thermal: arXiv:1303.5063)."""
    return np.cos(2.0 * np.pi * s.time_s / (27.0 * DAY_S) + 1.0)


def magnetic(s):
    """A gain that depends on the angle of the instrument to a fixed magnetic field (SPIDER: arXiv:1006.5486)."""
    return s.x[2] * s.at(s.n)


def zodiacal(s):
    """Interplanetary dust in all channels, brighter at high frequency (HFI: arXiv:1303.5074)."""
    return np.exp(-np.abs(s.n[2]) / 0.3)


def cosmic_rays(s):
    """More glitches, thus noise, in the second half of the year (HFI: arXiv:1303.5071)."""
    return np.zeros(len(s.psi))


def polarised(s):
    """Polarised light of the Galaxy in an intensity detector (LFI and WMAP: arXiv:1303.5063)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    pole = rotation_matrix("ecliptic", "galactic")[2]
    angle = np.arctan2(pole @ s.y, pole @ s.x)
    return np.exp(-np.abs(g[2]) / 0.3) * np.cos(2.0 * angle)


def transponder(s):
    """A gain that steps while the transmitter is on, 3 hours every day (LFI: arXiv:1101.2038)."""
    return (s.time_s / DAY_S % 1.0 < 0.125) * s.at(s.n)


@dataclass(frozen=True)
class Case:
    """What acts, and what is true of it: each of (stage, frame, kinds, splits) is right; None: whatever it is."""

    act: Callable[[Seen], np.ndarray]
    right: tuple[tuple[str, str, tuple[str, ...] | None, tuple[str, ...] | None], ...]
    common: bool = False


ALIKE = ("alike",)
CASES = (
    Case(adc, (("square", "", ANY, ALIKE),)),
    Case(gain_solutions, (("gain", "time", ANY, ANY),)),
    Case(long_tail, (("beam", "scan", ("order 1",), ALIKE), ("elsewhere", "spacecraft", ("lag",), ALIKE))),
    Case(ghost, (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE))),
    Case(galaxy_in_lobe, (("added", "spacecraft", ANY, ALIKE), ("elsewhere", "spacecraft", ANY, ALIKE))),
    Case(
        thermal_pointing,
        (("beam", "scan", ("order 1",), ("opposite",)), ("beam", "scan", ("order 1 year",), ALIKE)),
    ),
    Case(solar_rotation, (("added", "time", ANY, ANY),)),
    Case(magnetic, (("gain", "spacecraft", ANY, ALIKE),)),
    Case(zodiacal, (("added", "sky", ("latitude ecliptic",), ALIKE),), common=True),
    Case(cosmic_rays, (("noise", "", ("level",), ("half2",)),)),
    Case(polarised, (("added", "spacecraft", ("orientation 2",), ALIKE), ("added", "sky", ("orientation 2",), ALIKE))),
    Case(transponder, (("gain", "", ("constant",), ALIKE), ("gain", "time", ANY, ALIKE))),
)
