"""Twenty more systematics of published error budgets, by someone who had read the scripts of the score alone.

python sixth.py [A:B]       cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described.
"""

import os
import sys

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, YEAR_S, Case, main
from fourth import circle, year
from further import phase
from third import beside, between
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix

FIRST, SECOND = ("half1",), ("half2",)


def elongation(s):
    """Return the angle between the line of sight and the Sun, degrees."""
    return np.rad2deg(np.arccos(np.clip(-np.sum(circle(year(s)) * s.n, axis=0), -1.0, 1.0)))


def shifted(s, off_deg, angle):
    """Return the change of the signal when the beam moves by an offset, at an angle from its x axis (radians)."""
    return between(s, beside(s, 0.5 * off_deg, angle)) - between(s, beside(s, 0.5 * off_deg, angle + np.pi))


def haze(s):
    """Hard synchrotron light about the Galactic centre, which no template has (Planck: arXiv:1208.5483)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    longitude, latitude = np.rad2deg(np.arctan2(g[1], g[0])), np.rad2deg(np.arcsin(np.clip(g[2], -1.0, 1.0)))
    return np.exp(-0.5 * (longitude / 15.0) ** 2 - 0.5 * (latitude / 25.0) ** 2)


def quasar(s):
    """The quasar 3C 345, which flares for a hundred days about day 240 (variable sources, Planck: arXiv:1101.2047)."""
    source = rotation_matrix("galactic", "ecliptic") @ healpy.ang2vec(63.46, 40.95, lonlat=True)
    sigma = np.deg2rad(3.5) / np.sqrt(8.0 * np.log(2.0))
    flare = np.clip(1.0 - ((s.time_s / DAY_S - 240.0) / 50.0) ** 2, 0.0, None)
    return flare * np.exp((source @ s.n - 1.0) / sigma**2)


def baselines(s):
    """What destriping leaves: an error of the offset of each baseline, here of 4 hours (Madam: arXiv:0907.0367)."""
    return np.random.default_rng(2039).normal(size=2200)[(s.time_s / (4.0 * 3600.0)).astype(int)]


def transmitter(s):
    """Heat of the back end, once a day until the transmitter is left on, day 165 (LFI: arXiv:1303.5064)."""
    return (s.time_s < 165.0 * DAY_S) * np.sin(2.0 * np.pi * s.time_s / DAY_S + 0.4)


def ground(s):
    """Light of the surroundings, which follows the turn until a screen is built, day 150 (QUIET: arXiv:1207.5034)."""
    turn = phase(s, s.site)
    profile = np.sin(turn + 0.3) + 0.7 * np.sin(2.0 * turn - 0.8) + 0.4 * np.cos(3.0 * turn + 2.0)
    return (s.time_s < 150.0 * DAY_S) * profile


def jump(s):
    """A step of the offset that was not found, from day 262 until a reset on day 310 (HFI: arXiv:1303.5067)."""
    days = s.time_s / DAY_S
    return ((days > 262.0) & (days < 310.0)).astype(float)


def ring_lobe(s):
    """The Sun on a ring that a baffle scatters, 108 degrees from the line of sight (ACT: arXiv:1903.04689)."""
    return np.exp(-0.5 * ((elongation(s) - 108.0) / 6.0) ** 2)


def loading(s):
    """Scattered sunlight loads a detector, whose response falls near the Sun (load of CLASS: arXiv:1811.08287)."""
    load = np.exp((87.0 - elongation(s)) / 10.0)
    return (np.mean(load) - load) * between(s, s.n)  # the mean gain is calibrated


def ageing(s):
    """A gain that drifts steadily through the year; the mean of the year is right (DMR: astro-ph/9601066)."""
    return (s.time_s / YEAR_S - 0.5) * between(s, s.n)


def lost_telemetry(s):
    """Data of all channels lost in days 270 to 292, and filled with zeros (gaps of LFI: arXiv:1303.5063)."""
    days = s.time_s / DAY_S
    return -1.0 * ((days > 270.0) & (days < 292.0)) * between(s, s.n)


def trefoil(s):
    """A mirror held at three points, thus a beam with three corners (third order, HFI: arXiv:1303.5068)."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    return np.mean([np.cos(3.0 * (angle - 0.5)) * between(s, beside(s, 2.0, angle)) for angle in angles], axis=0)


def cold_focus(s):
    """A telescope out of focus until it is cold: 20 days, for all channels (Planck's cools down: arXiv:1101.2023)."""
    ring = [between(s, beside(s, 1.5, angle)) for angle in 0.25 * np.pi * np.arange(8)]
    return np.exp(-s.time_s / (20.0 * DAY_S)) * (np.mean(ring, axis=0) - between(s, s.n))


def clock(s):
    """Clocks of pointing and data that run apart until set anew, each 40 days (timing of WMAP: arXiv:1009.2701)."""
    return (s.time_s / (40.0 * DAY_S) % 1.0) * shifted(s, 1.0, 0.0)


def refocus(s):
    """Pointing that moves, always the same way, when focus is set on days 70, 160 and 250 (ACT: arXiv:1303.4714)."""
    moves = np.searchsorted([70.0, 160.0, 250.0], s.time_s / DAY_S)
    return moves * shifted(s, 1.0, np.deg2rad(110.0))


def ringing(s):
    """A resonance of the electronics: after a signal they ring, each 24 degrees of the spin (HFI: arXiv:1101.2048)."""
    angles = np.deg2rad(np.arange(3.0, 63.0, 3.0))
    weights = np.exp(-angles / np.deg2rad(20.0)) * np.cos(2.0 * np.pi * angles / np.deg2rad(24.0))
    now = s.at(s.n)
    return sum(w * (s.at(s.spun(a)) - now) for w, a in zip(weights, angles, strict=True))


def multiplexer(s):
    """Some of a detector 12 degrees away, next in the readout since that is tuned anew (SPT-3G: arXiv:2106.11202)."""
    return (s.time_s > 195.0 * DAY_S) * (between(s, beside(s, 12.0, np.deg2rad(65.0))) - between(s, s.n))


def squid(s):
    """A periodic response of the SQUID that feedback does not straighten (readout of SPT: arXiv:1112.4215)."""
    signal = s.at(s.n) / np.linalg.norm(s.site.dipole_uk)
    return np.cos(2.0 * signal + 0.3) + 2.0 * np.sin(0.3) * signal  # the dipole has calibrated it


def untuned(s):
    """White noise of an amplifier before its bias is tuned, until day 45 (LFI in flight: arXiv:1307.2029)."""
    noise = np.random.default_rng([2040, int(s.time_s[0])]).normal(size=len(s.time_s))
    return (s.time_s < 45.0 * DAY_S) * noise


def weather(s):
    """White noise that is another each day, as the water vapour over a telescope (ACT: arXiv:1208.0050)."""
    level = np.random.default_rng(2041).lognormal(sigma=0.8, size=400)[(s.time_s / DAY_S).astype(int)]
    return level * np.random.default_rng([2042, int(s.time_s[0])]).normal(size=len(s.time_s))


def cleaned_away(s):
    """Some of the CMB that goes with the foregrounds, near the Galaxy (bias of an ILC: arXiv:0807.0773)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    return -np.exp(-0.5 * (g[2] / np.sin(np.deg2rad(20.0))) ** 2) * (between(s, s.n) - s.site.dipole_uk @ s.n)


CASES = (
    Case(haze, (("added", "sky", ANY, ALIKE),), common=lambda ghz: (ghz / 94.0) ** -2.56),
    Case(quasar, (("added", "sky", ANY, SECOND),), common=lambda ghz: (ghz / 94.0) ** -2.0),
    Case(baselines, (("added", "time", ANY, ANY), ("noise", "", ANY, ALIKE))),
    Case(transmitter, (("added", "time", ANY, FIRST),), common=lambda ghz: 1.0),
    Case(ground, (("added", "time", ("spin",), FIRST),)),
    Case(jump, (("added", "time", ANY, SECOND),)),
    # The angle to the Sun is a function of the spin's phase, which is counted from the Sun.
    Case(ring_lobe, (("added", "Sun", ("elongation",), ALIKE), ("added", "time", ("spin",), ALIKE))),
    Case(loading, (("gain", "Sun", ANY, ALIKE), ("gain", "time", ("spin",), ALIKE))),
    # Of a line through zero, the means of the halves are most.
    Case(ageing, (("gain", "time", ANY, ANY), ("gain", "", ("constant",), ("opposite",)))),
    Case(lost_telemetry, (("gain", "time", ANY, SECOND),), common=lambda ghz: 1.0),
    Case(trefoil, (("beam", "scan", ("order 3",), ALIKE),)),
    Case(cold_focus, (("beam", "scan", ("order 0",), FIRST),), common=lambda ghz: 1.0),
    Case(clock, (("beam", "scan", ("order 1",), ALIKE),), common=lambda ghz: 1.0),
    Case(refocus, (("beam", "scan", ("order 1",), ANY),)),
    Case(ringing, (("elsewhere", "spacecraft", ANY, ALIKE), ("beam", "scan", ("order 1",), ALIKE))),
    Case(multiplexer, (("elsewhere", "spacecraft", ANY, SECOND), ("added", "spacecraft", ("lobe",), SECOND))),
    # Of the cube, the square of the dipole times the signal is a gain that is fixed to the sky, as of the square.
    Case(squid, (("square", "", ANY, ALIKE), ("gain", "sky", ANY, ALIKE))),
    Case(untuned, (("noise", "", ANY, FIRST),)),
    Case(weather, (("noise", "", ANY, ALIKE),)),
    # The dipole was taken away before: no gain, which would act on it too.
    Case(cleaned_away, (("modulation", "sky", ANY, ALIKE),), common=lambda ghz: 1.0),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=99_000, strengths=(8.0, 16.0))
