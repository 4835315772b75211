"""Effects on the noise: its level, its pattern over the sky, its memory, and outliers among the samples."""

from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np

from mcsim.errors import InputError
from mcsim.sphere import healpix, map_files
from mcsim.sphere.checks import check_complete
from mcsim.sphere.rotation import rotation_matrix
from mcsim.support.arrays import divided
from mcsim.support.loading import once_per_content
from mcsim.systematics.base import Bound, Effect, Map, Site, Wording
from mcsim.systematics.parametrization import Parametrization, Vector

AT_ONCE = 1 << 20  #: pixels of a template that are sorted at once: those of nside 2048 would take 3 GB together


@dataclass(frozen=True, kw_only=True)
class NoiseLevel(Effect):
    """Noise per sample sigma0 (1 + amplitude): a fraction of the standard deviation, not of the variance."""

    name = "noise_level"
    scope = "channel"
    unit = "fraction of sigma0"
    wording = Wording("{} more noise", " %", 100.0, negative="{} less noise")
    cause = "Noise estimated on other data, a gain that is not the fiducial one, or drifts (1/f) that the model lacks."
    signature = "Autos only, flat in l, as the hits."
    source = "Jarosik et al. 2011, ApJS 192, 14 (sigma0 per channel, and its error)"
    step = 0.01
    bounds = (Bound("amplitude", -0.9, 3.0, "a prior of this library: noise is known to a factor of four"),)
    parametrization = Parametrization(noise_alone=True)

    def noise(self, site: Site) -> Map | None:
        if self.amplitude == 0.0:
            return None
        if self.amplitude <= -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} leaves less than no noise; keep it above -1."
            )
        return np.full(12 * site.nside**2, (1.0 + self.amplitude) ** 2)


@dataclass(frozen=True, kw_only=True)
class NoiseAnisotropy(Effect):
    """Variance of the samples times 1 + amplitude t, t = 3 z^2 - 1 with z the sine of ecliptic latitude in every frame.

    Attributes
    ----------
    amplitude
        a.
    template
        Path of a HEALPix map to be taken for t; its frame is what its header says, or that in which maps are made
        (``map.frame``). Of a finer map the means over pixels are taken.
    """

    name = "noise_anisotropy"
    scope = "channel"
    unit = "fraction of the variance"
    wording = Wording("{} of the variance", " %", 100.0)
    cause = "Hits that are not those of the survey, flagged or lost samples, or noise that varies through the year."
    signature = "Autos only, L = 2, M = 0 of the ecliptic frame; the variance map of half differences."
    source = "The pattern is the lowest one that a scan symmetric about the ecliptic makes"
    step = 0.05
    bounds = (Bound("amplitude", -0.5, 1.0, "no variance is negative, the pattern being from -1 to 2"),)
    parametrization = Parametrization(noise_alone=True)

    template: str = ""

    def noise(self, site: Site) -> Map | None:
        if self.amplitude == 0.0:
            return None
        if self.template:
            pattern = _of_file(self.template, site.nside, site.frame)
        else:
            pattern = 3.0 * (rotation_matrix(site.frame, "ecliptic")[2] @ healpix.centres(site.nside)) ** 2 - 1.0
        factor = 1.0 + self.amplitude * pattern
        if factor.min() < 0.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} makes a variance negative, with a pattern from "
                f"{pattern.min():.3g} to {pattern.max():.3g}; choose a smaller one."
            )
        return np.asarray(factor)


@dataclass(frozen=True, kw_only=True)
class NoiseKnee(Effect):
    """Knee frequency of noise with memory f_knee (1 + amplitude); white noise has none.

    At the lowest frequency of the model, f_min, and below it the noise is white.
    """

    name = "noise_knee"
    scope = "channel"
    unit = "fraction of f_knee"
    wording = Wording("{} higher knee", " %", 100.0, negative="{} lower knee")
    cause = "Amplifiers, thermal control or an atmosphere that drift more than the noise model says."
    signature = "Autos only, along the scan, most at the largest scales, or as noise_level; acts on 1/f noise only."
    source = "Planck early results V, A&A 536, A5 (knee frequencies of LFI); Keihanen et al. 2004, A&A 428, 287"
    step = 0.05
    bounds = (Bound("amplitude", -1.0, 3.0, "a prior of this library: knees are known to a factor of four"),)
    parametrization = Parametrization(noise_alone=True, matched_filter=False)

    def knee(self, f_knee_hz: float) -> float:
        if self.amplitude < -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} makes a knee frequency negative; keep it at -1 or "
                "above."
            )
        return (1.0 + self.amplitude) * f_knee_hz


@once_per_content(4)
def _of_file(path: str, nside: int, frame: str) -> Map:
    """Return a template in the pixels of maps in a frame, once for all surveys of a process: means over finer ones.

    The variance of a pixel's mean is that of its samples, on average.
    """
    values, found, _ = map_files.read_map(Path(path))
    check_complete(values, path)
    fine, turn = healpy.npix2nside(values.size), rotation_matrix(frame, found or frame)
    pattern = values[healpy.vec2pix(fine, *(turn @ healpix.centres(nside)))]
    if fine > nside:
        count, total = np.zeros((2, pattern.size))
        for part in np.array_split(np.arange(values.size), -(-values.size // AT_ONCE)):
            inside = healpy.vec2pix(nside, *(turn.T @ np.stack(healpy.pix2vec(fine, part))))
            count += np.bincount(inside, minlength=pattern.size)
            total += np.bincount(inside, values[part], pattern.size)
        pattern = np.where(count > 0.0, divided(total, count), pattern)
    pattern.setflags(write=False)
    return pattern


MOST_HITS = 1e6  #: of a sample on average: more are no glitches, and too many to count


@dataclass(frozen=True, kw_only=True)
class ExcessNoise(Effect):
    """A random fraction of the samples has a Gaussian of a larger size added, each by itself.

    Attributes
    ----------
    amplitude
        Fraction of the samples; a sample may be hit more than once.
    glitch_uk
        Root mean square of what one hit adds, uK.

    Notes
    -----
    The number of hits is Poisson, so that their sum over h samples is sqrt(n) glitch_uk times a standard normal number,
    n Poisson of mean amplitude h: exact in both routes. The variance of a sample grows by amplitude glitch_uk^2; the
    sum's excess kurtosis is 3 / (amplitude h).
    """

    name = "excess_noise"
    scope = "channel"
    unit = "fraction of samples"
    wording = Wording("{} of the samples", " %", 100.0)
    cause = "Cosmic rays whose tails the flags do not cover, or electronics that spike."
    signature = "Autos only, as more noise: degenerate with noise_level, for tails are not measured."
    source = "Planck 2013 results X, A&A 571, A10 (glitches of HFI and what is left of them)"
    step = 1e-3
    bounds = (
        Bound("amplitude", 0.0, 1.0, "a share of the samples"),
        Bound("glitch_uk", 0.0, 1000000.0, "a size; fixed in a fit"),
    )
    parametrization = Parametrization(
        sign=1, max_amplitude=1.0, stochastic=True, mean_response=True, matched_filter=False
    )
    proposed = False

    glitch_uk: float = 500.0

    def excess(self, count: Vector, rng: np.random.Generator) -> Vector:
        if not 0.0 <= self.amplitude <= MOST_HITS:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} is no fraction; give 0 or more, and at most "
                f"{MOST_HITS:g} hits of a sample."
            )
        number = rng.poisson(self.amplitude * count)
        return np.asarray(self.glitch_uk * np.sqrt(number) * rng.standard_normal(number.size))
