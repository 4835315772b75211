"""The fiducial survey as the Wiener filter knows it: spectra, responses, weights, and the inverse covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.datavector.parts import Part, marginalised
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.errors import InputError
from mcsim.simulation import convolve
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.simulation.noise import NoiseOfFiles
from mcsim.simulation.preparation import Preparation, keeps_pixels, regressions, templates_of
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Cl, Map, Matrix, Vector, divided
from mcsim.systematics import Effect

FAINT = 0.1
"""Power of the sky over that of the noise at the last degree of the filters; what is above adds below 1 % to sigmas."""

SHARP = 30.0
"""Power of the sky over that of the noise at the last degree, up to which conjugate gradients converge soon: the
preconditioner has no such sharp end (:class:`mcsim.simulation.preconditioner.Preconditioner`)."""

CAREFUL = 0.1
"""Tolerance of the exact filter and of pooled maps, over that of the others: what all maps have alike, nearly all sky,
is known to a tenth of the rest."""

RANGE = 1e7
"""Largest power of the sky over the white part of noise: beyond, conjugate gradients converge late, and what a step has
smeared across a mask's edge counts. With more white noise the faintest degrees tell a little less than they could."""

LITTLE = 1e-6  #: part of the noise, or of a dipole, that is no more than rounding

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
    colours: Matrix  # noise of every channel's maps at degree l over that of white noise, (channel, lmax + 1): _colour
    sky_power: Cl  # of s^: E|s^_lm|^2 / C_l = C_l / (C_l + N_l) in the isotropic approximation
    settings: DiagnosisSettings
    #: s^ is that of the mean of all maps, and what they have alike beside it is sky beyond lmax, of this variance, uK^2
    pooled: float = 0.0
    tolerance: float = 1.0  # of the inverse covariance, over that of the settings
    bright: bool = False  # the maps show the sky beyond lmax
    least: Vector | None = None  #: :attr:`white`, if the maps are seen through another response
    share: Cl | None = None  # of the sky in what the inverse covariance finds, if noise is in it

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

    def last_shown(self, channel: int | None = None) -> int:
        """Return the last degree of the sky that a channel shows (None: that any shows): a spectrum may end earlier."""
        rows = self.response if channel is None else self.response[[channel]]
        return int(np.max(np.flatnonzero((self.cl > 0.0) & rows.any(axis=0)), initial=2))

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
    def alike(self) -> tuple[tuple[Cl, Cl, tuple[int, ...]], ...]:
        """Return the different responses and colours, each pair with the indices of all maps that have it."""
        rows, which = np.unique(np.hstack([self.response, self.colours]), axis=0, return_inverse=True)
        members = [sum(map(self.of, np.flatnonzero(which.ravel() == row).tolist()), ()) for row in range(len(rows))]
        responses, colours = np.split(rows, 2, axis=1)
        return tuple(zip(responses, colours, members, strict=True))

    @cached_property
    def unknown(self) -> Cl:
        """Return the power of the sky that all maps leave unknown in the isotropic approximation, uK^2, (lmax + 1,)."""
        return np.asarray(self.cl / (1.0 + self.cl * self._weight(self.colours)))

    @cached_property
    def hides(self) -> bool:
        """Return True if a map lacks a part of the sky that is more than little."""
        return hidden_share(self.parts) >= self.settings.hidden_share

    @cached_property
    def masks(self) -> tuple[Map, ...]:
        """Return the weights that the preparation has multiplied every map with.

        They are 0 also where a step in harmonics has smeared others in, and the sky with them, by more than the noise.
        """
        masks, noise = [], divided(1.0, np.sum([part.precision for part in self.parts], axis=0), np.inf)
        for part, made in zip(self.parts, self.survey.preparations, strict=True):
            weight = None if made is None else made.weight()
            if made is None or weight is None:
                masks.append(np.ones(part.precision.size))
            else:
                variance = made.smeared() ** 2 * sky_variance(self.cl, self.response[part.channel])
                masks.append(np.where(variance > noise, 0.0, weight))
        return tuple(masks)

    @cached_property
    def white(self) -> Vector:
        """Return the white part of the noise that :attr:`unmasked` knows, over that of pixels, shape (channel,).

        It is that of the degrees that the sky is seen at, and more where it is far above the noise: RANGE and SHARP.
        """
        if self.least is not None:
            return self.least
        shown = (self.response > 0.0) & (self.sky_power > FAINT / (1.0 + FAINT))
        snr = self.cl * self._weight(self.colours)
        least = np.min(self.colours, axis=1, where=shown, initial=self.colours.max())
        return np.maximum(least, np.max(snr * self.colours, axis=1) / RANGE) * max(snr[self.lmax] / SHARP, 1.0)

    @cached_property
    def unmasked(self) -> "Model | None":
        """Return the model with the inverse covariance of maps over their masks, as if their noise were independent.

        Noise that is more at some degrees than at others is white noise and a sky of its own, with which it is found.
        To an isotropic filter zeros in a mask are data: skies that filtered maps constrain had many times their power
        at high degrees. Of maps that show the sky beyond lmax it is that of their mean. None where an isotropic filter
        wastes little.
        """
        over_masks = [part.precision * mask**2 for part, mask in zip(self.parts, self.masks, strict=True)]
        if not (self.hides or _is_uneven(over_masks, self.sky_power, self.bright, self.settings)):
            return None
        parts, templates = [], templates_of(self.survey.preparations)
        for part, mask, own, over_mask in zip(self.parts, self.masks, templates, over_masks, strict=True):
            precision = over_mask / self.white[part.channel]
            subtracted = () if own is None else ((divided(own, mask), precision),)
            parts.append(replace(part, precision=precision, subtracted=subtracted))
        noise, white = (divided(1.0, self._weight(rows)) for rows in (self.colours, self.white[:, None]))
        total = self.cl + np.where(noise > (1.0 + LITTLE) * white, noise - white, 0.0)
        model = replace(self, cl=total, parts=tuple(parts), share=divided(self.cl, total))
        return _pooled(model) if self.bright else replace(model, inverse=inverse_of(total, self.response, parts))

    @cached_property
    def exact(self) -> "Model":
        """Return the model with the inverse covariance of all maps, samples' offsets included, if it is known."""
        if self.pooled or not self.exact_known:
            return self
        parts = marginalised(self.survey, self.parts)
        inverse = inverse_of(self.cl, self.response, parts, offsets=True)
        return replace(self, parts=parts, inverse=inverse, tolerance=CAREFUL)

    def _weight(self, colours: Matrix) -> Cl:
        """Return the inverse variance of a sky of all maps at every degree, with these colours, uK^-2."""
        rows = self.response**2 / colours
        return np.asarray(sum(rows[part.channel] / part.noise_power for part in self.parts))

    def of(self, channel: int) -> tuple[int, ...]:
        """Return the indices of the channel's maps."""
        return tuple(i for i, part in enumerate(self.parts) if part.channel == channel)

    def noise_factor(self, effect: Effect, channel: int) -> Map | None:
        """Return the factor of the variance of noise that an effect makes in the maps' pixels, (npix,); None: one.

        It acts on maps as they are made: in their own frame and pixels.
        """
        factor, steps = effect.noise(self.survey.making.channels[channel].site), self._steps(channel)
        return factor if factor is None or steps is None else np.nan_to_num(steps.local(factor), nan=1.0)

    def noise_change(self, acting: Sequence[Effect], channel: int) -> float:
        """Return the mean variance of the noise in the pixels that a channel sees, over that without effects."""
        factors = [own for effect in acting if (own := self.noise_factor(effect, channel)) is not None]
        if not factors:
            return 1.0
        variance = np.sum([divided(1.0, self.parts[i].precision) for i in self.of(channel)], axis=0)
        return float(np.dot(np.prod(factors, axis=0), variance) / variance.sum())

    def _steps(self, channel: int) -> Preparation | None:
        return self.survey.channels[channel].maps[0].preparation


def model_of(survey: Survey, settings: DiagnosisSettings) -> Model:
    """Prepare a survey for the filter; raise InputError unless it has power of the sky, pixels, and one dipole.

    Of a channel that reads differences of two beams, the filter knows the mean of both sides.
    """
    if survey.cl is None or not survey.cl[2:].any():
        raise InputError("a diagnosis needs the spectrum of the sky, with power from l = 2 on; give sky.spectrum.")
    run = survey.config
    if run.map.grid == "gl":
        raise InputError('a diagnosis compares maps of pixels; give the model map.grid = "healpix" and map.nside.')
    dipoles = {one.site.channel: float(np.linalg.norm(one.site.dipole_uk)) for one in survey.channels}
    if max(dipoles.values()) > min(dipoles.values()) * (1.0 + LITTLE):
        least, most = (choose(dipoles, key=dipoles.__getitem__) for choose in (min, max))
        raise InputError(
            f"the scan of channel {most} is described with a dipole of {dipoles[most]:g} uK, and that of {least} with "
            f"{dipoles[least]:g} uK; give the one that all channels see as sky.dipole_uk."
        )
    both = zip(survey.channels, survey.making.channels, strict=True)
    response = np.stack([_circular(channel, made) for channel, made in both])
    parts, colours = [], np.ones_like(response)
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
            if m.preparation is not None:
                colours[index] = _colour(m.preparation, run.map.resolution, floor**2 / noise_power, response.shape[1])
    white = survey.cl * sum(response[part.channel] ** 2 / part.noise_power for part in parts)
    snr = survey.cl * sum(response[p.channel] ** 2 / (p.noise_power * colours[p.channel]) for p in parts)
    lmax = _highest_degree(survey, snr)
    pixels = all(m.preparation is None or m.preparation.keeps_noise_white for m in survey.maps)
    independent = pixels and all(m.drawn is None and m.pairs is None for m in survey.maps)
    bright = bool(np.any(white[lmax + 1 :] > 1.0))
    cl, snr = survey.cl[: lmax + 1], snr[: lmax + 1]
    response, colours = response[:, : lmax + 1], colours[:, : lmax + 1]
    known, inverse, sky_power = pixels and not bright and bool(snr[lmax] <= SHARP), None, snr / (1.0 + snr)
    uneven = known and _is_uneven([part.precision for part in parts], sky_power, bright, settings)
    if known and (uneven or hidden_share(parts) >= settings.hidden_share):
        parts = list(marginalised(survey, parts))
        inverse = inverse_of(cl, response, parts)
    maps = survey.nside, cl, response, tuple(parts), dipole_alm(survey.channels[0].site.dipole_uk, lmax)
    exact = known and independent
    model = Model(survey, lmax, *maps, inverse, exact, colours, sky_power, settings, bright=bright)
    return replace(_pooled(model), exact_known=independent) if pixels and bright else model


def _colour(preparation: Preparation, fine: int, floor: float, size: int) -> Cl:
    """Return the noise of prepared maps at every degree over that of white noise in their pixels, shape (size,).

    What a step in harmonics takes from the noise of pixels, it takes at high degrees. ``fine``: nside before the steps;
    ``floor``: noise that is white all the same, as variance of a pixel over the power of white noise, 1/sr.
    """
    area = healpy.nside2pixarea(preparation.nside)
    window = preparation.noise_window(size - 1) ** 2 / (preparation.noise_band(fine) * area)
    return np.asarray(floor * area + (1.0 - floor * area) * window)


def hidden_share(parts: Sequence[Part]) -> float:
    """Return the share of the sky that the map which lacks most of it does not show."""
    return max(float(np.mean(part.precision == 0.0)) for part in parts)


def _is_uneven(precisions: Sequence[Map], sky_power: Cl, bright: bool, settings: DiagnosisSettings) -> bool:
    """Return True if maps have so uneven noise, of these inverse variances, that an isotropic filter wastes much.

    It takes the noise for the mean variance everywhere; what maps tell of the largest scales follows the mean of the
    inverse. Where the sky is far above the noise, or is seen beyond lmax, the inverse covariance takes it for noise,
    and tells less of a full sky than the isotropic filter.
    """
    seen = (precision[precision > 0.0] for precision in precisions)
    uneven = max((float(np.mean(1.0 / one) * np.mean(one)) for one in seen if one.size), default=1.0)
    return not bright and bool(sky_power[-1] <= SHARP / (1.0 + SHARP)) and uneven > settings.uneven_noise


def _pooled(model: Model) -> Model:
    """Return a model with the inverse covariance of the mean of all maps, which show the sky beyond lmax.

    In the mean this sky is noise, independent from pixel to pixel. What a beam makes of it otherwise than the others is
    noise of its own maps.
    """
    survey, cl = model.survey, np.asarray(model.survey.cl)
    response = np.stack([_circular(*both) for both in zip(survey.channels, survey.making.channels, strict=True)])
    unresolved = (np.arange(cl.size) > model.lmax) * np.sqrt(cl) * response  # uK, (channel, sky.lmax + 1)
    shared = _mean(unresolved, model.parts)
    own, alike = [_variance(one - shared) for one in unresolved], _variance(shared)
    parts = [
        replace(part, precision=part.precision / (1.0 + own[part.channel] * part.precision), subtracted=tuple(one))
        for part, one in zip(model.parts, regressions(model.survey.preparations), strict=True)
    ]
    seen, precision = _mean(model.response, model.parts), _precision(parts, alike)
    snr = model.cl * seen**2 * precision.sum() / (4.0 * np.pi)
    return replace(
        model,
        parts=tuple(parts),
        inverse=_of_mean(model.cl, seen, precision),
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


def seen_through(model: Model, response: Matrix, noise: Vector) -> Model:
    """Return the model if its channels see the sky through another response, shape (channel, lmax + 1).

    ``noise`` are the factors of the variance of their noise, shape (channel,).
    """
    inverse, parts = model.inverse, tuple(_noisier(part, float(noise[part.channel])) for part in model.parts)
    if model.pooled:
        inverse = _of_mean(model.cl, _mean(response, parts), _precision(parts, model.pooled))
    elif inverse is not None:
        inverse = inverse_of(model.cl, response, parts)
    return replace(model, response=response, parts=parts, inverse=inverse, least=model.white)


def _noisier(part: Part, factor: float) -> Part:
    return replace(part, precision=part.precision / factor, noise_power=part.noise_power * factor)


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


def smoothing(channel: Channel, lmax: int) -> Cl:
    """Return what the preparation of a channel's maps multiplies its beam with, shape (lmax + 1,)."""
    steps = channel.maps[0].preparation
    return np.ones(lmax + 1) if steps is None else steps.beam_window(lmax)


def sky_variance(cl: Cl, response: Cl) -> float:
    """Return the variance over the sky of a spectrum seen through B_l, in its unit."""
    return _variance(np.sqrt(cl) * response)


def _variance(root: Cl) -> float:
    """Return the variance over the sky of a signal, given the root of its spectrum."""
    return float(np.sum((2 * np.arange(root.size) + 1) / (4 * np.pi) * root**2))
