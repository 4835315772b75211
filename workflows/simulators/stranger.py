"""A simulator in numpy, ducc0 and healpy with every argument free, for surveys of nside 32 and lmax 64.

Samples are pointed by inputs.py and seen by ``ducc0.totalconvolve``, or looked up in a smoothed map by healpy; gains
and noise may drift; maps are binned, or destriped first.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import ducc0
import healpy
import inputs
import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

import mcsim
from mcsim import config

NSIDE, LMAX = 32, 64
NPIX = 12 * NSIDE**2
ELL = np.arange(LMAX + 1)
SCANS = {"wmap": 61.0, "planck": 61.0, "litebird": 61.0}
"""Packaged scans, and seconds between samples."""
Vector = np.ndarray


def beam_of(shape: str) -> mcsim.Beam:
    """Return a beam: an ellipse at 20 degrees, or one with a coma and a pear's shape besides (m = 1 and 3)."""
    beam = mcsim.Beam.elliptical(200.0, 160.0, angle_deg=20.0, lmax=LMAX, mmax=0 if shape == "circular" else 4)
    if shape != "pear":
        return beam
    blm, size = beam.blm.copy(), np.deg2rad(76.0 / 60.0) * np.sqrt(ELL * (ELL + 1.0))
    blm[1] += 0.05 * size**3 * np.exp(0.7j) * blm[0] * (ELL >= 1)
    blm[3] += 0.04 * size**3 * np.exp(-0.4j) * blm[0] * (ELL >= 3)
    return replace(beam, blm=blm)


def run_of(scan: str, shape: str, channels: tuple[str, ...] = ("T",), seed: int = 1) -> config.RunConfig:
    """Return the run that describes side A: two halves of a year of a packaged scan, decimated."""
    made = []
    for number, name in enumerate(channels):
        beam = (
            beam_of(shape) if number == 0 else mcsim.Beam.elliptical(180.0, 150.0, angle_deg=-10.0, lmax=LMAX, mmax=4)
        )
        line = {"line_of_sight": "AB"[number % 2]} if scan == "wmap" else {}
        period = {"kind": "hit_averaged", "model": scan, "sample_period_s": SCANS[scan]}
        made.append({"name": name, "frequency_ghz": 94.0, "beam": beam, "scan": period | line})
    return config.load(
        {
            "schema": 1, "name": scan, "sky": {"spectrum": "wmap7", "lmax": LMAX}, "ensemble": {"seed": seed},
            "map": {"nside": NSIDE, "splits": ["half1", "half2"]}, "channel": made,
        }
    )  # fmt: skip


@dataclass(frozen=True)
class Survey:
    """A simulator with every argument free; what is not changed is side A."""

    given: inputs.Inputs
    sky: Callable[[Vector], Vector] = lambda sky: sky
    beam: Callable[[mcsim.Beam], Vector] = lambda beam: beam.blm
    psi: Callable[[Vector], Vector] = lambda psi: psi
    late: float = 0.0
    centred: bool = False
    motion: dict[str, float] = field(default_factory=dict)
    tilt_deg: float = 0.0
    lag: float = 0.0
    grid: tuple[int, bool] | None = None
    drift_uk: float = 0.0
    gain: Callable[[Vector], Vector] | None = None
    baseline: int = 0
    noise: dict[str, Vector] = field(default_factory=dict)
    after: Callable[[Vector], Vector] = lambda map_: map_

    def maps(self) -> dict[str, Vector]:
        """Return the maps by name, UNSEEN where nothing was observed."""
        found = {}
        for channel in self.given.channels:
            signal = self._signal(channel.beam)
            for name, samples in inputs.parts(self.given, channel):
                theta, phi, psi = inputs.pointing(channel, samples, self.given.frame)
                pixel = healpy.ang2pix(NSIDE, theta, phi)
                noise = self.noise.get(name, np.zeros(NPIX)) / np.sqrt(
                    np.maximum(np.bincount(pixel, minlength=NPIX), 1)
                )
                line = channel.line
                line = replace(line, boresight_angle_deg=line.boresight_angle_deg + self.tilt_deg)
                true = replace(channel, line=line, model=replace(channel.model, **{
                    key: factor * getattr(channel.model, key) for key, factor in self.motion.items()
                }))  # fmt: skip
                if self.motion:
                    pixel = healpy.ang2pix(NSIDE, *inputs.pointing(true, samples, self.given.frame)[:2])
                if self.motion or self.tilt_deg or self.late:
                    theta, phi, psi = inputs.pointing(true, samples, self.given.frame, self.late)
                if self.centred:
                    theta, phi = healpy.pix2ang(NSIDE, pixel)
                tod = signal(theta, phi, self.psi(psi))
                if self.gain is not None:
                    year = np.array(samples) * channel.model.period_of_samples(line) / channel.model.orbit_period_s
                    tod = tod * (1.0 + self.gain(2.0 * np.pi * year))
                if self.drift_uk:
                    draw = np.random.default_rng([7, samples.start])
                    tod = tod + self.drift_uk * red(draw, tod.size) + self.drift_uk * draw.standard_normal(tod.size)
                if self.baseline:
                    tod = tod - destriped(tod, pixel, self.baseline)
                hits = np.bincount(pixel, minlength=NPIX)
                mean = np.bincount(pixel, tod, NPIX) / np.maximum(hits, 1)
                found[name] = self.after(np.where(hits > 0, mean + noise, healpy.UNSEEN))
        return found

    def _signal(self, beam: mcsim.Beam) -> Callable[..., Vector]:
        sky, blm = self.sky(self.given.sky), self.beam(beam)
        if self.grid is not None:
            nside, linear = self.grid
            smooth = healpy.alm2map(healpy.almxfl(sky, beam.window), nside, lmax=LMAX)
            if linear:
                return lambda theta, phi, psi: healpy.get_interp_val(smooth, theta, phi)
            return lambda theta, phi, psi: smooth[healpy.ang2pix(nside, theta, phi)]
        packed = np.concatenate([blm[m, m : LMAX + 1] for m in range(len(blm))])
        seen = ducc0.totalconvolve.Interpolator(
            sky[None], packed[None], separate=False, lmax=LMAX, kmax=len(blm) - 1, epsilon=1e-8, nthreads=1
        )
        return lambda theta, phi, psi: seen.interpol(np.stack([theta, phi, psi], axis=1))[0]


def red(draw: np.random.Generator, size: int) -> Vector:
    """Return noise of a 1/f spectrum below a hundredth of the sampling, rms 1."""
    f = np.fft.rfftfreq(size)
    f[0] = 1.0
    noise = np.fft.irfft(np.fft.rfft(draw.standard_normal(size)) * np.sqrt(np.minimum(0.01 / f, 1e3) * (f < 0.3)), size)
    return noise / noise.std()


def destriped(tod: Vector, pixel: Vector, length: int) -> Vector:
    """Return the baselines, ``length`` samples each, that a destriper takes off a time line."""
    baseline = np.arange(tod.size) // length
    hits, count = np.maximum(np.bincount(pixel, minlength=NPIX), 1), int(baseline[-1]) + 1

    def summed(values: Vector) -> Vector:
        return np.bincount(baseline, values - (np.bincount(pixel, values, NPIX) / hits)[pixel], count)

    amplitude, _ = cg(LinearOperator((count, count), matvec=lambda a: summed(a[baseline])), summed(tod), rtol=1e-6)
    return (amplitude - amplitude.mean())[baseline]
