"""Maps from differences: the normal equations by preconditioned conjugate gradients."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import healpy
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.healpix import Map
from mcsim.mapmaking.pairs import DifferencingScan


@dataclass(frozen=True)
class MapmakingReport:
    """How a solution was reached.

    Parameters
    ----------
    iterations
        Iterations made.
    converged
        Whether the residual asked for was reached.
    relative_residual
        |b - N m| / |b| of the map that is returned, computed afresh from it.
    history
        The same after each iteration, as the recurrence of the method has it.
    """

    iterations: int
    converged: bool
    relative_residual: float
    history: tuple[float, ...]


def diagonal(scan: DifferencingScan, x: float) -> Map:
    """Sum of the squared weights with which each pixel enters, (1+x)^2 hits_a + (1-x)^2 hits_b, shape (npix,)."""
    weight: Map = (1.0 + x) ** 2 * scan.hits_a + (1.0 - x) ** 2 * scan.hits_b
    return weight


def apply_normal(scan: DifferencingScan, x: float, map_uk: Map, pool: ThreadPoolExecutor, parts: int = 1) -> Map:
    """The normal matrix on a map: D m - (1 - x^2) C m, with C the counts of pairs; unobserved pixels give 0.

    Parameters
    ----------
    scan, x
        The pairs and the transmission imbalance, -1 < x < 1.
    map_uk
        Shape (npix,).
    pool, parts
        Threads that share out the rows, in ``parts`` pieces. Each row is summed by one of them: bit for bit the same
        for any number.
    """
    result = np.empty(scan.npix)
    edges = np.searchsorted(scan.row_start, np.linspace(0, scan.partner.size, parts + 1)[1:-1])
    edges = np.concatenate([[0], edges, [scan.npix]])
    weight, coupling = diagonal(scan, x), 1.0 - x * x
    jobs = [
        pool.submit(_rows, scan.row_start, scan.partner, scan.count, weight, coupling, map_uk, low, high, result)
        for low, high in zip(edges, edges[1:], strict=False)
    ]
    for job in jobs:
        job.result()
    return result


@njit(cache=True, nogil=True)
def _rows(row_start, partner, count, weight, coupling, map_uk, low, high, result):  # type: ignore[no-untyped-def]
    for row in range(low, high):
        first, last = row_start[row], row_start[row + 1]
        even, odd = 0.0, 0.0
        # Two sums, so that an addition need not wait for the one before.
        for k in range(first, last - 1, 2):
            even += count[k] * map_uk[partner[k]]
            odd += count[k + 1] * map_uk[partner[k + 1]]
        if (last - first) & 1:
            even += count[last - 1] * map_uk[partner[last - 1]]
        result[row] = weight[row] * map_uk[row] - coupling * (even + odd)
