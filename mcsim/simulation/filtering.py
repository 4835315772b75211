r"""Quadratic maximum-likelihood BipoSH coefficients: maps filtered by their inverse covariance, and what they measure.

The filtered coefficients of a map d = w a + n in pixels, with w the pixel window and C its covariance, are

    x = w Y^t C^-1 d,    on a full sky with uniform noise  x_lm = a_lm / C_l.

Small BipoSH coefficients, alpha_p l-independent in the units of the binned spectra within a bin p of a mode, change
the covariance of a by alpha_p C_p. The derivative of the log-likelihood is q_p = x' C_p x / 2, a weighted sum of the
BipoSH coefficients of x over the bin, and

    alpha^ = F^-1 (q - <q>),    F_pp' = 1/2 Tr[C^-1 C_p C^-1 C_p'],

<q> for isotropic skies, is unbiased with the covariance F^-1, the smallest possible (Hanson & Lewis 2009,
arXiv:0908.0963, eqs. 8-12; Hanson, Lewis & Challinor 2010, arXiv:1003.0198). F is that of the filter: what the true
noise and sky are changes the errors, not the mean.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import Estimator, estimate, power_spectrum
from mcsim.bipolar.modes import Mode, bin_factor, existing
from mcsim.errors import InputError
from mcsim.simulation.map_filter import MapFilter
from mcsim.support import folders
from mcsim.support.arrays import Alm, Matrix, Vector, divided
from mcsim.support.code import package_digest

LOWEST = 2  #: lowest degree in bins: the monopole and the dipole of a map are not those of its sky
PAIRS = 20  #: pairs of random probes for each number whose Fisher matrix they estimate
LEAST_PAIRS = 2  #: the least number of the same with which a matrix is inverted
APART = 1e-8  #: smallest eigenvalue of the correlation of the Fisher matrix over the largest, of numbers told apart

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Bands:
    """Bins of all modes of one pair of maps, as a vector of real numbers: real and imaginary parts where they exist."""

    #: modes, lmax, width: of the coefficients, and width of the bins in ell
    modes: tuple[Mode, ...]
    lmax: int
    width: int
    auto: bool  #: True if both maps of the pair are the same

    @cached_property
    def first(self) -> NDArray[np.int64]:
        """Return the first ell of every bin."""
        return np.arange(0, self.lmax + 1, self.width)

    @cached_property
    def count(self) -> Matrix:
        """How often a coefficient stands in x' C_p x / 2 (auto) or x' C_p y, shape (mode, lmax + 1); 0: not used."""
        count = np.zeros((len(self.modes), self.lmax + 1))
        ell = np.arange(self.lmax + 1)
        for row, mode in zip(count, self.modes, strict=True):
            used = existing(mode.L, mode.d, self.lmax) & (ell >= LOWEST) & (ell - mode.d >= LOWEST)
            if self.auto and not mode.in_auto:
                continue
            row[used] = (1.0 if mode.M == 0 else 2.0) * (0.5 if self.auto and mode.d == 0 else 1.0)
        return count

    @cached_property
    def weight(self) -> Matrix:
        """Return the count over the factor of the binned spectra, shape (mode, lmax + 1)."""
        factor = np.stack([bin_factor(mode, self.lmax) for mode in self.modes])
        return np.divide(self.count, factor, out=np.zeros_like(self.count), where=self.count > 0.0)

    @cached_property
    def numbers(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return mode, bin, and part (0 real, 1 imaginary) of every number."""
        filled = np.add.reduceat(self.count, self.first, axis=-1) > 0.0
        rows, bins = np.nonzero(filled)
        found = [
            (row, place, part)
            for row, place in zip(rows.tolist(), bins.tolist(), strict=True)
            for part in self.modes[row].parts
        ]
        mode, place, part = np.array(found, dtype=np.int64).T
        return mode, place, part

    @property
    def size(self) -> int:
        """Return how many numbers there are."""
        return len(self.numbers[0])

    def sums(self, biposh: NDArray[np.complex128]) -> Vector:
        """Return q_p of the BipoSH coefficients of filtered maps, shape (mode, lmax + 1)."""
        terms = np.where(self.count > 0.0, self.weight * np.where(self.count > 0.0, biposh, 0.0), 0.0)
        total = np.add.reduceat(terms, self.first, axis=-1)
        mode, place, part = self.numbers
        return np.where(part == 0, total.real[mode, place], total.imag[mode, place])

    def spectra(self, numbers: Vector) -> NDArray[np.complex128]:
        """Return numbers as complex ones, shape (mode, bin), NaN where there are none."""
        mode, place, part = self.numbers
        found = np.zeros((len(self.modes), len(self.first)), dtype=np.complex128)
        known = np.zeros(found.shape, dtype=bool)
        known[mode, place] = True
        np.add.at(found, (mode, place), np.where(part == 0, 1.0, 1j) * numbers)
        found[~known] = complex(np.nan, np.nan)
        return found

    def uniform(self, products: Matrix) -> Vector:
        """Return the diagonal of F under uniform noise, from the :meth:`products` of the total spectra."""
        terms = np.divide(self.weight**2, self.count * products, out=np.zeros_like(products), where=self.count > 0.0)
        mode, place, _ = self.numbers
        return np.asarray(np.add.reduceat(terms, self.first, axis=-1)[mode, place])

    def products(self, x: Vector, y: Vector) -> Matrix:
        """Return C_l1 of the first map times C_l2 of the second, (mode, lmax + 1), one where l1 does not exist."""
        found = np.ones(self.count.shape)
        for row, mode in zip(found, self.modes, strict=True):
            l2 = np.arange(max(0, mode.d), self.lmax + 1 + min(0, mode.d))
            row[l2] = x[l2 - mode.d] * y[l2]
        return found


def probes_of(bands: Sequence[Bands], asked: int | None) -> int:
    """Return how many random probes normalise the numbers of bands; InputError if those asked for are too few."""
    largest = max(each.size for each in bands)
    if asked is None:
        return int(np.ceil(np.sqrt(2.0 * PAIRS * largest))) + 1
    if asked * (asked - 1) < 2 * LEAST_PAIRS * largest:
        raise InputError(
            f"biposh.probes = {asked} make {asked * (asked - 1) // 2} pairs, too few to normalise {largest} numbers; "
            f"raise it to {int(np.sqrt(2.0 * LEAST_PAIRS * largest)) + 2} or more, or leave it out."
        )
    return asked


class Response(NamedTuple):
    """Fisher matrix of the numbers of a pair of maps, and the factor that makes its inverse unbiased on average."""

    matrix: Matrix
    unbiased: float = 1.0

    def checked(self) -> "Response":
        """Return the same; InputError if the maps do not tell its numbers apart, as behind a mask of nearly all."""
        scale = np.sqrt(np.diag(self.matrix))
        values = np.linalg.eigvalsh(divided(self.matrix, np.outer(scale, scale)))
        if values[0] < APART * values[-1]:
            raise InputError(
                f"the maps do not tell the {len(scale)} numbers of all modes and bins apart that their filter measures "
                "at once; raise biposh.summary_bin, lower biposh.L_max, or give a mask (map.mask) that leaves more sky."
            )
        return self


def _unbiased(halves: Sequence[tuple[Matrix, float]], pairs: float) -> float:
    """Return the factor of an inverse from so many pairs of random probes.

    ``halves``: sums over the pairs of two independent halves of the probes, and their numbers.

    Notes
    -----
    For independent pairs it is that of Hartlap, Simon & Schneider (2007, A&A 464, 399, eq. 17). But a probe is in many
    of them, which adds a bias in inverse proportion to the number of probes: tr(F_1^-1 F_2) of the halves, whose mean
    is one without a bias, has twice that of the whole. Halves of fewer than :data:`LEAST_PAIRS` pairs for each number
    tell nothing, and what is left of the bias stays.
    """
    size = len(halves[0][0])

    def independent(count: float) -> float:
        return (count - size - 1.0) / count

    if min(count for _, count in halves) < LEAST_PAIRS * size:
        return independent(pairs)
    (one, first), (two, second) = ((total / count, count) for total, count in halves)
    traces = [
        independent(count) * float(np.trace(np.linalg.solve(a, b))) / size
        for a, b, count in ((one, two, first), (two, one, second))
    ]
    return independent(pairs) / (1.0 + 0.5 * (float(np.mean(traces)) - 1.0))


@dataclass(frozen=True, eq=False)
class Filtering:
    """Filters of all maps of a survey, and the normalisation of what they measure."""

    filters: tuple[MapFilter, ...]  #: one for every map
    pairs: tuple[tuple[int, int], ...]  #: indices of maps
    tables: Estimator  #: of the estimator
    width: int  #: of the bins in ell
    probes: int | None = None  #: random probes for the normalisation; None: as many as give 20 pairs for each number

    @cached_property
    def bands(self) -> tuple[Bands, ...]:
        """Return the bins of every pair."""
        return tuple(Bands(self.tables.modes, self.tables.lmax, self.width, x == y) for x, y in self.pairs)

    @property
    def uniform(self) -> bool:
        """Return True if no map needs random probes."""
        return all(each.uniform for each in self.filters)

    @property
    def drawn(self) -> int:
        """Return the number of probes of every map; InputError if ``probes`` are too few."""
        return 0 if self.uniform else probes_of(self.bands, self.probes)

    def fisher(self, progress: Progress | None = None) -> tuple[Response, ...]:
        """Return F of every pair, estimated once and kept in the cache; exact if no map needs random probes.

        InputError if it cannot be inverted.
        """
        if not self.drawn:
            return tuple(Response(self._exact(number)).checked() for number in range(len(self.pairs)))

        def fill(folder: Path) -> None:
            probes = self.probed(progress)
            each = (self.response(probes, number) for number in range(len(self.pairs)))
            matrices, factors = zip(*each, strict=True)
            np.savez(folder / "fisher.npz", *matrices, factors=factors)

        with np.load(folders.cached(f"filter-{self._key()}", fill) / "fisher.npz") as stored:
            each = enumerate(stored["factors"].tolist())
            return tuple(Response(stored[f"arr_{number}"], factor).checked() for number, factor in each)

    @cached_property
    def inverses(self) -> tuple[Matrix, ...]:
        """Return F^-1 of every pair, its mean over random probes on the diagonal."""
        return tuple(np.asarray(each.unbiased * np.linalg.inv(each.matrix)) for each in self.fisher())

    @cached_property
    def per_ell(self) -> NDArray[np.float64]:
        """Return the factor from the BipoSH of filtered maps to uK^2, shape (pair, mode, lmax + 1).

        It is C_l1 C_l2 over the response to a flat spectrum of the same mode, that of the full sky with uniform noise
        being one.
        """
        found = np.stack([bands.products(*self._totals(pair)) for bands, pair in self._pairs()])
        if self.uniform:
            return found
        for factor, (bands, pair), (matrix, _) in zip(found, self._pairs(), self.fisher(), strict=True):
            full = bands.uniform(bands.products(*self._totals(pair)))
            mode, place, _ = bands.numbers
            middle = bands.first + (np.append(bands.first[1:], bands.lmax + 1) - 1 - bands.first) / 2.0
            for row in np.unique(mode):
                own = np.flatnonzero(mode == row)
                response = matrix[np.ix_(own, own)].sum(axis=1) / full[own]
                bins = np.unique(place[own])
                mean = [response[place[own] == each].mean() for each in bins]
                factor[row] /= np.interp(np.arange(bands.lmax + 1), middle[bins], mean)
        return found

    def measure(self, filtered: Sequence[Alm]) -> dict[str, NDArray]:
        """Return the spectra of filtered maps.

        ``biposh`` (pair, mode, lmax + 1) and ``cl`` (pair, lmax + 1), normalised degree by degree, and ``biposh_qml``
        (pair, mode, bin), F^-1 q, all in uK^2 and before the mean field is taken off; ``biposh_qml_score`` is q, uK^-2.
        """
        shape = (len(self.pairs), len(self.tables.modes), self.tables.lmax + 1)
        biposh, cl = np.empty(shape, dtype=np.complex128), np.empty((shape[0], shape[2]))
        qml, score = np.empty((2, *shape[:2], len(self.bands[0].first)), dtype=np.complex128)
        monopole = self.tables.modes.index(Mode(0, 0, 0))
        for row, ((x, y), bands, inverse) in enumerate(zip(self.pairs, self.bands, self.inverses, strict=True)):
            raw = estimate(self.tables, filtered[x], None if x == y else filtered[y])
            biposh[row] = self.per_ell[row] * raw
            cl[row] = self.per_ell[row, monopole] * power_spectrum(filtered[x], filtered[y], self.tables.lmax)
            q = bands.sums(raw)
            qml[row], score[row] = bands.spectra(inverse @ q), bands.spectra(q)
        return {"biposh": biposh, "cl": cl, "biposh_qml": qml, "biposh_qml_score": score}

    def errors(self) -> NDArray[np.float64]:
        """Return the standard deviation of ``biposh_qml`` of an isotropic sky for single maps, (pair, mode, bin).

        It is the root of the diagonal of F^-1, both parts together; NaN for pairs of different maps.
        """
        found = np.full((len(self.pairs), len(self.tables.modes), len(self.bands[0].first)), np.nan)
        for row, bands, inverse in zip(found, self.bands, self.inverses, strict=True):
            if bands.auto:
                variances = bands.spectra(np.diag(inverse))
                row[:] = np.sqrt(variances.real + variances.imag)
        return found

    def band_powers(self, biposh: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the bins of given coefficients A, uK^2, (pair, mode, lmax + 1), weighted as under uniform noise."""
        found = []
        for (bands, pair), given in zip(self._pairs(), biposh, strict=True):
            products = bands.products(*self._totals(pair))
            found.append(bands.spectra(bands.sums(given / products) / bands.uniform(products)))
        return np.stack(found)

    def response(
        self, probes: Sequence[tuple[Alm, ...]], number: int, given: Callable[[Alm, Alm], float] | None = None
    ) -> Response:
        """Return F of a pair of maps from the filtered coefficients of random probes.

        ``given``: a linear function x' dC y of two of them, of any other change dC of the covariance: as a last row
        and column what the numbers know of it.
        """
        (x, y), bands = self.pairs[number], self.bands[number]
        half = len(probes) // 2

        def of(i: int) -> NDArray[np.float64]:
            """Return the sums of a probe with others of the first half, of the second, and of different halves."""
            others = [j for j in range(i + 1 if x == y else 0, len(probes)) if j != i]
            rows = np.empty((len(others), bands.size + (given is not None)))
            for row, j in zip(rows, others, strict=True):
                first, second = probes[i][x], probes[j][y]
                raw = estimate(self.tables, first, second)
                if x == y:
                    raw = 0.5 * (raw + estimate(self.tables, second, first))
                row[: bands.size] = bands.sums(raw)
                if given is not None:
                    row[-1] = given(first, second) * (0.5 if x == y else 1.0)
            own = np.array([int(i >= half) if (i < half) == (j < half) else 2 for j in others])
            return np.stack([rows[own == which].T @ rows[own == which] for which in range(3)])

        members = range(len(probes) - 1 if x == y else len(probes))
        with ThreadPoolExecutor(self.filters[0].inverse.nthreads) as pool:
            first, second, across = reduce(np.add, pool.map(of, members))
        ordered = 2.0 if x == y else 1.0

        def pairs(count: int) -> float:
            return count * (count - 1) / ordered

        halves = [(first, pairs(half)), (second, pairs(len(probes) - half))]
        total = (first + second + across) / pairs(len(probes))
        unbiased = _unbiased(halves, pairs(len(probes)))
        return Response(np.asarray(ordered * total), unbiased)

    def probed(self, progress: Progress | None = None) -> list[tuple[Alm, ...]]:
        """Return the filtered coefficients of all maps for every random probe."""
        found = []
        for number in range(self.drawn):
            found.append(tuple(each.probe(number) for each in self.filters))
            if progress is not None:
                progress((number + 1.0) / self.drawn)
        return found

    def _pairs(self) -> Iterator[tuple[Bands, tuple[int, int]]]:
        return zip(self.bands, self.pairs, strict=True)

    def _totals(self, pair: tuple[int, int]) -> tuple[Vector, Vector]:
        return self.filters[pair[0]].total, self.filters[pair[1]].total

    def _exact(self, number: int) -> Matrix:
        bands, pair = self.bands[number], self.pairs[number]
        return np.diag(bands.uniform(bands.products(*self._totals(pair))))

    def _key(self) -> str:
        """Return what the normalisation depends on, hashed."""
        simulation = (f"mcsim.simulation.{name}" for name in ("filtering", "map_filter", "inverse_covariance"))
        code = (*simulation, "mcsim.bipolar", "mcsim.sphere")
        modes = [tuple(mode) for mode in self.tables.modes]
        text = f"{modes} {self.tables.lmax} {self.width} {self.drawn} {self.pairs} {package_digest(code, ['ducc0'])}"
        found = hashlib.sha256(text.encode())
        for each in self.filters:
            observed = each.inverse.maps[0]
            fitted = () if observed.templates is None else (observed.templates,)
            for array in (each.inverse.cl, observed.precision, observed.response.factors, each.window, *fitted):
                found.update(np.ascontiguousarray(array).tobytes())
            found.update(f"{each.name} {each.inverse.tolerance} {each.lmax}".encode())
        return found.hexdigest()[:32]
