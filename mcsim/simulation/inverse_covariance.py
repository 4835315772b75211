r"""Inverse covariance of maps that share one unknown sky, with masks and noise that differs from pixel to pixel.

With d_k the maps, P_k the response of map k (beam, pixel window, and on request the orders of the beam and the
centroids), N_k its white noise, without weight in pixels that are not observed, and S the covariance of the sky,

    C = P S P^t + N,     C^-1 d = N^-1 (d - P s^),     (S^-1 + sum_k P_k^t N_k^-1 P_k) s^ = sum_k P_k^t N_k^-1 d_k.

The system has the size (lmax + 1)^2 of the sky, however many maps there are. It is solved for u = S^-1/2 s^, in which
a sky without power at some l is no exception, by conjugate gradients (Wandelt, Larson & Lakshminarayanan 2004,
Phys. Rev. D 70, 083511; Eriksen et al. 2004, ApJS 155, 227), preconditioned in pixels
(:mod:`mcsim.simulation.preconditioner`).

Of maps from which templates T were fitted and subtracted N^-1 - N^-1 T (T^t N^-1 T)^-1 T^t N^-1 stands for N^-1: with
any amplitude of T it is the same, whatever weights the fit had.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan import Moments
from mcsim.simulation import convolve
from mcsim.simulation.preconditioner import Preconditioner
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng
from mcsim.sphere.checks import check_cl
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.arrays import Alm, Cl, Map, Maps, Matrix, Vector, divided

RANK = 1e-10  #: smallest eigenvalue over the largest of normalised templates that are fitted and subtracted
ITERATIONS = 2000  #: after so many the conjugate gradients are given up
TYPICAL = 3  #: maps that are drawn to tell how many iterations an approach takes


@dataclass(frozen=True, eq=False)
class ObservedMap:
    """Describe one map."""

    response: convolve.Response  #: Of the beam times the pixel window. Maps with equal ones share their transforms.
    #: inverse variance of the noise in every pixel, uK^-2, shape (npix,); 0 where not observed or masked
    precision: Map
    #: orientation moments and centroids of the samples; None: only the circular part of the beam, at pixel centres
    moments: Moments | None = None
    #: what was fitted and subtracted, of any amplitude, shape (K, npix)
    templates: NDArray[np.float64] | None = None

    @property
    def spins(self) -> list[int]:
        """Return the orders of the beam that act, but 0."""
        known = 0 if self.moments is None else min(self.response.mmax, self.moments.smax)
        return [s for s in range(1, known + 1) if self.response.factors[s].any()]

    @cached_property
    def _covariance(self) -> Matrix:
        assert self.templates is not None  # the caller has asked
        return covariance_of_amplitudes(self.templates, self.precision)

    def without_templates(self, weighted: Map) -> Map:
        """Return N^-1 d, uK^-1, without what the templates explain of d."""
        if self.templates is None:
            return weighted
        return weighted - self.precision * (self._covariance @ (self.templates @ weighted) @ self.templates)

    def unexplained(self, map_uk: Map) -> Map:
        """Return what the best fit of the templates leaves of a map, uK; nothing where that is rounding."""
        if self.templates is None:
            return map_uk
        left = divided(self.without_templates(self.precision * map_uk), self.precision)
        faint = self.precision @ left**2 <= RANK * (self.precision @ map_uk**2)
        return np.zeros_like(map_uk) if faint else left


class InverseCovariance:
    """Apply the inverse covariance of maps.

    ``cl``: spectrum of the sky, uK^2, shape (lmax + 1,). ``maps``: the maps in order, of one nside. ``tolerance``:
    relative residual at which the conjugate gradients end. ``nthreads``: threads of the transforms. Raise InputError if
    no map has an observed pixel, pixels differ in number, or a response does not reach lmax.

    Notes
    -----
    Equal to a dense solve to 1e-6 with a mask, uneven noise, the orders of the beam and centroids
    (tests/unit/test_inverse_covariance.py).
    """

    def __init__(self, cl: Cl, maps: Sequence[ObservedMap], tolerance: float = 1e-8, nthreads: int = 1) -> None:
        self.lmax, self.cl, self.maps = len(cl) - 1, cl, tuple(maps)
        self.tolerance, self.nthreads = tolerance, nthreads
        check_cl(cl, self.lmax)
        sizes = {m.precision.size for m in self.maps}
        if len(sizes) != 1:
            raise InputError(f"the maps have {sorted(sizes)} pixels; give at least one map, all of one nside.")
        if any(m.response.lmax != self.lmax for m in self.maps):
            found = [m.response.lmax for m in self.maps]
            raise InputError(f"the responses end at l = {found}, the spectrum at {self.lmax}; give all to one lmax.")
        if not any(m.precision.any() for m in self.maps):
            raise InputError("no map has an observed pixel; give a precision above 0 somewhere.")
        self.npix = sizes.pop()
        self.nside = int(np.sqrt(self.npix // 12))
        groups: dict[bytes, list[int]] = {}
        for i, m in enumerate(self.maps):
            groups.setdefault(m.response.factors.tobytes(), []).append(i)
        self._members = list(groups.values())  # maps of equal responses
        self._root = np.sqrt(cl)
        self._found: dict[tuple[float, int], int] = {}  # iterations of approach, by tolerance and their largest number

    @property
    def size(self) -> int:
        """Return the number of coefficients of a sky."""
        return alm_.size(self.lmax)

    @cached_property
    def precision(self) -> Maps:
        """Return the inverse variance of all pixels, uK^-2, shape (map, npix)."""
        return np.stack([m.precision for m in self.maps])

    def observe(self, sky: Alm) -> Maps:
        """Return P s, the maps of a sky without noise, uK."""
        found = np.empty((len(self.maps), self.npix))
        for members in self._members:
            shared = [self.maps[i] for i in members]
            response = shared[0].response
            circular = convolve.circular_alm(sky, response)
            found[members] = healpix.synthesis(circular[None], self.nside, self.lmax, nthreads=self.nthreads)[0]
            moved = self._moved(members)
            if moved:
                gradient = healpix.gradient(circular, self.nside, self.lmax, self.nthreads)
                for i, own in moved.items():
                    found[i] += convolve.centroid_map(gradient, own)
            wanted = {s for m in shared for s in m.spins}
            for s in sorted(wanted):
                only = convolve.Response(np.where(np.arange(s + 1)[:, None] == s, response.factors[: s + 1], 0.0))
                spins = convolve.spin_maps(sky, only, self.nside, self.nthreads)
                for i in members:
                    moments = self.maps[i].moments
                    if moments is not None and s in self.maps[i].spins:
                        found[i] += convolve.noncircular_map(spins, moments)
        return found

    def adjoint(self, maps: Maps, only: range | None = None) -> Alm:
        """Return P^t applied to maps: coefficients whose product with a sky is that of the maps with P s.

        ``only``: the maps that are given, the others being zero; None: all.
        """
        total = np.zeros(alm_.size(self.lmax), dtype=np.complex128)
        at = {i: row for row, i in enumerate(range(len(self.maps)) if only is None else only)}
        for everyone in self._members:
            members = [i for i in everyone if i in at]
            if not members:
                continue
            response = self.maps[members[0]].response
            added = np.sum([maps[at[i]] for i in members], axis=0)
            circular = healpix.adjoint(added, self.lmax, self.nthreads)
            moved = self._moved(members)
            if moved:
                along = [np.stack([maps[at[i]] * m.dtheta, maps[at[i]] * m.dphi]) for i, m in moved.items()]
                both = np.sum(along, axis=0)
                # The gradient of a_lm is the spin-1 synthesis of E = sqrt(l(l + 1)) a_lm, B = 0.
                electric, _ = healpix.adjoint(both, self.lmax, self.nthreads, spin=1)
                ell = np.arange(self.lmax + 1.0)
                circular = circular + alm_.multiply(electric, np.sqrt(ell * (ell + 1.0)), self.lmax)
            total += convolve.circular_alm(circular, response)
            for s in sorted({s for i in members for s in self.maps[i].spins}):
                own = [(maps[at[i]], self.maps[i].moments) for i in members if s in self.maps[i].spins]
                turned = convolve.turned([(map_, moments) for map_, moments in own if moments is not None], s)
                electric, magnetic = healpix.adjoint(turned, self.lmax, self.nthreads, spin=s)
                factor = response.factors[s]  # ducc0's sign: S_s is minus the synthesis
                total -= 2.0 * alm_.multiply(electric, factor.real, self.lmax)
                total -= 2.0 * alm_.multiply(magnetic, factor.imag, self.lmax)
        return total

    def draw(self, name: str, number: int, seed: int = 0) -> Maps:
        """Draw maps of this covariance, uK, 0 where nothing is observed; ``name`` is that of the random numbers."""
        sky = gaussian_alm(self.cl, rng.generator(seed, number, f"{name}/sky"))
        noise = rng.generator(seed, number, f"{name}/noise").standard_normal(self.precision.shape)
        seen = self.precision > 0.0
        return np.where(seen, self.observe(sky) + divided(1.0, np.sqrt(self.precision)) * noise, 0.0)

    def weighted(self, maps: Maps, part: slice = slice(None)) -> Maps:
        """Return N^-1 applied to all maps, or to those of ``part``, uK^-1; what was subtracted has no weight."""
        found: Maps = self.precision[part] * maps
        for row, one in enumerate(self.maps[part]):
            found[row] = one.without_templates(found[row])
        return found

    def of_own(self, maps: Maps, part: slice) -> Alm:
        """Return P^t N^-1 applied to some maps, the others being zero; ``part`` says which they are."""
        return self.adjoint(self.weighted(maps, part), range(len(self.maps))[part])

    def solve(self, sky: Alm, near: Alm | None = None) -> Alm:
        """Return (S^-1 + P^t N^-1 P)^-1 applied to coefficients; InputError if the iterations do not converge.

        ``near``: coefficients near the result, where the iterations begin; None: zero.
        """
        scale, known = self._root, self._right_side(sky)
        if not known.any():
            return np.zeros_like(sky)
        begin = None
        if near is not None:
            begin = _packed(alm_.multiply(near, divided(1.0, scale), self.lmax), self.lmax)
        found, used = conjugate_gradients(self._normal, known, self._precondition, (self.tolerance, ITERATIONS), begin)
        if used > ITERATIONS:
            raise InputError(
                f"the inverse covariance has not converged after {ITERATIONS} iterations: the noise is too small for "
                "the mask; mask less, or give the maps more noise."
            )
        return alm_.multiply(_unpacked(found, self.lmax), scale, self.lmax)

    def approach(self, sky: Alm, tolerance: float, iterations: int) -> Alm:
        """Return nearly the same as :meth:`solve`: of typical maps to a tolerance, or as near as these iterations come.

        What is left of the system is compared with S^-1/2 s^, which is what remains of the sky in C^-1 d: where the sky
        is far above the noise that is much less than the right hand side.

        Notes
        -----
        All maps have the same number of iterations, the median of :data:`TYPICAL` drawn ones. Iterations that end
        when the tolerance is met make the result jump where a small change of the maps takes one more: in one sky of 20
        the response to an effect of 1 %, per unit, was wrong by a hundred standard deviations of an element.
        """
        known = self._right_side(sky)
        until = 0.0, self._typical(tolerance, iterations)
        found, _ = conjugate_gradients(self._normal, known, self._precondition, until)
        return alm_.multiply(_unpacked(found, self.lmax), self._root, self.lmax)

    def _typical(self, tolerance: float, most: int) -> int:
        """Return how many iterations to a tolerance maps of this covariance take, or ``most`` if they take more."""
        if (tolerance, most) not in self._found:
            modes, gain = 2.0 * np.arange(self.lmax + 1) + 1.0, self._gain
            expected = float(np.sqrt(modes @ (gain / (1.0 + gain)) / (modes @ (gain * (1.0 + gain)))))
            until = tolerance * expected, most
            taken = []
            for number in range(TYPICAL):
                known = self._right_side(self.adjoint(self.weighted(self.draw("typical", number))))
                taken.append(conjugate_gradients(self._normal, known, self._precondition, until)[1])
            self._found[tolerance, most] = min(most, sorted(taken)[TYPICAL // 2])
        return self._found[tolerance, most]

    def _right_side(self, sky: Alm) -> Vector:
        """Return S^1/2 applied to coefficients, packed."""
        return _packed(alm_.multiply(sky, self._root, self.lmax), self.lmax)

    def iterations(self, sky: Alm) -> int:
        """Return how many iterations :meth:`solve` takes."""
        known = self._right_side(sky)
        return conjugate_gradients(self._normal, known, self._precondition, (self.tolerance, ITERATIONS))[1]

    def _normal(self, vector: Vector) -> Vector:
        """Return (1 + S^1/2 P^t N^-1 P S^1/2) applied to packed coefficients."""
        s = alm_.multiply(_unpacked(vector, self.lmax), self._root, self.lmax)
        back = self.adjoint(self.weighted(self.observe(s)))
        return vector + _packed(alm_.multiply(back, self._root, self.lmax), self.lmax)

    def wiener(self, maps: Maps) -> Alm:
        """Return s^ = S P^t C^-1 d, the sky as far as maps tell it, uK."""
        return self.solve(self.adjoint(self.weighted(maps)))

    def apply(self, maps: Maps, sky: Alm | None = None) -> Maps:
        """Return C^-1 d, uK^-1; ``sky`` is s^, if it is known already."""
        return self.weighted(maps - self.observe(self.wiener(maps) if sky is None else sky))

    def _moved(self, members: Sequence[int]) -> dict[int, Moments]:
        """Return the moments of those maps that have centroids."""
        found = {}
        for i in members:
            moments = self.maps[i].moments
            if moments is not None and moments.dtheta is not None:
                found[i] = moments
        return found

    @cached_property
    def _gain(self) -> Vector:
        """Power of the sky over that of the noise in one mode, if all pixels of a map counted alike; (lmax + 1,)."""
        total = sum(m.response.factors[0].real ** 2 * m.precision.sum() for m in self.maps)
        return np.asarray(self.cl * total / (4.0 * np.pi))

    @cached_property
    def _preconditioner(self) -> Preconditioner:
        # One map with the mean response stands for all.
        return Preconditioner(self._gain, self.precision.sum(axis=0), self.nthreads)

    def _precondition(self, vector: Vector) -> Vector:
        return _packed(self._preconditioner.apply(_unpacked(vector, self.lmax)), self.lmax)


def covariance_of_amplitudes(templates: NDArray[np.float64], weight: Map) -> Matrix:
    """Return (T^t W T)^-1 of templates, (K, npix), and weights, (npix,): (K, K), zero for what others explain."""
    normal = weight * templates @ templates.T
    scale = np.sqrt(np.outer(np.diag(normal), np.diag(normal)))
    return divided(np.linalg.pinv(divided(normal, scale), RANK, hermitian=True), scale)


def conjugate_gradients(
    apply: Callable[[Vector], Vector],
    known: Vector,
    precondition: Callable[[Vector], Vector],
    until: tuple[float, int],
    start: Vector | None = None,
) -> tuple[Vector, int]:
    """Solve a symmetric positive definite system by preconditioned conjugate gradients.

    ``until``: relative residual, and number of iterations, at which they end. Return the solution and the iterations,
    one more than allowed if they ended for their number.
    """
    tolerance, most = until
    size = np.sqrt(known @ known)
    found = np.zeros_like(known) if start is None else start.copy()
    left = known.copy() if start is None else known - apply(start)
    direction, before = np.zeros_like(known), 1.0
    for iteration in range(most):
        if left @ left <= (tolerance * size) ** 2:
            return found, iteration
        near = precondition(left)
        now = float(near @ left)
        direction = near + now / before * direction
        moved = apply(direction)
        step = now / (direction @ moved)
        found = found + step * direction
        left = left - step * moved
        before = now
    return found, most if left @ left <= (tolerance * size) ** 2 else most + 1


def unit_skies(lmax: int) -> Iterator[tuple[int, Alm]]:
    """Yield degree and coefficients of an orthonormal basis of the (lmax + 1)^2 real skies."""
    for k, ell in enumerate(_spread(np.arange(lmax + 1), lmax).tolist()):
        yield ell, _unpacked(np.where(np.arange((lmax + 1) ** 2) == k, 1.0, 0.0), lmax)


def product(a: Alm, b: Alm, lmax: int) -> float:
    """Return the product of two skies: the sum over all m of a_lm conj(b_lm)."""
    return float(_packed(a, lmax) @ _packed(b, lmax))


def _packed(alm: Alm, lmax: int) -> Vector:
    """Return coefficients as (lmax + 1)^2 real numbers, whose products are those of the fields."""
    rest = np.sqrt(2.0) * alm[lmax + 1 :]
    return np.concatenate([alm[: lmax + 1].real, rest.real, rest.imag])


def _unpacked(vector: Vector, lmax: int) -> Alm:
    zonal, real, imaginary = np.split(vector, [lmax + 1, alm_.size(lmax)])
    return np.concatenate([zonal.astype(np.complex128), (real + 1j * imaginary) / np.sqrt(2.0)])


def _spread(factor: NDArray, lmax: int) -> NDArray:
    """Return a function of l at the places of packed coefficients."""
    each = factor[alm_.degrees(lmax)]
    return np.concatenate([each, each[lmax + 1 :]])
