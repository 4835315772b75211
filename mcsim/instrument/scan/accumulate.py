"""Streaming of a survey's samples into per-pixel sums, on all cores, never holding the pointing in memory."""

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

import healpy
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.pointing import BLOCK, PointingStream, fill_block, ring_pixel
from mcsim.sphere.checks import check_whole

_RANGES = 16
_CHUNK = 1 << 21
_CACHE_LINE = 64


def stream_sums(
    model: ScanModel,
    grid: MapGrid,
    smax: int,
    nthreads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> NDArray[np.float64]:
    """Return the sums per pixel of a survey's default lines of sight, by streaming every sample.

    Parameters
    ----------
    model
        The survey.
    grid
        Pixels, and the part of the survey.
    smax
        Largest s of the moments (>= 1).
    nthreads
        Number of threads. The result does not depend on it, bit for bit; the memory does: one accumulator of
        8 (4 + 2 smax) bytes per pixel for each thread and one for the sum.
    progress
        Called with the fraction done.

    Returns
    -------
    ndarray
        As of :func:`pixel_sums`.

    Raises
    ------
    InputError
        If smax < 1, or the time range contains no sample.

    Notes
    -----
    Time is cut into 16 ranges, whatever the number of threads; each is summed on its own and the sums are added
    in the order of time. Besides e^{-i s psi} a pixel sums its samples' unit vectors: their mean against the
    pixel's centre is the centroid offset. So at smax 2 a pixel is one cache line.
    """
    check_whole(smax, "smax", 1)
    tasks = [task for line in model.select(None) for task in _tasks(model, line, grid)]
    if not tasks:
        start, stop = grid.time_range
        raise InputError(f"time_range ({start:g}, {stop:g}) of {model.name!r} contains no sample; widen it.")
    return _sum_of_tasks(tasks, grid.nside, smax, max(1, nthreads), progress)


def pixel_sums(nside: int, smax: int) -> NDArray[np.float64]:
    """Return zeros, shape (npix, 4 + 2 smax): hits, sums of the unit vector, of cos(s psi) and of -sin(s psi)."""
    columns = 4 + 2 * smax
    memory = np.zeros(12 * nside * nside * columns + _CACHE_LINE // 8)
    # At smax 2 each pixel is one cache line, if the first one starts at its boundary.
    offset = (-memory.ctypes.data % _CACHE_LINE) // 8
    return memory[offset : offset + 12 * nside * nside * columns].reshape(-1, columns)


def means(sums: NDArray[np.float64], nside: int, smax: int) -> dict[str, NDArray]:
    """Return ``hits, w, dtheta, dphi`` of an accumulator of :func:`pixel_sums`."""
    hits = sums[:, 0].copy()
    inverse = np.divide(1.0, hits, out=np.zeros_like(hits), where=hits > 0.0)
    w = np.empty((smax, hits.size), dtype=np.complex128)
    for s in range(smax):
        w[s].real = sums[:, 4 + 2 * s] * inverse
        w[s].imag = sums[:, 5 + 2 * s] * inverse
    dtheta, dphi = np.empty_like(hits), np.empty_like(hits)
    for first in range(0, hits.size, 1 << 18):
        part = slice(first, first + (1 << 18))
        pixels = np.arange(first, min(first + (1 << 18), hits.size))
        theta, phi = healpy.pix2ang(nside, pixels)
        x, y, z = (sums[part, axis] * inverse[part] for axis in (1, 2, 3))
        dtheta[part] = np.cos(theta) * (x * np.cos(phi) + y * np.sin(phi)) - np.sin(theta) * z
        dphi[part] = y * np.cos(phi) - x * np.sin(phi)
    return {"hits": hits, "w": w, "dtheta": dtheta, "dphi": dphi}


class _Task:
    """One range of time of one line of sight."""

    def __init__(self, stream: PointingStream, first: int, count: int) -> None:
        self.stream, self.first, self.count = stream, first, count

    def add_to(self, sums: NDArray[np.float64], nside: int, smax: int, report: Callable[[int], None]) -> None:
        stream = self.stream
        for first in range(self.first, self.first + self.count, _CHUNK):
            count = min(_CHUNK, self.first + self.count - first)
            start = stream.start_turns(first)
            _add_samples(
                start, stream.block_turns, stream.tables, stream.geometry, stream.to_frame, count, nside, smax, sums
            )
            report(count)


def _tasks(model: ScanModel, line: LineOfSight, grid: MapGrid) -> Iterable[_Task]:
    stream = PointingStream(model, line, grid.frame)
    first, last = (round(edge * stream.samples) for edge in grid.time_range)
    edges = [first + (last - first) * part // _RANGES for part in range(_RANGES + 1)]
    return [_Task(stream, low, high - low) for low, high in pairwise(edges) if high > low]


def _sum_of_tasks(
    tasks: list[_Task], nside: int, smax: int, nthreads: int, progress: Callable[[float], None] | None
) -> NDArray[np.float64]:
    """Sum all tasks, each into an accumulator of its own, added up in their order."""
    done, everything = [0], sum(task.count for task in tasks)

    def report(count: int) -> None:
        done[0] += count
        if progress is not None:
            progress(done[0] / everything)

    def run(task: _Task, sums: NDArray[np.float64]) -> NDArray[np.float64]:
        task.add_to(sums, nside, smax, report)
        return sums

    total = pixel_sums(nside, smax)
    waiting = deque(tasks)
    running: deque[Future[NDArray[np.float64]]] = deque()
    with ThreadPoolExecutor(nthreads) as pool:
        for _ in range(min(nthreads, len(tasks))):
            running.append(pool.submit(run, waiting.popleft(), pixel_sums(nside, smax)))
        while running:
            sums = running.popleft().result()
            total += sums
            if waiting:
                sums[:] = 0.0
                running.append(pool.submit(run, waiting.popleft(), sums))
    return total


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _add_samples(start, block_turns, tables, geometry, to_frame, count, nside, smax, sums):  # type: ignore[no-untyped-def]
    work = np.empty((6, BLOCK))
    pixels = np.empty(BLOCK, dtype=np.int64)
    turns = np.empty(3)
    touched = 0.0
    for block in range((count + BLOCK - 1) // BLOCK):
        size = min(BLOCK, count - block * BLOCK)
        for axis in range(3):
            turns[axis] = (start[axis] + block * block_turns[axis]) % 1.0
        fill_block(turns, tables, geometry, to_frame, size, work)
        for k in range(size):
            pixels[k] = ring_pixel(nside, work[5, k], work[0, k], work[1, k], work[2, k])
        # Reading ahead keeps many cache misses in flight at once: a third less time at nside 512. The value is
        # returned so that the compiler cannot drop the reads.
        for k in range(size):
            touched += sums[pixels[k], 0]
        for k in range(size):
            add_sample(sums, pixels[k], work[0, k], work[1, k], work[2, k], work[3, k], work[4, k], smax)
    return touched
