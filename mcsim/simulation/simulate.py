"""One realization: sky -> beams under the scan -> maps -> a_lm -> BipoSH and power spectra."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import bipolar, systematics
from mcsim.simulation import convolve, differencing, rings, skies
from mcsim.simulation.channels import refuse_unseen
from mcsim.simulation.offsets import Expansion, expansion, offset_maps
from mcsim.simulation.survey import Channel, Survey, SurveyMap
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng
from mcsim.sphere.sky import dipole_alm, gaussian_alm
from mcsim.support.arrays import Alm, Map, Maps, divided


@dataclass(frozen=True)
class Observed:
    """A map's a_lm, those of its circular-beam control, and the map itself where asked for."""

    alm: Alm
    circular: Alm | None
    map_uk: Map | None


def realize(survey: Survey, realization: int, nthreads: int = 1) -> dict[str, NDArray]:
    """Return the spectra of one realization.

    Its index, >= 0, fixes every random number with the run's seed. They are ``biposh`` (pair, mode, lmax + 1) complex
    and ``cl`` (pair, lmax + 1), uK^2; with a filter ``biposh_qml`` (pair, mode, bin); with pairing the same of the
    circular-beam control, ``biposh_circular`` and so on; with kept maps ``observed_map`` (map, npix), uK.
    """
    ensemble = survey.config.ensemble
    sky = draw_sky(survey, realization)
    made = circular_maps(survey, nthreads)
    observed = [result for channel in survey.channels for result in _observe(survey, channel, sky, realization, made)]
    result = _spectra(survey, [o.alm for o in observed], "")
    if ensemble.paired:
        result |= _spectra(survey, [o.circular for o in observed if o.circular is not None], "_circular")
    if ensemble.keep_maps:
        result["observed_map"] = np.stack([o.map_uk for o in observed if o.map_uk is not None])
    return result


def draw_sky(survey: Survey, realization: int) -> Alm:
    """Draw the sky of one realization, or read it from the user's files: a_lm up to the sky's lmax, uK."""
    if (known := skies.given(survey.config, realization)) is not None:
        return known
    assert survey.cl is not None  # the configuration holds at least one of the three sources
    return gaussian_alm(survey.cl, rng.generator(survey.config.ensemble.seed, realization, "sky"))


def maps(survey: Survey, realization: int, nthreads: int = 1, sky: Alm | None = None) -> Maps:
    """Return the maps of one realization with effects and noise, uK, shape (map, npix), ``healpy.UNSEEN`` without hits.

    They are prepared where the run says how.

    ``sky``: coefficients up to the sky's lmax, in place of those that the realization would draw.
    """
    if sky is None:
        sky = draw_sky(survey, realization)
    made = circular_maps(survey, nthreads)
    return np.stack([m for one in survey.making.channels for m in maps_of(survey, one, sky, realization, made)])


def maps_of(survey: Survey, channel: Channel, sky: Alm, realization: int, made: convolve.CircularMaps) -> list[Map]:
    """Return the maps of one channel of :attr:`Survey.making`, as :func:`maps` does; ``made``: of other channels."""
    if channel.side_b is not None:
        seen, dipole = _seen(survey.making, channel, sky, realization)
        seed = survey.config.ensemble.seed
        made_at_once = differencing.whole_maps(channel, seen, dipole, seed, realization, made.nthreads)
        return [_finished(m, map_uk) for m, map_uk in made_at_once]
    parts = _map_parts(survey.making, channel, sky, realization, made, smooth=True)
    return [_finished(m, own.total) for m, own in parts]


def _finished(m: SurveyMap, map_uk: Map) -> Map:
    """Return a map that was made as it is handed out: without what was not observed, and prepared."""
    observed = np.where(m.moments.hits > 0, map_uk, healpy.UNSEEN)
    return observed if m.preparation is None else m.preparation.apply(observed)


@dataclass(frozen=True)
class MapParts:
    """The parts that add up to a map, uK, shape (npix,) each.

    They are analysed apart, so that the quadrature error of the circular-beam control cancels in the paired difference.
    """

    #: the sky through the circular part of the beam at the pixels' centres; None where its a_lm stand for it
    smooth: Map | None
    #: The rest of the circular-beam control: centroids, noise, gain, what effects add to samples. None: nothing.
    extra: Map | None
    difference: Map | None  #: What the rest of the beam adds. None: nothing.

    @property
    def total(self) -> Map:
        """Sum of the parts."""
        return reduce(np.add, [part for part in (self.smooth, self.extra, self.difference) if part is not None])


def circular_maps(survey: Survey, nthreads: int = 1) -> convolve.CircularMaps:
    """Return what makes the maps of circular beams of a survey."""
    return convolve.CircularMaps(survey.config.map.resolution, survey.config.sky.lmax, nthreads)


def _observe(
    survey: Survey, channel: Channel, sky: Alm, realization: int, made: convolve.CircularMaps
) -> Iterator[Observed]:
    """Yield the analysed maps of a channel for one sky."""
    ensemble, making = survey.config.ensemble, survey.making
    if channel.rings is not None:
        yield _observe_on_rings(survey, channel, channel.rings, sky, realization, made.nthreads)
        return
    source = next(one for one in making.channels if one.name == channel.name)
    plain = survey.source is None and survey.filtering is None
    smooth = ensemble.keep_maps or not (plain and all(_is_exact(survey, m) for m in channel.maps))
    known = None
    if plain and channel.side_b is None:
        known = _circular(channel, *_seen(survey, channel, sky, realization))
    parts_of_maps = _map_parts(making, source, sky, realization, made, smooth)
    for m, (own, parts) in zip(channel.maps, parts_of_maps, strict=True):
        if survey.filtering is not None:
            alm, control = _filtered(survey, m, parts)
        elif survey.source is not None:
            alm, control = _prepared(survey, channel, (m, own), parts, made.nthreads)
        else:
            alm, control = _analysed(survey, channel, m, parts, known if _is_exact(survey, m) else None, made.nthreads)
        kept = _finished(own, parts.total) if ensemble.keep_maps else None
        yield Observed(alm, control if ensemble.paired else None, kept)


def _analysed(
    survey: Survey, channel: Channel, m: SurveyMap, parts: MapParts, known: Alm | None, nthreads: int
) -> tuple[Alm, Alm]:
    """Return the a_lm of a map and of its control; ``known``: of the smooth part, where they follow without it."""
    if known is not None:
        control = alm_.multiply(known, 1.0 / channel.window, survey.config.sky.lmax)
        if parts.extra is not None:
            control = control + _analyse(survey, channel, parts.extra, None, nthreads)
    else:
        assert parts.smooth is not None  # asked for above
        circular = parts.smooth if parts.extra is None else parts.smooth + parts.extra
        control = _analyse(survey, channel, circular, m.weight, nthreads)
    if parts.difference is None:
        return control, control
    return control + _analyse(survey, channel, parts.difference, m.weight, nthreads), control


def _prepared(
    survey: Survey, channel: Channel, maps: tuple[SurveyMap, SurveyMap], parts: MapParts, nthreads: int
) -> tuple[Alm, Alm | None]:
    """Return the a_lm of a map, and of its control where there is one: each prepared by itself.

    ``maps``: what the analysis knows of the map, and the map before its preparation.
    """
    m, own = maps
    alm = _analyse(survey, channel, _finished(own, parts.total), m.left_to_apply, nthreads)
    if not survey.config.ensemble.paired or parts.difference is None:
        return alm, alm
    circular = _finished(own, replace(parts, difference=None).total)
    return alm, _analyse(survey, channel, circular, m.left_to_apply, nthreads)


def _filtered(survey: Survey, m: SurveyMap, parts: MapParts) -> tuple[Alm, Alm | None]:
    """Return a map, and its control where there is one, as :class:`mcsim.simulation.map_filter.MapFilter` has them.

    What a preparation subtracts and masks is nothing to the filter, so it is not done.
    """
    assert survey.filtering is not None  # the caller looked
    apply = next(each.apply for each in survey.filtering.filters if each.name == m.name)
    if not survey.config.ensemble.paired:
        return apply(parts.total)[0], None
    control, near = apply(replace(parts, difference=None).total)
    return (control if parts.difference is None else apply(parts.total, near)[0]), control


def _map_parts(
    survey: Survey, channel: Channel, sky: Alm, realization: int, made: convolve.CircularMaps, smooth: bool
) -> Iterator[tuple[SurveyMap, MapParts]]:
    """Yield the maps of a channel for one sky, in parts; transforms that splits share are made once."""
    run = survey.config
    nside, seed, nthreads = run.map.resolution, run.ensemble.seed, made.nthreads
    seen, dipole = _seen(survey, channel, sky, realization)
    if channel.side_b is not None:
        for m, circular_uk, rest_uk in differencing.maps(channel, seen, dipole, seed, realization, nthreads):
            yield m, MapParts(circular_uk, None, rest_uk)
        return
    circular = _circular(channel, seen, dipole)
    seen_spins = convolve.spin_maps(seen, channel.response, nside, nthreads)
    spins = dict(seen_spins)
    if dipole is not None:
        for s, map_uk in convolve.spin_maps(dipole, _fiducial_response(channel), nside, nthreads).items():
            spins[s] = spins[s] - map_uk if s in spins else -map_uk
    flat = made.map(circular) if smooth else None
    gains = [_gain_of(m, systematics.spread_of(channel.effects)) for m in channel.maps]
    scaled = None
    if any(gain is not None for gain in gains):
        scaled = _seen_by_gains(channel, seen, nthreads)
    gradient = None
    terms = _expansion(channel)
    offsets: list[Map] = []
    if terms is not None:
        offsets = offset_maps(_unwindowed(channel, seen, dipole), terms, [m.moments for m in channel.maps], nthreads)
    elif any(m.moments.dtheta is not None for m in channel.maps):
        gradient = made.gradient(circular)
    for index, (m, gain) in enumerate(zip(channel.maps, gains, strict=True)):
        extra = []
        if terms is not None:
            extra.append(offsets[index])
        elif m.moments.dtheta is not None and gradient is not None:
            extra.append(convolve.centroid_map(gradient, m.moments))
        if m.noise_uk is not None:
            extra.append(m.noise(seed, realization))
        for effect, own in systematics.disturbing(channel.effects):
            draw = rng.generator(seed, realization, f"{own}/noise/{m.name}")
            extra.append(divided(effect.excess(m.moments.hits, draw), m.moments.hits))
        if gain is not None and scaled is not None:
            extra.append(_gained(gain, m, scaled, index))
        if m.signal_uk is not None:
            extra.append(m.signal_uk)
        difference = convolve.noncircular_map(spins, m.moments) if spins else None
        if gain is not None and seen_spins:
            drifting = convolve.noncircular_map(seen_spins, replace(m.moments, w=gain[2:]))
            difference = drifting if difference is None else difference + drifting
        yield m, MapParts(flat, sum(extra[1:], start=extra[0]) if extra else None, difference)


def _gain_of(m: SurveyMap, spread: float) -> NDArray[np.complex128] | None:
    """Return the means of a map's ``gain`` with what all samples share; None: no error.

    ``spread``: the factor by which samples are nearer to their pixel's centre than where the gain was taken.
    """
    if m.gain is None and m.steady_gain == 0.0:
        return None
    rows = len(m.moments.w) if m.gain is None else len(m.gain) - 2
    found = np.zeros((rows + 2, m.moments.npix), dtype=np.complex128)
    if m.gain is not None:
        found += m.gain
        found[1] *= spread
    found[0] += m.steady_gain
    if m.moments.dtheta is not None and m.moments.dphi is not None:
        found[1] += m.steady_gain * (m.moments.dtheta + 1j * m.moments.dphi)
    found[2:] += m.steady_gain * m.moments.w[:rows]
    return found


class _Scaled(NamedTuple):
    """What an error of the gain scales: all that the circular part of the beam sees."""

    alm: Alm
    made: convolve.CircularMaps  # its maps at the pixels' centres, which splits share
    offsets: list[Map]  # what the samples' offsets add to each map; empty where their mean is all that counts


def _seen_by_gains(channel: Channel, seen: Alm, nthreads: int) -> _Scaled:
    """Return what errors of the gain scale in a channel, the dipole in it."""
    terms, made = _expansion(channel), convolve.CircularMaps(channel.site.nside, channel.site.lmax, nthreads)
    if terms is None:
        return _Scaled(convolve.circular_alm(seen, channel.response), made, [])
    unwindowed = _unwindowed(channel, seen, None)
    offsets = offset_maps(unwindowed, terms, [m.moments for m in channel.maps], nthreads)
    return _Scaled(alm_.multiply(unwindowed, terms.smooth, channel.site.lmax), made, offsets)


def _gained(gain: NDArray[np.complex128], m: SurveyMap, scaled: _Scaled, index: int) -> Map:
    """Return what the error of the gain makes of a sky through the circular part of the beam, samples off the centres.

    The mean error of a pixel scales all that the offsets of its samples do; what varies inside it the first order.
    """
    mean, at_centre = gain[0].real, scaled.made.map(scaled.alm)
    added = mean * (at_centre + scaled.offsets[index] if scaled.offsets else at_centre)
    if m.moments.dtheta is None or m.moments.dphi is None or (scaled.offsets and m.gain is None):
        return np.asarray(added)
    varying = gain[1] - mean * (m.moments.dtheta + 1j * m.moments.dphi) if scaled.offsets else gain[1]
    off_centre = replace(m.moments, dtheta=varying.real, dphi=varying.imag)
    return np.asarray(added + convolve.centroid_map(scaled.made.gradient(scaled.alm), off_centre))


def _expansion(channel: Channel) -> Expansion | None:
    """Return the expansion in the samples' offsets; None if the pixel window and their mean are all that counts."""
    order = min((m.moments.offset_order for m in channel.maps), default=0)
    site = channel.site
    return expansion(site.nside, site.lmax, order, systematics.spread_of(channel.effects)) if order > 1 else None


def _unwindowed(channel: Channel, seen: Alm, dipole: Alm | None) -> Alm:
    """Return what the circular part of the beam sees, less the dipole, without a pixel window."""
    lmax = channel.site.lmax
    circular = convolve.circular_alm(seen, convolve.response(channel.beam, lmax))
    if dipole is None:
        return circular
    return circular - convolve.circular_alm(dipole, convolve.response(channel.site.beam, lmax))


def _circular(channel: Channel, seen: Alm, dipole: Alm | None) -> Alm:
    """Return what the circular part of the beam sees, less the dipole through the fiducial beam.

    The pixel window is in it; where the samples' offsets count beyond their mean, what stands in its place.
    """
    terms = _expansion(channel)
    if terms is not None:
        return alm_.multiply(_unwindowed(channel, seen, dipole), terms.smooth, channel.site.lmax)
    circular = convolve.circular_alm(seen, channel.response)
    return circular if dipole is None else circular - convolve.circular_alm(dipole, _fiducial_response(channel))


def _fiducial_response(channel: Channel) -> convolve.Response:
    """Return the response to the dipole that is taken off: the fiducial beam, at the samples' own places.

    A dipole is seen through its first two orders alone.
    """
    beam = channel.site.beam
    return convolve.response(beam.truncated(min(beam.mmax, 1)), channel.site.lmax, channel.seen_window)


def _observe_on_rings(
    survey: Survey, channel: Channel, grid: tuple[rings.Rings, ...], sky: Alm, realization: int, nthreads: int
) -> Observed:
    """Return the a_lm of a channel for one sky, where no map is needed for them."""
    lmax_sky, lmax = survey.config.sky.lmax, survey.lmax
    seen, dipole = _seen(survey, channel, sky, realization)
    circular = convolve.circular_alm(seen, channel.response)
    difference = rings.noncircular_alm(seen, channel.response, grid, lmax, nthreads)
    if dipole is not None:
        circular = circular - convolve.circular_alm(dipole, _fiducial_response(channel))
        difference = difference - rings.noncircular_alm(dipole, _fiducial_response(channel), grid, lmax, nthreads)
    control = alm_.resize(circular, lmax_sky, lmax)
    return Observed(control + difference, control if survey.config.ensemble.paired else None, None)


def _seen(survey: Survey, channel: Channel, sky: Alm, realization: int) -> tuple[Alm, Alm | None]:
    """Return the sky that the channel looks at, and the dipole in it that is taken off again, None if there is none."""
    refuse_unseen(channel.name, channel.effects)
    sky = systematics.looked_at(channel.effects, sky, channel.site, survey.config.ensemble.seed, realization)
    if not channel.effects or not channel.site.dipole_uk.any():
        return sky, None
    dipole = dipole_alm(channel.site.dipole_uk, channel.site.lmax)
    return sky + dipole, dipole


def _analyse(survey: Survey, channel: Channel, map_uk: Map, weight: Map | None, nthreads: int) -> Alm:
    """Return the coefficients of a weighted map, with the pixel window divided out."""
    weighted = map_uk if weight is None else weight * map_uk
    alm = healpix.analysis(weighted, survey.lmax, survey.config.biposh.iterations, nthreads)
    return alm_.multiply(alm, 1.0 / channel.window[: survey.lmax + 1], survey.lmax)


def _is_exact(survey: Survey, m: SurveyMap) -> bool:
    """Return True if the control's a_lm follow without a map: all sky, no noise, no power beyond the analysis."""
    return m.weight is None and m.noise_uk is None and survey.config.sky.lmax == survey.lmax


def _spectra(survey: Survey, alms: list[Alm], suffix: str) -> dict[str, NDArray]:
    if survey.filtering is not None:
        return {f"{name}{suffix}": values for name, values in survey.filtering.measure(alms).items()}
    modes, lmax = len(survey.estimator.modes), survey.lmax
    coefficients = np.empty((len(survey.pairs), modes, lmax + 1), dtype=np.complex128)
    cl = np.empty((len(survey.pairs), lmax + 1))
    for row, ((x, y), norm) in enumerate(zip(survey.pairs, survey.pair_norm, strict=True)):
        coefficients[row] = norm * bipolar.estimate(survey.estimator, alms[x], None if x == y else alms[y])
        cl[row] = norm * bipolar.power_spectrum(alms[x], alms[y], lmax)
    return {f"biposh{suffix}": coefficients, f"cl{suffix}": cl}
