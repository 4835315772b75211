"""Twenty more systematics of published error budgets, by someone who had read the scripts of the score alone.

python tenth.py [A:B]       cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described. Telescopes
on the ground are told as if they turned as this instrument spins, as in eighth.py.
"""

import os
import sys

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, Case, main
from eighth import half, sine_of_declination
from fourth import circle, year
from further import phase
from seventh import OPPOSITE
from sixth import FIRST, SECOND, shifted
from third import beside, between
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix

BLAZARS = (  # galactic longitude and latitude (degrees), change: 3C 273, 3C 279, 3C 454.3, 3C 84, OJ 287
    (289.95, 64.36, 1.0),
    (305.10, 57.06, -0.8),
    (86.11, -38.18, -1.0),
    (150.58, -13.26, 0.7),
    (206.81, 35.82, -0.4),
)


def galactic(s):
    """Return galactic longitude and latitude of the line of sight, radians."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    return np.arctan2(g[1], g[0]), np.arcsin(np.clip(g[2], -1.0, 1.0))


def gould_belt(s):
    """Spinning dust of the Gould Belt, a circle of clouds about the Sun, tilted by 18 degrees (arXiv:1301.5839)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    tilt, node = np.deg2rad(18.0), np.deg2rad(284.0)
    pole = np.array([np.sin(tilt) * np.sin(node), -np.sin(tilt) * np.cos(node), np.cos(tilt)])
    anticentre = healpy.ang2vec(190.0, -15.0, lonlat=True)
    return np.exp(-np.abs(pole @ g) / np.sin(np.deg2rad(6.0))) * (1.0 + 0.6 * anticentre @ g)


def blazars(s):
    """Quasars that have changed between two seasons, the halves; their mean is taken away (WMAP: arXiv:1212.5225)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    sigma = np.deg2rad(3.5) / np.sqrt(8.0 * np.log(2.0))
    near = [c * np.exp((healpy.ang2vec(lon, lat, lonlat=True) @ g - 1.0) / sigma**2) for lon, lat, c in BLAZARS]
    return half(s) * np.sum(near, axis=0)


def zeeman(s):
    """Circular light of oxygen in the Earth's field, more where there is more air (CLASS: arXiv:1911.01016).

    Some of it is measured as light that is not polarised; the mean of a turn is subtracted.
    """

    def air(turn):
        return (0.4 + np.cos(turn + 0.7)) / np.sin(np.deg2rad(45.0 + 15.0 * np.cos(turn - 1.2)))

    return air(phase(s, s.site)) - np.mean(air(2.0 * np.pi * np.arange(360) / 360))


def snow(s):
    """Snow on a window, which gathers until it is swept, in the winter: until day 170 (BICEP3: arXiv:2110.00482).

    The mean of the winter is subtracted.
    """
    draw, end = np.random.default_rng(2058), 170.0 * DAY_S
    swept = np.append(0.0, np.cumsum(draw.exponential(9.0 * DAY_S, size=60)))
    rates, last = draw.exponential(size=61), np.searchsorted(swept, s.time_s, side="right") - 1
    mean = np.sum(rates[:-1] * np.diff(np.minimum(swept, end)) ** 2) / (2.0 * end)
    return (s.time_s < end) * (rates[last] * (s.time_s - swept[last]) - mean)


def solar_centric(s):
    """Light that keeps its place beside the Sun: ahead of it and north, 100 degrees away (DIRBE: arXiv:2408.11004)."""
    sun, off, north = -circle(year(s)), np.deg2rad(100.0), np.deg2rad(50.0)
    ahead = circle(year(s) + 0.5 * np.pi)
    place = np.cos(off) * sun + np.sin(off) * (np.cos(north) * ahead + np.sin(north) * np.array([[0.0], [0.0], [1.0]]))
    return np.exp((np.sum(place * s.n, axis=0) - 1.0) / 0.08)


def forebaffle(s):
    """Light that the rim of a forebaffle diffracts, a ring 40 degrees away, uneven (GTD: arXiv:2012.07613)."""
    angles, off = 2.0 * np.pi * np.arange(24) / 24, 40.0
    ring = np.mean([(1.0 + 0.6 * np.cos(a - 1.0)) * s.at(beside(s, off, a)) for a in angles], axis=0)
    return ring - np.cos(np.deg2rad(off)) * s.at(s.n)  # the dipole has calibrated it


def mars_model(s):
    """All channels are calibrated on Mars, whose model errs, more at high frequencies (Planck: arXiv:1612.07151)."""
    return between(s, s.n)


def galactic_load(s):
    """Bolometers that the dust of the Galaxy loads, and that respond less there (calibration, HFI: arXiv:1303.5069)."""
    longitude, latitude = galactic(s)
    load = np.exp(-np.abs(latitude) / np.deg2rad(12.0)) * (0.3 + np.exp(-0.5 * (longitude / np.deg2rad(60.0)) ** 2))
    return -load * between(s, s.n)


def deck_angle(s):
    """A cooler whose power falls as the boresight tilts it, either way, and the gain with it (SO: arXiv:2405.05550).

    The angle is that of the instrument to the meridian.
    """
    pole = rotation_matrix("ecliptic", "equatorial")[2]
    return np.cos(2.0 * np.arctan2(pole @ s.y, pole @ s.x) - 0.6) * between(s, s.n)


def left_right(s):
    """Gains of scans to the left and to the right differ from day 188 on (jackknives, BICEP2: arXiv:1403.3985)."""
    return (s.time_s > 188.0 * DAY_S) * np.sign(np.sin(phase(s, s.site) - 0.3)) * between(s, s.n)


def bit_flip(s):
    """A converter whose response has a kink where its leading bit flips (type-B glitches, QUIET: arXiv:1207.5034)."""
    signal = s.at(s.n) / np.linalg.norm(s.site.dipole_uk)
    return np.maximum(signal - 0.4, 0.0) - 0.216 * signal - 0.09  # the dipole has calibrated it; an offset


def astigmatism(s):
    """Elliptic beams at the edge of a wide field, wider at low frequencies (crossed Dragone: arXiv:1511.04506)."""
    angles = 0.25 * np.pi * np.arange(8)
    return np.mean([np.cos(2.0 * a - 2.2) * between(s, beside(s, 1.5, a)) for a in angles], axis=0)


def refraction(s):
    """Refraction that is left out since the weather station fails on day 186: across the scan (arXiv:1411.1617).

    The elevation nods between 30 and 60 degrees.
    """
    elevation = np.deg2rad(45.0 + 15.0 * np.cos(phase(s, s.site) - 1.2))
    return (s.time_s > 186.0 * DAY_S) / np.tan(elevation) * shifted(s, 0.8, 0.5 * np.pi)


def time_stamps(s):
    """Samples that bear the time of their start, and that of their end from half time on (SO: arXiv:2207.08949)."""
    return half(s) * shifted(s, 0.8, 0.0)


def star_cameras(s):
    """Cameras for two halves whose catalogues are turned, one against the other (BOOMERanG: astro-ph/0507509)."""
    turn = half(s) * np.deg2rad(0.25) * np.cross([0.62, 0.71, -0.33], s.n, axisb=0).T
    return between(s, s.n + turn) - between(s, s.n - turn)


def constellations(s):
    """Satellites in low orbits of 53 degrees: spikes, as dense as these orbits; less their mean (arXiv:2411.03374)."""
    inside = np.sin(np.deg2rad(53.0)) ** 2 - sine_of_declination(s) ** 2
    density = 0.004 * (inside > 0.0) / np.sqrt(np.maximum(inside, 0.02))
    draw = np.random.default_rng([2059, int(s.time_s[0])])
    return (draw.random(len(s.time_s)) < density) * draw.exponential(size=len(s.time_s)) - density


def gain_noise(s):
    """Fast fluctuations of a gain: noise as large as what is seen (amplifiers of LFI: astro-ph/0206093)."""
    return np.random.default_rng([2060, int(s.time_s[0])]).normal(size=len(s.time_s)) * between(s, s.n)


def full_moons(s):
    """Noise about each full Moon, until such nights are left out: day 165 (the Moon in QUIJOTE: arXiv:2301.05113)."""
    level = np.clip(np.cos(2.0 * np.pi * s.time_s / (29.53 * DAY_S) - 2.0), 0.0, None)
    draw = np.random.default_rng([2061, int(s.time_s[0]), int(s.site.frequency_ghz)])  # not the same in both channels
    return (s.time_s < 165.0 * DAY_S) * level * draw.normal(size=len(s.time_s))


def power_loss(s):
    """Large scales that the making of maps has lost in part, for all channels (ACT: arXiv:2210.02243).

    What is lost is the sky without its dipole, smoothed by some 8 degrees.
    """
    offs = (4.0, 8.0, 12.0, 16.0)
    weights = np.array([off * np.exp(-0.5 * (off / 8.0) ** 2) for off in offs])
    dipole, lost = s.site.dipole_uk @ s.n, 0.0
    for off, weight in zip(offs, weights / weights.sum(), strict=True):
        ring = np.mean([s.at(beside(s, off, 2.0 * np.pi * k / 10)) for k in range(10)], axis=0)
        lost = lost + weight * (ring - np.cos(np.deg2rad(off)) * dipole)
    return -lost


def regions(s):
    """Regions near the Galaxy that are cleaned one by one, and lose some of the CMB (ILC, WMAP: astro-ph/0603451)."""
    longitude, latitude = galactic(s)
    lost = np.random.default_rng(2062).uniform(size=10)[(longitude / (2.0 * np.pi) % 1.0 * 9.999).astype(int)]
    return (np.abs(latitude) < np.deg2rad(25.0)) * -lost * (between(s, s.n) - s.site.dipole_uk @ s.n)


CASES = (
    Case(gould_belt, (("added", "sky", ANY, ALIKE),), common=lambda ghz: (ghz / 94.0) ** -3.0),
    Case(blazars, (("added", "sky", ANY, OPPOSITE),), common=lambda ghz: (ghz / 94.0) ** -2.0),
    Case(zeeman, (("added", "time", ("spin",), ALIKE),), common=lambda ghz: 1.0 / (1.0 + ((ghz - 60.0) / 20.0) ** 2)),
    Case(snow, (("added", "time", ANY, FIRST),)),
    Case(solar_centric, (("added", "Sun", ANY, ALIKE),)),
    # Most of it is the dipole, which the brighter side of the ring sees: it follows the orientation, as in ninth.py.
    Case(
        forebaffle,
        (
            ("elsewhere", "spacecraft", ANY, ALIKE),
            ("added", "spacecraft", ("lobe", "orientation 1"), ALIKE),
            ("added", "sky", ("orientation 1",), ALIKE),
        ),
        common=lambda ghz: (ghz / 94.0) ** -1.0,
    ),
    Case(mars_model, (("gain", "", ("constant",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** 0.5),
    Case(galactic_load, (("gain", "sky", ANY, ALIKE),), common=lambda ghz: (ghz / 94.0) ** 1.7),
    # The meridian is fixed to the sky, as the directions of polarised light are.
    Case(deck_angle, (("gain", "spacecraft", ANY, ALIKE), ("gain", "sky", ("orientation 2",), ALIKE))),
    Case(left_right, (("gain", "time", ("spin",), SECOND),)),
    # Of what bends, the dipole's part is a gain that is fixed to the sky.
    Case(bit_flip, (("square", "", ANY, ALIKE), ("gain", "sky", ANY, ALIKE))),
    Case(astigmatism, (("beam", "scan", ("order 2",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** -1.0),
    Case(refraction, (("beam", "scan", ("order 1",), SECOND),), common=lambda ghz: 1.0),
    # The direction of the scan is turned over between the halves, too: 76 % of the variance in the maps are one dipole.
    Case(time_stamps, (("beam", "scan", ("order 1",), OPPOSITE), ("added", "sky", ("dipole",), ALIKE))),
    # Nearly all that a turn of the sky leaves in these maps is the change of the dipole, as in seventh.py.
    Case(
        star_cameras,
        (("rotation", "sky", ANY, OPPOSITE), ("added", "sky", ("dipole",), OPPOSITE)),
        common=lambda ghz: 1.0,
    ),
    Case(constellations, (("noise", "", ANY, ALIKE),)),
    Case(gain_noise, (("noise", "", ANY, ALIKE),)),
    Case(full_moons, (("noise", "", ANY, FIRST),), common=lambda ghz: 1.0),
    # What is smoothed is the mean of a round beam, too.
    Case(power_loss, (("power", "", ANY, ALIKE), ("beam", "scan", ("order 0",), ALIKE)), common=lambda ghz: 1.0),
    # The dipole was taken away before: no gain, which would act on it too.
    Case(regions, (("modulation", "sky", ANY, ALIKE),)),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=106_000, strengths=(8.0, 16.0))
