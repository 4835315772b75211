"""Twenty more systematics of published error budgets, by someone who had read the scripts of the score alone.

python ninth.py [A:B]       cases A to B - 1, one after the other at S/N 8, then at S/N 16

What is true of each stands in CASES, as in budgets.py, and was written before any of them was described. Telescopes
on the ground are told as if they turned as this instrument spins, as in eighth.py.
"""

import os
import sys

import healpy
import numpy as np
from budgets import ALIKE, DAY_S, YEAR_S, Case, main
from eighth import half, ring
from fourth import circle, year
from further import phase
from seventh import OPPOSITE
from sixth import FIRST, SECOND, shifted
from third import beside, between
from unlisted import ANY

from mcsim.sphere.rotation import rotation_matrix


def magellanic_clouds(s):
    """Dust of the Magellanic Clouds, which no mask of the Galaxy covers (Planck: arXiv:1101.2046)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    clouds = ((280.5, -32.9, 2.5, 1.0), (302.8, -44.3, 1.8, 0.2))
    near = [(b, np.deg2rad(w), healpy.ang2vec(lon, lat, lonlat=True) @ g) for lon, lat, w, b in clouds]
    return sum(b * np.exp((cosine - 1.0) / w**2) for b, w, cosine in near)


def two_bands(s):
    """Bands that move with the air of two seasons, the halves: dust too bright, then too faint (arXiv:1803.07630).

    Dust of the Galaxy is taken away as in the mean band.
    """
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    latitude, longitude = np.arcsin(np.clip(g[2], -1.0, 1.0)), np.arctan2(g[1], g[0])
    disc = np.exp(-np.abs(latitude) / np.deg2rad(6.0)) * (0.2 + np.exp(-0.5 * (longitude / np.deg2rad(55.0)) ** 2))
    return half(s) * disc


def stale_ephemeris(s):
    """The orbital dipole is that of some hours before: what is left points along the Sun's line (arXiv:1505.08022).

    The mean of a turn is an offset, which no such instrument measures.
    """
    model = s.site.pointing.model
    mean = np.cos(np.deg2rad(model.precession_angle_deg)) * np.cos(s.away)
    return np.sum(circle(year(s)) * s.n, axis=0) - mean


def late_dipole(s):
    """The dipole that is taken away is that of a moment later, for all channels (timing, WMAP: arXiv:1009.2701)."""
    return s.site.dipole_uk @ s.x


def recycled(s):
    """A cold plate that warms before a refrigerator is cycled, each 46 hours; all detectors (ABS: arXiv:1801.01218).

    The mean of a cycle is subtracted.
    """
    return np.exp((s.time_s / (46.0 * 3600.0) % 1.0 - 1.0) / 0.15) - 0.15


def radio_masts(s):
    """Transmitters at two azimuths, which are on from day 205 (azimuth-synchronous, CLASS: arXiv:2305.01045).

    The mean of a turn is subtracted.
    """

    def seen(turn):
        near, far = ((np.cos(turn - at) - 1.0) / np.deg2rad(width) ** 2 for at, width in ((0.9, 14.0), (3.6, 20.0)))
        return np.exp(near) + 0.7 * np.exp(far)

    mean = np.mean(seen(2.0 * np.pi * np.arange(360) / 360))
    return (s.time_s > 205.0 * DAY_S) * (seen(phase(s, s.site)) - mean)


def polarised_dust(s):
    """Polarised dust in a detector that is turned by 90 degrees at half time (field: Planck, arXiv:1604.01029).

    The field about the Sun points to longitude 70 and latitude 24 degrees; light is polarised across it.
    """
    to_ecliptic = rotation_matrix("galactic", "ecliptic")
    field = to_ecliptic @ healpy.ang2vec(70.0, 24.0, lonlat=True)
    column = 1.0 / np.maximum(np.abs(to_ecliptic[:, 2] @ s.n), 0.1)
    return -half(s) * column * ((field @ s.x) ** 2 - (field @ s.y) ** 2)


def reflection(s):
    """A ghost, 35 degrees away, of a coating that is right for high frequencies (BICEP and Keck: arXiv:1502.00596)."""
    off = 35.0
    return s.at(beside(s, off, np.deg2rad(250.0))) - np.cos(np.deg2rad(off)) * s.at(s.n)  # the dipole has calibrated it


def phases_of_the_moon(s):
    """Gains by the Moon, whose surface warms and cools within a month (a calibrator of CLASS: arXiv:1811.08287)."""
    return np.cos(2.0 * np.pi * s.time_s / (29.53 * DAY_S) - 0.6) * between(s, s.n)


def fields(s):
    """Fields of the sky, here 60, that are calibrated one by one (SPT: arXiv:1210.7231)."""
    q = rotation_matrix("ecliptic", "equatorial") @ s.n
    column = np.minimum((np.arctan2(q[1], q[0]) / (2.0 * np.pi) % 1.0 * 12.0).astype(int), 11)
    row = np.minimum(((q[2] + 1.0) * 2.5).astype(int), 4)
    errors = np.random.default_rng(2052).normal(size=(12, 5))
    return (errors - np.mean(errors))[column, row] * between(s, s.n)


def elevation(s):
    """Air that dims the sky by elevation, which nods between 30 and 60 degrees (sky dips of ACBAR: astro-ph/0303515).

    The mean gain of a turn is calibrated.
    """

    def air(turn):
        return 1.0 / np.sin(np.deg2rad(45.0 + 15.0 * np.cos(turn - 1.2)))

    return (np.mean(air(2.0 * np.pi * np.arange(360) / 360)) - air(phase(s, s.site))) * between(s, s.n)


def retuned(s):
    """A detector is biased anew each day, to another gain, until day 170 (gains of SPIDER: arXiv:2112.00820)."""
    errors = np.zeros(400)
    errors[:170] = np.random.default_rng(2053).normal(size=170)
    errors[:170] -= np.mean(errors[:170])
    return errors[(s.time_s / DAY_S).astype(int)] * between(s, s.n)


def overloaded(s):
    """Detectors near saturation, whose response bends more where the load is higher (TES: arXiv:1808.10491)."""
    return -((s.at(s.n) / np.linalg.norm(s.site.dipole_uk)) ** 2)


def colour_of_the_beam(s):
    """Beams of planets, whose light is bluer than the CMB's, for the CMB (beam chromaticity: arXiv:2411.10124)."""
    return ring(s, 1.5)


def out_of_focus(s):
    """An array whose beam is elliptic, since it is out of focus until day 140 (beams of ACT: arXiv:1303.4714)."""
    angles = 0.25 * np.pi * np.arange(8)
    mean = np.mean([np.cos(2.0 * a + 1.3) * between(s, beside(s, 1.5, a)) for a in angles], axis=0)
    return (s.time_s < 140.0 * DAY_S) * mean


def encoder_ripple(s):
    """An encoder that errs twice a turn, along the scan, for all channels (pointing of CLASS: arXiv:2308.13309)."""
    return np.cos(2.0 * phase(s, s.site) + 0.5) * shifted(s, 1.0, 0.0)


def two_foci(s):
    """One beam for two seasons, here the halves, of unequal focus: too wide, then too narrow (SPT: arXiv:1111.7245)."""
    return half(s) * ring(s, 1.5)


def by_day(s):
    """White noise of turbulent air by day; from day 170 on nights alone are kept (ACT's air: arXiv:2111.01319)."""
    level = np.clip(np.sin(2.0 * np.pi * s.time_s / DAY_S - 0.7), 0.0, None)
    draw = np.random.default_rng([2054, int(s.time_s[0])])
    return (s.time_s < 170.0 * DAY_S) * level * draw.normal(size=len(s.time_s))


def dusty_window(s):
    """Photon noise of all channels, as a window gathers dust through the year (CLASS receivers: arXiv:2107.08022)."""
    draw = np.random.default_rng([2055, int(s.time_s[0]), int(s.site.frequency_ghz)])  # not the same in both channels
    return s.time_s / YEAR_S * draw.normal(size=len(s.time_s))


def microphonics(s):
    """Noise that rises in one hour out of twenty, as mechanical noise does (Archeops: astro-ph/0603665)."""
    level = np.random.default_rng(2056).random(8800) < 0.05
    draw = np.random.default_rng([2057, int(s.time_s[0])])
    return level[(s.time_s / 3600.0).astype(int)] * draw.normal(size=len(s.time_s))


CASES = (
    Case(magellanic_clouds, (("added", "sky", ANY, ALIKE),), common=lambda ghz: (ghz / 94.0) ** 1.7),
    Case(two_bands, (("added", "sky", ANY, OPPOSITE),), common=lambda ghz: (ghz / 94.0) ** 1.5),
    # The angle to the Sun is a function of the spin's phase, as in sixth.py.
    Case(
        stale_ephemeris,
        (("added", "Sun", ANY, ALIKE), ("added", "time", ("spin",), ALIKE)),
        common=lambda ghz: 1.0,
    ),
    # It follows the direction of the scan, which is turned over between the halves: 86 % of the variance that it leaves
    # in their maps are a dipole of opposite signs.
    Case(
        late_dipole,
        (
            ("added", "spacecraft", ("orientation 1",), ALIKE),
            ("added", "sky", ("orientation 1",), ALIKE),
            ("added", "sky", ("dipole",), OPPOSITE),
        ),
        common=lambda ghz: 1.0,
    ),
    Case(recycled, (("added", "time", ANY, ANY),), common=lambda ghz: 1.0),
    Case(radio_masts, (("added", "time", ("spin",), SECOND),)),
    # A polarised sky is fixed to the sky, and follows the orientation of the instrument.
    Case(
        polarised_dust,
        (("added", "spacecraft", ("orientation 2",), OPPOSITE), ("added", "sky", ("orientation 2",), OPPOSITE)),
    ),
    # Another place is seen, which turns with the spacecraft: a lobe far from the beam.
    Case(
        reflection,
        (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE)),
        common=lambda ghz: (ghz / 94.0) ** -2.0,
    ),
    Case(phases_of_the_moon, (("gain", "time", ANY, ANY),)),
    Case(fields, (("gain", "sky", ANY, ALIKE),)),
    Case(elevation, (("gain", "time", ("spin",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** 2.0),
    Case(retuned, (("gain", "time", ANY, FIRST),)),
    # Of the square, the dipole times the signal is a gain that is fixed to the sky.
    Case(
        overloaded,
        (("square", "", ANY, ALIKE), ("gain", "sky", ANY, ALIKE)),
        common=lambda ghz: (ghz / 94.0) ** 1.5,
    ),
    Case(colour_of_the_beam, (("beam", "scan", ("order 0",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** -2.0),
    Case(out_of_focus, (("beam", "scan", ("order 2",), FIRST),)),
    Case(encoder_ripple, (("beam", "scan", ("order 1",), ANY),), common=lambda ghz: 1.0),
    Case(two_foci, (("beam", "scan", ("order 0",), OPPOSITE),)),
    Case(by_day, (("noise", "", ANY, FIRST),)),
    Case(dusty_window, (("noise", "", ANY, ANY),), common=lambda ghz: ghz / 94.0),
    Case(microphonics, (("noise", "", ANY, ALIKE),)),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=105_000, strengths=(8.0, 16.0))
