"""Fifteen more systematics of published error budgets, by someone who had read the scripts of the score alone.

python fifth.py [A:B]       cases A to B - 1, one after the other at S/N 8, then at S/N 16

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

SECOND = ("half2",)


def carbon_monoxide(s):
    """A line of CO at the edge of a band: the inner plane, and five nearby clouds (HFI: arXiv:1303.5073)."""
    g = rotation_matrix("ecliptic", "galactic") @ s.n
    plane = np.exp(-0.5 * (g[2] / np.sin(np.deg2rad(2.0))) ** 2) * np.exp((g[0] - 1.0) / 0.3)
    clouds = ((209.0, -18.0, 0.5), (353.0, 16.0, 0.3), (170.0, -15.0, 0.4), (80.0, 1.0, 0.6), (110.0, 14.0, 0.3))
    sigma = np.deg2rad(3.0)
    near = [(c, healpy.ang2vec(lon, lat, lonlat=True) @ g) for lon, lat, c in clouds]
    return plane + sum(c * np.exp((cosine - 1.0) / sigma**2) for c, cosine in near)


def moon(s):
    """The Moon, seen from L2, as it comes to the edge of the sunshield once a month (WMAP: astro-ph/0302215)."""
    seen = 0.384 * circle(2.0 * np.pi * s.time_s / (27.32 * DAY_S) + 1.3) - 1.5 * circle(year(s))
    lobe = beside(s, 74.0, -0.5 * np.pi)  # 144 degrees from the spin axis, below the line of sight
    return np.exp((np.sum(seen * lobe, axis=0) / np.linalg.norm(seen, axis=0) - 1.0) / 0.03)


def cooler_line(s):
    """A line of the cooler's drive, aliased close to 4 times the spin: they beat in 20 days (HFI: arXiv:1303.5067)."""
    return np.cos(2.0 * np.pi * s.time_s * (4.0 / s.site.pointing.model.spin_period_s + 1.0 / (20.0 * DAY_S)))


def heater(s):
    """Heat of the bus, twice a spin, in all channels since a heater failed on day 190 (WMAP: astro-ph/0302224)."""
    return (s.time_s > 190.0 * DAY_S) * np.cos(2.0 * phase(s, s.site) - 1.1)


def telegraph(s):
    """An offset that jumps between two levels, after some 10 hours each (telegraph noise, HFI: arXiv:1303.5067)."""
    jumps = np.cumsum(np.random.default_rng(2037).exponential(0.4 * DAY_S, size=2000))
    return np.searchsorted(jumps, s.time_s) % 2 - 0.5


def nodding_gain(s):
    """A gain that follows the spin axis about the Sun, as amplifiers warm and cool (WMAP: astro-ph/0302224)."""
    model = s.site.pointing.model
    turn = 2.0 * np.pi * s.time_s / model.precession_period_s + np.deg2rad(model.precession_phase_deg)
    return np.cos(turn - 1.9) * between(s, s.n)


def safe_hold(s):
    """Gains of all channels after a safe hold on day 250, until they are warm again (WMAP: astro-ph/0302222)."""
    after = s.time_s / DAY_S - 250.0
    return (after > 0.0) * np.exp(-np.clip(after, 0.0, None) / 15.0) * between(s, s.n)


def dipole_fit(s):
    """Gains that are too high where the spin axis is near the dipole's, twice a year (LFI: arXiv:1505.08022)."""
    x, y, _ = s.site.dipole_uk
    return np.cos(2.0 * (year(s) - np.arctan2(y, x))) * between(s, s.n)


def dimples(s):
    """Six grating lobes, 6 degrees off, of a mirror that shows the cells of its core (HFI: arXiv:1303.5068)."""
    lobes = [between(s, beside(s, 6.0, 0.2 + angle)) for angle in np.pi / 3.0 * np.arange(6)]
    return np.mean(lobes, axis=0) - between(s, s.n)


def wheel(s):
    """Pointing that trembles at all angles since day 225, with a worn wheel (LiteBIRD's budget: arXiv:2202.02773)."""
    ring = [between(s, beside(s, 1.2, angle)) for angle in 0.25 * np.pi * np.arange(8)]
    return (s.time_s > 225.0 * DAY_S) * (np.mean(ring, axis=0) - between(s, s.n))


def aberration(s):
    """Aberration by the motion about the Sun, which the pointing forgets (aberration of CMB: arXiv:1303.5087)."""
    ahead = np.deg2rad(0.25) * circle(year(s) + 0.5 * np.pi)
    across = ahead - s.n * np.sum(ahead * s.n, axis=0)
    return between(s, s.n - across) - between(s, s.n + across)


def equinox(s):
    """Coordinates of another equinox in the second half, turned about the ecliptic pole (WMAP: astro-ph/0302222)."""
    turn = np.deg2rad(0.25) * np.stack([-s.n[1], s.n[0], 0.0 * s.n[2]])
    return (s.time_s > 0.5 * YEAR_S) * (between(s, s.n + turn) - between(s, s.n - turn))


def spillover_arc(s):
    """Sky past the mirror's rim, an arc 85 degrees from the line of sight, 120 degrees long (LFI: arXiv:1303.5065)."""
    return np.mean([s.at(beside(s, 85.0, np.deg2rad(angle))) for angle in 25.0 + np.linspace(-60.0, 60.0, 25)], axis=0)


def sunlit_noise(s):
    """Radio noise of the Sun, strongest where the spin turns the horn towards it (QUIET's Sun: arXiv:1012.3191)."""
    level = np.exp((np.cos(phase(s, s.site)) - 1.0) / 0.5)
    return level * np.random.default_rng([2038, int(s.time_s[0])]).normal(size=len(s.time_s))


def warm_bolometer(s):
    """A detector that is less linear since its bath is warmer, from day 200 on (POLARBEAR: arXiv:1702.07111)."""
    return (s.time_s > 200.0 * DAY_S) * s.at(s.n) ** 2


CASES = (
    Case(carbon_monoxide, (("added", "sky", ANY, ALIKE),)),
    # The Moon is never more than 15 degrees from the Sun; it is a lobe of the spacecraft that sees it.
    Case(
        moon,
        (("added", "Sun", ANY, ALIKE), ("added", "spacecraft", ANY, ALIKE)),
        common=lambda ghz: (ghz / 94.0) ** -2.0,
    ),
    Case(cooler_line, (("added", "time", ANY, ANY),)),
    Case(heater, (("added", "time", ("spin",), SECOND),), common=lambda ghz: 1.0),
    Case(telegraph, (("added", "time", ANY, ANY), ("noise", "", ANY, ALIKE))),
    Case(nodding_gain, (("gain", "time", ANY, ALIKE),)),
    Case(safe_hold, (("gain", "time", ANY, SECOND),), common=lambda ghz: 1.0),
    Case(dipole_fit, (("gain", "time", ANY, ALIKE),)),
    Case(dimples, (("beam", "scan", ("order 0", "order 6"), ALIKE), ("elsewhere", "spacecraft", ANY, ALIKE))),
    Case(wheel, (("beam", "scan", ("order 0",), SECOND),)),
    # A boost that turns with the year: opposite in the halves. Along the scan the shift goes as the spin's cosine.
    Case(
        aberration,
        (
            ("modulation", "sky", ("degree 1",), ("opposite",)),
            ("beam", "scan", ("order 1",), ANY),
            ("rotation", "Sun", ANY, ANY),
        ),
    ),
    Case(equinox, (("rotation", "sky", ANY, SECOND),)),
    Case(spillover_arc, (("elsewhere", "spacecraft", ANY, ALIKE), ("added", "spacecraft", ("lobe",), ALIKE))),
    Case(sunlit_noise, (("noise", "", ANY, ALIKE),)),
    # Of the square, the dipole times the signal is a gain that is fixed to the sky.
    Case(warm_bolometer, (("square", "", ANY, SECOND), ("gain", "sky", ANY, SECOND))),
)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:2], cases=CASES, first=98_000, strengths=(8.0, 16.0))
