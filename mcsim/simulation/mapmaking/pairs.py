"""Pairs of pixels that a differencing scan sees at once: counted, merged, kept on disk, shared by all realizations."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan import LineOfSight, MapGrid, Moments, ScanModel, cached_moments, scan_key
from mcsim.instrument.scan.pointing import PointingStream, fill_samples
from mcsim.simulation.tod import chunks
from mcsim.support import folders
from mcsim.support.code import package_digest
from mcsim.support.compiled import njit
from mcsim.support.npy import make_room, write_npy
from mcsim.support.threads import interruptible

PARTS = 16  #: parts of the survey that threads share out; fixed, so that sums do not depend on the number of threads

_BAND = 1 << 27
COUNTED = 1 << 24  #: samples that are counted at once

_META = "pairs.json"


@dataclass(frozen=True)
class DifferencingScan:
    """The pointing of two beams of one sampling rate that are read as a difference, as map-making needs it."""

    model: ScanModel
    side_a: LineOfSight
    side_b: LineOfSight
    grid: MapGrid
    #: hits_a, hits_b: samples with side A, side B in a pixel, shape (npix,)
    hits_a: NDArray[np.float64]
    hits_b: NDArray[np.float64]
    #: pixel i is seen together with the pixels ``partner[row_start[i]:row_start[i + 1]]``; shape (npix + 1,)
    row_start: NDArray[np.int64]
    #: partner, count: partners of every pixel in increasing order, and how often the two were seen at once with
    #: whichever side on whichever pixel: the off-diagonal part of the normal matrix, symmetric, compressed by rows
    partner: NDArray[np.int32]
    count: NDArray[np.unsignedinteger]

    @property
    def npix(self) -> int:
        """Number of pixels."""
        return self.grid.npix

    @property
    def samples(self) -> int:
        """Number of differences."""
        first, last = self.grid.sample_range(self.model, self.side_a)
        return last - first

    def moments(self, smax: int, nthreads: int = 1, progress: Callable[[float], None] | None = None) -> Moments:
        """Return the mean orientation moments of all samples of both sides, which stand at their pixels' centres."""
        model = self.model.with_lines_of_sight(self.side_a.name, self.side_b.name)
        found = Moments.load(cached_moments(model, self.grid, smax, nthreads, progress))
        return found.up_to_offsets(0)

    def hits_alone(self, smax: int) -> Moments:
        """Return the hits of both sides, for weights and masks; the moments mean nothing and are NaN."""
        unknown = np.broadcast_to(np.complex128(np.nan), (smax, self.npix))
        return Moments(self.grid.nside, self.grid.frame, self.hits_a + self.hits_b, unknown)


def prepare(
    model: ScanModel, pair: str, grid: MapGrid, nthreads: int = 1, progress: Callable[[float], None] | None = None
) -> DifferencingScan:
    """Return the pairs of pixels of a differencing scan, computed once and memory-mapped from then on.

    ``pair`` names one of the model's differencing pairs (assemblies); ``progress`` takes the fraction done. The result
    does not depend on the threads, bit for bit. InputError if the pair is unknown, its sides are sampled at different
    rates, the time range contains no sample, or the cache cannot be written.

    Notes
    -----
    While it works it needs 8 bytes per sample on disk and up to 1 GB of memory per thread. What stays on disk is 5 to 8
    bytes for each ordered pair of pixels that was seen, at most 2 x samples. A year of W1, one sample in four (154
    million), at nside 128: each pair comes 4.3 times, 72 million ordered pairs, 0.43 GB, 20 s on two cores.
    """
    sides = model.pair(pair)
    period_a, period_b = (model.period_of_samples(side) for side in sides)
    if period_a != period_b:
        raise InputError(
            f"pair {pair!r} samples side A every {period_a:g} s and side B every {period_b:g} s, but a difference "
            "needs one rate; give both one sample_period_s."
        )
    first, last = grid.sample_range(model, sides[0])
    streams = [PointingStream(model, side, grid.frame) for side in sides]

    def fill(folder: Path) -> None:
        _write(folder, streams, parts(chunks(first, last)), grid, max(1, nthreads), progress or (lambda _: None))

    code = package_digest([__name__, "mcsim.simulation.tod"])
    seen = scan_key(model.with_lines_of_sight(*(side.name for side in sides)), grid)
    folder = folders.cached(f"pairs-{seen[:32]}-{code[:32]}", fill)
    return DifferencingScan(model, *sides, grid, **_load(folder))


def parts(pieces: list[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Cut chunks into at most PARTS consecutive groups."""
    edges = [len(pieces) * part // PARTS for part in range(PARTS + 1)]
    return [pieces[low:high] for low, high in pairwise(edges) if high > low]


def _load(folder: Path) -> dict[str, Any]:
    meta = json.loads((folder / _META).read_text())
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("hits_a", "hits_b", "row_start")}
    shape = (meta["pairs"],)
    arrays["partner"] = np.memmap(folder / "partner.raw", dtype=np.int32, mode="r", shape=shape)
    arrays["count"] = np.memmap(folder / "count.raw", dtype=meta["count"], mode="r", shape=shape)
    return arrays


def _write(
    folder: Path,
    streams: list[PointingStream],
    shares: list[list[tuple[int, int]]],
    grid: MapGrid,
    nthreads: int,
    progress: Callable[[float], None],
) -> None:
    """Write the pairs of two streams of pointing, whose chunks threads share out."""
    first, last = shares[0][0][0], shares[-1][-1][1]
    path = folder / "samples.raw"
    make_room(path, 2 * (last - first) * np.dtype(np.int32).itemsize)
    pixels = np.memmap(path, dtype=np.int32, mode="r+", shape=(2, last - first))

    def run(stream: PointingStream, share: list[tuple[int, int]], own: NDArray[np.int32]) -> None:
        for low, high in share:
            check()
            fill_samples(stream.at(low), high - low, grid.nside, None, own[low - first : high - first])

    with interruptible(nthreads) as (pool, check):
        jobs = [
            pool.submit(run, stream, share, own)
            for share in shares
            for stream, own in zip(streams, pixels, strict=True)
        ]
        for done, job in enumerate(jobs):
            job.result()
            progress(0.5 * (done + 1) / len(jobs))
        hits = [_counted(side, grid.npix) for side in pixels]
        row_start, count_type = _write_rows(folder, pixels, hits[0] + hits[1], nthreads, pool, progress)
    for name, array in (("row_start", row_start), ("hits_a", hits[0]), ("hits_b", hits[1])):
        write_npy(folder / f"{name}.npy", array)
    path.unlink()
    (folder / _META).write_text(json.dumps({"pairs": int(row_start[-1]), "count": count_type.name}))


def _write_rows(
    folder: Path,
    pixels: NDArray[np.int32],
    entries: NDArray[np.float64],
    nthreads: int,
    pool: ThreadPoolExecutor,
    progress: Callable[[float], None],
) -> tuple[NDArray[np.int64], np.dtype]:
    """Merge the pairs of every pixel, band by band, and append them to the files; row starts and type of the counts."""
    # No pair can be more frequent than the pixel with the most samples.
    count_type = next(kind for kind in (np.uint8, np.uint16, np.uint32) if entries.max() <= np.iinfo(kind).max)
    row_start = np.zeros(entries.size + 1, dtype=np.int64)
    bands = _bands(entries)
    with (folder / "partner.raw").open("wb") as partner_file, (folder / "count.raw").open("wb") as count_file:
        # Only as many bands as there are threads, so that the memory stays bounded.
        for done in range(0, len(bands), nthreads):
            group = bands[done : done + nthreads]
            for (low, high), merged in zip(group, pool.map(partial(_band, pixels, entries), group), strict=True):
                partner, count, lengths = merged
                partner_file.write(partner.tobytes())
                count_file.write(count.astype(count_type).tobytes())
                row_start[low + 1 : high + 1] = lengths
            progress(0.5 + 0.5 * (done + len(group)) / len(bands))
    return np.cumsum(row_start), np.dtype(count_type)


def _bands(entries: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return bands of pixels with at most _BAND entries each (or one pixel)."""
    total = np.concatenate([[0], np.cumsum(entries)])
    bands, low = [], 0
    while low < entries.size:
        high = max(int(np.searchsorted(total, total[low] + _BAND, side="right")) - 1, low + 1)
        bands.append((low, min(high, entries.size)))
        low = high
    return bands


def _band(
    pixels: NDArray[np.int32], entries: NDArray[np.float64], band: tuple[int, int]
) -> tuple[NDArray[np.int32], NDArray[np.uint32], NDArray[np.int64]]:
    """Return merged partners and counts of the pixels of a band, and the number of partners of each."""
    low, high = band
    edges = np.concatenate([[0], np.cumsum(entries[low:high])]).astype(np.int64)
    partner = np.empty(edges[-1], dtype=np.int32)
    _collect(pixels[0], pixels[1], low, high, edges[:-1].copy(), partner)
    count = np.empty(edges[-1], dtype=np.uint32)
    lengths = np.empty(high - low, dtype=np.int64)
    size = _merge(edges, np.zeros(entries.size, dtype=np.uint32), partner, count, lengths)
    return partner[:size], count[:size], lengths


@njit(nogil=True)
def _collect(pixel_a, pixel_b, low, high, cursor, partner):  # type: ignore[no-untyped-def]
    """Write the partner of every sample to the rows low ... high - 1, in the order of time."""
    for k in range(pixel_a.size):
        a, b = pixel_a[k], pixel_b[k]
        if low <= a < high:
            partner[cursor[a - low]] = b
            cursor[a - low] += 1
        if low <= b < high:
            partner[cursor[b - low]] = a
            cursor[b - low] += 1


@njit(nogil=True)
def _merge(edges, seen, partner, count, lengths):  # type: ignore[no-untyped-def]
    """Merge equal partners of each row in place, in increasing order; return the number that is left."""
    out = 0
    for row in range(lengths.size):
        size = 0
        # What is left never overtakes what is still to be read.
        for k in range(edges[row], edges[row + 1]):
            j = partner[k]
            if seen[j] == 0:
                partner[out + size] = j
                size += 1
            seen[j] += 1
        partner[out : out + size].sort()
        for k in range(out, out + size):
            count[k] = seen[partner[k]]
            seen[partner[k]] = 0
        lengths[row] = size
        out += size
    return out


def _counted(pixel: NDArray[np.int32], npix: int) -> NDArray[np.float64]:
    """Count the samples of every pixel, in pieces: numpy's count makes a copy of 8 bytes a sample."""
    total = np.zeros(npix)
    for first in range(0, pixel.size, COUNTED):
        total += np.bincount(pixel[first : first + COUNTED], minlength=npix)
    return total
