"""Twenty more systematics of published error budgets, by someone who had read the scripts of the score alone.

python seventh.py [A:B]     cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described. Samples
of this instrument lie 31 s apart: what moves a beam faster than that acts by its mean, as in all the samples that
a real one takes meanwhile.
"""

import os
import sys
from functools import cache

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, FINE, YEAR_S, Case, main
from fourth import circle, year
from further import phase
from sixth import FIRST, SECOND, elongation, shifted
from third import beside, between, second_order
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix

OPPOSITE = ("opposite",)
CLOUDS = (  # galactic longitude and latitude in degrees, brightness: Orion A and B, Taurus, Ophiuchus, Cygnus X, ...
    (211.0, -19.5, 1.0),
    (206.0, -16.0, 0.8),
    (172.0, -15.0, 0.4),
    (353.0, 17.0, 0.5),
    (80.0, 0.5, 2.0),
    (111.0, 2.0, 1.0),
    (134.0, 1.0, 0.8),
    (287.5, -0.7, 1.5),
    (160.0, -19.0, 0.4),
)


@cache
def clustered():
    """Return a Gaussian map of nside FINE whose C_l falls as 1 / l, of unit variance, through a beam of 3.5 degrees."""
    ell, draw = np.arange(65.0), np.random.default_rng(2043)
    alm = draw.normal(size=(healpy.Alm.getsize(64), 2)) @ [1.0, 1j]
    alm[:65] = np.sqrt(2.0) * alm[:65].real
    spectrum = np.where(ell < 2.0, 0.0, 1.0 / np.maximum(ell, 1.0))
    field = healpy.alm2map(healpy.almxfl(alm, np.sqrt(spectrum) * healpy.gauss_beam(np.deg2rad(3.5), 64)), FINE)
    return field / np.std(field)


def carbon_monoxide(s):
    """A line of CO in the band, from the disc within 60 degrees and from clouds (Planck: arXiv:1303.5073)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    longitude, latitude = np.rad2deg(np.arctan2(g[1], g[0])), np.rad2deg(np.arcsin(np.clip(g[2], -1.0, 1.0)))
    disc = 4.0 * np.exp(-0.5 * (latitude / 1.8) ** 2) / (1.0 + (longitude / 45.0) ** 6)
    clouds = [b * np.exp((healpy.ang2vec(x, y, lonlat=True) @ g - 1.0) / np.deg2rad(2.0) ** 2) for x, y, b in CLOUDS]
    return disc + np.sum(clouds, axis=0)


def infrared_background(s):
    """Galaxies too many to be told apart, in all channels: they are clustered (Planck: arXiv:1309.0382)."""
    return clustered()[healpy.vec2pix(FINE, *s.n)]


def earthshine(s):
    """The Earth over the rim of the shield, in a season about day 95; it stands by the Sun (DMR: astro-ph/9601066)."""
    season = np.clip(1.0 - ((s.time_s / DAY_S - 95.0) / 60.0) ** 2, 0.0, None)
    return season * np.exp((87.0 - elongation(s)) / 9.0)


def template(s):
    """Pickup of the ground changes on day 176; its mean of the year is subtracted (POLARBEAR: arXiv:1403.2369)."""
    turn = phase(s, s.site)
    later = (s.time_s > 176.0 * DAY_S) - (1.0 - 176.0 / 365.25)
    return later * (np.cos(turn + 1.1) + 0.5 * np.sin(3.0 * turn + 0.4))


def lines(s):
    """Interference of a cooler's drive, by a third harmonic of the spin; the phase wanders (HFI: arXiv:1303.5067)."""
    wander = np.cumsum(np.random.default_rng(2044).normal(scale=0.5, size=400))
    return np.cos(3.0 * phase(s, s.site) + wander[(s.time_s / DAY_S).astype(int)])


def mirrors(s):
    """Emission of mirrors that are warmest at perihelion, longitude 103 degrees (Planck: arXiv:1101.2023)."""
    return np.cos(year(s) - np.deg2rad(103.0))


def ice_clouds(s):
    """Light of the ground that clouds scatter, polarised along the horizon; a season's (POLARBEAR: arXiv:1809.06556).

    Fields are observed near the meridian, where the horizon is a parallel of declination.
    """
    pole = rotation_matrix("ecliptic", "equatorial")[2]
    cloudy = np.random.default_rng(2045).random(400) < 0.4
    angle = np.arctan2(pole @ s.y, pole @ s.x)
    return (s.time_s < 160.0 * DAY_S) * cloudy[(s.time_s / DAY_S).astype(int)] * np.cos(2.0 * angle)


def other_horn(s):
    """Unequal losses of two horns 60 degrees apart, whose difference is measured (WMAP, DMR: astro-ph/0302224)."""
    return -between(s, s.spun(np.deg2rad(64.0)))


def opacity(s):
    """Water vapour that dims the sky, from day to day, more at high frequencies (ACT: arXiv:1208.0050).

    Each half of the year is a season that is calibrated by itself.
    """
    draw, vapour = np.random.default_rng(2046).normal(size=366), np.zeros(366)
    for day in range(1, 366):
        vapour[day] = 0.75 * vapour[day - 1] + draw[day]
    seasons = vapour.reshape(2, 183)
    vapour = (seasons - np.mean(seasons, axis=1, keepdims=True)).ravel()
    return -vapour[(s.time_s / DAY_S).astype(int)] * between(s, s.n)


def airmass(s):
    """A gain that falls with the air before a declination, near a line of water (QUIJOTE: arXiv:2510.19878).

    Seen at its highest from 28 degrees north, and no more than 2.9 times the air of the zenith.
    """

    def air(sine):
        return 1.0 / np.maximum(np.cos(np.arcsin(np.clip(sine, -1.0, 1.0)) - np.deg2rad(28.3)), 0.35)

    mean = np.mean(air(np.linspace(-1.0, 1.0, 2001)))  # the mean gain is calibrated
    return (mean - air(rotation_matrix("ecliptic", "equatorial")[2] @ s.n)) * between(s, s.n)


def saturn_rings(s):
    """All channels are calibrated on Saturn, whose rings have opened by day 184 (Saturn by WMAP: arXiv:1001.4731)."""
    return (s.time_s > 184.0 * DAY_S) * between(s, s.n)


def boosted(s):
    """The orbit's motion times the Sun's, left out of the orbital dipole (second order: arXiv:1504.04897).

    That motion makes whatever is seen brighter ahead and fainter behind, and a clock slow.
    """
    motion, dipole = circle(year(s) + 0.5 * np.pi), s.site.dipole_uk
    return np.sum(motion * s.n, axis=0) * between(s, s.n) - 0.5 * dipole @ motion


def hot_bias(s):
    """A TES biased higher in its transition from day 188 on, whose response bends (POLARBEAR: arXiv:1702.07111)."""
    return (s.time_s > 188.0 * DAY_S) * (s.at(s.n) / np.linalg.norm(s.site.dipole_uk)) ** 2


def dimples(s):
    """Six grating lobes, 6 degrees away, of the honeycomb under a mirror's skin (Planck's: Tauber et al. 2019)."""
    lobes = [between(s, beside(s, 6.0, 0.2 + np.pi * k / 3.0)) for k in range(6)]
    return np.mean(lobes, axis=0) - between(s, s.n)


def pendulum(s):
    """A gondola that swings in elevation within seconds, across the scan (BOOMERanG: astro-ph/0206254)."""
    ends = [between(s, beside(s, 1.5, angle)) for angle in (0.5 * np.pi, -0.5 * np.pi)]
    return np.mean(ends, axis=0) - between(s, s.n)


def gyroscopes(s):
    """Gyroscopes err more between images of stars, 40 s apart, from day 200 on (balloons, EBEX: arXiv:1602.03249)."""
    ring = [between(s, beside(s, 1.5, angle)) for angle in 0.25 * np.pi * np.arange(8)]
    return (s.time_s > 200.0 * DAY_S) * (np.mean(ring, axis=0) - between(s, s.n))


def boresight(s):
    """A detector off its pair's centre; the boresight is turned over at half time (BICEP2: arXiv:1502.00608)."""
    return np.sign(0.5 * YEAR_S - s.time_s) * shifted(s, 0.6, np.deg2rad(-35.0))


def encoder(s):
    """The zero of an azimuth encoder at the South Pole, after repair on day 196: right ascension moves (a worry)."""
    moved = np.deg2rad(0.5) * np.cross(rotation_matrix("ecliptic", "equatorial")[2], s.n, axisb=0).T
    return (s.time_s > 196.0 * DAY_S) * (between(s, s.n + moved) - between(s, s.n - moved))


def slow_readout(s):
    """White noise aliased by the readout of all detectors, until that is faster: day 178 (BICEP2: arXiv:1403.4302)."""
    draw = np.random.default_rng([2047, int(s.time_s[0]), int(s.site.frequency_ghz)])  # not the same in both channels
    return (s.time_s < 178.0 * DAY_S) * draw.normal(size=len(s.time_s))


def sunlit(s):
    """Photon noise of stray sunlight, more of it nearer the Sun (noise by load, CLASS: arXiv:1811.08287)."""
    level = np.exp((87.0 - elongation(s)) / 24.0)
    return level * np.random.default_rng([2048, int(s.time_s[0])]).normal(size=len(s.time_s))


CASES = (
    Case(carbon_monoxide, (("added", "sky", ANY, ALIKE),)),
    # One realization of a field is a pattern on the sky, too.
    Case(
        infrared_background,
        (("power", "", ANY, ALIKE), ("added", "sky", ANY, ALIKE)),
        common=lambda ghz: (ghz / 94.0) ** 1.4,
    ),
    # The angle to the Sun is a function of the spin's phase, as in sixth.py.
    Case(earthshine, (("added", "Sun", ("elongation",), FIRST), ("added", "time", ("spin",), FIRST))),
    Case(template, (("added", "time", ("spin",), OPPOSITE),)),
    Case(lines, (("added", "time", ANY, ANY),)),
    # The means of the halves, which differ in sign, are nearly all that is left of it in the maps.
    Case(
        mirrors,
        (("added", "time", ("year",), ANY), ("added", "sky", ("monopole",), OPPOSITE)),
        common=lambda ghz: (ghz / 94.0) ** 0.5,
    ),
    Case(
        ice_clouds,
        (("added", "spacecraft", ("orientation 2",), FIRST), ("added", "sky", ("orientation 2",), FIRST)),
    ),
    Case(other_horn, (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE))),
    Case(opacity, (("gain", "time", ANY, ANY),), common=lambda ghz: (ghz / 94.0) ** 2.0),
    Case(airmass, (("gain", "sky", ANY, ALIKE),)),
    Case(saturn_rings, (("gain", "", ("constant",), SECOND),), common=lambda ghz: 1.0),
    # It acts on the dipole and on all else that is seen: a gain, fixed to the direction of the motion.
    Case(boosted, (("gain", "Sun", ANY, ALIKE),), common=second_order),
    Case(hot_bias, (("square", "", ANY, SECOND),)),
    # The mean over all directions of the scan is a ring.
    Case(dimples, (("beam", "scan", ("order 0", "order 6"), ALIKE),)),
    Case(pendulum, (("beam", "scan", ("order 0", "order 2"), ALIKE),), common=lambda ghz: 1.0),
    Case(gyroscopes, (("beam", "scan", ("order 0",), SECOND),), common=lambda ghz: 1.0),
    Case(boresight, (("beam", "scan", ("order 1",), OPPOSITE),)),
    # Nearly all that a turn of the sky leaves in these maps is the change of the dipole.
    Case(
        encoder,
        (("rotation", "sky", ANY, SECOND), ("added", "sky", ("dipole",), SECOND)),
        common=lambda ghz: 1.0,
    ),
    Case(slow_readout, (("noise", "", ANY, FIRST),), common=lambda ghz: 1.0),
    Case(sunlit, (("noise", "", ANY, ALIKE),)),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=101_000, strengths=(8.0, 16.0))
