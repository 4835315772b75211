r"""Correlated (1/f) noise of samples, and maps made of it: binned, or destriped.

Destriping takes the samples for y = P m + F a + n, with P the pointing, F one offset for every baseline and n white.
The offsets solve F^T Z F a = F^T Z y, Z = 1 - P (P^T P)^{-1} P^T (Keihanen et al. 2004, A&A 428, 287), by conjugate
gradients. With the number of samples that baseline b has in pixel p in a sparse matrix C = F^T P, no realization needs
more than its sums over pixels, P^T y, and over baselines, F^T y.
"""

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Self

import ducc0
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, cg

from mcsim.config.noise import NoiseCorrelated
from mcsim.errors import InputError
from mcsim.instrument.scan import LineOfSight, MapGrid, ScanModel, scan_key
from mcsim.simulation import tod
from mcsim.sphere import rng
from mcsim.support import folders
from mcsim.support.arrays import Map, divided
from mcsim.support.code import package_digest
from mcsim.support.npy import write_npy

SECONDS_PER_SAMPLE = 8e-8
"""Time of one core for a sample of correlated noise: pointing, random numbers, filter, sums."""

TOLERANCE, ITERATIONS = 1e-10, 2000  #: of the offsets: relative residual of the conjugate gradients

LARGEST = 150_000_000
"""Pairs of baseline and pixel: 12 bytes each on disk, which all workers share, and 24 while they are found."""

LEVEL_DRAWS = 4  #: realizations from which the standard deviation of the noise of pixels is estimated


def noise_samples(noise: NoiseCorrelated, sampling_hz: float, draw: np.random.Generator) -> Callable[[int], Map]:
    """Return a function that gives the next n samples of stationary noise, uK; how they are cut changes no bit.

    Notes
    -----
    ``ducc0.misc.OofaNoise`` (Plaszczynski, arXiv:astro-ph/0510081) filters white noise. Its spectrum keeps to the
    formula of :class:`mcsim.config.noise.NoiseCorrelated` within 4 %. It starts from zero, so it runs for 1 / f_min
    before the first sample.
    """
    source = ducc0.misc.OofaNoise(
        sigmawhite=noise.sigma0_uk, f_knee=noise.f_knee_hz, f_min=noise.f_min_hz, f_samp=sampling_hz, slope=-noise.alpha
    )

    def following(number: int) -> Map:
        return np.asarray(source.filterGaussian(draw.standard_normal(number)))

    for low, high in tod.chunks(0, math.ceil(sampling_hz / noise.f_min_hz)):
        following(high - low)
    return following


def per_hit(map_uk: Map, hits: Map) -> float:
    """Return the noise per hit of a map, uK, if its variance is inversely proportional to hits."""
    return float(np.sqrt(np.mean(hits[hits > 0] * map_uk[hits > 0] ** 2)))


@dataclass(frozen=True, eq=False)
class CorrelatedNoise:
    """Correlated noise of a map."""

    #: noise, model, grid: spectrum and map-making, the scan, and the pixels and span of the map
    noise: NoiseCorrelated
    model: ScanModel
    grid: MapGrid
    streams: str  #: name of its random numbers; rings of one survey share them
    rings: tuple[int, int] | None  #: every how many rings belong to the map, and the first one; None: all
    #: hits, level_uk: samples of every pixel; standard deviation of the noise, as 1 / sqrt(hits), shape (npix,)
    hits: Map
    pairs: csr_matrix | None  #: samples of every baseline in every pixel; None: the map is binned
    level_uk: Map

    def with_knee(self, f_knee_hz: float) -> Self:
        """Return the noise with another knee, of the same random numbers: at f_min or below it is white.

        A knee that the sampling cannot show is the highest one that it can: a diagnosis tries them.
        """
        least = math.nextafter(self.noise.f_min_hz, math.inf)
        most = math.nextafter(nyquist_hz(self.model), 0.0)
        return replace(self, noise=replace(self.noise, f_knee_hz=min(max(f_knee_hz, least), most)))

    def draw(self, seed: int, realization: int) -> Map:
        """Return the noise of a realization, uK, shape (npix,), 0 where nothing is observed; destriped, of mean 0."""
        in_pixels, in_baselines = np.zeros(self.grid.npix), np.zeros(0 if self.pairs is None else self.pairs.shape[0])
        first = 0
        for line in self.model.select():
            draw = rng.generator(seed, realization, f"{self.streams}/{line.name}")
            following = noise_samples(self.noise, 1.0 / self.model.period_of_samples(line), draw)
            for chunk, baseline in _timed(self, line, _adding(following)):
                in_pixels += np.bincount(chunk.pixel, weights=chunk.signal_uk, minlength=in_pixels.size)
                if self.pairs is not None:
                    low, high = baseline[0], baseline[-1] + 1
                    in_baselines[first + low : first + high] += np.bincount(baseline - low, weights=chunk.signal_uk)
            first += _number(self, line)
        if self.pairs is None:
            return divided(in_pixels, self.hits)
        return destriped(in_pixels, in_baselines, self.pairs, self.hits)


def destriped(in_pixels: Map, in_baselines: Map, pairs: csr_matrix, hits: Map) -> Map:
    """Return the destriped map, its mean over samples 0, from sums of the samples over pixels and over baselines.

    ``pairs``: the number of samples that every baseline has in every pixel. The mean of a map is not measured by
    differences between baselines, so it is set to zero.
    """
    length = np.asarray(pairs.sum(axis=1)).ravel()
    there = np.maximum(length, 1.0)  # a baseline without samples has the offset 0
    system = LinearOperator(pairs.shape[:1] * 2, matvec=lambda a: length * a - pairs @ divided(pairs.T @ a, hits))
    diagonal = LinearOperator(pairs.shape[:1] * 2, matvec=lambda a: a / there)
    known = in_baselines - pairs @ divided(in_pixels, hits)
    rounding = 1e-13 * float(np.linalg.norm(in_baselines))
    offsets, failed = cg(system, known, rtol=TOLERANCE, atol=rounding, maxiter=ITERATIONS, M=diagonal)
    if failed:
        raise RuntimeError(f"the offsets of destriping do not converge in {ITERATIONS} iterations; lengthen baseline_s")
    map_uk = divided(in_pixels - pairs.T @ offsets, hits)
    return np.where(hits > 0, map_uk - np.sum(hits * map_uk) / hits.sum(), 0.0)


def correlated_noise(
    noise: NoiseCorrelated, model: ScanModel, grid: MapGrid, streams: str, rings: tuple[int, int] | None = None
) -> CorrelatedNoise:
    """Return the correlated noise of a map; what all realizations share is kept on disk.

    InputError if the sampling cannot show the knee, the survey is shorter than 1 / f_min, or destriping would take too
    much memory.
    """
    _check(noise, model)
    empty = CorrelatedNoise(noise, model, grid, streams, rings, np.zeros(0), None, np.zeros(0))
    text = repr((astuple(noise), streams, rings, package_digest(["mcsim.simulation.timestream"], ["ducc0", "numpy"])))
    key = hashlib.sha256(f"{scan_key(model, grid)} {text}".encode()).hexdigest()
    folder = folders.cached(f"correlated-{key}", lambda scratch: _fill(scratch, empty))
    loaded = {path.stem: np.load(path, mmap_mode="r") for path in folder.glob("*.npy")}
    pairs = None
    if "data" in loaded:
        shape = (loaded["indptr"].size - 1, grid.npix)
        pairs = csr_matrix((loaded["data"], loaded["indices"], loaded["indptr"]), shape=shape, copy=False)
    return replace(empty, hits=loaded["hits"], level_uk=loaded["level"], pairs=pairs)


def _fill(folder: Path, empty: CorrelatedNoise) -> None:
    """Write what :func:`correlated_noise` keeps."""
    hits = np.zeros(empty.grid.npix)
    pieces: list[tuple[NDArray[np.int32], Map]] = []
    total = sum(_number(empty, line) for line in empty.model.select())
    filled, first, size = np.zeros(total, dtype=np.int64), 0, 0
    for line in empty.model.select():
        for chunk, baseline in _timed(empty, line):
            hits += np.bincount(chunk.pixel, minlength=hits.size)
            if empty.noise.map_making == "destriped":
                where, count = np.unique((first + baseline) * hits.size + chunk.pixel, return_counts=True)
                # Baselines come in the order of time, so these are rows of a matrix, in which pairs may be repeated.
                pieces.append(((where % hits.size).astype(np.int32), count.astype(np.float64)))
                filled += np.bincount(where // hits.size, minlength=total)
                size += where.size
                if size > LARGEST:
                    raise InputError(
                        f"destriping {empty.model.name!r} at nside {empty.grid.nside} with baselines of "
                        f"{_baseline_s(empty):g} s takes more than {LARGEST} pairs of baseline and pixel; lengthen "
                        "noise.baseline_s, or lower map.nside."
                    )
        first += _number(empty, line)
    made = replace(empty, hits=hits)
    if pieces:
        pixel, count = (np.concatenate(each) for each in zip(*pieces, strict=True))
        begin = np.concatenate([[0], np.cumsum(filled)]).astype(np.int32)  # at most LARGEST
        made = replace(made, pairs=csr_matrix((count, pixel, begin), shape=(total, hits.size)))
        for name in ("data", "indices", "indptr"):
            write_npy(folder / f"{name}.npy", getattr(made.pairs, name))
    other = replace(made, streams=f"level of {empty.streams}")
    level = math.sqrt(np.mean([per_hit(other.draw(0, r), hits) ** 2 for r in range(LEVEL_DRAWS)]))
    write_npy(folder / "hits.npy", hits)
    write_npy(folder / "level.npy", np.sqrt(divided(np.full(hits.size, level**2), hits)))


def _check(noise: NoiseCorrelated, model: ScanModel) -> None:
    if noise.f_knee_hz >= (nyquist := nyquist_hz(model)):
        raise InputError(
            f"noise.f_knee_hz = {noise.f_knee_hz:g} is not below {nyquist:g} Hz, half the sampling rate of "
            f"{model.name!r}; lower it or shorten scan.sample_period_s."
        )
    for line in model.select():
        shortest = 1.0 / (model.samples(line) * model.period_of_samples(line))
        if noise.f_min_hz < shortest:
            raise InputError(
                f"noise.f_min_hz = {noise.f_min_hz:g} is below one over the duration of {model.name!r}, which cannot "
                f"show it; give at least {shortest:.3g} Hz."
            )


def nyquist_hz(model: ScanModel) -> float:
    """Return half the lowest sampling rate of a model's lines of sight."""
    return 0.5 / max(model.period_of_samples(line) for line in model.select())


def _timed(
    of: CorrelatedNoise, line: LineOfSight, stage: tod.Stage | None = None
) -> Iterator[tuple[tod.Samples, NDArray[np.int64]]]:
    """Yield the samples of a map after a stage, with the numbers of their baselines."""
    stages = [] if stage is None else [stage]
    if of.rings is not None:
        stages.append(tod.every_ring(of.model.spin_period_s, *of.rings))
    start = of.grid.sample_range(of.model, line)[0] * of.model.period_of_samples(line)
    for chunk in tod.through(tod.samples(of.model, line, of.grid, angles=False), stages):
        if chunk.time_s.size:
            yield chunk, np.floor((chunk.time_s - start) / _baseline_s(of)).astype(np.int64)


def _adding(following: Callable[[int], Map]) -> tod.Stage:
    return tod.with_signal(lambda chunk: chunk.signal_uk + following(chunk.time_s.size))


def _baseline_s(of: CorrelatedNoise) -> float:
    return of.noise.baseline_s or abs(of.model.spin_period_s)


def _number(of: CorrelatedNoise, line: LineOfSight) -> int:
    """Return the number of baselines of a line of sight."""
    first, last = of.grid.sample_range(of.model, line)
    return math.floor((last - 1 - first) * of.model.period_of_samples(line) / _baseline_s(of)) + 2
