"""Maps from differences: the normal equations by preconditioned conjugate gradients."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import healpy
import numpy as np

from mcsim.errors import InputError
from mcsim.simulation.mapmaking.pairs import DifferencingScan
from mcsim.support.arrays import Map, divided
from mcsim.support.compiled import njit


@dataclass(frozen=True)
class StoppingRule:
    """Conjugate gradients stop at the relative residual |b - N m| / |b| of ``tol``, > 0, or give up."""

    tol: float = 1e-8
    max_iterations: int = 500

    def __post_init__(self) -> None:
        """Raise InputError unless tol > 0 and max_iterations >= 0."""
        if not self.tol > 0.0:
            raise InputError(f"tol is {self.tol:g}, but the relative residual to reach must be > 0.")
        if self.max_iterations < 0:
            raise InputError(f"max_iterations is {self.max_iterations}, but it must be >= 0.")


DEFAULT_RULE = StoppingRule()


@dataclass(frozen=True)
class MapmakingReport:
    """How a solution was reached.

    ``relative_residual`` is |b - N m| / |b| of the map that is returned, computed afresh from it; ``history`` has the
    same after each iteration, as the recurrence of the method has it.
    """

    iterations: int
    converged: bool
    relative_residual: float
    history: tuple[float, ...]


def solve(
    scan: DifferencingScan,
    rhs: Map,
    x: float = 0.0,
    rule: StoppingRule = DEFAULT_RULE,
    start: Map | None = None,
    nthreads: int = 1,
) -> tuple[Map, MapmakingReport]:
    """Return the map that fits the differences best in the sense of least squares, uK, and how it was reached.

    ``rhs`` is P^T d in uK, shape (npix,), as :mod:`mcsim.simulation.mapmaking.rhs` makes it for the same fiducial
    imbalance ``x``, -1 < x < 1; ``start`` is a map to start from (None: zero). The map is ``healpy.UNSEEN`` where no
    sample fell. With x = 0 differences say nothing about the monopole: the mean of the observed pixels is zero then.
    The result does not depend on the threads, bit for bit. Raise InputError if x is out of range, or the right-hand
    side or the start does not fit the scan.

    Notes
    -----
    Conjugate gradients on N m = P^T d, N = P^T P = D - (1 - x^2) C, preconditioned by 1/D. For x != 0 the constant map
    is the one direction that N nearly ignores, 1^T N 1 = 4 x^2 samples: it is added to the preconditioner and costs
    nothing; the monopole's relative error is about tol / 2 x^2. For a year of W1 at nside 128 the residual falls by ten
    in 3 iterations (1e-8 after 26, 1e-10 after 33), 0.1 s each on two cores; the binned A^{20}_ll are within 1 % of
    what an axis ratio of 1.15 adds to them from 1e-7 on, within 3e-4 at 1e-8. A further solution on a coarse grid of
    nside 8 saved 3 of 33 iterations and took more time than that, so there is none; on two weeks of data, which leave
    half of the sky unobserved and take 120 iterations, nside 16 would save half of them. With samples at pixel centres
    and equal circular beams the map is the sky itself (tests/unit/test_mapmaking.py).
    """
    check_imbalance(x)
    _check_map(scan, rhs, "right-hand side")
    if start is not None:
        _check_map(scan, start, "starting map")
    weight = diagonal(scan, x)
    seen = weight > 0.0
    inverse = divided(1.0, weight)
    constant = 0.0 if x == 0.0 else 1.0 / (4.0 * x * x * scan.samples)

    def precondition(residual: Map) -> Map:
        # A matrix product would be threaded by the BLAS and its rounding depend on that; np.sum does not.
        return inverse * residual + np.where(seen, constant * np.sum(residual), 0.0)

    with ThreadPoolExecutor(max(1, nthreads)) as pool:
        size = _norm(rhs)
        map_uk = np.zeros(scan.npix) if start is None else np.where(seen, start, 0.0)
        residual = rhs.copy() if start is None else rhs - apply_normal(scan, x, map_uk, pool, nthreads)
        direction, slope, history = np.zeros(scan.npix), 1.0, [_norm(residual) / size if size > 0.0 else 0.0]
        while history[-1] > rule.tol and len(history) <= rule.max_iterations:
            conditioned = precondition(residual)
            before, slope = slope, float(np.sum(residual * conditioned))
            direction = conditioned + (slope / before if len(history) > 1 else 0.0) * direction
            image = apply_normal(scan, x, direction, pool, nthreads)
            step = slope / float(np.sum(direction * image))
            map_uk += step * direction
            residual -= step * image
            history.append(_norm(residual) / size)
        found = _norm(rhs - apply_normal(scan, x, map_uk, pool, nthreads)) / size if size > 0.0 else 0.0
    report = MapmakingReport(len(history) - 1, history[-1] <= rule.tol, found, tuple(history[1:]))
    offset = float(np.mean(map_uk[seen])) if x == 0.0 else 0.0
    return np.where(seen, map_uk - offset, healpy.UNSEEN), report


def diagonal(scan: DifferencingScan, x: float) -> Map:
    """Return each pixel's sum of squared weights, (1+x)^2 hits_a + (1-x)^2 hits_b, shape (npix,)."""
    weight: Map = (1.0 + x) ** 2 * scan.hits_a + (1.0 - x) ** 2 * scan.hits_b
    return weight


def level_uk(scan: DifferencingScan, sigma0_uk: float) -> Map | None:
    """Return about the noise of every pixel, uK, shape (npix,), 0 where unobserved; None: no noise.

    It is that of known partners, sigma0 over the root of the hits. Harmonics of a low degree l have
    1 / (1 - P_l(cos of the angle between the sides)) times this variance, small scales nearly 1.
    """
    if sigma0_uk == 0.0:
        return None
    return divided(sigma0_uk, np.sqrt(scan.hits_a + scan.hits_b))


def rhs_of_map(scan: DifferencingScan, map_uk: Map, x: float = 0.0) -> Map:
    """Return the right-hand side, uK, shape (npix,), whose solution is a map: N m, without a pass over the samples."""
    check_imbalance(x)
    _check_map(scan, map_uk, "map")
    with ThreadPoolExecutor(1) as pool:
        return apply_normal(scan, x, map_uk, pool)


def apply_normal(scan: DifferencingScan, x: float, map_uk: Map, pool: ThreadPoolExecutor, parts: int = 1) -> Map:
    """Apply the normal matrix to a map: D m - (1 - x^2) C m, C the counts of pairs; unobserved pixels give 0.

    Threads share out the rows in ``parts`` pieces. Each row is summed by one of them: the same bits for any number.
    """
    result = np.empty(scan.npix)
    rows = partial(_rows, scan.row_start, scan.partner, scan.count, diagonal(scan, x), 1.0 - x * x, map_uk, result)
    if parts <= 1:  # a thread would take longer to start than small maps do
        rows(0, scan.npix)
        return result
    edges = np.searchsorted(scan.row_start, np.linspace(0, scan.partner.size, parts + 1)[1:-1])
    for job in [pool.submit(rows, low, high) for low, high in pairwise([0, *edges, scan.npix])]:
        job.result()
    return result


def check_imbalance(x: float) -> None:
    """Raise InputError unless -1 < x < 1."""
    if not -1.0 < x < 1.0:
        raise InputError(f"the transmission imbalance is {x:g}, but it must lie between -1 and 1.")


def _check_map(scan: DifferencingScan, map_: Map, name: str) -> None:
    if map_.shape != (scan.npix,):
        raise InputError(f"the {name} has shape {map_.shape}, but nside {scan.grid.nside} needs ({scan.npix},).")
    if not np.all(np.isfinite(map_)):
        raise InputError(f"the {name} has values that are not finite; leave such samples out.")


def _norm(vector: Map) -> float:
    return float(np.sqrt(np.sum(vector * vector)))


@njit(nogil=True)
def _rows(row_start, partner, count, weight, coupling, map_uk, result, low, high):  # type: ignore[no-untyped-def]
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
