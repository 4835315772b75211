"""Twelve more systematics of published error budgets, by someone who had seen the words of the score alone.

python third.py [A:B]       cases A to B - 1, one after the other at S/N 10, then at S/N 20

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described.
"""

import os
import sys

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, YEAR_S, Case, main
from further import phase
from unlisted import ANY


def between(s, n):
    """Return sky and dipole in directions, shape (3, n), interpolated: for differences of near directions."""
    return healpy.get_interp_val(s.sky, *healpy.vec2ang(n.T))


def beside(s, off_deg, angle):
    """Return directions at a distance from the line of sight, at an angle from the beam's x axis (radians)."""
    off = np.deg2rad(off_deg)
    return np.cos(off) * s.n + np.sin(off) * (np.cos(angle) * s.x + np.sin(angle) * s.y)


def cooler(s):
    """Temperature of the cooler, whose six beds take 940 s each (LFI: arXiv:1303.5064)."""
    return np.sin(2.0 * np.pi * s.time_s / 5640.0) + 0.5 * np.sin(2.0 * np.pi * s.time_s / 940.0 + 1.0)


def eclipses(s):
    """An offset in the two months whose orbits have eclipses, strongest in their middle (DMR: astro-ph/9601066)."""
    return np.clip(1.0 - ((s.time_s / DAY_S - 75.0) / 30.0) ** 2, 0.0, None)


def refrigerator(s):
    """A gain that falls through each cycle of the refrigerator, 3 days (BICEP2: arXiv:1403.4302)."""
    return (s.time_s / (3.0 * DAY_S) % 1.0 - 0.5) * between(s, s.n)


def flares(s):
    """Glitches, thus noise, in twelve days of a solar flare (HFI: arXiv:1303.5071)."""
    days = np.abs(s.time_s / DAY_S - 50.0) < 6.0
    return days * np.random.default_rng([2033, int(s.time_s[0])]).normal(size=len(s.time_s))


def ferrite(s):
    """A switch that is magnetic: its offset follows the field along the beam's x axis (DMR: astro-ph/9601066)."""
    return np.array([0.5, 0.3, 0.81]) @ s.x


def sun_lobe(s):
    """The Sun as it crosses a narrow far sidelobe, 110 degrees from the line of sight (QUIET: arXiv:1012.3191)."""
    model = s.site.pointing.model
    turn = 2.0 * np.pi * s.time_s / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)
    sun = -np.stack([np.cos(turn), np.sin(turn), 0.0 * turn])
    return np.exp((np.sum(sun * beside(s, 110.0, np.deg2rad(-75.0)), axis=0) - 1.0) / 0.03)


def kinetic_quadrupole(s):
    """Second order of the motion that makes the dipole (astro-ph/0210165; LFI: arXiv:1505.08022)."""
    dipole = s.site.dipole_uk
    return (dipole @ s.n) ** 2 / (dipole @ dipole) - 1.0 / 3.0


def second_order(ghz):
    """Return that quadrupole's temperature at a frequency in units of its value at low frequencies: x/2 coth(x/2)."""
    half = 0.5 * ghz / 56.78
    return half / np.tanh(half)


def crosstalk(s):
    """Some of the detector beside it, 4 degrees away; the dipole has calibrated the sum (BICEP2: arXiv:1502.00608)."""
    return between(s, beside(s, 4.0, np.deg2rad(200.0))) - between(s, s.n)


def smearing(s):
    """The motion of the beam while a sample is integrated (WMAP: astro-ph/0302214)."""
    near = np.deg2rad(1.5)
    return between(s, s.spun(near)) + between(s, s.spun(-near)) - 2.0 * between(s, s.n)


def daytime(s):
    """A focus that the heat of the Sun moves, here with the seasons (ACT in daytime: arXiv:2007.07288)."""
    ring = [between(s, beside(s, 1.5, angle)) for angle in 0.25 * np.pi * np.arange(8)]
    return np.sin(2.0 * np.pi * s.time_s / YEAR_S) * (np.mean(ring, axis=0) - between(s, s.n))


def high_pass(s):
    """The mean of a turn of the spin is taken from its samples (filters of time lines, SPT: arXiv:1105.3182)."""
    return -np.mean([s.at(s.spun(angle)) for angle in 2.0 * np.pi * np.arange(48) / 48], axis=0)


def nutation(s):
    """A tilt of the spin axis in the spacecraft: the pointing nods once a spin (Planck: arXiv:1303.5062)."""
    moved = between(s, beside(s, 0.5, 0.5 * np.pi)) - between(s, beside(s, 0.5, -0.5 * np.pi))
    return np.cos(phase(s, s.site) - 0.7) * moved


CASES = (
    Case(cooler, (("added", "time", ANY, ANY),)),
    Case(eclipses, (("added", "time", ANY, ANY),)),
    Case(refrigerator, (("gain", "time", ANY, ANY),)),
    Case(flares, (("noise", "", ANY, ("half1",)),)),
    Case(
        ferrite,
        (("added", "spacecraft", ("orientation 1",), ALIKE), ("added", "sky", ("orientation 1",), ALIKE)),
    ),
    Case(sun_lobe, (("added", "Sun", ANY, ALIKE), ("added", "spacecraft", ANY, ALIKE))),
    Case(kinetic_quadrupole, (("added", "sky", ANY, ALIKE), ("square", "", ANY, ALIKE)), common=second_order),
    Case(crosstalk, (("beam", "scan", ("order 1",), ALIKE), ("elsewhere", "spacecraft", ANY, ALIKE))),
    Case(smearing, (("beam", "scan", ("order 0", "order 2"), ALIKE),)),
    Case(daytime, (("beam", "scan", ("order 0",), ("opposite",)), ("beam", "scan", ("order 0 year",), ALIKE))),
    Case(high_pass, (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE))),
    Case(nutation, (("beam", "scan", ("order 1",), ANY),)),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=96_000)
