"""Mean BipoSH of the CMB, to leading order in the non-circular part of the beam and to all orders, and of white noise.

The CMB's is that of one map or of the ordered pair X, Y: ``x`` and ``y`` are beams and scans of a_{l1 m1} and of
a_{l2 m2}, ``y`` is ``x`` by default. C_l of the sky is without beam, in uK^2, shape (> lmax,). Results are in uK^2 and
the Hajian-Souradeep normalisation, shape (n_mode, lmax + 1), at ell = l2 <= lmax; NaN where a mode does not exist.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Indices, bennett_factor, check_degree, check_modes, existing
from mcsim.bipolar.theory.beam_biposh import ScannedBeam, beam_biposh
from mcsim.sphere.checks import check_cl, check_shape, check_whole
from mcsim.sphere.wigner import sixj_family, threej_family
from mcsim.support.arrays import Cl
from mcsim.support.compiled import njit

_BLOCK = 32

# Products of moments and beams below this fraction of the circular term are left out.
_TOLERANCE = 1e-12


def cmb_biposh_leading(
    modes: Sequence[Indices], cl: Cl, lmax: int, x: ScannedBeam, y: ScannedBeam | None = None, nthreads: int = 1
) -> NDArray[np.complex128]:
    """Return the mean A^{LM}_{l1 l2} of modes (L, M, d), with |M|, |d| <= L, to leading order.

    Weights of pixels are taken as by :func:`cmb_biposh_exact`, with ``nthreads``. Raise InputError if a mode cannot
    exist, spectrum or beam end below lmax, or moments below L.

    Notes
    -----
    For L > 0, A = (-1)^{l2} [C_{l2} B^{00,Y}_{l2 l2} B^{LM,X}_{l1 l2}/sqrt(2 l2+1) + (-1)^L C_{l1} B^{00,X}_{l1 l1}
    B^{LM,Y}_{l2 l1}/sqrt(2 l1+1)] (arXiv:1210.7318, eqs. WMAP1 and WMAP2 generalised); for L = 0 the circular spectrum
    (-1)^l sqrt(2l+1) C_l B^X_l B^Y_l. The error is of second order in b_ls: halving b_l2 quarters it
    (tests/unit/test_predict_brute_force.py); :func:`cmb_biposh_exact` includes it.
    """
    x, y = beams = _checked(modes, cl, lmax, x, y)
    if x.weighted or y.weighted:
        return _summed(modes, cl, lmax, beams, nthreads, leading=True)
    l2 = np.arange(lmax + 1)
    sign = (-1.0) ** l2
    root = np.sqrt(2.0 * l2 + 1)
    monopole_x, monopole_y = (beam_biposh(beam, (0, 0, 0), lmax) for beam in (x, y))
    result = np.full((len(modes), lmax + 1), np.nan, dtype=np.complex128)
    for row, (L, M, d) in zip(result, modes, strict=True):
        exists = existing(L, d, lmax)
        right = l2[exists]
        left = right - d
        if L == 0:
            row[:] = sign * cl[: lmax + 1] * monopole_x * monopole_y / root
            continue
        through_x = cl[right] * monopole_y[right] * beam_biposh(x, (L, M, d), lmax)[right] / root[right]
        through_y = cl[left] * monopole_x[left] * beam_biposh(y, (L, M, -d), lmax)[left] / root[left]
        row[exists] = sign[right] * (through_x + (-1) ** L * through_y)
    return result


def cmb_biposh_exact(
    modes: Sequence[Indices], cl: Cl, lmax: int, x: ScannedBeam, y: ScannedBeam | None = None, nthreads: int = 1
) -> NDArray[np.complex128]:
    """Return the mean A^{LM}_{l1 l2} of modes (L, M, d), with |M|, |d| <= L, to all orders in b_ls.

    L = 0 gives (-1)^l sqrt(2l+1) C_l with the second order of the beam. Include any power above ``lmax`` in ``cl``: it
    leaks down. The sums over L1, L2 end at the L_max of the moments of the beams; threads share the blocks of ell.
    Maps whose pixels have weights W_x, W_y are not divided by <W_x W_y>, and their own BipoSH is in the result. Raise
    InputError if a mode cannot exist, spectrum or beam end below lmax, or moments below L.

    Notes
    -----
    A^{LM}_{l1 l2} = sum_{l L1 L2} C_l (-1)^{l1+L2-L} sqrt((2 L1+1)(2 L2+1)) {l l1 L1; L L2 l2}
    sum_{M1 M2} C^{LM}_{L1 M1 L2 M2} B^{L1 M1,X}_{l1 l} B^{L2 M2,Y}_{l2 l}
    (arXiv:1210.7318, appendix; the phase (-1)^l of its main text fails for odd parity). With the beam-BipoSH inserted,
    the moments couple once, X^{ss'}_{L1 L2} = sum C^{LM}_{L1 M1 L2 M2} w_{s,L1 M1} w_{s',L2 M2}, whatever l1, l2 and
    l, so that M costs next to nothing.

    Equal to K C K^+ of a convolution point by point to 1e-12 at lmax 6, all L <= 3, M and d of a pair
    (tests/unit/test_predict_brute_force.py). Convergence in L1, L2 is slow under parallel transport, as L_max^-2 of the
    second-order part: for an elliptical Gaussian of 17.7' and e = 0.46 at l = 1000, where that part is 0.8 % of
    A^{20}, it is within 8e-4, 2.5e-4 and 7e-5 of A^{20} with L_max 32, 64 and 128 (within a sixth of this at l = 400).
    """
    return _summed(modes, cl, lmax, _checked(modes, cl, lmax, x, y), nthreads)


def _summed(
    modes: Sequence[Indices],
    cl: Cl,
    lmax: int,
    beams: tuple[ScannedBeam, ScannedBeam],
    nthreads: int,
    leading: bool = False,
) -> NDArray[np.complex128]:
    """Return the sum over L1, L2 of :func:`cmb_biposh_exact`; ``leading``: without products of non-circular parts."""
    x, y = beams
    result = np.full((len(modes), lmax + 1), np.nan, dtype=np.complex128)
    groups: dict[tuple[int, int], list[int]] = {}
    for i, (L, _, d) in enumerate(modes):
        groups.setdefault((L, d), []).append(i)
    orders = {group: tuple(modes[i][1] for i in rows) for group, rows in groups.items()}
    plans = {(L, d): _plan(L, orders[L, d], x, y, len(cl) - 1, leading) for L, d in groups}
    reach = max(abs(d) for _, d in groups) if groups else 0
    response_x, response_y = x.response(len(cl) - 1), y.response(len(cl) - 1)
    power = cl * (2.0 * np.arange(len(cl)) + 1) / (4 * np.pi)

    def work(first: int) -> None:
        last = min(first + _BLOCK, lmax + 1)
        low, high = max(first - reach, 0), min(last + reach, lmax + 1)
        table_x = _spin_table(low, high, x.smax, x.L_max, response_x)
        table_y = table_x if x is y else _spin_table(low, high, y.smax, y.L_max, response_y)
        seen = _Seen(low, power, table_x, table_y)
        for (L, d), rows in groups.items():
            l2 = np.arange(first, last)[existing(L, d, lmax)[first:last]]
            block = np.zeros((len(rows), len(l2)), dtype=np.complex128)
            _contract(L, d, l2, seen, plans[L, d], block)
            for row, values in zip(rows, block, strict=True):
                result[row, l2] = values

    with ThreadPoolExecutor(nthreads) as pool:
        list(pool.map(work, range(0, lmax + 1, _BLOCK)))
    return result


def noise_biposh(modes: Sequence[Indices], variance: NDArray[np.complex128], lmax: int) -> NDArray[np.complex128]:
    """Return the mean A^{LM}_{l1 l2} of white noise of uneven variance; zero for odd parity.

    The variance is given by the coefficients v_LM, any M, of (pixel variance) x (pixel area) in uK^2 sr, shape (L_max +
    1, 2 L_max + 1), ``variance[L, L_max + M]``. Raise InputError if they end below the L of a mode.

    Notes
    -----
    A^{LM}_{l1 l2} = v_LM sqrt((2 l1+1)(2 l2+1)/(4pi (2L+1))) C^{L0}_{l1 0 l2 0}: in the Bennett normalisation
    v_LM/sqrt(4pi), for every l. It follows from int Y* Y V, without the convolution
    (tests/unit/test_predict_biposh.py compares with an explicit sum).
    """
    check_modes(modes)
    check_whole(lmax, "lmax")
    L_max = len(variance) - 1
    check_shape(variance, (L_max + 1, 2 * L_max + 1), "the variance")
    check_degree(modes, L_max, "the coefficients of the variance")
    result = np.full((len(modes), lmax + 1), np.nan, dtype=np.complex128)
    for row, (L, M, d) in zip(result, modes, strict=True):
        v = variance[L, L_max + M]
        exists = existing(L, d, lmax)
        row[exists] = v / np.sqrt(4 * np.pi) / bennett_factor((L, M, d), lmax)[exists] if (L + d) % 2 == 0 else 0.0
    return result


def _checked(
    modes: Sequence[Indices], cl: Cl, lmax: int, x: ScannedBeam, y: ScannedBeam | None
) -> tuple[ScannedBeam, ScannedBeam]:
    """Return both beams, with the moments that count.

    Raise InputError for modes that cannot exist, a spectrum or beam that ends below lmax, or moments that end below L.
    """
    check_cl(cl, lmax)
    for beam in (x, x if y is None else y):
        beam.check(lmax, modes)
    top = lmax + len(cl) - 1  # L1 <= l1 + l
    cut = x.within(top)
    return cut, cut if y is None or y is x else y.within(top)


class _Seen(NamedTuple):
    """(2l+1) C_l/4pi of the sky, and the tables of two beams, whose first l1 or l2 is ``low``."""

    low: int
    power: Cl
    x: NDArray[np.complex128]
    y: NDArray[np.complex128]


class _Plan(NamedTuple):
    """Terms (L1, L2) and (s, s') of the sum, and the coupling of the moments for every M."""

    pairs: NDArray[np.int64]
    first_term: NDArray[np.int64]
    spins: NDArray[np.int64]
    coupling: NDArray[np.complex128]


def _plan(L: int, orders: tuple[int, ...], x: ScannedBeam, y: ScannedBeam, lsky: int, leading: bool) -> _Plan:
    size_x, size_y = (abs(beam.response(lsky)).max(axis=1) for beam in (x, y))
    limit = _TOLERANCE * 4 * np.pi
    pairs, counts, spins, couplings = [], [0], [], []
    for L1, L2, coupling in _moment_couplings(L, orders, x, y):
        scale = size_x[:, None] * size_y
        kept = np.argwhere((abs(coupling).max(axis=0) * scale > limit) & (abs(coupling).max(axis=0) > 0.0))
        if leading:
            kept = kept[(kept[:, 0] == x.smax) | (kept[:, 1] == y.smax)]
        if len(kept):
            pairs.append((L1, L2))
            spins.append(kept)
            couplings.append(coupling[:, kept[:, 0], kept[:, 1]].T * np.sqrt((2.0 * L1 + 1) * (2.0 * L2 + 1)))
            counts.append(len(kept))
    return _Plan(
        np.array(pairs, dtype=np.int64).reshape(-1, 2),
        np.cumsum(counts),
        np.concatenate([np.zeros((0, 2), dtype=np.int64), *spins]),
        np.concatenate([np.zeros((0, len(orders)), dtype=np.complex128), *couplings]),
    )


def _moment_couplings(
    L: int, orders: tuple[int, ...], x: ScannedBeam, y: ScannedBeam
) -> Iterator[tuple[int, int, NDArray[np.complex128]]]:
    """Yield (L1, L2, X), X[M, s, s'] = sum_{M1 M2} C^{LM}_{L1 M1 L2 M2} w^X_{s,L1 M1} w^Y_{s',L2 M2}."""
    w_x, w_y = x.orientations(), y.orientations()
    for L1 in range(x.L_max + 1):
        degrees = range(abs(L - L1), min(L + L1, y.L_max) + 1)
        # Of one layout whatever the shape: numba compiles for each.
        of_x, of_y = np.ascontiguousarray(w_x[:, L1]), np.ascontiguousarray(w_y[:, degrees.start : degrees.stop])
        couplings = np.zeros((len(orders), len(degrees), len(w_x), len(w_y)), dtype=np.complex128)
        for rows, M in zip(couplings, orders, strict=True):
            _couple((L, M), L1, of_x, of_y, rows)
        for place, L2 in enumerate(degrees):
            yield L1, L2, couplings[:, place]


@njit(nogil=True)
def _couple(
    mode: tuple[int, int],
    L1: int,
    w_x: NDArray[np.complex128],
    w_y: NDArray[np.complex128],
    rows: NDArray[np.complex128],
) -> None:
    """Add sum_{M1 M2} C^{LM}_{L1 M1 L2 M2} w^X_{s,L1 M1} w^Y_{s',L2 M2} to ``rows[L2 - |L - L1|, s, s']``."""
    (L, M), first = mode, abs(mode[0] - L1)
    family = np.zeros(2 * min(L1, L) + 1)
    # C = (-1)^{L1-L2+M} sqrt(2L+1) (L1 L2 L; M1 M2 -M), and (-1)^{L1+L2+L} for L2 in the first column.
    factor = np.sqrt(2.0 * L + 1.0) * (1.0 if (L + M) % 2 == 0 else -1.0)
    for M1 in range(-L1, L1 + 1):
        left = w_x[:, w_x.shape[1] // 2 + M1]
        if not np.any(left != 0.0):
            continue
        lowest, n = threej_family(L1, L, M1, -M, family)
        for L2 in range(lowest, min(lowest + n, first + w_y.shape[1])):
            clebsch = factor * family[L2 - lowest]
            right = w_y[:, L2 - first, w_y.shape[2] // 2 + M - M1]
            for s in range(len(left)):
                for t in range(len(right)):
                    rows[L2 - first, s, t] += clebsch * left[s] * right[t]


@njit(nogil=True)
def _spin_table(low: int, high: int, smax: int, L_max: int, response: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return k_l b_ls (l1 L1 l; 0 s -s) at [l1 - low, L1, l - l1 + L_max, smax + s], zero if undefined."""
    lsky = response.shape[1] - 1
    table = np.zeros((high - low, L_max + 1, 2 * L_max + 1, 2 * smax + 1), dtype=np.complex128)
    family = np.zeros(2 * L_max + 1)
    for l1 in range(low, high):
        for L1 in range(L_max + 1):
            zero = 0 * L1  # a literal 0 is a type of its own to numba, compiled anew
            for s in range(min(smax, L1) + 1):
                bottom, n = threej_family(l1, L1, zero, s, family)
                for ell in range(bottom, min(bottom + n, lsky + 1)):
                    symbol = family[ell - bottom]
                    mirrored = symbol if (l1 + L1 + ell) % 2 == 0 else -symbol
                    row = table[l1 - low, L1, ell - l1 + L_max]
                    row[smax - s] = mirrored * response[smax - s, ell]
                    row[smax + s] = symbol * response[smax + s, ell]
    return table


@njit(nogil=True)
def _contract(
    L: int, d: int, degrees: NDArray[np.int64], seen: _Seen, plan: _Plan, block: NDArray[np.complex128]
) -> None:
    """Add to ``block[M, l2]`` the sums over l, (L1, L2) and (s, s')."""
    low, power, table_x, table_y = seen
    pairs, first_term, spins, coupling = plan
    L_max_x, L_max_y = table_x.shape[1] - 1, table_y.shape[1] - 1
    symbols = np.zeros(2 * max(L_max_x, L_max_y) + 2)
    sums = np.zeros(table_x.shape[3] * table_y.shape[3], dtype=np.complex128)
    lsky = len(power) - 1
    for i in range(len(degrees)):
        l2 = degrees[i]
        l1 = l2 - d
        norm = np.sqrt((2.0 * l1 + 1.0) * (2.0 * l2 + 1.0)) * (1.0 if (l2 - L) % 2 == 0 else -1.0)
        for p in range(len(pairs)):
            L1, L2 = pairs[p, 0], pairs[p, 1]
            bottom = max(abs(l1 - L1), abs(l2 - L2))
            top = min(l1 + L1, l2 + L2, lsky)
            if top < bottom:
                continue
            sixj_family(l1, L1, L, L2, l2, symbols)
            begin, end = first_term[p], first_term[p + 1]
            sums[: end - begin] = 0.0
            for ell in range(bottom, top + 1):
                weight = power[ell] * symbols[ell - bottom]
                row_x = table_x[l1 - low, L1, ell - l1 + L_max_x]
                row_y = table_y[l2 - low, L2, ell - l2 + L_max_y]
                for t in range(begin, end):
                    sums[t - begin] += weight * row_x[spins[t, 0]] * row_y[spins[t, 1]]
            sign = norm if L2 % 2 == 0 else -norm
            for t in range(begin, end):
                for k in range(block.shape[0]):
                    block[k, i] += sign * coupling[t, k] * sums[t - begin]
