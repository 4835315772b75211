"""Fifteen more systematics of published error budgets, by someone who had read the scripts of the score alone.

python fourth.py [A:B]      cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described.
"""

import os
import sys

import numpy as np
from budgets import ALIKE, DAY_S, YEAR_S, Case, main
from further import phase
from scipy.signal import lfilter
from third import beside, between
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix


def year(s):
    """Return the longitude of the Earth as seen from the Sun, which is that of the anti-Sun direction, radians."""
    model = s.site.pointing.model
    return 2.0 * np.pi * s.time_s / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)


def circle(longitude):
    """Return unit vectors in the ecliptic, shape (3, n)."""
    return np.stack([np.cos(longitude), np.sin(longitude), 0.0 * longitude])


def decaying(s, drive, lifetime_s):
    """Return a memory of what drives it, which it forgets within a lifetime, shape (n,)."""
    kept = np.exp(-np.median(np.diff(s.time_s)) / lifetime_s)
    return lfilter([1.0], [1.0, -kept], drive)


def jupiter(s):
    """A planet that is not cut out, in opposition on day 75: seen in two seasons (WMAP: arXiv:1001.4731)."""
    opposition = 2.0 * np.pi * 75.0 * DAY_S / YEAR_S + np.deg2rad(s.site.pointing.model.orbit_phase_deg)
    far = 5.2 * circle(opposition + 2.0 * np.pi * (s.time_s - 75.0 * DAY_S) / (11.86 * YEAR_S)) - circle(year(s))
    distance = np.linalg.norm(far, axis=0)
    sigma = np.deg2rad(3.5) / np.sqrt(8.0 * np.log(2.0))
    return np.exp((np.sum(far * s.n, axis=0) / distance - 1.0) / sigma**2) / distance**2


def cooldown(s):
    """An offset of all channels while the instrument still cools after launch, 25 days (Planck: arXiv:1101.2023)."""
    return np.exp(-s.time_s / (25.0 * DAY_S))


def precession(s):
    """An offset that follows the spin axis about the Sun, as heat on the bus may do (WMAP: astro-ph/0302224)."""
    model = s.site.pointing.model
    return np.cos(2.0 * np.pi * s.time_s / model.precession_period_s + np.deg2rad(model.precession_phase_deg) + 0.8)


def showers(s):
    """Particles that heat the cold plate of all detectors, 5 a day; each tail is 40 minutes (HFI: arXiv:1303.5071)."""
    draw = np.random.default_rng([2034, int(s.time_s[0])])  # the same in both channels
    hits = draw.random(len(s.time_s)) < 5.0 * np.median(np.diff(s.time_s)) / DAY_S
    return decaying(s, hits * draw.exponential(size=len(s.time_s)), 2400.0)


def wake(s):
    """Interplanetary dust that trails the Earth, 85 degrees from the Sun (DIRBE: astro-ph/9806250)."""
    off = np.deg2rad(85.0)
    trailing = -np.cos(off) * circle(year(s)) - np.sin(off) * circle(year(s) + 0.5 * np.pi)
    return np.exp((np.sum(trailing * s.n, axis=0) - 1.0) / 0.1)


def satellites(s):
    """Geostationary satellites, near one declination, as in maps from the ground (QUIJOTE MFI: arXiv:2301.05113)."""
    declination = np.arcsin(np.clip((rotation_matrix("ecliptic", "equatorial") @ s.n)[2], -1.0, 1.0))
    return np.exp(-0.5 * (np.rad2deg(declination + np.deg2rad(4.5)) / 6.0) ** 2)


def gain_jump(s):
    """A gain that jumps on day 120, as when a cooler is exchanged for its spare (LFI: arXiv:1303.5066)."""
    return (s.time_s > 120.0 * DAY_S) * between(s, s.n)


def struts(s):
    """A gain that follows the shade of two struts, twice a spin, from day 200 on (a worry about amplifiers' heat)."""
    return (s.time_s > 200.0 * DAY_S) * np.cos(2.0 * phase(s, s.site) - 0.9) * between(s, s.n)


def warping(s):
    """A mirror that warps more and more: the beam becomes elliptic through the year (WMAP: arXiv:0803.0570)."""
    ring = [np.cos(2.0 * angle - 0.6) * between(s, beside(s, 1.5, angle)) for angle in 0.25 * np.pi * np.arange(8)]
    return s.time_s / YEAR_S * np.mean(ring, axis=0)


def star_tracker(s):
    """Pointing that jumps on day 215, as the support of the star tracker bends (HFI: arXiv:1303.5067, Fig. 9)."""
    angle = np.deg2rad(40.0)
    moved = between(s, beside(s, 0.5, angle)) - between(s, beside(s, 0.5, angle + np.pi))
    return (s.time_s > 215.0 * DAY_S) * moved


def exhausted(s):
    """White noise that rises in the last weeks, with the end of the coolant (HFI at its end: arXiv:1303.5062)."""
    level = np.exp((s.time_s - YEAR_S) / (20.0 * DAY_S))
    return level * np.random.default_rng([2035, int(s.time_s[0])]).normal(size=len(s.time_s))


def flicker(s):
    """1/f noise of an amplifier, from minutes to a day (radiometers of WMAP: astro-ph/0301164)."""
    draw, lifetimes_s = np.random.default_rng([2036, int(s.time_s[0])]), (100.0, 400.0, 1600.0, 6400.0, 25600.0)
    return sum(decaying(s, draw.normal(size=len(s.time_s)), one) / np.sqrt(one) for one in lifetimes_s)


def compression(s):
    """An amplifier that saturates, at both signs; the dipole has calibrated it (LFI receivers: arXiv:1001.4610)."""
    signal = s.at(s.n) / np.linalg.norm(s.site.dipole_uk)
    return 0.6 * signal - signal**3


def leakage(s):
    """Some of the detector on the other side of the spacecraft, through its cables (crosstalk: arXiv:1502.00608)."""
    return between(s, s.spun(np.pi))


def gyroscope(s):
    """An attitude that drifts about an axis in space, 1 degree in a year (WMAP's attitude: astro-ph/0302222)."""
    turn = np.deg2rad(0.5) * s.time_s / YEAR_S * np.cross([0.42, -0.5, 0.76], s.n, axisb=0).T
    return between(s, s.n + turn) - between(s, s.n - turn)


CASES = (
    Case(jupiter, (("added", "sky", ANY, ("half1",)),)),
    Case(cooldown, (("added", "time", ANY, ANY),), common=lambda ghz: 1.0),
    Case(precession, (("added", "time", ANY, ALIKE),)),
    # They are noise by their origin, but the same in both channels: a signal, in the cross-spectra.
    Case(showers, (("added", "time", ANY, ANY), ("noise", "", ANY, ALIKE)), common=lambda ghz: 1.0),
    Case(wake, (("added", "Sun", ANY, ALIKE),), common=lambda ghz: (ghz / 94.0) ** 1.5),
    Case(satellites, (("added", "sky", ANY, ALIKE),)),
    Case(gain_jump, (("gain", "time", ANY, ANY),)),
    Case(struts, (("gain", "time", ("spin",), ("half2",)),)),
    Case(warping, (("beam", "scan", ("order 2",), ANY),)),
    Case(star_tracker, (("beam", "scan", ("order 1",), ("half2",)),)),
    Case(exhausted, (("noise", "", ANY, ("half2",)),)),
    Case(flicker, (("noise", "", ANY, ALIKE), ("added", "time", ANY, ANY))),
    # Of the cube, the square of the dipole times the signal is a gain that is fixed to the sky.
    Case(compression, (("square", "", ANY, ALIKE), ("gain", "sky", ANY, ALIKE))),
    Case(leakage, (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE))),
    Case(gyroscope, (("rotation", "sky", ANY, ANY),)),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=97_000, strengths=(8.0, 16.0))
