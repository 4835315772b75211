"""Streaming of a survey's samples into per-pixel sums, on all cores, never holding the pointing in memory."""

from collections import deque
from collections.abc import Callable
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray

from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import ScanModel
from mcsim.instrument.scan.offsets import add_powers, centres, exponents
from mcsim.instrument.scan.pointing import BLOCK, PointingStream, fill_block, fill_pixels
from mcsim.instrument.scan.sampling import warn_of_aliases
from mcsim.sphere.checks import check_memory, check_whole
from mcsim.support.compiled import njit
from mcsim.support.threads import interruptible

SECONDS_PER_SAMPLE = 7e-8
"""Time of one core for a sample of the moments (docs/measured.md: 21 to 39 million samples/s on two)."""

_RANGES = 16
_CHUNK = 1 << 21
_CACHE_LINE = 64


def stream_sums(
    model: ScanModel, grid: MapGrid, smax: int, nthreads: int = 1, progress: Callable[[float], None] | None = None
) -> NDArray[np.float64]:
    """Return the sums per pixel (:func:`pixel_sums`) of a survey's default lines of sight, by streaming every sample.

    Notes
    -----
    Time is cut into 16 ranges, whatever the number of threads; each is summed on its own and the sums are added
    in the order of time: the result does not depend on ``nthreads``, bit for bit. The memory does: one accumulator of
    8 (4 + 2 smax) bytes per pixel for each thread and one for the sum; 24, 56 or 96 bytes more each for offsets of
    order 2, 3 or 4, and 24 for the centres. Besides e^{-i s psi} a pixel sums its samples' unit vectors: their mean
    against the pixel's centre is the centroid offset. ``progress`` takes the fraction done.
    """
    check_whole(smax, "smax", 1)
    check_whole(nthreads, "nthreads", 1)
    warn_of_aliases(model, grid)
    tasks = []
    for line in model.select():
        first, last = grid.sample_range(model, line)
        edges = [first + (last - first) * part // _RANGES for part in range(_RANGES + 1)]
        stream = PointingStream(model, line, grid.frame)
        tasks += [(stream, low, high) for low, high in pairwise(edges) if high > low]
    done, everything = 0, sum(high - low for _, low, high in tasks)
    order = grid.offset_order
    middle = centres(grid.nside) if order > 1 else np.empty((0, 3))

    def run(task: tuple[PointingStream, int, int], sums: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal done
        stream, low, high = task
        for first in range(low, high, _CHUNK):
            check()
            count = min(_CHUNK, high - first)
            _add_samples(stream.at(first), count, grid.nside, smax, order, middle, sums)
            done += count
            if progress is not None:
                progress(done / everything)
        return sums

    total = pixel_sums(grid.nside, smax, order)
    waiting = iter(tasks)
    with interruptible(nthreads) as (pool, check):
        first_tasks = islice(waiting, nthreads)
        running = deque(pool.submit(run, task, pixel_sums(grid.nside, smax, order)) for task in first_tasks)
        while running:
            sums = running.popleft().result()
            total += sums
            for task in islice(waiting, 1):
                sums[:] = 0.0
                running.append(pool.submit(run, task, sums))
    return total


def pixel_sums(nside: int, smax: int, order: int = 1) -> NDArray[np.float64]:
    """Return zeros, shape (npix, 4 + 2 smax + p): hits, sums of the unit vector, of cos(s psi) and of -sin(s psi).

    The last p are sums of the powers of the offsets of degree 2 to ``order``.
    """
    columns = 4 + 2 * smax + len(exponents(order))
    check_memory(96.0 * nside**2 * columns, f"smax = {smax} at nside {nside}", "lower smax or nside")
    memory = np.zeros(12 * nside * nside * columns + _CACHE_LINE // 8)
    # At smax 2 each pixel is one cache line, if the first one starts at its boundary.
    offset = (-memory.ctypes.data % _CACHE_LINE) // 8
    return memory[offset : offset + 12 * nside * nside * columns].reshape(-1, columns)


@njit(nogil=True, error_model="numpy")
def add_sample(sums, pixel, x, y, z, cos_psi, sin_psi, smax):  # type: ignore[no-untyped-def]
    """Add one sample to the accumulator; powers of e^{-i psi} by multiplication."""
    sums[pixel, 0] += 1.0
    sums[pixel, 1] += x
    sums[pixel, 2] += y
    sums[pixel, 3] += z
    real, imag = cos_psi, -sin_psi
    for s in range(smax):
        sums[pixel, 4 + 2 * s] += real
        sums[pixel, 5 + 2 * s] += imag
        real, imag = real * cos_psi + imag * sin_psi, imag * cos_psi - real * sin_psi


@njit(nogil=True, error_model="numpy")
def _add_samples(start, count, nside, smax, order, middle, sums):  # type: ignore[no-untyped-def]
    work = np.empty((6, BLOCK))
    pixels = np.empty(BLOCK, dtype=np.int64)
    touched = 0.0
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        fill_block(start, first, size, work)
        fill_pixels(nside, work, pixels[:size])
        # Reading ahead keeps many cache misses in flight at once: a third less time at nside 512. The value is
        # returned so that the compiler cannot drop the reads.
        for k in range(size):
            touched += sums[pixels[k], 0]
        for k in range(size):
            add_sample(sums, pixels[k], work[0, k], work[1, k], work[2, k], work[3, k], work[4, k], smax)
        if order > 1:
            for k in range(size):
                pixel = pixels[k]
                add_powers(sums[pixel], 4 + 2 * smax, order, middle[pixel], work[0, k], work[1, k], work[2, k])
    return touched


@njit(nogil=True, error_model="numpy")
def add_weighted_samples(start, nside, smax, weights, counted, sums):  # type: ignore[no-untyped-def]
    """Add the hits of consecutive samples, and weights times what :func:`add_sample` adds, to (npix, 5 + 2 smax) sums.

    ``start`` is that of :meth:`mcsim.instrument.scan.pointing.PointingStream.at`. The second column takes the weights.
    Samples that do not count are left out; as many as there are ``weights``.
    """
    work = np.empty((6, BLOCK))
    pixels = np.empty(BLOCK, dtype=np.int64)
    touched = 0.0
    for first in range(0, weights.size, BLOCK):
        size = min(BLOCK, weights.size - first)
        fill_block(start, first, size, work)
        fill_pixels(nside, work, pixels[:size])
        for k in range(size):  # reads ahead, as for the moments
            touched += sums[pixels[k], 0]
        for k in range(size):
            if not counted[first + k]:
                continue
            own, weight, cos_psi, sin_psi = sums[pixels[k]], weights[first + k], work[3, k], work[4, k]
            own[0] += 1.0
            own[1] += weight
            own[2] += weight * work[0, k]
            own[3] += weight * work[1, k]
            own[4] += weight * work[2, k]
            real, imag = weight * cos_psi, -weight * sin_psi
            for s in range(smax):
                own[5 + 2 * s] += real
                own[6 + 2 * s] += imag
                real, imag = real * cos_psi + imag * sin_psi, imag * cos_psi - real * sin_psi
    return touched
