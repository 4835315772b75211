"""Localise a departure from the model: rank groups of numbers, standardise residual maps, find what stands out."""

from collections.abc import Sequence
from dataclasses import dataclass

import healpy
import numpy as np
from scipy import stats

from mcsim.datavector.summaries import Element
from mcsim.stats.look_elsewhere import deviations, scan_pvalues
from mcsim.support.arrays import Map, Matrix, Vector

NEAR, NEAR_DEG = 0.8, 20.0  #: share that a place which stands out must reach over the pixels up to that distance
FEWEST = 40  #: pixels of a map of which a place can stand out: the median of fewer tells no scatter
FOLDS = 20  #: parts of the simulations, at most, each of which is compared with all others


@dataclass(frozen=True)
class Place:
    """Describe a group of numbers that belong together, and how far it departs from the model."""

    element: Element  # the number of the group that departs most
    z: float  # normal deviate of the group
    p: float  # global p-value: that the largest departure of all groups is as large


def places(x: Vector, simulations: Vector, elements: Sequence[Element], level: float = 0.01) -> list[Place]:
    """Rank groups of numbers, shape (B,), by their departure from simulations, shape (N, B).

    Elements that share statistic, channels, split, frame, L, M and parity are a group. Groups with a global p-value up
    to ``level`` come first; of these, and of the others, one of each kind comes before the rest of it.

    Notes
    -----
    A kind is a frame, an L and a parity: one effect shows in every channel and split that it acts on, and a list of
    these would hide all else. The cube root of a group's sum of squared deviates is nearly normal (Wilson & Hilferty,
    PNAS 17, 684, 1931). Deviates, and these roots, are from the mean and over the scatter of simulations: of all for
    the data, and for each simulation of those of the other parts. Rates: tests/statistical/test_diagnose_statistics.py.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, e in enumerate(elements):
        groups.setdefault((e.statistic, e.channels, e.split, e.frame, e.L, e.M, e.parity), []).append(number)
    rows, count = list(groups.values()), len(simulations)
    deviates, found, drawn = _roots(x[None], simulations, rows)
    held_out, parts = np.empty((count, len(rows))), min(FOLDS, count // 2)
    for part in range(parts):
        own = np.arange(count) % parts == part
        held_out[own] = deviations(*_roots(simulations[own], simulations[~own], rows)[1:])
    z, p = (one[0] for one in scan_pvalues(found, drawn, held_out))
    # A group with too small deviates is no departure.
    p = np.where(z > 0, p, 1.0)
    ranked: list[tuple[bool, bool, Place]] = []
    seen: set[tuple[object, ...]] = set()
    for group in np.argsort(-z):
        most = max(rows[group], key=lambda number: abs(deviates[0, number]))
        place = Place(elements[most], float(z[group]), float(p[group]))
        kind = (place.element.frame, place.element.L, place.element.parity)
        ranked.append((place.p > level, kind in seen, place))
        seen.add(kind)
    return [place for _, _, place in sorted(ranked, key=lambda one: one[:2])]


def _roots(x: Matrix, simulations: Matrix, rows: Sequence[Sequence[int]]) -> tuple[Matrix, Matrix, Matrix]:
    """Return the deviates of data, shape (M, B), from simulations, (N, B), and the roots of groups of both."""
    mean, spread = simulations.mean(axis=0), simulations.std(axis=0, ddof=1)
    spread = np.where(spread > 0.0, spread, np.inf)
    deviates = (x - mean) / spread / np.sqrt(1.0 + 1.0 / len(simulations))
    both = (deviates, (simulations - mean) / spread)
    found, drawn = (np.cbrt(np.stack([np.mean(z[:, row] ** 2, axis=1) for row in rows], axis=1)) for z in both)
    return deviates, found, drawn


def standardised(x: Map, mean: Map, scatter: Map, count: int) -> Map:
    """Return coarse residuals of data less the mean and over the scatter of ``count`` > 3 simulations.

    All have the shape (map, npix). The variance is one in every pixel where the model is right; NaN where nothing was
    observed.

    Notes
    -----
    The filter leaves a part of the sky in the residual (at high l, behind a mask), so that noise alone is not the
    scatter. x less the mean of N, over their scatter, is Student's t with N - 1 degrees of freedom times
    sqrt(1 + 1/N), of variance (1 + 1/N) (N - 1)/(N - 3), by which it is divided.
    Rms of simulated data: tests/integration/test_diagnosis.py.
    """
    seen = scatter > 0.0
    scale = np.sqrt((1.0 + 1.0 / count) * (count - 1.0) / (count - 3.0))
    return np.where(seen, (x - mean) / np.where(seen, scatter, 1.0) / scale, np.nan)


def outstanding(maps: Matrix, count: int, level: float) -> dict[int, dict[int, float]]:
    """Return pixels and sizes, the largest first, of what stands out of each standardised residual map, (map, npix).

    A residual counts over the scatter of its map, one or more, which what acts everywhere widens, if pixels that are
    independent have one as large with a probability of at most ``level`` by chance; a share ``NEAR`` of that is asked
    for over the scatter of the pixels near it, which uneven noise widens. ``count`` > 3 simulations told the scatter of
    pixels: the deviates are those of Student's t. Maps of which nothing stands out, or with fewer than ``FEWEST``
    pixels, are left out.
    """
    chance = level / max(int(np.isfinite(maps).sum()), 1)
    least = float(stats.t.isf(chance / 2.0, count - 1)) / np.sqrt((count - 1.0) / (count - 3.0))
    found = {}
    for number, one in enumerate(maps):
        if np.isfinite(one).sum() < FEWEST:
            continue
        distance = np.abs(one - np.nanmedian(one))
        size = distance / _scatter(distance)
        places = [int(pixel) for pixel in np.argsort(-size) if size[pixel] >= least]  # a NaN is not
        if near := {pixel: float(size[pixel]) for pixel in places if _over_near(distance, pixel) >= NEAR * least}:
            found[number] = near
    return found


def _scatter(distance: Vector) -> float:
    """Return the scatter of which the median distance from the median is that of a Gaussian, or the model's if less.

    The median of few pixels can be small by chance.
    """
    return max(float(np.nanmedian(distance) / stats.norm.ppf(0.75)), 1.0)


def _over_near(distance: Vector, pixel: int) -> float:
    """Return a distance over the scatter of the pixels around it, some at least."""
    nside = healpy.npix2nside(len(distance))
    radius = max(np.deg2rad(NEAR_DEG), 3.0 * healpy.nside2resol(nside))
    near = healpy.query_disc(nside, healpy.pix2vec(nside, pixel), radius)
    return float(distance[pixel]) / _scatter(distance[near])
