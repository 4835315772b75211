"""The sky that makes a channel's maps: by GMRES where they are whole, else by a Wiener filter."""

from dataclasses import replace

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg, gmres

from mcsim.comparison.scene import WEAKEST, Maps, Scene
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.support.arrays import Alm, Vector, divided

ITERATIONS = 30
"""Largest number of iterations for the sky that whole maps show, and of each filter for what holes leave of it."""

WHOLE = 0.99  #: share of the pixels from which on holes hide nothing

TRUSTED = 0.02
"""Noise over the sky at which maps with holes are filtered: what orientation moments leave of single samples."""

FILTERS, FILTERS_AGAIN = 4, 2
"""How often maps with holes are filtered, each time less what the beam's shape made of the sky before."""

NEAR = 5  #: degrees over which power is averaged


def mean_map(maps: Maps, seen: NDArray[np.bool_]) -> Vector:
    """Return the mean of maps, shape (split, npix), over those in which a pixel is seen; 0 where it is in none."""
    return np.where(seen, maps, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)


def circular_response(scene: Scene, nside: int) -> tuple[Vector, NDArray[np.bool_], Vector]:
    """Return the circular part of a scene's response up to what pixels hold, where it is known, and 1 over it there."""
    factor = scene.response.factors[0].real[: 3 * nside]
    known = factor > WEAKEST * factor.max()
    return factor, known, divided(known, factor)


def sky_in(
    maps: Maps, seen: NDArray[np.bool_], empty: Scene, tolerance: float = 1e-5, beside: Alm | None = None
) -> Alm:
    """Return the sky whose simulation makes a channel's maps where they are seen.

    What maps of that nside cannot hold, above l = 3 nside - 1, is zero, and so is what the beam suppresses.

    ``maps``, ``seen``: shape (split, npix) each; ``empty``: scene of the channel, whose sky is not used; ``tolerance``:
    residual at which iterations end, over the maps' own size; ``beside``: sky whose maps are taken off already.

    Notes
    -----
    GMRES for the sky smoothed by beam and pixel window; the operator is the simulation, then the transform of its
    mean map with 0 for what is not seen. Without holes that is the unit matrix but for the beam's shape and the
    quadrature; with holes it has small eigenvalues, and what they hide would be anything: see :func:`_behind_holes`.
    """
    if float(seen.any(axis=0).mean()) < WHOLE and not empty.preparations:
        return _behind_holes(maps, seen, empty, beside)
    factor = empty.response.factors[0].real
    for steps in empty.preparations[:1]:
        factor = factor * steps.beam_window(empty.lmax) * steps.pixel_window(empty.lmax)
    nside = healpy.npix2nside(maps.shape[1])
    shown = min(empty.lmax, 3 * nside - 1)
    known = factor[: shown + 1] > WEAKEST * factor.max()
    inverse = divided(known, factor[: shown + 1])
    affine = replace(empty, sky=np.zeros_like(empty.sky)).maps() if empty.preparations else np.zeros_like(maps)

    def analysed(values: Maps) -> NDArray[np.float64]:
        found = healpix.analysis(mean_map(values, seen), shown, nthreads=empty.nthreads)
        return alm_.multiply(found, known.astype(float), shown).view(np.float64)

    def sky(smooth: NDArray[np.float64]) -> Alm:
        alm = alm_.multiply(np.ascontiguousarray(smooth).view(np.complex128), inverse, shown)
        return alm_.resize(alm, shown, empty.lmax)

    def simulated(smooth: NDArray[np.float64]) -> NDArray[np.float64]:
        return analysed(replace(empty, sky=sky(smooth)).maps() - affine)

    wanted = analysed(maps - affine)
    operator = LinearOperator((wanted.size, wanted.size), matvec=simulated, dtype=np.float64)
    return sky(gmres(operator, wanted, rtol=tolerance, restart=ITERATIONS, maxiter=1)[0])


def _behind_holes(maps: Maps, seen: NDArray[np.bool_], empty: Scene, beside: Alm | None) -> Alm:
    """Return the sky of maps with holes, which is as small there as the power of the sky that is seen says.

    Notes
    -----
    Without that, what holes hide, and noise does not, grows until it makes up for what orientation moments miss where
    the sky is seen: the sky of 39 % of the pixels is then too large by half, and moves wrongly with the samples.
    """
    nside, nthreads = empty.nside, empty.nthreads
    factor, known, inverse = circular_response(empty, nside)
    lmax = factor.size - 1
    before = np.zeros_like(empty.sky) if beside is None else beside
    smooth = alm_.multiply(alm_.resize(before, empty.lmax, lmax), factor * known, lmax)
    shown = smooth
    if beside is None:
        shown = healpix.analysis(mean_map(maps, seen), lmax, nthreads=nthreads)
    power = healpy.alm2cl(shown) / float(seen.any(axis=0).mean())
    variance = TRUSTED**2 * float((2 * np.arange(lmax + 1) + 1) @ power) / (4.0 * np.pi)
    power = np.maximum(averaged(power), 1e-3 * variance * healpy.nside2pixarea(nside))
    weight, sky = seen.sum(axis=0) / variance, before
    for _ in range(FILTERS if beside is None else FILTERS_AGAIN):
        rest = np.where(seen, maps - replace(empty, sky=sky - before).maps(), 0.0).sum(axis=0) / variance
        rest += weight * healpix.synthesis(smooth[None], nside, lmax, nthreads=nthreads)[0]
        smooth = wiener(rest, weight, power * known, nthreads, smooth, ITERATIONS)
        sky = alm_.resize(alm_.multiply(smooth, inverse, lmax), lmax, empty.lmax)
    return sky - before


def averaged(power: Vector) -> Vector:
    """Return power averaged over the :data:`NEAR` nearest degrees, zero beyond its ends."""
    return np.convolve(power, np.ones(NEAR) / NEAR)[NEAR // 2 :][: power.size]


def wiener(
    weighted: Vector, weight: Vector, power: Vector, nthreads: int, start: Alm | None = None, iterations: int = 100
) -> Alm:
    """Return the mean of the coefficients whose map, times a weight, was ``weighted`` but for noise.

    ``weighted``, ``weight``: map times inverse variance of the noise, and that, shape (npix,). ``power``: of the sky,
    shape (lmax + 1,). ``start``: coefficients near the answer; None: zeros. ``iterations``: steps at most.
    """
    lmax, nside = power.size - 1, healpy.npix2nside(weight.size)
    size = np.sqrt(alm_.multiplicity(lmax))  # so that the product of vectors is that of maps

    def of_map(values: NDArray[np.float64]) -> NDArray[np.float64]:
        alm = healpix.adjoint(values, lmax, nthreads)
        return (size * alm_.multiply(alm, np.sqrt(power), lmax)).view(np.float64)

    def to_alm(vector: NDArray[np.float64]) -> Alm:
        return alm_.multiply(np.ascontiguousarray(vector).view(np.complex128) / size, np.sqrt(power), lmax)

    def applied(vector: NDArray[np.float64]) -> NDArray[np.float64]:
        return vector + of_map(weight * healpix.synthesis(to_alm(vector)[None], nside, lmax, nthreads=nthreads)[0])

    first = np.zeros(2 * size.size)
    if start is not None:
        first = (size * alm_.multiply(start, divided(1.0, np.sqrt(power)), lmax)).view(np.float64)
    diagonal = 1.0 + np.repeat(power[alm_.degrees(lmax)], 2) * weight.sum() / (4.0 * np.pi)
    shape = (diagonal.size, diagonal.size)
    found, _ = cg(
        LinearOperator(shape, matvec=applied, dtype=np.float64), of_map(weighted), first, rtol=1e-6,
        maxiter=iterations, M=LinearOperator(shape, matvec=lambda v: v / diagonal, dtype=np.float64),
    )  # fmt: skip
    return to_alm(found)
