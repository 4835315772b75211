r"""Wiener-filter maps: the sky that they share, the residuals, and the residuals' correlation with sky and scan.

With d_i the maps, P_i the fiducial response of map i (beam, pixel window, centroids) and N_i its white noise,

    s^ = (S^-1 + sum_i P_i^t N_i^-1 P_i)^-1 sum_i P_i^t N_i^-1 d_i,     r_i = N_i^-1 (d_i - P_i s^).

On the full sky the first inverse is taken as if noise were isotropic, which costs little. Behind a mask it would cost
much, and is that of the noise of every pixel, by conjugate gradients (Model.inverse), or that of maps over their masks
where noise is not independent from pixel to pixel (Model.unmasked). What describes unlisted effects
has it on every sky, with the offsets of the samples (Model.exact). Maps that show the sky beyond the filter's last
degree are filtered by the inverse covariance of their mean, in which that sky is noise of pixels, and what all of them
have alike in a pixel is taken for sky (Model.pooled): the isotropic filter leaves it in all residuals, and most effects
then need 1.3 to 2 times the amplitude.

The matched filter of any small change dP_i of a response is <r_i, dP_i s^>: the filtered sky of *all* maps stands in
for the sky, so that noise limits it, not cosmic variance as for the spectra of a single sky. A change of the beam,
db_ls, acts as 2 Re[w_s db_ls ...] and its matched filter is sum_l Re[conj(db_ls) D_s(l)]: one transform of w_s r for
each order gives that of every beam.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

from mcsim.bipolar import by_degree
from mcsim.datavector import pixel_noise
from mcsim.datavector.filter_model import Model
from mcsim.simulation import convolve
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm, Map, Vector, divided

FILLED = 0.01  #: part of the sky in unobserved pixels up to which it is left to be found


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


def wiener_filter(model: Model, maps: Sequence[Map]) -> FilteredMaps:
    """Filter maps of all parts, uK, shape (npix,) each; ``healpy.UNSEEN`` or NaN is not observed."""
    lmax, top = model.lmax, model.settings.beam_orders
    clean, seen = cleaned(model, maps)
    model, clean = over_masks(model, clean)
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

    Pixels that the data lack and the simulations have are filled with the sky that is filtered from maps with them:
    zeros would be a departure of their own.
    """
    hit = [part.precision > 0 for part in model.parts]
    seen = [h & (map_ != healpy.UNSEEN) & np.isfinite(map_) for h, map_ in zip(hit, maps, strict=True)]
    clean = [np.where(observed, map_, 0.0) for observed, map_ in zip(seen, maps, strict=True)]
    holes = {i: hit[i] & ~seen[i] for i in range(len(hit)) if np.any(hit[i] & ~seen[i])}
    if holes and model.settings.hole_iterations:
        clean = _filled(model, clean, holes)
    return [part.without_subtracted(map_) for part, map_ in zip(model.parts, clean, strict=True)], seen


def _filled(model: Model, clean: Sequence[Map], holes: Mapping[int, NDArray[np.bool_]]) -> list[Map]:
    """Return maps with what they show of their filtered sky in the holes of some, by number.

    Notes
    -----
    Filled pixels h and that sky depend on each other, h = A h + b. Putting the sky of the last round in their place
    comes near the solution in as many rounds as the sky in a hole that all maps have is above the noise, and with bare
    quadrature diverges at the poles. So h is found by GMRES, with the more careful analysis.
    """
    ends = np.cumsum([0, *(int(hole.sum()) for hole in holes.values())])

    def with_pixels(values: Vector) -> list[Map]:
        maps = list(clean)
        for (i, hole), start, end in zip(holes.items(), ends, ends[1:], strict=False):
            maps[i] = maps[i].copy()
            maps[i][hole] = values[start:end]
        return maps

    def shown(values: Vector) -> Vector:
        sky, found = filtered_sky(model, with_pixels(values), careful=True), []
        for i, hole in holes.items():
            through = alm_.multiply(sky, model.response[model.parts[i].channel], model.lmax)
            found.append(healpix.synthesis(through[None], model.nside, model.lmax)[0][hole])
        return np.concatenate(found)

    alone, size = shown(np.zeros(ends[-1])), (ends[-1], ends[-1])
    operator = LinearOperator(size, matvec=lambda values: values - (shown(values) - alone))
    most = model.settings.hole_iterations
    return with_pixels(gmres(operator, alone, rtol=FILLED, restart=most, maxiter=1)[0])


def over_masks(model: Model, clean: list[Map]) -> tuple[Model, list[Map]]:
    """Return :attr:`Model.unmasked` and clean maps over their masks; both as they are if the model knows the masks."""
    if model.inverse is not None or model.unmasked is None:
        return model, clean
    return model.unmasked, [divided(*one) for one in zip(clean, model.masks, strict=True)]


def filtered_sky(model: Model, clean: Sequence[Map], careful: bool = False) -> Alm:
    """Return the filtered sky s^ of maps that are clean, up to the model's lmax, uK; see :func:`shared_sky`."""
    lmax, settings = model.lmax, model.settings
    if model.inverse is not None:
        maps = divided(*_summed(model, clean))[None] if model.pooled else np.stack(clean)
        weighted = model.inverse.adjoint(model.inverse.weighted(maps))
        tolerance, most = settings.filter_tolerance * model.tolerance, settings.filter_iterations
        found = model.inverse.approach(weighted, *((0.01 * tolerance, 10 * most) if careful else (tolerance, most)))
        return found if model.share is None else alm_.multiply(found, model.share, lmax)
    total = np.zeros(alm_.size(lmax), dtype=np.complex128)
    gain = np.zeros(lmax + 1)
    # Channels that see the sky alike are analysed together.
    for response, colour, members in model.alike:
        together = reduce(np.add, [clean[i] / model.parts[i].noise_power for i in members])
        total += alm_.multiply(healpix.analysis(together, lmax, int(careful)), response / colour, lmax)
        gain += response**2 / colour * sum(1.0 / model.parts[i].noise_power for i in members)
    return alm_.multiply(total, model.cl / (1.0 + model.cl * gain), lmax)


def _transforms(model: Model, members: tuple[int, ...]) -> Iterator[tuple[int, int, tuple[int, ...]]]:
    """Yield the map in whose place a transform is kept, its order, and the maps that it adds up."""
    for s in range(1, min(model.settings.beam_orders, model.lmax) + 1):
        filtered = tuple(i for i in members if model.parts[i].moments.smax >= s)
        if s <= model.settings.split_beam_orders:
            yield from ((i, s, (i,)) for i in filtered)
        elif filtered:
            yield filtered[0], s, filtered
