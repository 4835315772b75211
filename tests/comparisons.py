"""Simulators of small surveys, and differences that are put into them by hand, for comparisons."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import healpy
import numpy as np
from numpy.typing import NDArray

import mcsim
from mcsim import config
from mcsim.comparison.result import ComparisonResult
from mcsim.instrument.scan import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotate_alm

NSIDE, LMAX = 16, 32
MODEL = {
    "schema": 1,
    "name": "pair",
    "sky": {"spectrum": "wmap7", "lmax": LMAX},
    "map": {"nside": NSIDE, "splits": ["half1", "half2"]},
    "channel": [
        {
            "name": "W1",
            "frequency_ghz": 94.0,
            "beam": {
                "kind": "elliptical_gaussian", "fwhm_major_arcmin": 400.0, "fwhm_minor_arcmin": 320.0,
                "angle_deg": 20.0, "m_max": 4,
            },
            "scan": {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "A", "sample_period_s": 601.0},
        }
    ],
    "ensemble": {"seed": 3},
}  # fmt: skip

Maps = list[NDArray[np.float64]]


class Simulator:
    """Another simulator of the same survey: every sample by totalconvolve, every argument free."""

    def __init__(self, model: dict = MODEL, channel: int = 0) -> None:
        self.run = config.load(model)
        whole = survey(self.run)
        self.site = whole.making.channels[channel].site
        self.sky = simulate.draw_sky(whole, 0)
        self.halves = len(self.run.map.splits) or 1

    def __call__(
        self,
        sky: NDArray[np.complex128] | None = None,
        beam: mcsim.Beam | None = None,
        psi: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
        centred: bool = False,
        turning: dict[str, float] | None = None,
        added: Callable[[tod.Samples], NDArray[np.float64]] | None = None,
    ) -> Maps:
        pointing, nside = self.site.pointed(""), self.site.nside
        periods = {key: sign * getattr(pointing.model, key) for key, sign in (turning or {}).items()}
        model = replace(pointing.model, **periods)
        observe = tod.sky_signal(self.sky if sky is None else sky, self.site.lmax, beam or self.site.beam, 1e-8, 1)

        def pointed(half: int) -> Iterator[tod.Samples]:
            grid = MapGrid(nside, "ecliptic", self.run.map.span(half))
            for chunk in tod.samples(model, pointing.line, grid):
                theta, phi = healpy.pix2ang(nside, chunk.pixel) if centred else (chunk.theta, chunk.phi)
                extra = chunk.signal_uk if added is None else added(chunk)
                turned = chunk.psi if psi is None else psi(chunk.psi)
                yield replace(chunk, theta=theta, phi=phi, psi=turned, signal_uk=extra)

        binned = [tod.bin_samples(observe(pointed(half)), nside) for half in range(self.halves)]
        return [np.where(hits > 0, mean, healpy.UNSEEN) for mean, hits in binned]


def names(found: ComparisonResult) -> list[str]:
    return [d.name for channel in found.channels for d in channel.differences]


CASES: dict[str, tuple[Callable[[Simulator, Maps], Maps], float]] = {
    "psi_offset": (lambda s, a: s(psi=lambda p: p + np.deg2rad(30.0)), 30.0),
    "psi_sign": (lambda s, a: s(psi=lambda p: -p), 1.0),
    "mmax_cut": (lambda s, a: s(beam=s.site.beam.truncated(0)), 0.0),
    "pixel_centres": (lambda s, a: s(centred=True), 1.0),
    "spin_sign": (lambda s, a: s(turning={"spin_period_s": -1.0}), 1.0),
    "frame_rotated": (lambda s, a: s(sky=rotate_alm(s.sky, LMAX, "galactic", "ecliptic")), 110.5),
    "lmax_cut": (lambda s, a: s(sky=healpy.almxfl(s.sky, np.arange(LMAX + 1) <= 22)), 22.0),
    "pixel_window": (lambda s, a: s(sky=healpy.almxfl(s.sky, mcsim_window())), 1.0),
    "beam_window": (lambda s, a: s(sky=healpy.almxfl(s.sky, s.site.beam.window)), 1.0),
    "calibration": (lambda s, a: scaled(a, 1.002), 0.002),
    "unit": (lambda s, a: scaled(a, 1e-3), 1e-3),
    "monopole": (lambda s, a: [np.where(m > -1e20, m + 2.0, m) for m in a], 2.0),
    "ordering": (lambda s, a: [healpy.reorder(m, r2n=True) for m in a], 1.0),
    "split_exchanged": (lambda s, a: a[::-1], 1.0),
}


def mcsim_window() -> NDArray[np.float64]:
    from mcsim.sphere.healpix import pixel_window

    return pixel_window(NSIDE, LMAX)


def scaled(maps: Maps, factor: float) -> Maps:
    return [np.where(m > -1e20, factor * m, m) for m in maps]


def noise_of(simulator: Simulator) -> Maps:
    """Return noise of 60 uK a sample for every map."""
    draw = np.random.default_rng(6)
    hits = [m.moments.hits for m in survey(simulator.run).making.channels[0].maps]
    return [60.0 * draw.standard_normal(h.size) / np.sqrt(np.maximum(h, 1.0)) for h in hits]


SMALL = MODEL | {"sky": {"spectrum": "wmap7", "lmax": 32}, "map": {"nside": 16, "splits": ["half1", "half2"]}}
PEAR = mcsim.Beam.elliptical(400.0, 320.0, angle_deg=20.0, lmax=32, mmax=3)
PEAR.blm[1] += 0.2 * np.exp(0.7j) * PEAR.blm[0] * (np.arange(33) / 32) ** 3
PEAR.blm[3, 3:] += 0.1 * np.exp(-0.4j) * PEAR.blm[0, 3:] * (np.arange(3, 33) / 32) ** 3


def small(model: str = "wmap", beam: mcsim.Beam = PEAR, period_s: float = 601.0, **more: object) -> dict:
    """Return a run of nside 16 with a beam of odd orders."""
    line = {"line_of_sight": "A"} if model == "wmap" else {}
    scan = {"kind": "hit_averaged", "model": model, "sample_period_s": period_s} | line
    return SMALL | {"channel": [{"name": "W1", "frequency_ghz": 94.0, "beam": beam, "scan": scan}]} | more


ODD: dict[str, Callable[[Simulator], Maps]] = {
    "beam_conjugated": lambda s: s(beam=replace(s.site.beam, blm=s.site.beam.blm.conj())),
    "psi_sign": lambda s: s(psi=lambda p: -p),
    "precession_sign": lambda s: s(turning={"precession_period_s": -1.0}),
    "mmax_cut": lambda s: s(beam=s.site.beam.truncated(2)),
}
