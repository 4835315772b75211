"""The right-hand side P^T d of map-making: differences of one realization, weighted and summed into pixels."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.pointing import BLOCK, PointingStream, fill_block, ring_pixel
from mcsim.simulation import convolve
from mcsim.simulation.mapmaking.pairs import DifferencingScan, parts
from mcsim.simulation.mapmaking.solve import check_imbalance
from mcsim.simulation.tod import Stage, check_noise, chunks, sample_range, samples, through
from mcsim.sphere.healpix import Map

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

    Parameters
    ----------
    true
        Of the instrument.
    fiducial
        Of the map-making, which sums and solves with it; None: the true one.
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
    """White noise of ``sigma0_uk`` per difference, drawn from generators that are spawned from ``rng``."""

    sigma0_uk: float
    rng: np.random.Generator

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
    """Return right-hand sides of samples taken at their pixels' centres with their own orientations.

    Parameters
    ----------
    scan
        The pairs of pixels.
    skies
        For each right-hand side what sides A and B see (:func:`side_maps`). Several at once share the pointing and the
        noise: a map and its circular-beam control, for example.
    imbalance, noise
        Of the differences; None: no noise.
    nthreads
        Number of threads; the result does not depend on it, bit for bit.

    Returns
    -------
    ndarray
        P^T d in uK, shape (len(skies), npix).

    Raises
    ------
    InputError
        If maps have another nside.

    Notes
    -----
    d = (1 + x) T_A(p_A, psi_A) - (1 - x) T_B(p_B, psi_B). The pointing is computed again for every call, which is as
    fast as reading it would be: 60 to 80 ns of one core per sample at nside 128 with mmax 2, and half as much again
    for each further sky. Noise comes from one generator per chunk of the survey, so that :func:`rhs_from_samples` draws
    the same.
    """
    side_a, side_b = (_stacked(scan, [sky[side] for sky in skies]) for side in (0, 1))
    first, last = sample_range(scan.model, scan.side_a, scan.grid.time_range)
    drawn = _ChunkNoise(noise, chunks(first, last))
    a, b = (PointingStream(scan.model, line, scan.grid.frame) for line in (scan.side_a, scan.side_b))
    x, weight = imbalance.true, imbalance.weight
    gains = np.array([1.0 + x, x - 1.0, 1.0 + weight, weight - 1.0])

    def run(part: list[tuple[int, int]]) -> NDArray[np.float64]:
        rhs = np.zeros((scan.npix, len(skies)))
        for low, high in part:
            side_of_a = (a.start_turns(low), a.block_turns, a.tables, a.geometry, side_a)
            side_of_b = (b.start_turns(low), b.block_turns, b.tables, b.geometry, side_b)
            _add_chunk(side_of_a, side_of_b, a.to_frame, scan.grid.nside, gains, drawn.draw(low, high), rhs)
        return rhs

    total = np.zeros((scan.npix, len(skies)))
    with ThreadPoolExecutor(max(1, nthreads)) as pool:
        for partial in pool.map(run, parts(first, last)):
            total += partial
    return np.ascontiguousarray(total.T)


def rhs_from_samples(
    scan: DifferencingScan,
    stages: tuple[Sequence[Stage], Sequence[Stage]],
    imbalance: Imbalance = BALANCED,
    noise: DifferenceNoise | None = None,
    at_pixel_centres: bool = False,
) -> Map:
    """Return the right-hand side of samples at their own directions: the time-ordered reference.

    Parameters
    ----------
    scan, imbalance, noise
        As in :func:`rhs_from_maps`; the same generator gives the same noise.
    stages
        What the samples of sides A and B pass through, :func:`mcsim.simulation.tod.sky_signal` among them; they must
        keep the chunks as they come.
    at_pixel_centres
        As in :func:`mcsim.simulation.tod.samples`.

    Returns
    -------
    ndarray
        P^T d in uK, shape (npix,).
    """
    drawn = _ChunkNoise(noise, chunks(*sample_range(scan.model, scan.side_a, scan.grid.time_range)))
    streams = [
        through(samples(scan.model, line, scan.grid, at_pixel_centres), own)
        for line, own in zip((scan.side_a, scan.side_b), stages, strict=True)
    ]
    x, weight = imbalance.true, imbalance.weight
    rhs = np.zeros(scan.npix)
    for (low, high), a, b in zip(drawn.chunks, *streams, strict=True):
        difference = (1.0 + x) * a.signal_uk - (1.0 - x) * b.signal_uk + drawn.draw(low, high)
        _scatter(a.pixel, b.pixel, difference, 1.0 + weight, weight - 1.0, rhs)
    return rhs


class _ChunkNoise:
    """White noise by a generator per chunk, so that the order in which chunks are made does not matter."""

    def __init__(self, noise: DifferenceNoise | None, chunks: list[tuple[int, int]]) -> None:
        self.sigma0_uk, self.chunks = 0.0 if noise is None else noise.sigma0_uk, chunks
        self._generators: dict[int, np.random.Generator] = {}
        if noise is not None and noise.sigma0_uk > 0.0:
            children = noise.rng.spawn(len(chunks))
            self._generators = {low: child for (low, _), child in zip(chunks, children, strict=True)}

    def draw(self, low: int, high: int) -> NDArray[np.float64]:
        """Return the noise of the chunk low ... high - 1 in uK; zeros if there is none."""
        if not self._generators:
            return np.zeros(high - low)
        return self.sigma0_uk * self._generators[low].standard_normal(high - low)


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


@njit(cache=True, nogil=True, error_model="numpy")
def _add_chunk(side_of_a, side_of_b, to_frame, nside, gains, noise, rhs):  # type: ignore[no-untyped-def]
    """Add the differences of consecutive samples to ``rhs``; a side is (start, block_turns, tables, geometry, maps)."""
    pixel_a, pixel_b = np.empty(BLOCK, dtype=np.int64), np.empty(BLOCK, dtype=np.int64)
    difference = np.empty((rhs.shape[1], BLOCK))
    for block in range((noise.size + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        size = min(BLOCK, noise.size - first)
        difference[:, :size] = noise[first : first + size]
        _add_side(side_of_a, block, to_frame, nside, size, gains[0], pixel_a, difference)
        _add_side(side_of_b, block, to_frame, nside, size, gains[1], pixel_b, difference)
        for sky in range(rhs.shape[1]):
            for k in range(size):
                rhs[pixel_a[k], sky] += gains[2] * difference[sky, k]
                rhs[pixel_b[k], sky] += gains[3] * difference[sky, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_side(side, block, to_frame, nside, size, gain, pixel, difference):  # type: ignore[no-untyped-def]
    """Add gain x (what one side sees) to the differences of one block and leave the samples' pixels in ``pixel``."""
    start, block_turns, tables, geometry, maps = side
    turns, work = np.empty(3), np.empty((6, BLOCK))
    for axis in range(3):
        turns[axis] = (start[axis] + block * block_turns[axis]) % 1.0
    fill_block(turns, tables, geometry, to_frame, size, work)
    for k in range(size):
        pixel[k] = ring_pixel(nside, work[5, k], work[0, k], work[1, k], work[2, k])
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


@njit(cache=True, nogil=True)
def _scatter(pixel_a, pixel_b, difference, weight_a, weight_b, rhs):  # type: ignore[no-untyped-def]
    for k in range(difference.size):
        rhs[pixel_a[k]] += weight_a * difference[k]
        rhs[pixel_b[k]] += weight_b * difference[k]
