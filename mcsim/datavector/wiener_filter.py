r"""Wiener-filter maps: the sky that they share, the residuals, and the residuals' correlation with sky and scan.

With d_i the maps, P_i the fiducial response of map i (beam, pixel window, centroids) and N_i its white noise,

    s^ = (S^-1 + sum_i P_i^t N_i^-1 P_i)^-1 sum_i P_i^t N_i^-1 d_i,     r_i = N_i^-1 (d_i - P_i s^).

On the full sky the first inverse is taken as if noise were isotropic, which costs little. Behind a mask it would cost
much, and is that of the noise of every pixel, by conjugate gradients (Model.inverse). What describes unlisted effects
has it on every sky, with the offsets of the samples (Model.exact). Maps that show the sky beyond the filter's last
degree are filtered by the inverse covariance of their mean, in which that sky is noise of pixels, and what all of them
have alike in a pixel is taken for sky (_pooled): the isotropic filter leaves it in all residuals, and most effects then
need 1.3 to 2 times the amplitude.

The matched filter of any small change dP_i of a response is <r_i, dP_i s^>: the filtered sky of *all* maps stands in
for the sky, so that noise limits it, not cosmic variance as for the spectra of a single sky. A change of the beam,
db_ls, acts as 2 Re[w_s db_ls ...] and its matched filter is sum_l Re[conj(db_ls) D_s(l)]: one transform of w_s r for
each order gives that of every beam.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import by_degree
from mcsim.datavector import pixel_noise
from mcsim.datavector.parts import Part, marginalised
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.errors import InputError
from mcsim.simulation import convolve
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.simulation.noise import NoiseOfFiles
from mcsim.simulation.preparation import keeps_pixels, regressions, templates_of
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided

FAINT = 0.1
"""Power of the sky over that of the noise at the last degree of the filters; what is above adds below 1 % to sigmas."""

SHARP = 30.0
"""Power of the sky over that of the noise at the last degree, up to which conjugate gradients converge soon: the
preconditioner has no such sharp end (:class:`mcsim.simulation.preconditioner.Preconditioner`)."""

CAREFUL = 0.1
"""Tolerance of the exact filter and of pooled maps, over that of the others: what all maps have alike, nearly all sky,
is known to a tenth of the rest."""

TAIL = 1e-3  #: part of the squared S/N of a change of a beam that is left beyond the last degree of its order
EARLIEST = 16  #: degree at which orders may end: bins have degrees
SAVED = 0.1  #: least part of a transform that an earlier last degree must save


@dataclass(frozen=True)
class Model:
    """Describe the fiducial survey for the filter."""

    survey: Survey  # without effects, with moments up to the orders that are measured
    lmax: int  # highest degree of the sky and the matched filters: _highest_degree
    nside: int
    cl: Cl  # spectrum of the sky, uK^2
    response: Matrix  # B_l w_l of every channel, (channel, lmax + 1)
    parts: tuple[Part, ...]  # the maps in order
    dipole: Alm  # that the survey sees besides, up to lmax, uK
    #: of all maps, if they lack a part of the sky, or of their mean, if pooled; None: the isotropic filter
    inverse: InverseCovariance | None
    exact_known: bool  # the noise of pixels is independent, and the sky beyond lmax not shown, or pooled
    sky_power: Cl  # of s^: E|s^_lm|^2 / C_l = C_l / (C_l + N_l) in the isotropic approximation
    settings: DiagnosisSettings
    #: s^ is that of the mean of all maps, and what they have alike beside it is sky beyond lmax, of this variance, uK^2
    pooled: float = 0.0
    tolerance: float = 1.0  # of the inverse covariance, over that of the settings
    bright: bool = False  # the maps show the sky beyond lmax

    @property
    def frame(self) -> str:
        """Return the frame of the maps."""
        return self.survey.frame

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of the channels."""
        return tuple(channel.name for channel in self.survey.channels)

    @cached_property
    def inverse_cl(self) -> Cl:
        """Return 1/C_l, zero where C_l is, uK^-2."""
        return divided(1.0, self.cl)

    @cached_property
    def last_degrees(self) -> NDArray[np.int64]:
        """Return the last degree at which orders s of each channel's beam are measured, (channel, beam_orders + 1).

        Beyond it there is less than TAIL of the squared S/N of a change of B_l by (l / lmax)^s: the sky is below the
        noise there, or the beam has taken it away. It is lmax where an earlier end would save little.
        """
        ell = np.arange(self.lmax + 1.0)
        powers = (ell / max(self.lmax, 1)) ** (2 * np.arange(self.settings.beam_orders + 1.0)[:, None])
        squared = (2.0 * ell + 1.0) * self.cl * self.sky_power * self.response[:, None] ** 2 * powers
        beyond = np.cumsum(squared[..., ::-1], axis=-1)[..., ::-1]
        last = np.maximum(np.sum(beyond >= TAIL * beyond[..., :1], axis=-1) - 1, min(self.lmax, EARLIEST))
        little = (last + 1.0) ** 2 > (1.0 - SAVED) * (self.lmax + 1.0) ** 2
        return np.where(little, self.lmax, last)

    @cached_property
    def alike(self) -> tuple[tuple[Cl, tuple[int, ...]], ...]:
        """Return the different responses, each with the indices of all maps that have it."""
        rows, which = np.unique(self.response, axis=0, return_inverse=True)
        groups = (np.flatnonzero(which.ravel() == row) for row in range(len(rows)))
        return tuple((row, sum(map(self.of, group.tolist()), ())) for row, group in zip(rows, groups, strict=True))

    @cached_property
    def hides(self) -> bool:
        """Return True if a map lacks a part of the sky that is more than little."""
        return hidden_share(self.parts) >= self.settings.hidden_share

    @cached_property
    def masks(self) -> tuple[Map, ...]:
        """Return the weights that the preparation has multiplied every map with; 0 also where others are smeared in."""
        each = (None if one is None else one.weight(sharp=True) for one in self.survey.preparations)
        pairs = zip(self.parts, each, strict=True)
        return tuple(np.ones(part.precision.size) if own is None else own for part, own in pairs)

    @cached_property
    def unmasked(self) -> "Model | None":
        """Return the model with the inverse covariance of maps over their masks, as if their noise were white.

        To an isotropic filter zeros in a mask are data: skies that filtered maps constrain had many times their power
        at high degrees. None: nothing is hidden, or the maps show the sky beyond lmax, or far above the noise there.
        """
        if not self.hides or self.bright or self.sky_power[self.lmax] > SHARP / (1.0 + SHARP):
            return None
        templates = templates_of(self.survey.preparations)
        parts = []
        for part, mask, own in zip(self.parts, self.masks, templates, strict=True):
            subtracted = () if own is None else ((divided(own, mask), part.precision),)
            parts.append(replace(part, precision=part.precision * mask**2, subtracted=subtracted))
        return replace(self, inverse=inverse_of(self.cl, self.response, parts))

    @cached_property
    def exact(self) -> "Model":
        """Return the model with the inverse covariance of all maps, samples' offsets included, if it is known."""
        if self.pooled or not self.exact_known:
            return self
        parts = marginalised(self.survey, self.parts)
        inverse = inverse_of(self.cl, self.response, parts, offsets=True)
        return replace(self, parts=parts, inverse=inverse, tolerance=CAREFUL)

    def of(self, channel: int) -> tuple[int, ...]:
        """Return the indices of the channel's maps."""
        return tuple(i for i, part in enumerate(self.parts) if part.channel == channel)


@dataclass(frozen=True)
class FilteredMaps:
    """Hold one set of maps after the filter."""

    sky: Alm  # s^ up to the model's lmax, uK
    expected: NDArray[np.float64]  # P_i s^, (map, npix), uK
    residual: NDArray[np.float64]  # r_i, (map, npix), uK^-1
    adjoint: NDArray[np.complex128]  # spin-0 adjoint synthesis of every r_i, (map, size)
    # D_s(l) of every map, (map, beam_orders + 1, lmax + 1); s = 0 is real. The sky in it has the dipole. Above
    # split_beam_orders the channel's sum stands in its first map.
    orders: NDArray[np.complex128]
    difference: NDArray[np.float64]  # u^2 - 1 of every pixel, (channel, npix): pixel_noise.fill_difference
    squares: NDArray[np.float64]  # N_i r_i^2 summed over maps, (channel, npix): pixel_noise.add_squares
    mean: Map | None = None  # residual of the mean of pooled maps, uK^-1, (npix,)


def model_of(survey: Survey, settings: DiagnosisSettings) -> Model:
    """Prepare a survey for the filter; raise InputError unless it has power of the sky, and pixels.

    Of a channel that reads differences of two beams, the filter knows the mean of both sides.
    """
    if survey.cl is None or not survey.cl[2:].any():
        raise InputError("a diagnosis needs the spectrum of the sky, with power from l = 2 on; give sky.spectrum.")
    run = survey.config
    if run.map.grid == "gl":
        raise InputError('a diagnosis compares maps of pixels; give the model map.grid = "healpix" and map.nside.')
    both = zip(survey.channels, survey.making.channels, strict=True)
    response = np.stack([_circular(channel, made) for channel, made in both])
    parts = []
    for index, channel in enumerate(survey.channels):
        floor = settings.noise_floor * float(np.sqrt(sky_variance(survey.cl, response[index])))
        for m, split in zip(channel.maps, run.map.each_split, strict=True):
            if isinstance(m.drawn, NoiseOfFiles):
                raise InputError(
                    f"the noise of map {m.name} is read from files, of which a diagnosis would need thousands; "
                    'describe it by noise of kind "white", "depth", "variance", "difference" or "correlated".'
                )
            seen = m.moments.hits > 0
            if m.weight is not None:
                seen = seen & (m.weight > 0)
            variance = np.broadcast_to(floor**2 + (0.0 if m.noise_uk is None else m.noise_uk**2), seen.shape)
            if np.any(variance[seen] == 0.0):
                raise InputError(
                    f"noise_floor = {settings.noise_floor:g}, but map {m.name} has pixels without noise; give more "
                    "than 0, or the map noise."
                )
            precision = np.where(seen, 1.0 / variance, 0.0)
            noise_power = 4 * np.pi / seen.size * float(np.mean(1.0 / precision[seen]))
            parts.append(Part(index, m.name, split, m.moments, precision, noise_power))
    snr = survey.cl * sum(response[part.channel] ** 2 / part.noise_power for part in parts)
    lmax = _highest_degree(survey, snr)
    pixels = all(m.preparation is None or m.preparation.keeps_noise_white for m in survey.maps)
    white = pixels and all(m.drawn is None and m.pairs is None for m in survey.maps)
    bright = bool(np.any(snr[lmax + 1 :] > 1.0))
    unresolved = (np.arange(snr.size) > lmax) * np.sqrt(survey.cl) * response
    cl, response, snr = survey.cl[: lmax + 1], response[:, : lmax + 1], snr[: lmax + 1]
    known, inverse = pixels and not bright and bool(snr[lmax] <= SHARP), None
    if known and hidden_share(parts) >= settings.hidden_share:
        parts = list(marginalised(survey, parts))
        inverse = inverse_of(cl, response, parts)
    maps = survey.nside, cl, response, tuple(parts), dipole_alm(survey.channels[0].site.dipole_uk, lmax)
    model = Model(survey, lmax, *maps, inverse, known and white, snr / (1.0 + snr), settings, bright=bright)
    return replace(_pooled(model, unresolved), exact_known=white) if pixels and bright else model


def hidden_share(parts: Sequence[Part]) -> float:
    """Return the share of the sky that the map which lacks most of it does not show."""
    return max(float(np.mean(part.precision == 0.0)) for part in parts)


def _pooled(model: Model, unresolved: Matrix) -> Model:
    """Return a model with the inverse covariance of the mean of all maps, which show the sky beyond lmax.

    ``unresolved``: the amplitude of this sky in every channel, sqrt(C_l) B_l w_l, uK, shape (channel, sky.lmax + 1). In
    the mean it is noise, independent from pixel to pixel. What a beam makes of it otherwise than the others is noise of
    its own maps.
    """
    shared = _mean(unresolved, model.parts)
    own, alike = [_variance(one - shared) for one in unresolved], _variance(shared)
    parts = [
        replace(part, precision=part.precision / (1.0 + own[part.channel] * part.precision), subtracted=tuple(one))
        for part, one in zip(model.parts, regressions(model.survey.preparations), strict=True)
    ]
    response, precision = _mean(model.response, model.parts), _precision(parts, alike)
    snr = model.cl * response**2 * precision.sum() / (4.0 * np.pi)
    return replace(
        model,
        parts=tuple(parts),
        inverse=_of_mean(model.cl, response, precision),
        sky_power=snr / (1.0 + snr),
        pooled=alike,
        tolerance=CAREFUL,
    )


def _mean(rows: Matrix, parts: Sequence[Part]) -> Vector:
    """Return the mean over all maps of what every channel has, shape (channel, n): (n,)."""
    weights = [1.0 / part.noise_power for part in parts]
    return np.asarray(np.average([rows[part.channel] for part in parts], axis=0, weights=weights))


def _of_mean(cl: Cl, response: Vector, precision: Map) -> InverseCovariance:
    return InverseCovariance(cl, [ObservedMap(convolve.Response(response[None].astype(np.complex128)), precision)])


def _precision(parts: Sequence[Part], alike: float) -> Map:
    """Return the inverse variance of the mean of all maps, which have more of this variance alike, uK^-2, (npix,)."""
    total = np.sum([part.precision for part in parts], axis=0)
    return np.asarray(total / (1.0 + alike * total))


def seen_through(model: Model, response: Matrix) -> Model:
    """Return the model if its channels see the sky through another response, shape (channel, lmax + 1)."""
    inverse = model.inverse
    if model.pooled:
        inverse = _of_mean(model.cl, _mean(response, model.parts), _precision(model.parts, model.pooled))
    elif inverse is not None:
        inverse = inverse_of(model.cl, response, model.parts)
    return replace(model, response=response, inverse=inverse)


def inverse_of(cl: Cl, response: Matrix, parts: Sequence[Part], offsets: bool = False) -> InverseCovariance:
    """Return the inverse covariance of all maps, of the circular parts of their beams.

    They are those at the centres of pixels, or, with ``offsets``, at the means of their samples. Of what is subtracted
    parts are :func:`marginalised`, or know nothing.
    """
    through, observed = [convolve.Response(row[None].astype(np.complex128)) for row in response], []
    for part in parts:
        templates = part.subtracted[0][0] if part.subtracted else None
        moments = part.moments if offsets else None
        observed.append(ObservedMap(through[part.channel], part.precision, moments, templates))
    return InverseCovariance(cl, observed)


def _highest_degree(survey: Survey, snr: Cl) -> int:
    """Return the highest degree of the filters from the sky's power over the noise's in all maps, (sky.lmax + 1,).

    Notes
    -----
    It is ``biposh.lmax``, or on to where the maps no longer show the sky if their pixels hold it so far. From 2.2 nside
    on quadrature leaks 2 % of the power, and pixels average the sky in ways that no single window tells: little beside
    noise. A sky that is above the noise beyond 2.5 nside is filtered up to the degree that the run chooses, and so are
    prepared maps, whose noise is not white and whose pixels may be degraded.
    """
    last = min(snr.size - 1, 5 * survey.nside // 2)
    if not keeps_pixels(survey.preparations) or np.any(snr[last + 1 :] > 1.0):
        return survey.lmax
    return max(survey.lmax, int(np.flatnonzero(snr[: last + 1] >= FAINT).max(initial=0)))


def _circular(channel: Channel, made: Channel) -> Cl:
    """Return B_l w_l of a channel; of a differencing scan their mean over both sides.

    ``made`` is the channel before its maps are prepared.
    """
    own = channel.response.factors[0].real
    if made.side_b is None:
        return own
    a, b = made.response.factors[0].real, made.side_b.response.factors[0].real
    return np.asarray(own * np.divide(0.5 * (a + b), a, out=np.ones_like(a), where=a != 0.0))


def sky_variance(cl: Cl, response: Cl) -> float:
    """Return the variance over the sky of a spectrum seen through B_l, in its unit."""
    return _variance(np.sqrt(cl) * response)


def _variance(root: Cl) -> float:
    """Return the variance over the sky of a signal, given the root of its spectrum."""
    return float(np.sum((2 * np.arange(root.size) + 1) / (4 * np.pi) * root**2))


def wiener_filter(model: Model, maps: Sequence[Map]) -> FilteredMaps:
    """Filter maps of all parts, uK, shape (npix,) each; ``healpy.UNSEEN`` or NaN is not observed."""
    lmax, top = model.lmax, model.settings.beam_orders
    clean, seen = cleaned(model, maps)
    sky = filtered_sky(model, clean)
    looked_at = sky + model.dipole
    expected, mean = _expected(model, clean, sky)
    residual, adjoint = np.empty_like(expected), np.empty((len(model.parts), sky.size), dtype=np.complex128)
    up_to = cache(lambda last: alm_.resize(looked_at, lmax, last))
    scratch = np.empty((2, expected.shape[1]))
    orders = np.zeros((len(model.parts), top + 1, lmax + 1), dtype=np.complex128)
    k = np.sqrt(4 * np.pi / (2 * np.arange(lmax + 1) + 1))
    for channel in range(len(model.channels)):
        members = model.of(channel)
        window = model.survey.channels[channel].window[: lmax + 1]
        for i in members:
            part = model.parts[i]
            pixel_noise.weigh(clean[i], expected[i], np.where(seen[i], part.precision, 0.0), residual[i])
            if part.subtracted:
                residual[i] = part.without_response(residual[i])
            adjoint[i] = healpix.adjoint(residual[i], lmax)
            orders[i, 0] = window * k * by_degree(looked_at, adjoint[i], lmax)
        for i, s, together in _transforms(model, members):
            last = int(model.last_degrees[channel, s])
            turned = convolve.turned([(residual[j], model.parts[j].moments) for j in together], s, scratch)
            electric, magnetic = healpix.adjoint(turned, last, spin=s)
            # ducc0's sign: S_s is minus the synthesis of E = Re(k b) a, B = Im(k b) a.
            both = by_degree(up_to(last), electric, last) + 1j * by_degree(up_to(last), magnetic, last)
            orders[i, s, : last + 1] = -2.0 * (window * k)[: last + 1] * both
    difference, squares = np.zeros((2, len(model.channels), expected.shape[1]))
    for channel in range(len(model.channels)):
        # What is fitted and subtracted may depend on pixels without weight.
        parts = [(model.parts[i], residual[i]) for i in model.of(channel)]
        own = [(np.where(p.precision > 0.0, r, 0.0) if p.subtracted else r, p.precision) for p, r in parts]
        pixel_noise.fill_difference(own, difference[channel])
        pixel_noise.add_squares(own, squares[channel])
    return FilteredMaps(sky, expected, residual, adjoint, orders, difference, squares, mean)


def _expected(model: Model, clean: Sequence[Map], sky: Alm) -> tuple[NDArray[np.float64], Map | None]:
    """Return what the maps show of a sky, uK, shape (map, npix); pooled maps what they have alike beside it, too.

    With it stands the residual of the mean of pooled maps, C^-1 of it, uK^-1, shape (npix,); None of others.

    Notes
    -----
    The unresolved sky u of a pixel is taken for the same in all maps, and for independent of other pixels. Given s^,
    the mean of what is left of the maps with weights 1/N_i has the variance of u and 1/sum_i(1/N_i).
    """
    made = convolve.CircularMaps(model.nside, model.lmax)
    expected = np.empty((len(model.parts), clean[0].size))
    for channel, response in enumerate(model.response):
        through = alm_.multiply(sky, response, model.lmax)
        for i in model.of(channel):
            expected[i] = made.map(through)
            if model.parts[i].moments.dtheta is not None:
                expected[i] += convolve.centroid_map(made.gradient(through), model.parts[i].moments)
    if not model.pooled:
        return expected, None
    left, precision = _summed(model, [map_ - own for map_, own in zip(clean, expected, strict=True)])
    mean = left / (1.0 + model.pooled * precision)
    expected += model.pooled * mean
    return expected, mean


def _summed(model: Model, maps: Sequence[Map]) -> tuple[Map, Map]:
    """Return the sum of maps over their noise variances, and of one over these, shape (npix,) both."""
    precision = [part.precision for part in model.parts]
    return np.sum([one * map_ for one, map_ in zip(precision, maps, strict=True)], axis=0), np.sum(precision, axis=0)


def cleaned(model: Model, maps: Sequence[Map]) -> tuple[list[Map], list[NDArray[np.bool_]]]:
    """Return maps with zeros in pixels that the fiducial scan does not hit, and where something was observed.

    Pixels that the data lack and the simulations have are filled with the filtered sky: zeros would be a departure of
    their own.
    """
    hit = [part.precision > 0 for part in model.parts]
    seen = [h & (map_ != healpy.UNSEEN) & np.isfinite(map_) for h, map_ in zip(hit, maps, strict=True)]
    clean = [np.where(observed, map_, 0.0) for observed, map_ in zip(seen, maps, strict=True)]
    holes = {i: hit[i] & ~seen[i] for i in range(len(hit)) if np.any(hit[i] & ~seen[i])}
    for _ in range(model.settings.hole_iterations if holes else 0):
        sky = filtered_sky(model, clean)
        for i, hole in holes.items():
            through = alm_.multiply(sky, model.response[model.parts[i].channel], model.lmax)
            smooth = healpix.synthesis(through[None], model.nside, model.lmax)[0]
            clean[i] = np.where(hole, smooth, clean[i])
    return [part.without_subtracted(map_) for part, map_ in zip(model.parts, clean, strict=True)], seen


def filtered_sky(model: Model, clean: Sequence[Map], careful: bool = False) -> Alm:
    """Return the filtered sky s^ of maps that are clean, up to the model's lmax, uK; see :func:`shared_sky`."""
    lmax, settings = model.lmax, model.settings
    if model.inverse is not None:
        maps = divided(*_summed(model, clean))[None] if model.pooled else np.stack(clean)
        weighted = model.inverse.adjoint(model.inverse.weighted(maps))
        tolerance = settings.filter_tolerance * model.tolerance * (0.01 if careful else 1.0)
        return model.inverse.approach(weighted, tolerance, settings.filter_iterations)
    total = np.zeros(alm_.size(lmax), dtype=np.complex128)
    gain = np.zeros(lmax + 1)
    # Channels that see the sky alike are analysed together.
    for response, members in model.alike:
        together = reduce(np.add, [clean[i] / model.parts[i].noise_power for i in members])
        total += alm_.multiply(healpix.analysis(together, lmax, int(careful)), response, lmax)
        gain += response**2 * sum(1.0 / model.parts[i].noise_power for i in members)
    return alm_.multiply(total, model.cl / (1.0 + model.cl * gain), lmax)


def _transforms(model: Model, members: tuple[int, ...]) -> Iterator[tuple[int, int, tuple[int, ...]]]:
    """Yield the map in whose place a transform is kept, its order, and the maps that it adds up."""
    for s in range(1, model.settings.beam_orders + 1):
        filtered = tuple(i for i in members if model.parts[i].moments.smax >= s)
        if s <= model.settings.split_beam_orders:
            yield from ((i, s, (i,)) for i in filtered)
        elif filtered:
            yield filtered[0], s, filtered
