r"""From a sky to the map of a survey: spin transforms of the beam's components, combined with orientation moments.

    T(n) = S_0(n) + 2 Re sum_{s > 0} w_s(n) S_s(n),
    S_s(n) = sum_lm k_l a_lm b_ls sY_lm(n),   k_l = sqrt(4 pi / (2l + 1)).

One transform per kept s, whatever the number of samples in the survey (paper, Sec. III and App. C).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_alm, check_cl, check_nside, check_shape
from mcsim.support.arrays import Alm, Cl, Map, Maps
from mcsim.support.compiled import njit


@dataclass(frozen=True)
class Response:
    """A beam's components with the pixel window folded in: shape (mmax + 1, lmax + 1), k_l b_ls w_l."""

    factors: NDArray[np.complex128]

    @property
    def lmax(self) -> int:
        """Largest degree."""
        return self.factors.shape[1] - 1

    @property
    def mmax(self) -> int:
        """Largest order of the beam that is kept."""
        return self.factors.shape[0] - 1


def response(beam: Beam, lmax: int, window: Cl | None = None) -> Response:
    """Return the response of a beam times a pixel window, shape (>= lmax + 1,); InputError if one ends before lmax."""
    if beam.lmax < lmax:
        raise InputError(f"the beam ends at l = {beam.lmax}, below the lmax {lmax} of the sky; compute it further.")
    k = np.sqrt(4.0 * np.pi / (2.0 * np.arange(lmax + 1) + 1.0))
    if window is not None:
        check_cl(window, lmax, "the pixel window")
        k = k * window[: lmax + 1]
    return Response(k * beam.blm[:, : lmax + 1])


def circular_alm(alm: Alm, response: Response) -> Alm:
    """Return the coefficients of the sky seen through the circular part of the beam, shape as ``alm``."""
    return alm_.multiply(alm, response.factors[0].real, response.lmax)


def circular_map(alm: Alm, response: Response, nside: int, nthreads: int = 1) -> Map:
    """Return S_0, the sky through the circular part of the beam at pixel centres, uK, shape (npix,)."""
    return healpix.synthesis(circular_alm(alm, response)[None], nside, response.lmax, nthreads=nthreads)[0]


class CircularMaps:
    """Maps of skies that a circular beam has smoothed; the last is kept, for the next channel with an equal beam."""

    def __init__(self, nside: int, lmax: int, nthreads: int = 1) -> None:
        self._grid = (nside, lmax)
        self.nthreads = nthreads
        self._alm: Alm | None = None
        self._made: dict[str, Maps] = {}

    def map(self, alm: Alm) -> Map:
        """Return the sky at pixel centres, uK, shape (npix,); read-only."""
        return self._once(alm, "map", lambda: healpix.synthesis(alm[None], *self._grid, nthreads=self.nthreads)[0])

    def gradient(self, alm: Alm) -> Maps:
        """Return its gradient as :func:`mcsim.sphere.healpix.gradient` does, uK/rad, shape (2, npix); read-only."""
        return self._once(alm, "gradient", lambda: healpix.gradient(alm, *self._grid, self.nthreads))

    def _once(self, alm: Alm, name: str, make: Callable[[], Maps]) -> Maps:
        if self._alm is None or not np.array_equal(self._alm, alm):
            self._alm, self._made = alm, {}
        if name not in self._made:
            self._made[name] = make()
            self._made[name].setflags(write=False)
        return self._made[name]


def spin_maps(
    alm: Alm, response: Response, nside: int, nthreads: int = 1, rings: slice | None = None
) -> dict[int, Maps]:
    """Return S_s at pixel centres for every s > 0 that the beam has: real and imaginary parts, shape (2, npix), in uK.

    ``rings``: of these rings alone.

    Notes
    -----
    ducc0 returns -S_s from E = Re(k b_s) a, B = Im(k b_s) a. The test against ``ducc0.totalconvolve`` holds the sign
    (``tests/unit/test_convolve.py``).
    """
    check_nside(nside)
    check_alm(alm, response.lmax, "the sky")
    maps = {}
    for s in range(1, response.mmax + 1):
        factor = -response.factors[s]
        if not factor.any():  # the odd orders of an ellipse, say
            continue
        electric_magnetic = np.stack(
            [alm_.multiply(alm, factor.real, response.lmax), alm_.multiply(alm, factor.imag, response.lmax)]
        )
        maps[s] = healpix.synthesis(electric_magnetic, nside, response.lmax, s, nthreads, rings)
    return maps


def noncircular_map(maps: dict[int, Maps], moments: Moments) -> Map:
    """Return 2 Re sum_{s > 0} w_s S_s, what the non-circular part of the beam adds under a scan, uK, shape (npix,).

    InputError if the moments have fewer orders than the maps, or another nside.
    """
    highest = max(maps, default=0)
    if moments.smax < highest:
        raise InputError(
            f"The moments end at s = {moments.smax}, the beam has orders up to {highest}; lower its m_max."
        )
    total = np.zeros(12 * moments.nside**2)
    for s, pair in maps.items():
        check_shape(pair, (2, total.size), f"the map S_{s} beside moments of nside {moments.nside}")
    for s, (real, imag) in maps.items():
        add_twice_real_part(moments.w[s - 1], real, imag, total)
    return total


@njit(nogil=True)
def add_twice_real_part(w, real, imag, total):  # type: ignore[no-untyped-def]
    """Add 2 Re(w (real + i imag)) to ``total`` in one pass over memory, which is what this costs."""
    for pixel in range(total.size):
        total[pixel] += 2.0 * (w[pixel].real * real[pixel] - w[pixel].imag * imag[pixel])


def turned(each: Sequence[tuple[Map, Moments]], s: int, total: Maps | None = None) -> Maps:
    """Return the sum of conj(w_s) times maps, real and imaginary part, shape (2, npix): adjoint to w_s S_s.

    ``total``: an array of this shape to fill, in place of a new one.
    """
    total = np.empty((2, each[0][0].size)) if total is None else total
    for place, (map_, moments) in enumerate(each):
        check_shape(map_, (moments.npix,), f"the map beside moments of nside {moments.nside}")
        _turn(map_, moments.w[s - 1], total, place == 0)
    return total


@njit(nogil=True)
def _turn(map_, w, total, first):  # type: ignore[no-untyped-def]
    """Add conj(w) times a map to ``total``, or begin with the ``first`` one, in one pass over memory."""
    for pixel in range(map_.size):
        real, imag = map_[pixel] * w[pixel].real, map_[pixel] * w[pixel].imag
        total[0, pixel] = real if first else total[0, pixel] + real
        total[1, pixel] = -imag if first else total[1, pixel] - imag


def centroid_map(gradient: Maps, moments: Moments) -> Map:
    """Return d . grad S_0 for samples whose mean position is off the pixel centre by d, uK, shape (npix,).

    The gradient is d/dtheta and 1/sin(theta) d/dphi of S_0, shape (2, npix), uK/rad; d is the moments'.
    """
    if moments.dtheta is None or moments.dphi is None:
        raise InputError("the moments have no centroids (dtheta, dphi); leave the centroid map out.")
    check_shape(gradient, (2, moments.npix), f"the gradient beside moments of nside {moments.nside}")
    result = np.empty(gradient.shape[1])
    _along(moments.dtheta, gradient[0], moments.dphi, gradient[1], result)
    return result


@njit(nogil=True)
def _along(dtheta, down, dphi, east, result):  # type: ignore[no-untyped-def]
    """Fill ``result`` with d . grad in one pass over memory."""
    for pixel in range(result.size):
        result[pixel] = dtheta[pixel] * down[pixel] + dphi[pixel] * east[pixel]
