"""The right-hand side P^T d of map-making: differences of one realization, weighted and summed into pixels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.pointing import BLOCK, PointingStream, fill_block, fill_pixels
from mcsim.simulation import convolve
from mcsim.simulation.mapmaking.pairs import DifferencingScan, parts
from mcsim.simulation.mapmaking.solve import check_imbalance
from mcsim.simulation.tod import check_noise, chunks
from mcsim.support.arrays import Map
from mcsim.support.compiled import njit
from mcsim.support.threads import interruptible

SideMaps = NDArray[np.float64]
"""S_0, then 2 Re S_s and 2 Im S_s for s = 1 ... mmax of one beam at pixel centres, in uK, shape (npix, 1 + 2 mmax)."""


def side_maps(alm: NDArray[np.complex128], response: convolve.Response, nside: int, nthreads: int = 1) -> SideMaps:
    """Return what one side sees at every pixel's centre in any orientation.

    T(psi) = S_0 + 2 Re sum_s e^{-i s psi} S_s.
    """
    maps = np.zeros((12 * nside * nside, 1 + 2 * response.mmax))
    maps[:, 0] = convolve.circular_map(alm, response, nside, nthreads)
    for s, (real, imag) in convolve.spin_maps(alm, response, nside, nthreads).items():
        maps[:, 2 * s - 1], maps[:, 2 * s] = 2.0 * real, 2.0 * imag
    return maps


@dataclass(frozen=True)
class Imbalance:
    """Transmission imbalance x of a differencing instrument: d = (1 + x) T_A - (1 - x) T_B, -1 < x < 1.

    ``true`` is that of the instrument; map-making sums and solves with ``fiducial`` (None: the true one).
    """

    true: float = 0.0
    fiducial: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError unless both lie between -1 and 1."""
        for x in (self.true, self.weight):
            check_imbalance(x)

    @property
    def weight(self) -> float:
        """Imbalance that differences are summed with."""
        return self.true if self.fiducial is None else self.fiducial


BALANCED = Imbalance()


@dataclass(frozen=True)
class DifferenceNoise:
    """White noise of ``sigma0_uk`` per difference, drawn from generators that are spawned from ``rng``.

    ``factor``: of the variance in every pixel, shape (npix,); a difference has the mean of its two pixels'. None: one.
    """

    sigma0_uk: float
    rng: np.random.Generator
    factor: Map | None = None

    def __post_init__(self) -> None:
        """Raise InputError unless sigma0_uk is finite and >= 0."""
        check_noise(self.sigma0_uk)


def rhs_from_maps(
    scan: DifferencingScan,
    skies: Sequence[tuple[SideMaps, SideMaps]],
    imbalance: Imbalance = BALANCED,
    noise: DifferenceNoise | None = None,
    nthreads: int = 1,
) -> NDArray[np.float64]:
    """Return P^T d in uK, shape (len(skies), npix), of samples at their pixels' centres with their own orientations.

    Each of ``skies`` is what sides A and B see (:func:`side_maps`), of the scan's nside. Several at once share the
    pointing and the noise: a map and its circular-beam control, for example. The result does not depend on the threads,
    bit for bit.

    Notes
    -----
    d = (1 + x) T_A(p_A, psi_A) - (1 - x) T_B(p_B, psi_B). The pointing is computed again for every call, which is as
    fast as reading it would be: 60 to 80 ns of one core per sample at nside 128 with mmax 2, and half as much again
    for each further sky. Noise comes from one generator per chunk of the survey, so that the order in which chunks are
    made does not matter.
    """
    side_a, side_b = (_stacked(scan, [sky[side] for sky in skies]) for side in (0, 1))
    pieces = chunks(*scan.grid.sample_range(scan.model, scan.side_a))
    draw = noise_by_chunk(noise, pieces)
    a, b = (PointingStream(scan.model, line, scan.grid.frame) for line in (scan.side_a, scan.side_b))
    x, weight = imbalance.true, imbalance.weight
    gains = np.array([1.0 + x, x - 1.0, 1.0 + weight, weight - 1.0])
    factor = np.zeros(0) if noise is None or noise.factor is None else noise.factor

    def run(share: list[tuple[int, int]]) -> NDArray[np.float64]:
        rhs = np.zeros((scan.npix, len(skies)))
        for low, high in share:
            check()
            own = draw(low, high)
            _add_chunk((a.at(low), side_a), (b.at(low), side_b), scan.grid.nside, gains, own, factor, rhs)
        return rhs

    total = np.zeros((scan.npix, len(skies)))
    with interruptible(nthreads) as (pool, check):
        for partial in (pool.map if nthreads > 1 else map)(run, parts(pieces)):
            total += partial
    return np.ascontiguousarray(total.T)


def noise_by_chunk(noise: DifferenceNoise | None, pieces: list[tuple[int, int]]) -> Callable[[int, int], Map]:
    """Return what draws the noise of a chunk low ... high - 1, uK, from a generator of its own; zeros without noise."""
    if noise is None or noise.sigma0_uk == 0.0:
        return lambda low, high: np.zeros(high - low)
    sigma0_uk, generators = noise.sigma0_uk, dict(zip(pieces, noise.rng.spawn(len(pieces)), strict=True))
    return lambda low, high: sigma0_uk * generators[low, high].standard_normal(high - low)


def _stacked(scan: DifferencingScan, maps: list[SideMaps]) -> NDArray[np.float64]:
    """Stack the maps of one side of all skies, shape (npix, skies, 1 + 2 mmax): what a sample needs lies together."""
    for array in maps:
        if array.shape[0] != scan.npix:
            raise InputError(
                f"maps of a side have {array.shape[0]} pixels, but the scan has {scan.npix}; use its nside."
            )
    stacked = np.zeros((scan.npix, len(maps), max((array.shape[1] for array in maps), default=1)))
    for sky, array in enumerate(maps):
        stacked[:, sky, : array.shape[1]] = array
    return stacked


@njit(nogil=True, error_model="numpy")
def _add_chunk(side_of_a, side_of_b, nside, gains, noise, factor, rhs):  # type: ignore[no-untyped-def]
    """Add the differences of consecutive samples to ``rhs``; a side is where its stream starts, and its maps."""
    pixel_a, pixel_b = np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK, dtype=np.int64)
    difference = np.empty((rhs.shape[1], BLOCK))
    for first in range(0, noise.size, BLOCK):
        size = min(BLOCK, noise.size - first)
        for sky in range(rhs.shape[1]):  # a loop: numba takes seconds to compile the assignment of a slice
            for k in range(size):
                difference[sky, k] = noise[first + k]
        _add_side(side_of_a, first, nside, gains[0], pixel_a[:size], difference)
        _add_side(side_of_b, first, nside, gains[1], pixel_b[:size], difference)
        if factor.size > 0:
            for k in range(size):
                more = np.sqrt(0.5 * (factor[pixel_a[k]] + factor[pixel_b[k]])) - 1.0
                for sky in range(rhs.shape[1]):
                    difference[sky, k] += more * noise[first + k]
        for sky in range(rhs.shape[1]):
            for k in range(size):
                rhs[pixel_a[k], sky] += gains[2] * difference[sky, k]
                rhs[pixel_b[k], sky] += gains[3] * difference[sky, k]


@njit(nogil=True, error_model="numpy")
def _add_side(side, first, nside, gain, pixel, difference):  # type: ignore[no-untyped-def]
    """Add gain x (what one side sees) to the differences of one block and leave the samples' pixels in ``pixel``."""
    start, maps = side
    size, work = pixel.size, np.empty((6, BLOCK))
    fill_block(start, first, size, work)
    fill_pixels(nside, work, pixel)
    # One order at a time for all samples of the block: short loops of one gather each take half the time of one loop
    # that sums the orders sample by sample.
    for sky in range(difference.shape[0]):
        for k in range(size):
            difference[sky, k] += gain * maps[pixel[k], sky, 0]
    cosine, sine = work[3].copy(), work[4].copy()
    for order in range(maps.shape[2] // 2):
        even, odd = 2 * order + 1, 2 * order + 2
        for sky in range(difference.shape[0]):
            for k in range(size):
                seen = maps[pixel[k], sky, even] * cosine[k] + maps[pixel[k], sky, odd] * sine[k]
                difference[sky, k] += gain * seen
        for k in range(size):
            turned = cosine[k] * work[3, k] - sine[k] * work[4, k]
            sine[k] = sine[k] * work[3, k] + cosine[k] * work[4, k]
            cosine[k] = turned
