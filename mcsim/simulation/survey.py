"""From a configuration to what a realization needs: spectrum, beam responses, moments, weights, estimator tables."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.bipolar import Estimator, estimator
from mcsim.errors import InputError
from mcsim.instrument import beams, scan
from mcsim.instrument.scan import MapGrid
from mcsim.simulation import convolve, mapmaking, windows
from mcsim.simulation.channels import (
    effects_on,
    in_channel,
    refuse_differences,
    refuse_excess,
    refuse_external,
    refuse_pixel_effects,
    refuse_short,
    scan_model,
    site_b_of,
    site_of,
    with_offsets,
)
from mcsim.simulation.filtering import Filtering, Progress
from mcsim.simulation.noise import DrawnNoise, of_map
from mcsim.simulation.pixel_means import Part, gain_of_all, signal_of_all
from mcsim.simulation.preparation import Preparation, preparation
from mcsim.simulation.rings import Rings, limit_rings, parallel_transport_rings
from mcsim.simulation.survey_filter import filtering_of
from mcsim.simulation.timestream import CorrelatedNoise
from mcsim.sphere import healpix, rng, spectra
from mcsim.sphere.checks import check_whole
from mcsim.sphere.mask import kept_mask
from mcsim.support.arrays import divided
from mcsim.support.loading import once_per_content
from mcsim.systematics import Effect, Library, Site, acts_through, seen_through, shared_gain, spread_of, variance_factor


@dataclass(frozen=True)
class SurveyMap:
    """One map of a realization, ``channel`` or ``channel:split``."""

    name: str
    #: orientation moments of its samples; of a differencing scan those of both sides, or, not asked for, hits and NaN
    moments: scan.Moments
    #: weight before analysis, shape (npix,), mean square 1; ``None``: every pixel counts alike
    weight: NDArray[np.float64] | None
    #: standard deviation of the noise per pixel, shape (npix,), of a differencing scan about, where moments were asked
    #: for; ``None``: no noise, or noise of differences
    noise_uk: NDArray[np.float64] | None
    pairs: mapmaking.DifferencingScan | None = None  #: pairs of pixels of a differencing scan; ``None``: any other scan
    #: means over the samples of a pixel of g, the relative error of the gain, g (dtheta + i dphi), and g e^{-i s psi}
    #: for s from 1 to the orders of the beam, shape (orders + 2, npix); ``None``: no error
    gain: NDArray[np.complex128] | None = None
    steady_gain: float = 0.0  #: relative error of the gain that all samples share
    #: mean of what effects add to the samples of a pixel, shape (npix,); ``None``: nothing
    signal_uk: NDArray[np.float64] | None = None
    preparation: Preparation | None = None  #: what is done to the map after it is made; ``None``: nothing
    #: how noise that is not white comes into the map, whose standard deviation noise_uk then describes; ``None``: white
    drawn: DrawnNoise | None = None

    def noise(self, seed: int, realization: int) -> NDArray[np.float64]:
        """Return the noise of a realization before any preparation, uK, shape (npix,); the map must have some."""
        assert self.noise_uk is not None  # the caller looked
        if self.drawn is None:
            draw = rng.generator(seed, realization, f"noise/{self.name}")
            return self.noise_uk * draw.standard_normal(self.noise_uk.size)
        return divided(self.noise_uk, self.drawn.level_uk) * self.drawn.draw(seed, realization)

    @property
    def left_to_apply(self) -> NDArray[np.float64] | None:
        """Return the part of the weight that the preparation has not multiplied the map with already."""
        done = None if self.preparation is None else self.preparation.weight()
        return self.weight if self.weight is None or done is None else divided(self.weight, done)


@dataclass(frozen=True)
class SideB:
    """What a differencing channel has besides its side A."""

    #: beam, response, fiducial: beam of side B with effects, its response, and the beam without effects
    beam: beams.Beam
    response: convolve.Response
    fiducial: beams.Beam
    #: scan, imbalance: fiducial transmission imbalance, which map-making uses, and its convergence; the true imbalance
    scan: config.ScanDifferencing
    #: sigma0_uk, noise_factor: white noise per difference, and the factor of its variance in every pixel, shape
    #: (npix,); None: one
    sigma0_uk: float
    noise_factor: NDArray[np.float64] | None
    imbalance: float
    iterations_short: int  #: how many iterations before convergence the map-making stops, which then starts from zeros


@dataclass(frozen=True)
class Channel:
    """A beam and the maps made with it."""

    name: str
    #: beam, response: what the sky is seen through, effects included
    beam: beams.Beam
    response: convolve.Response
    window: NDArray[np.float64]  #: fiducial pixel window, shape (lmax + 1,), ones where there is none
    maps: tuple[SurveyMap, ...]  #: one for every split
    site: Site  #: what effects may know of the channel, its fiducial beam among it
    effects: tuple[Effect, ...] = ()  #: those that act in this channel, in the order of the configuration
    side_b: SideB | None = None  #: the other beam of a differencing scan, None for any other scan
    #: the grid, where it is one of rings instead of pixels; the moments of the map then mean nothing and are NaN
    rings: tuple[Rings, ...] | None = None

    @property
    def seen_window(self) -> NDArray[np.float64]:
        """Pixel window of samples where effects leave them, (lmax + 1,)."""
        return windows.stretched(self.window, self.site.nside, spread_of(self.effects))


@dataclass(frozen=True)
class Survey:
    """Everything that all realizations of a run share.

    ``pairs`` are indices of maps, ``pair_norm`` 1 / <w_x w_y> of their weights. Prepared maps are what the channels
    describe (noise, weights, windows), and ``source`` is the survey whose maps are made; None without preparation.
    """

    config: config.RunConfig
    cl: NDArray[np.float64] | None
    channels: tuple[Channel, ...]
    lmax: int
    estimator: Estimator
    pairs: tuple[tuple[int, int], ...]
    pair_norm: tuple[float, ...]
    source: "Survey | None" = None
    filtering: Filtering | None = None  # inverse covariances of the maps

    @property
    def making(self) -> "Survey":
        """The survey whose maps are made, before their preparation."""
        return self if self.source is None else replace(self.source, config=self.config)

    @property
    def without_noise(self) -> "Survey":
        """The survey without noise that is added to maps; that of differencing scans is made with them."""
        channels = (replace(c, maps=tuple(replace(m, noise_uk=None) for m in c.maps)) for c in self.channels)
        source = None if self.source is None else self.source.without_noise
        return replace(self, channels=tuple(channels), source=source)

    @property
    def nside(self) -> int:
        """Resolution of the maps that are analysed, 0 on a grid without pixels."""
        return config.prepared_grid(self.config)[0]

    @property
    def frame(self) -> str:
        """Frame of the maps that are analysed."""
        return config.prepared_grid(self.config)[1]

    @property
    def maps(self) -> tuple[SurveyMap, ...]:
        """Maps of all channels, in order."""
        return tuple(m for channel in self.channels for m in channel.maps)

    @property
    def preparations(self) -> tuple[Preparation | None, ...]:
        """What is done to each map after it is made."""
        return tuple(m.preparation for m in self.maps)

    @property
    def map_names(self) -> tuple[str, ...]:
        """Names of the maps, in order."""
        return tuple(m.name for m in self.maps)

    @property
    def pair_names(self) -> tuple[str, ...]:
        """Labels of the pairs, for example ``W1:half1,W1:half2``."""
        names = self.map_names
        return tuple(f"{names[x]},{names[y]}" for x, y in self.pairs)


def survey(
    run: config.RunConfig,
    nthreads: int = 1,
    progress: Progress | None = None,
    orders: int = 0,
    library: Library | None = None,
) -> Survey:
    """Load or compute everything that the realizations of a run share; InputError for files that do not fit it.

    Moments of scan models, and pairs of pixels of differencing scans, are computed once and cached for all workers.
    ``orders``: moments up to this order even where the beam needs fewer (of a file of moments, all that it has).
    ``library``: the effects that the run may name; default: the catalogue.
    """
    check_whole(nthreads, "nthreads", 1)
    refuse_external(run)
    cl = None if run.sky.spectrum is None else spectra.load(run.sky.spectrum, run.sky.lmax)
    each = []
    for spec in run.channels:
        with in_channel(run, spec):
            each.append(_channel(run, spec, nthreads, progress, orders, library))
    made = tuple(each)
    channels = (
        tuple(_prepared(run, *each) for each in zip(run.channels, made, strict=True)) if run.preparation else made
    )
    maps = [m for channel in channels for m in channel.maps]
    size, both = len(maps), run.biposh.pairs == "all"
    pairs = tuple((x, y) for x in range(size) for y in range(x, size) if both or x == y)
    norm = tuple(1.0 / _overlap(maps[x], maps[y]) for x, y in pairs)
    tables = estimator(run.biposh.L_max, config.analysis_lmax(run), both_orders=both and size > 1)
    filters = filtering_of(run, (made, channels), cl, (pairs, tables), nthreads)
    found = Survey(run, cl, made, config.analysis_lmax(run), tables, pairs, norm, None, filters)
    return replace(found, channels=channels, source=found) if run.preparation else found


def _channel(
    run: config.RunConfig,
    spec: config.Channel,
    nthreads: int,
    progress: Progress | None,
    orders: int,
    library: Library | None,
) -> Channel:
    acting = effects_on(run, spec.name, library)
    if not isinstance(spec.scan, config.ScanDifferencing):
        refuse_differences(spec.name, acting)
    site = site_of(run, spec)
    if run.map.grid == "gl":
        return _channel_on_rings(run, spec, site, acting)
    window = _window(run, spec)
    beam = seen_through(acting, site)
    maps, splits = [], run.map.each_split
    for index, split in enumerate(splits):
        offsets = 1 if run.map.offset_order is None else run.map.offset_order
        grid = MapGrid(run.map.resolution, run.map.frame, run.map.span(index), max(offsets, 1))
        pairs = None
        if isinstance(spec.scan, config.ScanDifferencing):
            model = scan_model(spec, spec.scan, split)
            refuse_excess(spec.name, acting)
            sides = model.with_lines_of_sight(*(side.name for side in model.pair(spec.scan.pair)))
            scan.warn_of_aliases(sides, grid)
            pairs = mapmaking.prepare(model, spec.scan.pair, grid, nthreads=nthreads, progress=progress)
            smax = max(beam.mmax, orders, 1)
            moments = pairs.moments(smax, nthreads, progress) if orders else pairs.hits_alone(smax)
            moments = with_offsets(moments, offsets, spec)
        else:
            smax = max(beam.mmax, orders)
            if isinstance(spec.scan, config.ScanMoments):
                path = config.channel_path(spec.scan.path, spec.name, split)
                wanted = smax if smax == site.beam.mmax else None
                moments = _moments_of_file(path, grid.nside, wanted, grid.frame)
                refuse_short(spec.name, moments.smax, site.beam)
            else:
                moments = _moments(spec, split, grid, max(smax, 1), nthreads, progress)
            if run.map.split_by == "rings" and _whole_survey(spec.scan):
                moments = replace(moments, hits=moments.hits / len(splits))
            moments = with_offsets(moments, offsets, spec)
            # An effect may give the beam higher orders than a file of moments has: they are left out.
            beam = beam.truncated(moments.smax) if acting and moments.smax < beam.mmax else beam
        m = _survey_map(run, spec, split, moments, pairs)
        if pairs is not None and orders:
            m = replace(m, noise_uk=mapmaking.level_uk(pairs, _sigma0_uk(spec)))
        m = with_effects(m, acting, site)
        part = Part.of(run, index)
        gain, signal_uk = gain_of_all(acting, site, part, beam.mmax), signal_of_all(acting, site, part)
        steady = shared_gain(acting, replace(site, split=split))
        maps.append(replace(m, gain=gain, steady_gain=steady, signal_uk=signal_uk))
    seen_window = windows.stretched(window, site.nside, spread_of(acting))  # samples closer to centres blur less
    response = convolve.response(beam, run.sky.lmax, seen_window)
    side_b = _side_b(spec, seen_window, site, acting)
    return Channel(spec.name, beam, response, window, tuple(maps), site, acting, side_b)


def _whole_survey(scan: config.Scan) -> bool:
    """Return True if a scan describes all rings, whatever the split."""
    if isinstance(scan, config.ScanPointing | config.ScanMoments):
        return "{split}" not in str(scan.path)
    return isinstance(scan, config.ScanHitAveraged)


def _prepared(run: config.RunConfig, spec: config.Channel, channel: Channel) -> Channel:
    """Return what the analysis knows of a channel whose maps are prepared."""
    maps = []
    for split, m in zip(run.map.each_split, channel.maps, strict=True):
        assert m.preparation is not None  # as of every map of a run that declares one
        steps = m.preparation
        steps.check(m.moments.hits)
        moments = steps.moments(m.moments)
        noise = None if m.noise_uk is None else steps.noise_uk(m.noise_uk, m.moments.hits)
        weight = _weight(run, spec, split, m.name, moments, steps.weight())
        own = replace(m, moments=moments, noise_uk=noise, weight=weight)
        maps.append(replace(own, gain=None, steady_gain=0.0, signal_uk=None))
    pixels, smoothing = steps.pixel_window(run.sky.lmax), steps.beam_window(run.sky.lmax)
    return replace(
        channel,
        beam=steps.beam(channel.beam),
        response=convolve.Response(np.asarray(channel.response.factors * (pixels * smoothing))),
        window=channel.window * pixels,
        maps=tuple(maps),
        site=steps.site(channel.site),
    )


def _channel_on_rings(run: config.RunConfig, spec: config.Channel, site: Site, acting: tuple[Effect, ...]) -> Channel:
    refuse_pixel_effects(spec.name, acting)
    beam = seen_through(acting, site)
    response = convolve.response(beam, run.sky.lmax)
    orders = [s for s in range(1, response.mmax + 1) if response.factors[s].any()]
    degree = run.sky.lmax + config.analysis_lmax(run)
    match spec.scan:
        case config.ScanParallelTransport():
            grid = parallel_transport_rings(np.deg2rad(spec.scan.psi0_deg), orders, degree)
        case config.ScanHitAveraged():
            grid = limit_rings(scan_model(spec, spec.scan, None), orders, degree)
        case _:
            raise TypeError("the configuration refuses other scans on rings")
    unknown = scan.Moments(1, run.map.frame, np.full(12, np.nan), np.full((max(beam.mmax, 1), 12), np.nan + 0j))
    m = SurveyMap(spec.name, unknown, None, None)
    return Channel(spec.name, beam, response, np.ones(run.sky.lmax + 1), (m,), site, acting, rings=grid)


def _side_b(spec: config.Channel, window: NDArray[np.float64], site: Site, acting: tuple[Effect, ...]) -> SideB | None:
    if not isinstance(spec.scan, config.ScanDifferencing):
        return None
    other = site_b_of(site, spec)
    beam = seen_through(acting, other)
    response = convolve.response(beam, site.lmax, window)
    imbalance, short = spec.scan.transmission_imbalance, 0
    for effect in acting:
        imbalance, short = effect.differencing(imbalance, short)
    factor = variance_factor(acting, site)
    return SideB(beam, response, other.beam, spec.scan, _sigma0_uk(spec), factor, imbalance, short)


def _sigma0_uk(spec: config.Channel) -> float:
    assert isinstance(spec.noise, config.Noise)  # the configuration refuses other noise of differences
    return spec.noise.sigma0_uk


def with_effects(m: SurveyMap, acting: tuple[Effect, ...], site: Site) -> SurveyMap:
    """Return the map with what effects make of its moments and noise."""
    moments, noise, drawn, spread = m.moments, m.noise_uk, m.drawn, spread_of(acting)
    for effect in acting:
        moments = effect.orientations(moments, site)
        factor = effect.noise(site)
        if factor is not None and noise is not None:
            noise = noise * np.sqrt(np.clip(factor, 0.0, None))
        if isinstance(drawn, CorrelatedNoise) and effect.amplitude != 0.0 and acts_through(effect, "knee"):
            drawn = drawn.with_knee(effect.knee(drawn.noise.f_knee_hz))
    if spread != 1.0:
        moments = moments.shrunk(spread)
    return replace(m, moments=moments, noise_uk=noise, drawn=drawn)


def _window(run: config.RunConfig, spec: config.Channel) -> NDArray[np.float64]:
    choice = config.pixel_window(run, spec)
    if choice == "none":
        return np.ones(run.sky.lmax + 1)
    if choice == "computed":
        return healpix.pixel_window(run.map.resolution, run.sky.lmax)
    return healpix.read_pixel_window(Path(choice), run.sky.lmax, run.map.resolution)


def _moments(
    spec: config.Channel, split: str | None, grid: MapGrid, smax: int, nthreads: int, progress: Progress | None
) -> scan.Moments:
    match spec.scan:
        case config.ScanParallelTransport():
            return scan.Moments.parallel_transport(grid.nside, spec.scan.psi0_deg, smax, grid.frame)
        case config.ScanPointing():
            path = config.channel_path(spec.scan.path, spec.name, split)
            return scan.Moments.from_pointing_files([path], grid.nside, smax, grid.frame, grid.offset_order)
        case config.ScanHitAveraged():
            model = scan_model(spec, spec.scan, split)
            scan.warn_of_aliases(model, grid)
            return _mapped(scan.cached_moments(model, grid, smax, nthreads, progress))
        case config.ScanMoments() | config.ScanDifferencing():
            raise TypeError("the caller reads files of moments, and a differencing scan has no moments")


_mapped = lru_cache(maxsize=16)(scan.Moments.load)  # once for all surveys: the folder's name says what is in it


@once_per_content(16)
def _moments_of_file(path: Path, nside: int, smax: int | None, frame: str) -> scan.Moments:
    """Read moments once for all surveys of a process that differ in effects alone."""
    return scan.read_moments(path, nside, smax, frame)


def _survey_map(
    run: config.RunConfig,
    spec: config.Channel,
    split: str | None,
    moments: scan.Moments,
    pairs: mapmaking.DifferencingScan | None,
) -> SurveyMap:
    """Return a map without effects: moments, weights of its pixels, and noise."""
    name = spec.name if split is None else f"{spec.name}:{split}"
    if not np.any(moments.hits > 0):
        raise InputError(
            f"The scan of map {name} hits no pixel of nside {moments.nside}; check the scan of the channel."
        )
    moments, noise, drawn = (moments, None, None) if pairs is not None else of_map(run, spec, split, moments)
    steps = preparation(run, spec, split)
    weight = None if steps is not None else _weight(run, spec, split, name, moments)
    return SurveyMap(name, moments, weight, noise, pairs, preparation=steps, drawn=drawn)


def _weight(
    run: config.RunConfig,
    spec: config.Channel,
    split: str | None,
    name: str,
    moments: scan.Moments,
    done: NDArray[np.float64] | None = None,
) -> NDArray[np.float64] | None:
    """Return the weight of a map that is analysed; ``done``: by which its preparation multiplied it."""
    weight = (moments.hits > 0).astype(float)
    if run.biposh.weighting == "hits":
        weight *= moments.hits
    mask = spec.mask or run.map.mask
    if mask is not None:
        path = config.channel_path(mask, spec.name, split)
        weight *= kept_mask(path, moments.nside, moments.frame, run.map.mask_frame, run.map.mask_apodisation_deg)
    if done is not None:
        weight *= done
    if not weight.any():
        raise InputError(f"The mask of map {name} leaves no observed pixel; widen it or observe more of the sky.")
    uniform = bool(np.all(weight == weight[0]))
    return None if uniform else weight / np.sqrt(np.mean(weight**2))


def _overlap(x: SurveyMap, y: SurveyMap) -> float:
    """Return <w_x w_y>, by which the weights scale the spectra of the pair."""
    if x.weight is None and y.weight is None:
        return 1.0
    product = (1.0 if x.weight is None else x.weight) * (1.0 if y.weight is None else y.weight)
    overlap = float(np.mean(product))
    if overlap <= 0.0:
        raise InputError(
            f'Maps {x.name} and {y.name} share no pixel, so they have no cross spectra; set biposh.pairs = "auto".'
        )
    return overlap
