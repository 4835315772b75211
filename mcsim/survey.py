"""From a configuration to what a realization needs: spectrum, beam responses, moments, weights, estimator tables."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim import beams, config, convolve, healpix, mapmaking, resources, scan, spectra
from mcsim.beams.turn import mirrored, rotated
from mcsim.biposh import Estimator, estimator
from mcsim.errors import InputError
from mcsim.mask import read_mask

Progress = Callable[[float], None]


@dataclass(frozen=True)
class SurveyMap:
    """One map of a realization.

    Attributes
    ----------
    name
        ``channel`` or ``channel:split``.
    moments
        Orientation moments of the samples in it; of a differencing scan the hits of both sides, and NaN.
    weight
        Weight before analysis, shape (npix,), mean square 1; ``None``: every pixel counts alike.
    noise_uk
        Standard deviation of the noise per pixel, shape (npix,); ``None``: no noise, or noise of differences.
    pairs
        Pairs of pixels of a differencing scan; ``None``: any other scan.
    """

    name: str
    moments: scan.Moments
    weight: NDArray[np.float64] | None
    noise_uk: NDArray[np.float64] | None
    pairs: mapmaking.DifferencingScan | None = None

    @property
    def sky_fraction(self) -> float:
        """<W^2>^2 / <W^4> of the weight W: the modes that are left, and what variances are divided by."""
        return 1.0 if self.weight is None else float(np.mean(self.weight**2) ** 2 / np.mean(self.weight**4))


@dataclass(frozen=True)
class SideB:
    """What a differencing channel has besides its side A.

    Attributes
    ----------
    beam, response
        Beam of side B.
    scan
        Transmission imbalance, noise per difference, and convergence of the map-making.
    sigma0_uk
        White noise per difference.
    """

    beam: beams.Beam
    response: convolve.Response
    scan: config.ScanDifferencing
    sigma0_uk: float


@dataclass(frozen=True)
class Channel:
    """A beam and the maps made with it; ``window`` is the pixel window, shape (lmax + 1,), ones where there is none.

    ``side_b``: the other beam of a differencing scan, None for any other scan.
    """

    name: str
    beam: beams.Beam
    response: convolve.Response
    window: NDArray[np.float64]
    maps: tuple[SurveyMap, ...]
    side_b: SideB | None = None


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

    @property
    def sky_fractions(self) -> dict[str, float]:
        """Effective fraction of the sky of every map; see :attr:`SurveyMap.sky_fraction`."""
        return {m.name: m.sky_fraction for channel in self.channels for m in channel.maps}


def survey(run: config.RunConfig, nthreads: int = 1, progress: Progress | None = None) -> Survey:
    """Load or compute everything that the realizations of a run share.

    Moments of scan models, and pairs of pixels of differencing scans, are computed once, cached on disk and
    memory-mapped, so that workers share them.

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
    """The beam of a channel, up to lmax; of a differencing scan that of side A."""
    return _beam(channel.name, channel.beam, lmax)


def load_beam_b(channel: config.Channel, lmax: int) -> beams.Beam:
    """The beam of side B of a differencing channel, up to lmax: its own, or side A's mirrored."""
    if channel.beam_b is None:
        return mirrored(load_beam(channel, lmax))
    return _beam(channel.name, channel.beam_b, lmax)


def _beam(channel: str, spec: config.Beam, lmax: int) -> beams.Beam:
    match spec:
        case config.BeamGaussian():
            return beams.gaussian(spec.fwhm_arcmin, lmax)
        case config.BeamEllipticalGaussian():
            major, minor = spec.fwhm_major_arcmin, spec.fwhm_minor_arcmin
            return beams.elliptical_gaussian(major, minor, spec.angle_deg, lmax, mmax=spec.m_max)
        case config.BeamMap():
            return rotated(load_beam_map(channel, spec).beam(lmax, spec.m_max), np.deg2rad(spec.angle_deg))
        case config.BeamBlm():
            file = config.channel_path(spec.path, channel)
            return rotated(beams.from_blm_file(file, lmax, mmax=spec.m_max), np.deg2rad(spec.angle_deg))


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
        name = spec.name if split is None else f"{spec.name}:{split}"
        pairs = None
        if isinstance(spec.scan, config.ScanDifferencing):
            pairs = _pairs(run, spec, spec.scan, split, share, nthreads, progress)
            moments = _hits_alone(pairs, max(beam.mmax, 1))
        else:
            moments = _moments(run, spec, split, share, beam.mmax, nthreads, progress)
        maps.append(_survey_map(run, spec, split, name, moments, pairs))
    response = convolve.response(beam, run.sky.lmax, window)
    return Channel(spec.name, beam, response, window, tuple(maps), _side_b(run, spec, window))


def _side_b(run: config.RunConfig, spec: config.Channel, window: NDArray[np.float64]) -> SideB | None:
    if not isinstance(spec.scan, config.ScanDifferencing):
        return None
    beam = load_beam_b(spec, run.sky.lmax)
    return SideB(beam, convolve.response(beam, run.sky.lmax, window), spec.scan, spec.noise.sigma0_uk)


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
            return scan.read_moments_fits(path, nside, mmax, frame)
        case config.ScanPointing():
            path = config.channel_path(spec.scan.path, spec.name, split)
            return scan.pointing_moments([path], nside, smax, frame)
        case config.ScanHitAveraged():
            model = scan_model(spec, spec.scan, split)
            lines = None if spec.scan.line_of_sight is None else [spec.scan.line_of_sight]
            folder = scan.cached_moments(
                model, nside, smax, frame, lines, time_range=share, nthreads=nthreads, progress=progress
            )
            return scan.Moments.load(folder, mmap=True)
        case config.ScanDifferencing():
            raise TypeError("a differencing scan has pairs of pixels, no moments")


def scan_model(
    spec: config.Channel, chosen: config.ScanHitAveraged | config.ScanDifferencing, split: str | None
) -> scan.ScanModel:
    """The scan model of a channel, at the sampling that the channel asks for."""
    template = config.channel_path(chosen.model, spec.name, split)
    model = scan.load_model(resources.scan_model(str(template)))
    return model if chosen.sample_period_s is None else model.with_sampling(chosen.sample_period_s)


def _pairs(
    run: config.RunConfig,
    spec: config.Channel,
    chosen: config.ScanDifferencing,
    split: str | None,
    share: tuple[float, float],
    nthreads: int,
    progress: Progress | None,
) -> mapmaking.DifferencingScan:
    model = scan_model(spec, chosen, split)
    return mapmaking.prepare(
        model, chosen.pair, run.map.nside, run.map.frame, share, nthreads=nthreads, progress=progress
    )


def _hits_alone(pairs: mapmaking.DifferencingScan, smax: int) -> scan.Moments:
    """What weights and masks ask of a scan, its hits; whatever asks for moments, which mean nothing here, gets NaN."""
    unknown = np.broadcast_to(np.complex128(np.nan), (smax, pairs.npix))
    return scan.Moments(pairs.nside, pairs.frame, pairs.hits_a + pairs.hits_b, unknown)


def _survey_map(
    run: config.RunConfig,
    spec: config.Channel,
    split: str | None,
    name: str,
    moments: scan.Moments,
    pairs: mapmaking.DifferencingScan | None,
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
        weight *= read_mask(path, moments.nside, run.map.frame, run.map.mask_frame, run.map.mask_apodisation_deg)
    if not weight.any():
        raise InputError(f"The mask of map {name} leaves no observed pixel; widen it or observe more of the sky.")
    noise = None
    if spec.noise.sigma0_uk > 0 and pairs is None:
        noise = np.divide(spec.noise.sigma0_uk, np.sqrt(moments.hits), out=np.zeros(weight.size), where=observed)
    uniform = bool(np.all(weight == weight[0]))
    return SurveyMap(name, moments, None if uniform else weight / np.sqrt(np.mean(weight**2)), noise, pairs)


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
