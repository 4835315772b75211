r"""Wiener-filter maps: the sky that they share, the residuals, and the residuals' correlation with sky and scan.

With d_i the maps, P_i the fiducial response of map i (beam, pixel window, centroids) and N_i its white noise,

    s^ = (S^-1 + sum_i P_i^t N_i^-1 P_i)^-1 sum_i P_i^t N_i^-1 d_i,     r_i = N_i^-1 (d_i - P_i s^).

On the full sky the first inverse is taken as if noise were isotropic, which costs little. Behind a mask it would cost
much, and is that of the noise of every pixel, by conjugate gradients (Model.inverse). What describes unlisted effects
has it on every sky, with the offsets of the samples (Model.exact).

The matched filter of any small change dP_i of a response is <r_i, dP_i s^>: the filtered sky of *all* maps stands in
for the sky, so that noise limits it, not cosmic variance as for the spectra of a single sky. A change of the beam,
db_ls, acts as 2 Re[w_s db_ls ...] and its matched filter is sum_l Re[conj(db_ls) D_s(l)]: one transform of w_s r for
each order gives that of every beam.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import by_degree
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.errors import InputError
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.inverse_covariance import InverseCovariance, ObservedMap
from mcsim.simulation.noise import NoiseOfFiles
from mcsim.simulation.survey import Channel, Survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Alm, Cl, Map, divided
from mcsim.support.compiled import njit

FAINT = 0.1
"""Power of the sky over that of the noise at the last degree of the filters; what is above adds below 1 % to sigmas."""


SHARP = 30.0
"""Power of the sky over that of the noise at the last degree, up to which conjugate gradients converge soon: the
preconditioner has no such sharp end (:class:`mcsim.simulation.preconditioner.Preconditioner`)."""

EXACT = 0.1  #: filter_tolerance of the exact filter


@dataclass(frozen=True)
class Part:
    """Describe one map of the data: its place in the survey, and its weights."""

    channel: int
    name: str  # in the survey
    split: str | None  # None if there are none
    moments: Moments  # of the orientations of its samples
    precision: Map  # inverse variance of the noise of every pixel, uK^-2, (npix,); 0 where unobserved or masked
    noise_power: float  # of the noise in the map's a_lm when its pixels count alike, uK^2 sr


@dataclass(frozen=True)
class Model:
    """Describe the fiducial survey for the filter."""

    survey: Survey  # without effects, with moments up to the orders that are measured
    lmax: int  # highest degree of the sky and the matched filters: _highest_degree
    nside: int
    cl: Cl  # spectrum of the sky, uK^2
    response: NDArray[np.float64]  # B_l w_l of every channel, (channel, lmax + 1)
    parts: tuple[Part, ...]  # the maps in order
    dipole: Alm  # that the survey sees besides, up to lmax, uK
    #: of all maps, if they lack a part of the sky; None, and of maps whose noise is not white or that show the sky
    #: beyond lmax: the isotropic filter
    inverse: InverseCovariance | None
    white: bool  # the noise of pixels is independent, and the maps do not show the sky beyond lmax
    sky_power: Cl  # of s^: E|s^_lm|^2 / C_l = C_l / (C_l + N_l) in the isotropic approximation
    settings: DiagnosisSettings

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
    def alike(self) -> tuple[tuple[Cl, tuple[int, ...]], ...]:
        """Return the different responses, each with the indices of all maps that have it."""
        rows, which = np.unique(self.response, axis=0, return_inverse=True)
        groups = (np.flatnonzero(which.ravel() == row) for row in range(len(rows)))
        return tuple((row, sum(map(self.of, group.tolist()), ())) for row, group in zip(rows, groups, strict=True))

    @cached_property
    def exact(self) -> "Model":
        """Return the model with the inverse covariance of all maps, samples' offsets included, if noise is white.

        Its filter goes on until what all maps have alike, which is nearly all sky, is known to a tenth of its residual.
        """
        if not self.white:
            return self
        inverse = _inverse(self.cl, self.response, self.parts, offsets=True)
        return replace(self, inverse=inverse, settings=replace(self.settings, filter_tolerance=EXACT))

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
    difference: NDArray[np.float64]  # u^2 - 1 of every pixel, (channel, npix): _normalised_difference
    squares: NDArray[np.float64]  # N_i r_i^2 summed over maps, (channel, npix): _squares


def model_of(survey: Survey, settings: DiagnosisSettings) -> Model:
    """Prepare a survey for the filter; raise InputError unless it has a spectrum of the sky, and pixels.

    Of a channel that reads differences of two beams, the filter knows the mean of both sides.
    """
    if survey.cl is None:
        raise InputError("a diagnosis needs the spectrum of the sky; give sky.spectrum.")
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
            variance = floor**2 + (0.0 if m.noise_uk is None else m.noise_uk**2)
            precision = np.where(seen, 1.0 / np.broadcast_to(variance, seen.shape), 0.0)
            noise_power = 4 * np.pi / seen.size * float(np.mean(1.0 / precision[seen]))
            parts.append(Part(index, m.name, split, m.moments, precision, noise_power))
    snr = survey.cl * sum(response[part.channel] ** 2 / part.noise_power for part in parts)
    lmax = _highest_degree(survey, snr)
    hidden = max(float(np.mean(part.precision == 0.0)) for part in parts)
    known = not survey.config.preparation and bool(np.all(snr[lmax + 1 :] <= 1.0) and snr[lmax] <= SHARP)
    white = known and all(m.drawn is None and m.pairs is None for channel in survey.channels for m in channel.maps)
    cl, response, snr = survey.cl[: lmax + 1], response[:, : lmax + 1], snr[: lmax + 1]
    dipole = dipole_alm(survey.channels[0].site.dipole_uk, lmax)
    inverse = _inverse(cl, response, parts) if known and hidden >= settings.hidden_share else None
    power = snr / (1.0 + snr)
    return Model(survey, lmax, survey.nside, cl, response, tuple(parts), dipole, inverse, white, power, settings)


def _inverse(cl: Cl, response: NDArray[np.float64], parts: Sequence[Part], offsets: bool = False) -> InverseCovariance:
    """Return the inverse covariance of all maps, of the circular parts of their beams.

    They are those at the centres of pixels, or, with ``offsets``, at the means of their samples.
    """
    through = [convolve.Response(row[None].astype(np.complex128)) for row in response]
    observed = [ObservedMap(through[p.channel], p.precision, p.moments if offsets else None) for p in parts]
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
    if survey.config.preparation or np.any(snr[last + 1 :] > 1.0):
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
    return float(np.sum((2 * np.arange(cl.size) + 1) / (4 * np.pi) * cl * response**2))


def wiener_filter(model: Model, maps: Sequence[Map]) -> FilteredMaps:
    """Filter maps of all parts, uK, shape (npix,) each; ``healpy.UNSEEN`` or NaN is not observed."""
    lmax, top = model.lmax, model.settings.beam_orders
    clean, seen = _clean(model, maps)
    sky = _sky(model, clean)
    looked_at = sky + model.dipole
    expected = np.empty((len(model.parts), seen[0].size))
    residual, adjoint = np.empty_like(expected), np.empty((len(model.parts), sky.size), dtype=np.complex128)
    orders = np.zeros((len(model.parts), top + 1, lmax + 1), dtype=np.complex128)
    k = np.sqrt(4 * np.pi / (2 * np.arange(lmax + 1) + 1))
    made = convolve.CircularMaps(model.nside, lmax)
    for channel, response in enumerate(model.response):
        through = alm_.multiply(sky, response, lmax)
        members = model.of(channel)
        window = model.survey.channels[channel].window[: lmax + 1]
        for i in members:
            part = model.parts[i]
            expected[i] = made.map(through)
            if part.moments.dtheta is not None:
                expected[i] += convolve.centroid_map(made.gradient(through), part.moments)
            residual[i] = np.where(seen[i], part.precision * (clean[i] - expected[i]), 0.0)
            adjoint[i] = healpix.adjoint(residual[i], lmax)
            orders[i, 0] = window * k * by_degree(looked_at, adjoint[i], lmax)
        for i, s, together in _transforms(model, members):
            turned = convolve.turned([(residual[j], model.parts[j].moments) for j in together], s)
            electric, magnetic = healpix.adjoint(turned, lmax, spin=s)
            # ducc0's sign: S_s is minus the synthesis of E = Re(k b) a, B = Im(k b) a.
            both = by_degree(looked_at, electric, lmax) + 1j * by_degree(looked_at, magnetic, lmax)
            orders[i, s] = -2.0 * window * k * both
    groups = [model.of(channel) for channel in range(len(model.channels))]
    difference = np.stack([_normalised_difference(model, residual, alike) for alike in groups])
    squares = np.stack([_squares(model, residual, alike) for alike in groups])
    return FilteredMaps(sky, expected, residual, adjoint, orders, difference, squares)


def _normalised_difference(model: Model, residual: NDArray[np.float64], parts: tuple[int, ...]) -> Map:
    """Return u^2 - 1 of every pixel seen by a channel's first two maps, u their difference over its noise; else 0.

    Of a channel with one map, u is its residual over the noise.
    """
    # Residuals are zero where nothing was seen, and come times their precision: (r/a - s/b)^2 / (1/a + 1/b).
    first, a = residual[parts[0]], model.parts[parts[0]].precision
    if len(parts) == 1:
        seen = first != 0.0
        return np.asarray(divided(first**2, np.where(seen, a, 0.0)) - seen)
    found = np.zeros_like(first)
    _difference(first, a, residual[parts[1]], model.parts[parts[1]].precision, found)
    return found


@njit(nogil=True)
def _difference(first, a, second, b, found):  # type: ignore[no-untyped-def]
    """Fill ``found`` where both are seen, in one pass over memory."""
    for pixel in range(found.size):
        if first[pixel] != 0.0 and second[pixel] != 0.0:
            square = (first[pixel] * b[pixel] - second[pixel] * a[pixel]) ** 2
            found[pixel] = square / (a[pixel] * b[pixel] * (a[pixel] + b[pixel])) - 1.0


def _squares(model: Model, residual: NDArray[np.float64], parts: tuple[int, ...]) -> Map:
    """Return N_i r_i^2 of every pixel, summed over maps: twice the derivative of ln L in ln N, but for a constant.

    All modes take part that know of the noise: those of the difference of splits, and those of their sum that the sky
    does not fill. A pixel that the data lack counts like the map's mean.
    """
    total = np.zeros(residual.shape[1])
    for i in parts:
        precision, seen = model.parts[i].precision, residual[i] != 0.0
        square = divided(residual[i] ** 2, precision)
        total += np.where(seen, square, square.sum() / max(np.count_nonzero(seen), 1) * (precision > 0.0))
    return total


def shared_sky(model: Model, maps: Sequence[Map]) -> Alm:
    """Return the filtered sky s^ of a set of maps, up to the model's lmax, uK.

    Notes
    -----
    It is found to a hundredth of the tolerance of :func:`wiener_filter`. By quadrature alone, what leaks
    between degrees adds power to s^: skies that it constrains had 2 % too much at l > 2.2 nside, and responses in them
    were 0.8 % too large. One iteration of the analysis takes most of it away where the filter is isotropic.
    """
    return _sky(model, _clean(model, maps)[0], careful=True)


def _clean(model: Model, maps: Sequence[Map]) -> tuple[list[Map], list[NDArray[np.bool_]]]:
    """Return maps with zeros in pixels that the fiducial scan does not hit, and where something was observed.

    Pixels that the data lack and the simulations have are filled with the filtered sky: zeros would be a departure of
    their own.
    """
    hit = [part.precision > 0 for part in model.parts]
    seen = [h & (map_ != healpy.UNSEEN) & np.isfinite(map_) for h, map_ in zip(hit, maps, strict=True)]
    clean = [np.where(observed, map_, 0.0) for observed, map_ in zip(seen, maps, strict=True)]
    holes = {i: hit[i] & ~seen[i] for i in range(len(hit)) if np.any(hit[i] & ~seen[i])}
    for _ in range(model.settings.hole_iterations if holes else 0):
        sky = _sky(model, clean)
        for i, hole in holes.items():
            through = alm_.multiply(sky, model.response[model.parts[i].channel], model.lmax)
            smooth = healpix.synthesis(through[None], model.nside, model.lmax)[0]
            clean[i] = np.where(hole, smooth, clean[i])
    return clean, seen


def _sky(model: Model, clean: Sequence[Map], careful: bool = False) -> Alm:
    lmax, settings = model.lmax, model.settings
    if model.inverse is not None:
        weighted = model.inverse.adjoint(model.inverse.precision * np.stack(clean))
        tolerance = settings.filter_tolerance * (0.01 if careful else 1.0)
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
