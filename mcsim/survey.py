"""From a configuration to what a realization needs: spectrum, beam responses, moments, weights, estimator tables."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import beams, config, convolve, healpix, resources, scan, spectra
from mcsim.biposh import Estimator, estimator
from mcsim.errors import InputError

Progress = Callable[[float], None]


@dataclass(frozen=True)
class SurveyMap:
    """One map of a realization.

    Attributes
    ----------
    name
        ``channel`` or ``channel:split``.
    moments
        Orientation moments of the samples in it.
    weight
        Weight before analysis, shape (npix,), mean square 1; ``None``: every pixel counts alike.
    noise_uk
        Standard deviation of the noise per pixel, shape (npix,); ``None``: no noise.
    """

    name: str
    moments: scan.Moments
    weight: NDArray[np.float64] | None
    noise_uk: NDArray[np.float64] | None


@dataclass(frozen=True)
class Channel:
    """A beam and the maps made with it; ``window`` is the pixel window, shape (lmax + 1,), ones where there is none."""

    name: str
    beam: beams.Beam
    response: convolve.Response
    window: NDArray[np.float64]
    maps: tuple[SurveyMap, ...]


@dataclass(frozen=True)
class Survey:
    """Everything that all realizations of a run share.

    ``pairs`` are indices into the maps in order, with 1 / <w_x w_y> of their weights in ``pair_norm``.
    """

    config: config.RunConfig
    cl: NDArray[np.float64] | None
    channels: tuple[Channel, ...]
    lmax: int
    estimator: Estimator
    pairs: tuple[tuple[int, int], ...]
    pair_norm: tuple[float, ...]

    @property
    def map_names(self) -> tuple[str, ...]:
        """Names of the maps, in order."""
        return tuple(m.name for channel in self.channels for m in channel.maps)

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Labels of the pairs, for example ``W1:half1,W1:half2``."""
        names = self.map_names
        return tuple(f"{names[x]},{names[y]}" for x, y in self.pairs)


def survey(run: config.RunConfig, nthreads: int = 1, progress: Progress | None = None) -> Survey:
    """Load or compute everything that the realizations of a run share.

    Moments of scan models are computed once, cached on disk and memory-mapped, so that workers share them.

    Raises
    ------
    InputError
        For files that are missing, unreadable, or do not fit the configuration.
    """
    lmax = config.analysis_lmax(run)
    cl = None if run.sky.spectrum is None else spectra.load(run.sky.spectrum, run.sky.lmax)
    channels = tuple(_channel(run, channel, nthreads, progress) for channel in run.channels)
    maps = [m for channel in channels for m in channel.maps]
    both = run.biposh.pairs == "all"
    pairs = tuple((x, y) for x in range(len(maps)) for y in range(x, len(maps)) if both or x == y)
    norm = tuple(1.0 / _overlap(maps[x], maps[y]) for x, y in pairs)
    tables = estimator(run.biposh.L_max, lmax, both_orders=both and len(maps) > 1)
    return Survey(run, cl, channels, lmax, tables, pairs, norm)


def load_beam(channel: config.Channel, lmax: int) -> beams.Beam:
    """The beam of a channel, up to lmax."""
    spec = channel.beam
    match spec:
        case config.BeamGaussian():
            return beams.gaussian(spec.fwhm_arcmin, lmax)
        case config.BeamEllipticalGaussian():
            major, minor = spec.fwhm_major_arcmin, spec.fwhm_minor_arcmin
            return beams.elliptical_gaussian(major, minor, spec.angle_deg, lmax, mmax=spec.m_max)
        case config.BeamMap():
            return load_beam_map(channel.name, spec).beam(lmax, spec.m_max)
        case config.BeamBlm():
            return beams.from_blm_file(config.channel_path(spec.path, channel.name), lmax, mmax=spec.m_max)


def load_beam_map(channel: str, spec: config.BeamMap) -> beams.BeamMap:
    """The beam map of a channel."""
    return beams.read_map(
        config.channel_path(spec.path, channel),
        pixel_deg=spec.pixel_deg,
        cut_deg=spec.cut_deg,
        centre=spec.centre_pixel,
        plane=spec.plane,
        projection=spec.projection,
    )


def _channel(run: config.RunConfig, spec: config.Channel, nthreads: int, progress: Progress | None) -> Channel:
    beam = load_beam(spec, run.sky.lmax)
    window = _window(run, spec)
    splits = run.map.splits or (None,)
    maps = []
    for index, split in enumerate(splits):
        share = (index / len(splits), (index + 1) / len(splits))
        moments = _moments(run, spec, split, share, beam.mmax, nthreads, progress)
        name = spec.name if split is None else f"{spec.name}:{split}"
        maps.append(_survey_map(run, spec, split, name, moments))
    return Channel(spec.name, beam, convolve.response(beam, run.sky.lmax, window), window, tuple(maps))


def _window(run: config.RunConfig, spec: config.Channel) -> NDArray[np.float64]:
    choice = config.pixel_window(run, spec)
    if choice == "none":
        return np.ones(run.sky.lmax + 1)
    if choice == "computed":
        return healpix.pixel_window(run.map.nside, run.sky.lmax)
    return healpix.read_pixel_window(Path(choice), run.sky.lmax)


def _moments(
    run: config.RunConfig,
    spec: config.Channel,
    split: str | None,
    share: tuple[float, float],
    mmax: int,
    nthreads: int,
    progress: Progress | None,
) -> scan.Moments:
    nside, frame, smax = run.map.nside, run.map.frame, max(mmax, 1)
    match spec.scan:
        case config.ScanParallelTransport():
            return scan.parallel_transport(np.deg2rad(spec.scan.psi0_deg), nside, smax, frame)
        case config.ScanMoments():
            path = config.channel_path(spec.scan.path, spec.name, split)
            return scan.read_moments_fits(path, nside, smax, frame)
        case config.ScanPointing():
            path = config.channel_path(spec.scan.path, spec.name, split)
            return scan.pointing_moments([path], nside, smax, frame)
        case config.ScanHitAveraged():
            template = config.channel_path(spec.scan.model, spec.name, split)
            model = scan.load_model(resources.scan_model(str(template)))
            if spec.scan.sample_period_s is not None:
                model = model.with_sampling(spec.scan.sample_period_s)
            lines = None if spec.scan.line_of_sight is None else [spec.scan.line_of_sight]
            folder = scan.cached_moments(
                model, nside, smax, frame, lines, time_range=share, nthreads=nthreads, progress=progress
            )
            return scan.Moments.load(folder, mmap=True)


def _survey_map(
    run: config.RunConfig, spec: config.Channel, split: str | None, name: str, moments: scan.Moments
) -> SurveyMap:
    observed = moments.hits > 0
    if not observed.any():
        raise InputError(
            f"The scan of map {name} hits no pixel of nside {moments.nside}; check the scan of the channel."
        )
    weight = observed.astype(float)
    if run.biposh.weighting == "hits":
        weight *= moments.hits
    if run.map.mask is not None:
        path = config.channel_path(run.map.mask, spec.name, split)
        weight *= read_mask(path, moments.nside)
    if not weight.any():
        raise InputError(f"The mask of map {name} leaves no observed pixel; widen it or observe more of the sky.")
    noise = None
    if spec.noise.sigma0_uk > 0:
        noise = np.divide(spec.noise.sigma0_uk, np.sqrt(moments.hits), out=np.zeros(weight.size), where=observed)
    uniform = bool(np.all(weight == weight[0]))
    return SurveyMap(name, moments, None if uniform else weight / np.sqrt(np.mean(weight**2)), noise)


def read_mask(path: Path, nside: int) -> NDArray[np.float64]:
    """Mask of a HEALPix FITS file as RING-ordered weights between 0 and 1, shape (12 nside^2,).

    Raises
    ------
    InputError
        If the file is no HEALPix map, has another nside, or values outside 0 ... 1.
    """
    try:
        mask = np.asarray(healpy.read_map(path, dtype=float))
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
        raise InputError(f"{path} cannot be read as a HEALPix mask ({error}); give a FITS map of weights.") from error
    found = healpy.npix2nside(mask.size)
    if found != nside:
        raise InputError(f"{path} has nside {found}, the maps have nside {nside}; bring the mask to that nside.")
    if not (np.all(np.isfinite(mask)) and mask.min() >= 0.0 and mask.max() <= 1.0):
        raise InputError(f"{path} has values outside 0 ... 1; a mask is a map of weights, 1 where the sky is used.")
    return mask


def _overlap(x: SurveyMap, y: SurveyMap) -> float:
    """<w_x w_y>: by what the weights scale the spectra of the pair."""
    if x.weight is None and y.weight is None:
        return 1.0
    product = (1.0 if x.weight is None else x.weight) * (1.0 if y.weight is None else y.weight)
    overlap = float(np.mean(product))
    if overlap <= 0.0:
        raise InputError(
            f'Maps {x.name} and {y.name} share no pixel, so they have no cross spectra; set pairs = "auto".'
        )
    return overlap
