"""Steps of the preparation of maps, each with what it makes of windows, noise, hits and orientation moments."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg

from mcsim.errors import InputError
from mcsim.simulation import windows
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rotation
from mcsim.support.arrays import Map, divided

ITERATIONS = 1  #: Jacobi iterations of the analysis of maps that are smoothed or degraded in harmonics
NEGLIGIBLE = 1e-6  #: B_l below this is taken for zero
FILL_TOLERANCE = 1e-10  #: relative residual of the diffuse filling


class Step(ABC):
    """One step on the maps of a channel; a step that does not change something inherits it unchanged."""

    transforms = 0  #: number of scalar transforms

    @abstractmethod
    def apply(self, map_uk: Map) -> Map:
        """Return the map after the step, uK, NaN where not observed."""

    def check(self, seen: Map) -> Map:
        """Raise InputError if the step cannot be applied to a map that is NaN where ``seen`` is; return it after it."""
        return self.apply(seen)

    def beam_window(self, lmax: int) -> NDArray[np.float64]:
        """Return what the step multiplies B_l with, shape (lmax + 1,)."""
        return np.ones(lmax + 1)

    def pixel_window(self, lmax: int) -> NDArray[np.float64]:
        """Return what the step multiplies the pixel window with, shape (lmax + 1,)."""
        return np.ones(lmax + 1)

    def noise(self, power: Map) -> Map:
        """Return the local power of white noise (variance times pixel area, uK^2 sr), but for windows."""
        return np.asarray(self.local(power))

    def local(self, values: NDArray) -> NDArray:
        """Return the means over observed pixels of what belongs to samples; NaN where a pixel has no data."""
        return values

    def orientations(self, w: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return orientation moments after the step, shape (smax, npix)."""
        return np.stack([self.local(row) for row in w])


@dataclass(frozen=True)
class Average(Step):
    """Mean of the observed pixels inside each coarse one."""

    fine: int
    coarse: int

    def apply(self, map_uk: Map) -> Map:
        return np.asarray(self.local(map_uk))

    def pixel_window(self, lmax: int) -> NDArray[np.float64]:
        """Return the window of the mean over the centres of the fine pixels."""
        return windows.of_average(self.fine, self.coarse, lmax)

    def noise(self, power: Map) -> Map:
        """Return the power of the means: more where fewer pixels are observed."""
        share = np.isfinite(_blocks(power, self.fine, self.coarse)).mean(axis=1)
        return np.asarray(self.local(power) / np.where(share > 0.0, share, np.nan))

    def local(self, values: NDArray) -> NDArray:
        inside = _blocks(values, self.fine, self.coarse)
        seen = np.isfinite(inside)
        count = seen.sum(axis=1)
        total = np.where(seen, inside, 0.0).sum(axis=1)
        return divided(total, count, np.nan)


@dataclass(frozen=True, eq=False)
class Filter(Step):
    """Product with a window in harmonics, and synthesis at another nside where that is lower."""

    name: str  # of the step, for messages
    fine: int  # nside before
    coarse: int  # nside after
    beam: NDArray[np.float64]  # factors of B_l, (lmax + 1,); nothing is kept above
    pixels: NDArray[np.float64]  # factors of the pixel window, (lmax + 1,)

    transforms = 2 + 2 * ITERATIONS

    def apply(self, map_uk: Map) -> Map:
        lmax = self.beam.size - 1
        alm = healpix.analysis(_complete(map_uk, self.name), lmax, ITERATIONS)
        return healpix.synthesis(alm_.multiply(alm, self.beam * self.pixels, lmax)[None], self.coarse, lmax)[0]

    def check(self, seen: Map) -> Map:
        _complete(seen, self.name)
        return np.ones(12 * self.coarse**2)

    def beam_window(self, lmax: int) -> NDArray[np.float64]:
        """Return the factors, zero above their end."""
        return _resized(self.beam, lmax, 0.0)

    def pixel_window(self, lmax: int) -> NDArray[np.float64]:
        """Return the factors, 1 above their end, where those of the beam are zero."""
        return _resized(self.pixels, lmax, 1.0)

    def local(self, values: NDArray) -> NDArray:
        return values if self.fine == self.coarse else Average(self.fine, self.coarse).local(values)


@dataclass(frozen=True, eq=False)
class Regression(Step):
    """Templates (K, npix) times coefficients, subtracted: given ones, or fitted with weights (npix,)."""

    columns: NDArray[np.float64]
    weight: Map
    coefficients: NDArray[np.float64] | None = None

    def apply(self, map_uk: Map) -> Map:
        if self.coefficients is not None:
            return map_uk - self.coefficients @ self.columns
        used = np.flatnonzero((self.weight > 0.0) & np.isfinite(map_uk))
        if used.size < len(self.columns):
            raise InputError(
                f"{used.size} pixels are left to fit {len(self.columns)} templates to; widen the mask of the step."
            )
        weighted = self.weight[used] * self.columns[:, used]
        normal = weighted @ self.columns[:, used].T
        scale = np.sqrt(np.diag(normal))
        if not scale.all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e10:
            raise InputError("the templates of a preparation cannot be told apart outside the mask; leave one out.")
        return map_uk - np.linalg.solve(normal, weighted @ map_uk[used]) @ self.columns

    def check(self, seen: Map) -> Map:
        self.apply(seen)
        return seen


@dataclass(frozen=True, eq=False)
class Filled(Step):
    """A value for pixels without data, or the mean of their neighbours (``value_uk`` None).

    Notes
    -----
    Each filled pixel equals the mean of its neighbours, all at once: the state that the diffusive inpainting of Planck
    (arXiv:1502.01592) iterates towards, by conjugate gradients to ``FILL_TOLERANCE``.
    """

    masked: NDArray[np.bool_]
    value_uk: float | None

    def apply(self, map_uk: Map) -> Map:
        hole = self._hole(map_uk)
        if self.value_uk is not None:
            return np.where(hole, self.value_uk, map_uk)
        filled = map_uk.copy()
        matrix, edge = _neighbours(hole.tobytes(), healpy.npix2nside(hole.size))
        known = edge @ np.where(hole, 0.0, map_uk)
        found, failed = cg(matrix, known, x0=np.full(known.size, map_uk[~hole].mean()), rtol=FILL_TOLERANCE)
        if failed:
            raise InputError("the diffuse filling of a preparation does not converge; fill a smaller mask.")
        filled[hole] = found
        return filled

    def check(self, seen: Map) -> Map:
        return np.where(self._hole(seen), 1.0, seen)

    def _hole(self, map_uk: Map) -> NDArray[np.bool_]:
        hole = self.masked | ~np.isfinite(map_uk)
        if self.value_uk is None and hole.all():
            raise InputError("a preparation has no observed pixel to fill the others from; widen its mask.")
        return np.asarray(hole)

    def noise(self, power: Map) -> Map:
        """Return the power, 0 in filled pixels, which have a value and no noise of their own."""
        return np.where(self.masked | ~np.isfinite(power), 0.0, power)

    def local(self, values: NDArray) -> NDArray:
        """Return the values; filled pixels have no data."""
        return np.where(self.masked, np.nan, values)


@dataclass(frozen=True, eq=False)
class Weighted(Step):
    """Product with a mask, shape (npix,)."""

    mask: Map

    @property
    def whole(self) -> bool:
        """Return True if pixels are kept as they are, or not at all."""
        return bool(np.isin(self.mask, (0.0, 1.0)).all())

    def apply(self, map_uk: Map) -> Map:
        """Return the product: 0 where the mask is, observed or not."""
        return np.where(self.mask == 0.0, 0.0, self.mask * map_uk)

    def noise(self, power: Map) -> Map:
        """Return the power of the product, 0 where the mask is."""
        return np.where(self.mask == 0.0, 0.0, power * self.mask**2)

    def local(self, values: NDArray) -> NDArray:
        """Return the values; pixels of weight 0 have no data."""
        return np.where(self.mask == 0.0, np.nan, values)


@dataclass(frozen=True)
class Rotated(Step):
    """Rotation into another frame."""

    before: str
    after: str
    nside: int

    transforms = 8

    def apply(self, map_uk: Map) -> Map:
        lmax = 2 * self.nside
        alm = healpix.analysis(_complete(map_uk, "rotate"), lmax, iterations=3)
        return healpix.synthesis(rotation.rotate_alm(alm, lmax, self.before, self.after)[None], self.nside, lmax)[0]

    def check(self, seen: Map) -> Map:
        return _complete(seen, "rotate")

    def beam_window(self, lmax: int) -> NDArray[np.float64]:
        """Return 1 up to 2 nside, where the harmonics end."""
        return _resized(np.ones(2 * self.nside + 1), lmax, 0.0)

    def local(self, values: NDArray) -> NDArray:
        """Return the values at the same place of the sky."""
        real = rotation.rotate_pixels(values.real, self.before, self.after)
        return real + 1j * self.local(values.imag) if np.iscomplexobj(values) else real

    def orientations(self, w: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the moments of psi from the meridians of the new frame."""
        turn = rotation.between_meridians(self.nside, self.after, self.before)
        return np.stack([np.exp(-1j * s * turn) * self.local(row) for s, row in enumerate(w, start=1)])


def _complete(map_uk: Map, name: str) -> Map:
    holes = int(np.sum(~np.isfinite(map_uk)))
    if holes:
        raise InputError(
            f'a step "{name}" works in harmonics and cannot take {holes} pixels without data; put a step "fill" before '
            "it."
        )
    return map_uk


def _resized(window: NDArray[np.float64], lmax: int, beyond: float) -> NDArray[np.float64]:
    return np.concatenate([window, np.full(max(lmax + 1 - window.size, 0), beyond)])[: lmax + 1]


@lru_cache(maxsize=2)
def _nested_order(nside: int) -> NDArray[np.int64]:
    return np.asarray(healpy.nest2ring(nside, np.arange(12 * nside**2)))


def _blocks(values: NDArray, fine: int, coarse: int) -> NDArray:
    """Return the fine pixels inside every coarse one in RING order, shape (npix, (fine / coarse)^2)."""
    inside = values[_nested_order(fine)].reshape(12 * coarse**2, -1)
    return inside[healpy.ring2nest(coarse, np.arange(12 * coarse**2))]


@lru_cache(maxsize=8)
def _neighbours(hole: bytes, nside: int) -> tuple[csr_matrix, csr_matrix]:
    """Return the Laplacian among unknown pixels, and the neighbours of each among all pixels."""
    unknown = np.flatnonzero(np.frombuffer(hole, dtype=bool))
    near = healpy.get_all_neighbours(nside, unknown)
    row, column = np.broadcast_to(np.arange(unknown.size), near.shape)[near >= 0], near[near >= 0]
    edge = csr_matrix((np.ones(row.size), (row, column)), shape=(unknown.size, 12 * nside**2))
    return csr_matrix(diags(np.asarray(edge.sum(axis=1)).ravel()) - edge[:, unknown]), edge
