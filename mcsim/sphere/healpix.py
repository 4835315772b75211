"""HEALPix maps and their harmonic coefficients: transforms, quadrature weights, pixel window."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import ducc0
import healpy
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere.checks import (
    check_alm,
    check_complete,
    check_map,
    check_nside,
    check_whole,
    nside_of,
)
from mcsim.sphere.header import first_table, opened
from mcsim.support.arrays import Alm, Cl, Map, Maps, Matrix, Vector
from mcsim.support.code import package_digest
from mcsim.support.folders import cached, unreadable
from mcsim.support.npy import read_npy, write_npy


@lru_cache(maxsize=4)
def geometry(nside: int) -> dict[str, Any]:
    """Return the rings of a RING-ordered map, as ducc0's transforms take them."""
    return dict(ducc0.healpix.Healpix_Base(nside, "RING").sht_info())


def centres(nside: int) -> Matrix:
    """Return the unit vectors of the centres of all pixels in RING order, shape (3, npix)."""
    return np.stack(healpy.pix2vec(nside, np.arange(12 * nside**2)))


def rings_between(nside: int, north: float, south: float) -> slice:
    """Return the rings between two colatitudes, radians, and the next one on either side."""
    theta = geometry(nside)["theta"]
    first, last = np.searchsorted(theta, [north, south])
    return slice(max(int(first) - 2, 0), min(int(last) + 2, theta.size))


def synthesis(alm: Alm, nside: int, lmax: int, spin: int = 0, nthreads: int = 1, rings: slice | None = None) -> Maps:
    """Return the map of a_lm: (1, npix) from (1, size) at spin 0, else (2, npix) from E and B (2, size).

    ``rings``: make these alone, one after the other, as :func:`rings_between` gives them.
    Raise InputError if the coefficients do not fit ``lmax`` and ``spin``, or nside is not whole (any number will do).
    """
    check_whole(nside, "nside", 1)
    check_alm(alm, lmax, shape=(2 if spin else 1,))
    where = geometry(nside)
    if rings is not None:
        where = {key: values[rings] for key, values in where.items()}
        where["ringstart"] = where["ringstart"] - where["ringstart"][0]
    return np.asarray(ducc0.sht.synthesis(alm=alm, spin=spin, lmax=lmax, nthreads=nthreads, **where))


def gradient(alm: Alm, nside: int, lmax: int, nthreads: int = 1) -> Maps:
    """Return (d/dtheta, 1/sin(theta) d/dphi), shape (2, npix), of the spin-0 map of a_lm of shape (size,).

    Notes
    -----
    These are the maps of spin 1 of E = sqrt(l (l + 1)) a and no B, which ducc0 makes in two thirds of the time of its
    own derivatives.
    """
    check_alm(alm, lmax)
    if lmax == 0:  # where there is no spin 1
        return np.zeros((2, 12 * nside**2))
    ell = np.arange(lmax + 1.0)
    electric_magnetic = np.zeros((2, alm.size), dtype=np.complex128)
    electric_magnetic[0] = alm_.multiply(alm, np.sqrt(ell * (ell + 1.0)), lmax)
    return synthesis(electric_magnetic, nside, lmax, 1, nthreads)


def adjoint(map_: Maps, lmax: int, nthreads: int = 1, spin: int = 0) -> Alm:
    """Return the adjoint of the synthesis: the sum over pixels of the map times conj(Y_lm), shape (size,) at spin 0.

    At other spins a map of shape (2, npix) gives E and B, shape (2, size).
    """
    maps = map_ if spin else map_[None]
    nside = nside_of(map_.shape[-1], "the map") if spin else check_map(map_)
    found = ducc0.sht.adjoint_synthesis(map=maps, spin=spin, lmax=lmax, nthreads=nthreads, **geometry(nside))
    return np.asarray(found if spin else found[0])


def analysis(map_: Map, lmax: int, iterations: int = 0, nthreads: int = 1) -> Alm:
    """Return the coefficients of a RING-ordered map, shape (npix,), by ring-weighted quadrature and Jacobi iterations.

    Raise InputError if the map is not complete, or lmax exceeds 3 nside - 1. Each of the ``iterations`` costs a
    synthesis and an adjoint synthesis.

    Notes
    -----
    Relative error at nside 512, lmax 1024 for a sky smoothed by a 13.6' beam: 3e-5, 3e-6 and 4e-7 with 0, 1 and 2
    iterations (``tests/unit/test_healpix.py`` tests a smaller case).
    """
    nside = check_map(map_)
    check_complete(map_)
    check_whole(lmax, "lmax")
    if lmax > 3 * nside - 1:
        raise InputError(f"lmax = {lmax} is beyond {3 * nside - 1}, the largest that nside {nside} holds; lower lmax.")
    weight = _pixel_weights(nside)

    def quadrature(residual: Map) -> Alm:
        return adjoint(weight * residual, lmax, nthreads)

    alm = quadrature(map_)
    for _ in range(iterations):
        alm = alm + quadrature(map_ - synthesis(alm[None], nside, lmax, nthreads=nthreads)[0])
    return alm


@lru_cache(maxsize=2)
def _pixel_weights(nside: int) -> Map:
    """Return each pixel's quadrature weight: its area times healpy's ring weight (none for nside 1)."""
    rings = np.ones(4 * nside - 1)
    path = Path(healpy.__file__).parent / "data" / f"weight_ring_n{nside:05d}.fits"
    if nside > 1:
        north = 1.0 + fits.getdata(path).field(0).astype(float).ravel()[: 2 * nside]
        rings = np.concatenate([north, north[-2::-1]])
    weights = np.repeat(rings, geometry(nside)["nphi"].astype(int)) * healpy.nside2pixarea(nside)
    weights.setflags(write=False)
    return weights


@lru_cache(maxsize=4)
def pixel_window(nside: int, lmax: int) -> Cl:
    r"""Return the pixel window w_l, computed from the shapes of the pixels and averaged; shape (lmax + 1,).

    Notes
    -----
    w_l^2 is the mean over pixels of <P_l(x . y)>, x and y uniform in the pixel. A lattice of at most 32 x 32 pixels on
    one polar and one equatorial face represents all. A pixel is sampled at the centres of its sub-pixels. Against the
    published HEALPix tables, l <= 3 nside: within 2e-4 for nside 32 to 1024; if that matters, name a table in
    ``[map] pixel_window``.
    """
    check_nside(nside)
    check_whole(lmax, "lmax")
    window = np.zeros(lmax + 1)
    for face, share in _FACES:
        # The centres of n x n sub-pixels miss 1/n^2 of a pixel's extent: extrapolate from n = 4 and 8.
        window += share * (4.0 * _mean_legendre(face, nside, 8, lmax) - _mean_legendre(face, nside, 4, lmax)) / 3.0
    window = np.sqrt(np.abs(window))
    window.setflags(write=False)
    return window


def mean_window(nside: int, split: int, lmax: int) -> Cl:
    """Return the window of the mean of split x split sub-pixel centres over pixels, shape (lmax + 1,)."""
    found = [share * _mean_legendre(face, nside, split, lmax) for face, share in _FACES]
    return np.asarray(np.sqrt(np.abs(np.sum(found, axis=0))))


_FACES = ((0, 2.0 / 3.0), (4, 1.0 / 3.0))
"""One polar and one equatorial face that represent all, with the share of such faces."""


def _representatives(face: int, nside: int) -> NDArray[np.int64]:
    """Return NESTED pixels of a face that represent all of it."""
    lattice = min(nside, 32)
    step = (nside // lattice) ** 2
    cell = np.arange(lattice * lattice)
    # Pixels alternate just above and just below the middle of a cell: their mean is at the middle.
    above = (cell ^ (cell >> 1)) & 1 == 0
    pixels = cell * step + np.where(above, 3 * step // 4, max(step // 4 - 1, 0))
    return pixels + face * nside * nside


@lru_cache(maxsize=4)
def distances_from_centres(nside: int, split: int = 16) -> tuple[Vector, Vector]:
    """Return distances of points all over the pixels from their pixels' centres, radians, by a histogram, and shares.

    A pixel is sampled at the centres of split x split sub-pixels.
    """
    check_nside(nside)
    found, shares = [], []
    for face, share in _FACES:
        pixels = _representatives(face, nside)
        inside = pixels[:, None] * split**2 + np.arange(split**2)
        points = np.stack(healpy.pix2vec(split * nside, inside, nest=True), axis=-1)
        centres = np.stack(healpy.pix2vec(nside, pixels, nest=True), axis=-1)
        found.append(2.0 * np.arcsin(0.5 * np.linalg.norm(points - centres[:, None], axis=-1)).ravel())
        shares.append(np.full(inside.size, share / inside.size))
    r, weight = np.concatenate(found), np.concatenate(shares)
    total, edges = np.histogram(r, 256, range=(0.0, r.max() * (1.0 + 1e-12)), weights=weight)
    sums, _ = np.histogram(r, edges, weights=weight * r)
    filled = total > 0.0
    return sums[filled] / total[filled], total[filled] / total.sum()


@lru_cache(maxsize=32)
def _distances(face: int, nside: int, split: int) -> Matrix:
    """Return the cosines between split x split sub-pixel centres of a face's pixels, and their shares; shape (2, n).

    They serve windows up to any lmax. Finding them takes longer than all else at the start of a small run: the cache
    keeps them, if it can be written.
    """
    code = package_digest([__name__], ["healpy", "numpy"])

    def fill(scratch: Path) -> None:
        write_npy(scratch / "distances.npy", _histogram(face, nside, split))

    try:
        folder = cached(f"pixels-{face}-{nside}-{split}-{code[:32]}", fill)
    except InputError:
        found = _histogram(face, nside, split)
    else:
        found = np.load(folder / "distances.npy")
    found.setflags(write=False)
    return found


def _histogram(face: int, nside: int, split: int) -> Matrix:
    """Return cosines and shares of :func:`_distances` from a histogram of all distances within a pixel."""
    inside = _representatives(face, nside)[:, None] * split**2 + np.arange(split**2)
    centres = np.stack(healpy.pix2vec(split * nside, inside, nest=True), axis=-1)
    difference = centres[:, :, None, :] - centres[:, None, :, :]
    chord = np.sqrt(np.einsum("pijk,pijk->pij", difference, difference)).ravel()
    count, edges = np.histogram(chord, bins=4000, range=(0.0, chord.max() * (1.0 + 1e-12)))
    total, _ = np.histogram(chord, bins=edges, weights=chord)
    filled = count > 0
    return np.stack([1.0 - (total[filled] / count[filled]) ** 2 / 2.0, count[filled] / count.sum()])


def _mean_legendre(face: int, nside: int, split: int, lmax: int) -> Cl:
    """Return <P_l(x . y)> over pairs of the split x split sub-pixel centres of a face's pixels, shape (lmax + 1,)."""
    cosine, weight = _distances(face, nside, split)
    before, legendre = np.ones_like(cosine), cosine
    mean = np.ones(lmax + 1)
    for ell in range(1, lmax + 1):
        mean[ell] = weight @ legendre
        before, legendre = legendre, ((2 * ell + 1) * cosine * legendre - ell * before) / (ell + 1)
    return mean


def read_pixel_window(path: Path, lmax: int, nside: int | None = None) -> Cl:
    """Read a temperature pixel window, shape (lmax + 1,), from a HEALPix FITS file or a .npy file.

    Raise InputError if the file cannot be read, ends below lmax, states another ``nside``, or is not a window.
    """
    window, found = (read_npy(path, "iuf"), None) if path.suffix == ".npy" else _fits_pixel_window(path)
    window = window.astype(np.float64)
    if nside is not None and found not in (None, nside):
        raise InputError(f"{path} holds the pixel window of nside {found}; give that of {nside}.")
    if window.size <= lmax:
        raise InputError(
            f"{path} holds a pixel window up to l = {window.size - 1}, below the lmax {lmax} of the sky; lower "
            "sky.lmax or give a longer table."
        )
    if window[0] < 0.0:
        raise InputError(f"{path} starts at {window[0]:g}, so its sign is reversed; multiply it by -1.")
    if not np.all(window[: lmax + 1] > 0.0):
        raise InputError(f"{path} holds a pixel window that is not positive up to l = {lmax}; give a HEALPix table.")
    if abs(window[0] - 1.0) > 0.01 or window[: lmax + 1].max() > 1.01:
        raise InputError(
            f"{path} starts at {window[0]:g} and reaches {window[: lmax + 1].max():g}, where a pixel window starts at "
            "1 and stays below; give w_l from l = 0."
        )
    return window[: lmax + 1]


def _fits_pixel_window(path: Path) -> tuple[NDArray, int | None]:
    with unreadable(path, "a pixel window", "give a HEALPix pixel_window file"), opened(path) as hdus:
        table = first_table(hdus)
        return np.asarray(table.data.field(0), dtype=float).ravel(), table.header.get("NSIDE")
