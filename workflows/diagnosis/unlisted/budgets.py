"""Twelve systematics of published error budgets, written before the grammar was made general.

python budgets.py [A:B]     cases A to B - 1, one after the other at S/N 10, then at S/N 20

What is true of each is written beside it; where two descriptions say the same thing, both are right.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

import healpy
import numpy as np
from unlisted import ANY, ask, known, row, scored

from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.instrument.scan import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotation_matrix
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Site
from mcsim.systematics.spacecraft import axes

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
    site: Site

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
    common: Callable[[float], float] | None = None  # in both channels, by frequency in GHz; None: in one


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
    Case(zodiacal, (("added", "sky", ("latitude ecliptic",), ALIKE),), common=lambda ghz: (ghz / 94.0) ** 1.5),
    Case(cosmic_rays, (("noise", "", ("level",), ("half2",)),)),
    Case(polarised, (("added", "spacecraft", ("orientation 2",), ALIKE), ("added", "sky", ("orientation 2",), ALIKE))),
    Case(transponder, (("gain", "", ("constant",), ALIKE), ("gain", "time", ANY, ALIKE))),
)


class Sky:
    """One realization of the model of two channels, and what acts on it."""

    def __init__(self, seed):
        self.run, self.context, self.scene, self.search = known("two")
        self.survey, self.seed = survey(self.run), seed
        self.maps = np.array(list(simulate.maps(self.survey, seed)))
        lmax, dipole = self.survey.lmax, self.survey.channels[0].site.dipole_uk
        beam = self.survey.channels[0].site.beam.blm[0, : lmax + 1].real
        window = beam * np.sqrt(4.0 * np.pi / (2.0 * np.arange(lmax + 1) + 1.0))
        seen = healpy.almxfl(simulate.draw_sky(self.survey, seed) + dipole_alm(dipole, lmax), window)
        self.fine = healpy.alm2map(seen, FINE)

    def change(self, case, channels):
        """Return what a case adds to all maps, shape (maps, npix)."""
        change = np.zeros_like(self.maps)
        for c in channels:
            site = self.survey.channels[c].site
            pointing, away = site.pointing, np.deg2rad(site.pointing.line.boresight_angle_deg)
            scale = case.common(site.frequency_ghz) if case.common else 1.0

            def signal(chunk, away=away, scale=scale, site=site):
                n, south, east = axes(chunk.theta, chunk.phi)
                x, y = (np.cos(a) * south + np.sin(a) * east for a in (chunk.psi, chunk.psi + 0.5 * np.pi))
                return scale * case.act(Seen(chunk.time_s, chunk.psi, x, y, n, away, self.fine, site))

            for k in range(2):
                grid = MapGrid(self.survey.nside, site.frame, self.run.map.span(k))
                stream = tod.with_signal(signal)(tod.samples(pointing.model, pointing.line, grid))
                change[2 * c + k] = tod.bin_samples(stream, self.survey.nside)[0]
        if case.act is cosmic_rays:
            (c,), draw = channels, np.random.default_rng([2032, self.seed])
            precision = self.context.analysis.model.parts[2 * c + 1].precision
            change[2 * c + 1] = draw.normal(size=precision.size) / np.sqrt(precision)
        return change


def factor_of(snr, wanted):
    """Return the factor at which an S/N has a value, by secants of its logarithm: it may grow as the square."""
    where, power = [0.0], 1.0
    reached = [np.log(snr(1.0) / wanted)]
    while abs(reached[-1]) > 0.005 and len(where) < 20:
        if len(where) > 1:
            power = np.clip(np.diff(reached[-2:])[0] / np.diff(where[-2:])[0], 1.0, 4.0)
        where.append(where[-1] - reached[-1] / power)
        reached.append(np.log(snr(np.exp(where[-1])) / wanted))
    return np.exp(where[-1])


def main(span="0:99", cases=CASES, first=95_000, strengths=(10.0, 20.0)):
    """Scale each case to every S/N of the data vector in turn, and print what is said of it."""
    for number in range(len(strengths) * len(cases))[slice(*map(int, span.split(":")))]:
        case, wanted, sky = cases[number % len(cases)], strengths[number // len(cases)], Sky(first + number)
        channel = None if case.common else int(np.random.default_rng([2032, number]).integers(2))
        change = sky.change(case, range(2) if case.common else [channel])
        before = sky.context.analysis.data_vector(list(sky.maps))

        def snr(factor, sky=sky, change=change, before=before):
            return sky.context.null.expected_snr(
                sky.context.analysis.data_vector(list(sky.maps + factor * change)) - before
            )

        factor = factor_of(snr, wanted)
        data = ObservedMaps(sky.context, list(sky.maps + factor * change), ask)
        found, reduction = unlisted.structures_of(data, sky.scene, sky.search, scored)
        owner = None if case.common else sky.run.channels[channel].name
        row("further", case.act.__name__, case.right, owner, wanted, "", found, reduction)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:])
