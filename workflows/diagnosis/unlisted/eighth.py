"""Twenty more systematics of published error budgets, by someone who had read the scripts of the score alone.

python eighth.py [A:B]      cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described. Telescopes
on the ground and under balloons are told as if they turned as this instrument spins: azimuth and elevation follow its
phase.
"""

import os
import sys

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, YEAR_S, Case, main
from fourth import circle, decaying, year
from further import phase
from seventh import OPPOSITE
from sixth import FIRST, SECOND
from third import beside, between, second_order
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix

CLUSTERS = (  # galactic longitude and latitude, width through the beam (degrees), decrement: Virgo, Coma, Perseus
    (283.8, 74.5, 3.0, 1.0),
    (58.1, 88.0, 1.8, 0.8),
    (150.6, -13.3, 1.8, 0.6),
)


def ring(s, off_deg, number=8):
    """Return the mean of the signal at a distance from the line of sight, without what it keeps of a dipole."""
    around = [between(s, beside(s, off_deg, 2.0 * np.pi * k / number)) for k in range(number)]
    return np.mean(around, axis=0) / np.cos(np.deg2rad(off_deg)) - between(s, s.n)


def half(s):
    """Return 1 in the first half and -1 in the second one."""
    return np.sign(0.5 * YEAR_S - s.time_s)


def sine_of_declination(s):
    """Return the sine of the declination of the line of sight."""
    return rotation_matrix("ecliptic", "equatorial")[2] @ s.n


def hot_gas(s):
    """Hot gas of clusters nearby, which is left in the maps (Virgo's by Planck: arXiv:1511.05156)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    near = [(d, np.deg2rad(w), healpy.ang2vec(lon, lat, lonlat=True) @ g) for lon, lat, w, d in CLUSTERS]
    return sum(d * np.exp((cosine - 1.0) / w**2) for d, w, cosine in near)


def thermal_sz(ghz):
    """Return the change of the CMB's temperature by hot gas at a frequency, in units of y: x coth(x/2) - 4."""
    return 2.0 * second_order(ghz) - 4.0


def half_wave_plate(s):
    """Light of a plate that is turned on by 22.5 degrees twice a sidereal day (SPIDER: arXiv:0710.0375)."""
    turned = np.deg2rad(22.5) * (s.time_s // 43082.0)
    return np.cos(2.0 * turned - 0.4) + 0.6 * np.cos(4.0 * turned + 1.0)


def forbush(s):
    """Fewer cosmic rays for a week after storms of the Sun: the cold plate cools (HFI: arXiv:1303.5071).

    The mean of the year is subtracted.
    """
    days = s.time_s / DAY_S
    storms = ((21.0, 0.6), (68.0, 1.0), (131.0, 0.4), (207.0, 0.9), (290.0, 0.5))
    mean = sum(d * 7.0 / 365.25 for _, d in storms)
    return mean - sum(d * (days > t) * np.exp(-np.clip(days - t, 0.0, None) / 7.0) for t, d in storms)


def atmosphere(s):
    """Light of water vapour, which comes and goes within hours (POLARBEAR: arXiv:1501.07911)."""
    draw = np.random.default_rng([2049, int(s.time_s[0])])  # the same in both channels
    return sum(decaying(s, draw.normal(size=len(s.time_s)), one) for one in (3600.0, 14400.0, 57600.0))


def geomagnetic(s):
    """The Earth's field in the SQUIDs, once a turn; it grows as a balloon drifts away (SPIDER: arXiv:1102.0559)."""
    return (0.3 + s.time_s / YEAR_S) * np.cos(phase(s, s.site) - 0.5)


def loop(s):
    """Polarised light of Loop I since a plate that turned has got stuck, day 190 (loops of WMAP: arXiv:1410.4438).

    Its field runs along the loop, which is 58 degrees from its centre and brighter in the north.
    """
    to_ecliptic = rotation_matrix("galactic", "ecliptic")
    centre = to_ecliptic @ healpy.ang2vec(329.0, 17.5, lonlat=True)
    away = np.rad2deg(np.arccos(np.clip(centre @ s.n, -1.0, 1.0)))
    bright = np.exp(-0.5 * ((away - 58.0) / 5.0) ** 2) * (1.2 + to_ecliptic[:, 2] @ s.n)
    return (s.time_s > 190.0 * DAY_S) * bright * np.cos(2.0 * np.arctan2(centre @ s.y, centre @ s.x))


def two_sites(s):
    """Two telescopes whose calibrations differ, one for each hemisphere of the Earth (C-BASS: arXiv:1805.04490)."""
    return np.sign(sine_of_declination(s)) * between(s, s.n)


def enclosure(s):
    """Electronics that the Sun heats by day, since their cooling fails on day 190 (QUIET: arXiv:1207.5562)."""
    heat = np.clip(np.sin(2.0 * np.pi * s.time_s / DAY_S + 0.8), 0.0, None)
    return (s.time_s > 190.0 * DAY_S) * heat * between(s, s.n)


def two_seasons(s):
    """Two seasons, here the halves, that are calibrated by themselves, with other errors (ACT: arXiv:1009.0777)."""
    return half(s) * between(s, s.n)


def frost(s):
    """Air that freezes on open optics and dims the sky, until these are warmed: day 160 (ARCADE 2: arXiv:0901.0546)."""
    return (s.time_s < 160.0 * DAY_S) * (-s.time_s / (160.0 * DAY_S)) * between(s, s.n)


def resonators(s):
    """Resonators read out above, and in the second half below resonance: curvature (GroundBIRD: arXiv:2509.20285)."""
    return half(s) * (s.at(s.n) / np.linalg.norm(s.site.dipole_uk)) ** 2


def linearised(s):
    """A spectrum's second order, which makes y of the CMB times the dipole, in linear units (arXiv:1510.08793).

    The square of the dipole itself is taken away with the quadrupole of the motion.
    """
    dipole = s.site.dipole_uk @ s.n
    sky = between(s, s.n) - dipole
    return (2.0 * dipole + sky) * sky / np.linalg.norm(s.site.dipole_uk)


def surface(s):
    """Light that a rough mirror scatters by some degrees, more at high frequencies (Ruze, ACT: arXiv:2112.12226)."""
    return sum(off * np.exp(-0.5 * (off / 5.0) ** 2) * ring(s, off, 12) for off in (3.0, 6.0, 9.0))


def turned_ellipse(s):
    """An elliptic beam, turned by 90 degrees with the boresight at half time (BICEP2 and Keck: arXiv:1904.01640)."""
    angles = 0.25 * np.pi * np.arange(8)
    return half(s) * np.mean([np.cos(2.0 * a - 0.8) * between(s, beside(s, 1.5, a)) for a in angles], axis=0)


def sun_sensor(s):
    """An attitude that is turned about the line to the Sun, which all else is measured from (arXiv:1407.1883)."""
    turn = np.deg2rad(0.25) * np.cross(circle(year(s)), s.n, axis=0)
    return between(s, s.n + turn) - between(s, s.n - turn)


def sluggish(s):
    """A bolometer slower, by 1 s, until its bias is set anew on day 150 (time constants: arXiv:2403.16620)."""
    return (s.time_s < 150.0 * DAY_S) * (between(s, s.spun(np.deg2rad(2.8))) - between(s, s.n))


def triple_beam(s):
    """What is left of beams on both sides, 8.1 degrees away, that are switched to (Tenerife: astro-ph/9903196)."""
    sides = between(s, beside(s, 8.1, 0.0)) + between(s, beside(s, 8.1, np.pi))
    return between(s, s.n) - 0.5 * sides / np.cos(np.deg2rad(8.1))  # the dipole has calibrated it


def gravity(s):
    """A dish that sags with elevation, and is in focus at the mean of a turn (Effelsberg: arXiv:2109.00006)."""
    return np.cos(phase(s, s.site)) * ring(s, 1.5)


def spikes(s):
    """Hits of cosmic rays that are not found, a sample each; their mean is subtracted (SPIDER: arXiv:2002.05771)."""
    draw = np.random.default_rng([2050, int(s.time_s[0])])
    return (draw.random(len(s.time_s)) < 0.01) * draw.exponential(size=len(s.time_s)) - 0.01


def low_elevation(s):
    """White noise that grows with the air before a declination, seen from 37 degrees north (NIKA2: arXiv:1910.02038).

    Seen at its highest, and no more than 2.9 times the air of the zenith.
    """
    declination = np.arcsin(np.clip(sine_of_declination(s), -1.0, 1.0))
    draw = np.random.default_rng([2051, int(s.time_s[0]), int(s.site.frequency_ghz)])  # not the same in both channels
    return draw.normal(size=len(s.time_s)) / np.maximum(np.cos(declination - np.deg2rad(37.1)), 0.35)


CASES = (
    Case(hot_gas, (("added", "sky", ANY, ALIKE),), common=thermal_sz),
    Case(half_wave_plate, (("added", "time", ANY, ANY),)),
    Case(forbush, (("added", "time", ANY, ANY),), common=lambda ghz: 1.0),
    # It is noise by its origin, but the same in both channels: a signal, in the cross-spectra.
    Case(
        atmosphere,
        (("added", "time", ANY, ANY), ("noise", "", ANY, ALIKE)),
        common=lambda ghz: (ghz / 94.0) ** 2.0,
    ),
    Case(geomagnetic, (("added", "time", ("spin",), ANY),), common=lambda ghz: 1.0),
    # A polarised sky is fixed to the sky, and follows the orientation of the instrument.
    Case(
        loop,
        (("added", "spacecraft", ("orientation 2",), SECOND), ("added", "sky", ("orientation 2",), SECOND)),
        common=lambda ghz: (ghz / 94.0) ** -3.0,
    ),
    Case(two_sites, (("gain", "sky", ANY, ALIKE),)),
    # Of heat that comes by day alone the mean is most of what is left in the maps: it is not calibrated.
    Case(enclosure, (("gain", "time", ANY, SECOND), ("gain", "", ("constant",), SECOND))),
    # A step at half time is a constant of each half.
    Case(two_seasons, (("gain", "", ("constant",), OPPOSITE), ("gain", "time", ANY, ANY))),
    Case(frost, (("gain", "time", ANY, FIRST),), common=lambda ghz: (ghz / 94.0) ** 2.0),
    # Of the square, the dipole times the signal is a gain that is fixed to the sky.
    Case(resonators, (("square", "", ANY, OPPOSITE), ("gain", "sky", ANY, OPPOSITE))),
    Case(
        linearised,
        (("modulation", "sky", ("degree 1",), ALIKE),),
        common=lambda ghz: second_order(ghz) - 1.0,
    ),
    Case(surface, (("beam", "scan", ("order 0",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** 2.0),
    Case(turned_ellipse, (("beam", "scan", ("order 2",), OPPOSITE),)),
    # The spin axis is 22.5 degrees from that line: nearly all of it is a constant shift along the scan. Three quarters
    # of the variance that it leaves in these maps are a change of the dipole, whose sign follows the Sun's place.
    Case(
        sun_sensor,
        (
            ("rotation", "Sun", ANY, ALIKE),
            ("beam", "scan", ("order 1",), ALIKE),
            ("added", "sky", ("dipole",), OPPOSITE),
        ),
        common=lambda ghz: 1.0,
    ),
    Case(sluggish, (("beam", "scan", ("order 1",), FIRST),)),
    # Two lobes far from the beam, or the orders 0 and 2 of a wide one.
    Case(triple_beam, (("beam", "scan", ("order 0", "order 2"), ALIKE), ("elsewhere", "spacecraft", ANY, ALIKE))),
    Case(gravity, (("beam", "scan", ("order 0",), ANY),)),
    Case(spikes, (("noise", "", ANY, ALIKE),)),
    Case(low_elevation, (("noise", "", ANY, ALIKE),), common=lambda ghz: 1.0),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=103_000, strengths=(8.0, 16.0))
