"""Noise of the pixels of a map: its standard deviation, and how it is drawn, from what a run says of the channel."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.config import noise as declared
from mcsim.errors import InputError
from mcsim.instrument.scan import MapGrid, Moments
from mcsim.simulation import timestream
from mcsim.simulation.channels import scan_model
from mcsim.sphere import header, map_files
from mcsim.sphere.checks import UNSEEN_BELOW, check_not_infinite
from mcsim.sphere.mask import kept_mask
from mcsim.support.arrays import Map, divided
from mcsim.support.numbers import measured

SMALLEST_UK2 = 1e-8
"""Largest variance of a map of variances, and mean square of a map of noise, at least.

1 uK^2 is 1e-12 K^2, and the best surveys have 1e-4 uK^2 a pixel.
"""


class DrawnNoise(Protocol):
    """Noise of a map that is not white."""

    @property
    def level_uk(self) -> Map:
        """Its standard deviation, about, shape (npix,), 0 where nothing is observed."""

    def draw(self, seed: int, realization: int) -> Map:
        """Return the noise of a realization, uK, shape (npix,)."""


@dataclass(frozen=True)
class Level:
    """Level of white noise from the differences of splits."""

    #: sigma_uk, error_uk: noise per observation, or, isotropic, of a pixel of one split; its standard error
    sigma_uk: float
    error_uk: float
    #: pixels, splits: from how many
    pixels: int
    splits: int
    isotropic: bool  #: True if the noise was taken to be the same in all pixels

    def __str__(self) -> str:
        """Say it in words."""
        per = "per pixel of a split" if self.isotropic else "per observation"
        return (
            f"{measured(self.sigma_uk, self.error_uk, ' uK')} {per}, from the differences of {self.splits} splits in "
            f"{self.pixels} pixels"
        )


@dataclass(frozen=True, eq=False)
class NoiseOfFiles:
    """Noise maps in files, ``template`` with {realization}, ``like`` the moments of the map that they are of."""

    template: str
    like: Moments
    frequency_ghz: float | None
    level_uk: Map

    def draw(self, seed: int, realization: int) -> Map:
        """Return the map of a realization; InputError for a file that cannot be used."""
        return _noise_map(Path(self.template.format(realization=realization)), self.like, self.frequency_ghz)


def of_map(
    run: config.RunConfig, spec: config.Channel, split: str | None, moments: Moments
) -> tuple[Moments, Map | None, DrawnNoise | None]:
    """Return moments of a map, standard deviation of its noise, and how it is drawn where it is not white.

    The deviation has shape (npix,) and is None without noise. A map of hits takes the place of the scan's hits, and
    what is not observed in a map of hits or variances is not observed. InputError if a file of the run cannot be used;
    its pixels and frame must be those of the maps that are made.
    """
    noise = spec.noise_of(split)
    if isinstance(noise, declared.Noise) and noise.hits is not None:
        path = config.channel_path(noise.hits, spec.name, split)
        moments = replace(moments, hits=np.where(moments.hits > 0, _positive(path, moments, map_files.HITS)[0], 0.0))
    if declared.is_noise_free(noise):
        return moments, None, None
    observed = moments.hits > 0
    match noise:
        case declared.Noise():
            return moments, divided(noise.sigma0_uk, np.sqrt(moments.hits)), None
        case declared.NoiseDepth():
            side = np.rad2deg(healpy.nside2resol(moments.nside)) * 60.0
            return moments, np.where(observed, noise.depth_uk_arcmin / side, 0.0), None
        case declared.NoiseVariance():
            path = config.channel_path(noise.variance, spec.name, split)
            variance, unit = _positive(path, moments, map_files.VARIANCE)
            variance = header.to_uk2(unit, path, spec.frequency_ghz) * variance
            moments = replace(moments, hits=np.where(variance > 0.0, moments.hits, 0.0))
            return moments, np.where(moments.hits > 0, np.sqrt(variance), 0.0), None
        case declared.NoiseDifference():
            level, hits = _difference(run, spec, noise, moments)
            own = [hits[run.map.splits.index(split)]] if split is not None else hits
            together = np.sum(own, axis=0)
            own_hits = np.minimum(together, 1.0) * moments.hits if noise.isotropic else together
            moments = replace(moments, hits=np.where(observed, own_hits, 0.0))
            return moments, np.where(moments.hits > 0, divided(level.sigma_uk, np.sqrt(together)), 0.0), None
        case declared.NoiseRealizations():
            template = noise.files.replace("{channel}", spec.name).replace("{split}", str(split))
            first = _noise_map(Path(template.format(realization=0)), moments, spec.frequency_ghz)
            level_uk = divided(timestream.per_hit(first, moments.hits), np.sqrt(moments.hits))
            return moments, level_uk, NoiseOfFiles(template, moments, spec.frequency_ghz, level_uk)
        case declared.NoiseCorrelated():
            correlated = _correlated(run, spec, noise, split, moments)
            # Every other ring hits a pixel about half as often as all of them; the time stream knows how often.
            moments = replace(moments, hits=np.where(observed, correlated.hits, 0.0))
            return moments, correlated.level_uk, correlated


def difference_level(run: config.RunConfig, channel: str, split: str | None = None) -> Level:
    """Return the level of noise of kind "difference" that a channel of a run has, with its error.

    Notes
    -----
    With maps m_i of h_i observations each (isotropic: h_i = 1), of noise sigma^2 / h_i and the same sky, and their mean
    m = sum h_i m_i / sum h_i, sum_i h_i (m_i - m)^2 / sigma^2 is a chi^2 of n - 1 degrees of freedom in every pixel; of
    two splits it is the half-difference squared over its variance. The mean over N pixels gives sigma, with a relative
    error of 1 / sqrt(2 N (n - 1)). A constant offset of each split is fitted along. What else differs between the
    splits (calibration, foregrounds in another beam) counts as noise: mask it.
    """
    spec = next((one for one in run.channels if one.name == channel), None)
    noise = None if spec is None else spec.noise_of(split)
    if spec is None or not isinstance(noise, declared.NoiseDifference):
        raise InputError(f'channel {channel} of {run.name} has no noise of kind "difference"; name one that has.')
    npix = 12 * run.map.resolution**2
    anywhere = Moments(run.map.resolution, run.map.frame, np.ones(npix), np.zeros((1, npix), dtype=np.complex128))
    return _difference(run, spec, noise, anywhere)[0]


def in_words(run: config.RunConfig) -> list[str]:
    """Return lines on noise whose level is estimated from data, and on noise that takes time to draw."""
    lines: dict[str, None] = {}  # splits that share a line have it once
    for one in run.each_map:
        match one.channel.noise_of(one.split):
            case declared.NoiseDifference():
                lines[f"{one.channel.name} {difference_level(run, one.channel.name, one.split)}"] = None
            case declared.NoiseCorrelated() as noise:
                number = _samples(run, *one)
                lines[f"{one.name} 1/f, {number:.3g} samples for each realization, {noise.map_making}"] = None
    return list(lines)


def seconds(run: config.RunConfig) -> float:
    """Return the time of a core, for a realization, that correlated noise takes."""
    return timestream.SECONDS_PER_SAMPLE * sum(
        _samples(run, spec, split)
        for spec, split in run.each_map
        if isinstance(spec.noise_of(split), declared.NoiseCorrelated)
    )


def _samples(run: config.RunConfig, spec: config.Channel, split: str | None) -> float:
    """Return the number of samples from which the noise of a split is made."""
    assert isinstance(spec.scan, config.ScanHitAveraged)  # the configuration refuses other scans
    model = scan_model(spec, spec.scan, split)
    first, last = run.map.span(run.map.each_split.index(split))
    return (last - first) * sum(model.samples(line) for line in model.select())


def _difference(
    run: config.RunConfig, spec: config.Channel, noise: declared.NoiseDifference, moments: Moments
) -> tuple[Level, NDArray[np.float64]]:
    """Return the level of the noise, and the hits of the splits, shape (split, npix)."""
    paths = [config.channel_path(path, spec.name) for path in noise.maps]
    maps = np.stack([_temperature(path, moments, spec.frequency_ghz) for path in paths])
    if noise.isotropic:
        hits = np.isfinite(maps).astype(np.float64)
    else:
        given = [config.channel_path(path, spec.name) for path in noise.hits] or paths
        hits = np.stack([_positive(path, moments, map_files.HITS, bool(noise.hits))[0] for path in given])
    used = np.all(np.isfinite(maps) & (hits > 0.0), axis=0)
    if noise.mask is not None:
        mask = kept_mask(config.channel_path(noise.mask, spec.name), moments.nside, moments.frame, run.map.mask_frame)
        used &= mask > 0.0
    if used.sum() < len(maps) + 1:
        raise InputError(
            f"the splits {', '.join(map(str, paths))} have {used.sum()} pixels in common outside the mask, too few for "
            "the level of their noise; widen the mask."
        )
    m, h = maps[:, used], hits[:, used]
    share = h / h.sum(axis=0)
    apart = m - np.sum(share * m, axis=0)
    normal = np.diag(h.sum(axis=1)) - h @ share.T
    offset = np.linalg.lstsq(normal, np.sum(h * apart, axis=1))[0]
    apart -= offset[:, None] - offset @ share
    freedom = (len(maps) - 1) * (used.sum() - 1)
    sigma = float(np.sqrt(np.sum(h * apart**2) / freedom))
    if sigma == 0.0:
        raise InputError(f"the splits {', '.join(map(str, paths))} do not differ; give maps of independent noise.")
    if sigma**2 < SMALLEST_UK2 * float(np.median(h)):
        raise InputError(
            f"the splits {', '.join(map(str, paths))} differ by {sigma / math.sqrt(float(np.median(h))):.3g} uK in a "
            f"pixel, less than the noise of any map ({math.sqrt(SMALLEST_UK2):g} uK); say their unit in their headers "
            "(TUNIT), or give them in uK."
        )
    return Level(sigma, sigma / float(np.sqrt(2.0 * freedom)), int(used.sum()), len(maps), noise.isotropic), hits


def _correlated(
    run: config.RunConfig, spec: config.Channel, noise: declared.NoiseCorrelated, split: str | None, moments: Moments
) -> timestream.CorrelatedNoise:
    assert isinstance(spec.scan, config.ScanHitAveraged)  # the configuration refuses other scans
    place, name = 0, spec.name
    rings = None
    if split is not None:
        place = run.map.splits.index(split)
        rings = run.map.rings(place)
        if rings is None:  # rings are of one time stream
            name = f"{spec.name}:{split}"
    grid = MapGrid(moments.nside, moments.frame, run.map.span(place))
    return timestream.correlated_noise(noise, scan_model(spec, spec.scan, split), grid, f"noise/{name}", rings)


def _noise_map(path: Path, moments: Moments, frequency_ghz: float | None) -> Map:
    """Return a noise map where the scan observes, 0 elsewhere; InputError if it has no noise to speak of."""
    found = _temperature(path, moments, frequency_ghz)
    missing = int(np.sum(~np.isfinite(found) & (moments.hits > 0)))
    if missing:
        raise InputError(
            f"{path} has no noise in {missing} pixels that the scan observes; give them a value, or set "
            "them to 0 if a mask leaves them out."
        )
    found = np.where(moments.hits > 0, found, 0.0)
    square = float(np.mean(found**2))
    if square < SMALLEST_UK2:
        raise InputError(
            f"{path} has noise of {math.sqrt(square):.3g} uK rms, less than any map's ({math.sqrt(SMALLEST_UK2):g} "
            "uK); give a map that has noise, say its unit in its header (TUNIT), or give it in uK."
        )
    return found


def _temperature(path: Path, moments: Moments, frequency_ghz: float | None) -> Map:
    """Return a map in uK, NaN where nothing was observed."""
    values = map_files.read_uk(path, moments.frame, frequency_ghz)
    _check_nside(values, path, moments)
    return np.where(np.isfinite(values) & (values > UNSEEN_BELOW), values, np.nan)


def _positive(path: Path, moments: Moments, names: Sequence[str], alone: bool = True) -> tuple[Map, str | None]:
    """Return a map of hits or variances, 0 where nothing was observed, and its unit.

    ``alone``: a file with a single column holds it, whatever it is called.
    """
    others = map_files.VARIANCE if names is map_files.HITS else (*map_files.HITS, *map_files.WEIGHT)
    other = (*map_files.POLARISATION, *map_files.DEVIATION, *others)
    values, _, unit = map_files.read_map(path, tuple(names), moments.frame, alone=alone, other=other)
    _check_nside(values, path, moments)
    if names is map_files.HITS:
        header.refuse_temperature(unit, path, "the number of observations")
        check_not_infinite(values, str(path))  # an infinite variance is that of a pixel that was not observed
    values = np.where(np.isfinite(values) & (values > UNSEEN_BELOW), values, 0.0)
    if unit is None and names is map_files.VARIANCE and 0.0 < values.max() < SMALLEST_UK2:
        raise InputError(
            f"{path} has variances of at most {values.max():.3g} uK^2, less than any map's ({SMALLEST_UK2:g} uK^2); "
            "are they in K^2? Say the unit in its header (TUNIT), or give them in uK^2."
        )
    if values.min() < 0.0 or not np.any((values > 0.0) & (moments.hits > 0)):
        raise InputError(
            f"{path} has values between {values.min():g} and {values.max():g} for {names[0]} where the scan observes; "
            "they must be positive, and 0 or UNSEEN where nothing was observed."
        )
    return values, unit


def _check_nside(values: Map, path: Path, moments: Moments) -> None:
    nside = healpy.npix2nside(values.size)
    if nside != moments.nside:
        raise InputError(
            f"{path} has nside {nside}, but maps are made with map.nside = {moments.nside}; set map.nside to {nside} "
            "(a preparation can degrade the maps)."
        )
