"""Detectability of a BipoSH signal: variances under isotropy, masks or none, signal to noise, Fisher information."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_legendre

from mcsim.bipolar.modes import Indices, check_modes, existing
from mcsim.bipolar.theory.circles import Circles, circles
from mcsim.bipolar.theory.harmonics import map_harmonics, spin_functions
from mcsim.errors import InputError
from mcsim.sphere.checks import check_cl, check_finite, check_shape
from mcsim.support.arrays import divided


class Spectra(NamedTuple):
    """Total power spectra of a map X, or of a pair X, Y: beam^2 signal + noise, uK^2, shape (lmax + 1,).

    ``cross`` is C_l^{XY}; for one map leave out ``y`` and ``cross``.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64] | None = None
    cross: NDArray[np.float64] | None = None


class Overlap(NamedTuple):
    """How the weights of two maps correlate coefficients A_{l1 l2} and A_{l1+n, l2+n}, by degrees of the weights.

    Factors of C^XX C^YY and of (C^XY)^2 for L = 0 or high l are sums over degrees; shape (n, degree of weights). They
    are means over M; ``around`` says what single M differ by. None: nothing.
    """

    autos: NDArray[np.float64]
    cross: NDArray[np.float64]
    around: Circles | None = None

    @property
    def shared(self) -> float:
        """Return the share of (C^XY)^2 that counts at a single l: one if both maps have the same weights."""
        return float(self.cross[0].sum() / self.autos[0].sum())

    def factors(self, mode: Indices, shift: int, lmax: int) -> NDArray[np.float64]:
        """Return both factors of A^{LM} at (l1 + l2 + n) / 2 = 0, 1/2, 1, ..., lmax, shape (2, 2 lmax + 1)."""
        coupled = _coupling(mode[0], self.autos.shape[1], lmax)
        found = np.stack([coupled @ self.autos[shift], (mode[2] == 0) * (coupled @ self.cross[shift])])
        if self.around is None:
            return found
        # At low l the degrees of weights count less, in what M adds as in the mean.
        less = [coupled @ one[0] / one[0].sum() for one in (self.autos, self.cross)]
        return found + np.array(self.around.beside(mode, shift))[:, None] * less


@lru_cache(maxsize=16)
def _coupling(L: int, size: int, lmax: int) -> NDArray[np.float64]:
    """Return (-1)^(L+K) (2l+1) {l l L; l l K}, about, at l = 0, 1/2, ..., lmax, shape (2 lmax + 1, size of K)."""
    ell, degree = np.arange(2 * lmax + 1)[:, None] / 2.0, np.arange(size)
    angle = divided(degree * (degree + 1.0), 2.0 * ell * (ell + 1.0))
    return np.where(degree <= 2.0 * ell, eval_legendre(L, 1.0 - angle), 0.0)


FULL_SKY = Overlap(np.ones((1, 1)), np.ones((1, 1)))


def overlap(
    x: NDArray[np.float64], y: NDArray[np.float64], reach: int, L_max: int, d_max: int | None = None
) -> Overlap:
    """Return the overlap of two weights of pixels, shape (npix,), up to n = ``reach``, from their degrees to ``L_max``.

    With ``d_max`` it tells modes of |d| up to that of each M apart, of which else it is the mean.

    Notes
    -----
    At l far above the degrees of the weights, a_lm of one l are those of great circles. A product f of weights
    correlates l and l + n by the n-th Fourier coefficient of f along a circle, whose mean square over all circles is
    sum_K d^K_{n0}(pi/2)^2 sum_N |f_KN|^2 / 4pi: the squared Funk transform at n = 0, and <f^2> summed over n. Here f
    is W_x^2 and W_y^2, or twice W_x W_y, over <W_x W_y>. A^{LM} couples degree K of f by the 6j symbol
    (-1)^(L+K) (2l+1) {l l L; l l K}, about P_L(1 - K(K+1)/(2l(l+1))), which is exact for L = 0 and 1, where K <= 2l.
    Sums over explicit covariances agree to a few per cent from l = 2 on: tests/unit/test_predict_overlap.py.
    A^{LM}_{l1 l2} is the mean of D^L_{Md} over circles, whose pole is at theta, of what l1 and l2 have in common there:
    its first term has the factor (2L+1) <d^L_{Md}(theta)^2 f_n f_n*>, its second one, also where d is not 0,
    (2L+1) <d^L_{Md}(theta) d^L_{M,-d}(theta) f_{d+n} f_{d-n}>, f_n the n-th Fourier coefficient. Means over M are those
    above, and the second term of d other than 0 has none.
    """
    products = [map_harmonics(product, L_max) for product in ((x * x, x * y) if x is y else (x * x, y * y, x * y))]
    own, other, both = products[0], products[-2], products[-1]
    degrees = 2.0 * np.arange(L_max + 1) + 1.0
    share = 4.0 * np.pi / degrees * spin_functions(reach, L_max, np.array([0.5 * np.pi]))[..., 0] ** 2
    share /= 4.0 * np.pi * np.mean(x * y) ** 2
    autos = np.sum(own * other.conj(), axis=1).real
    unit = float(np.mean(x * y)) ** 2
    around = None if d_max is None else circles((own, other, both), unit, reach, d_max)
    return Overlap(share * autos, share * np.sum(np.abs(both) ** 2, axis=1), around)


def isotropic_variance(
    modes: Sequence[Indices], spectra: Spectra, overlap: Overlap = FULL_SKY, shift: int = 0
) -> NDArray[np.float64]:
    """Return E|A^{LM}_{l1 l2}|^2 less the mean of an isotropic sky for modes (L, M, d) of a map or a pair.

    In uK^4, shape (n_mode, lmax + 1), NaN where the mode does not exist. With a ``shift`` n it is the covariance with
    A_{l1+n, l2+n}, up to the alternating sign of A in l.

    Notes
    -----
    C^XX_l1 C^YY_l2 + (-1)^L delta_{l1 l2} (C^XY_l)^2, each times its factor of the ``overlap``; for one map
    C_l1 C_l2 (1 + delta_{l1 l2}), L even where l1 = l2. Weights give single M such a second term with C^XY_l1 C^XY_l2
    where l1 is not l2, too. Variances are zero where they are less than 1e-12 of their first term.
    """
    check_modes(modes)
    x = spectra.x
    lmax = len(x) - 1
    y, cross = (x, x) if spectra.y is None else (spectra.y, spectra.cross)
    if cross is None:
        raise InputError("the cross spectrum of the two maps is missing; give cross with y.")
    for name, cl in (("x", x), ("y", y), ("cross", cross)):
        check_cl(cl, lmax, name, cross=name == "cross")
        check_shape(cl, (lmax + 1,), name)
    variance = np.full((len(modes), lmax + 1), np.nan)
    for row, mode in zip(variance, modes, strict=True):
        L, _, d = mode
        there = existing(L, d, lmax)
        l2 = np.flatnonzero(there[: lmax + 1 - shift] & there[shift:])
        square = x[l2 - d] * y[l2]
        if shift:
            square = np.sqrt(square * x[l2 - d + shift] * y[l2 + shift])
        first, second = overlap.factors(mode, shift, lmax)[:, 2 * l2 - d + shift]
        product = first * square
        shared = cross[l2] * cross[l2 + shift]
        if d:
            shared = np.sqrt(np.abs(shared * cross[l2 - d] * cross[l2 - d + shift]))
        row[l2] = product + (-1) ** L * second * shared
        if shift == 0:
            # For maps without noise and odd L only round-off of either sign remains.
            row[l2[row[l2] < 1e-12 * product]] = 0.0
    return variance


def signal_to_noise(
    biposh: NDArray[np.complex128],
    modes: Sequence[Indices],
    spectra: Spectra,
    f_sky: float = 1.0,
    ell_range: tuple[int, int] | None = None,
) -> NDArray[np.float64]:
    """Return the signal to noise of each mode, shape (n_mode,), from the first to the last l2 of a range; default: all.

    ``biposh`` is the expected A^{LM}_{l1 l2} in uK^2 (Hajian-Souradeep), shape (n_mode, lmax + 1), of the modes (L, M,
    d), L > 0, M >= 0; M > 0 includes its mirror -M. ``f_sky`` is the observed fraction of the sky, 0 < f_sky <= 1.

    Notes
    -----
    (S/N)^2 = f_sky sum_l2 (2 - delta_M0) |A|^2 / E|A|^2, over the l2 of nonzero variance. Modes with d of both signs of
    one pair share noise (E A_{l1 l2} A*_{l2 l1} is not zero): their sum in quadrature is an approximation;
    :func:`fisher_information` is exact.
    """
    _check_f_sky(f_sky)
    _check_biposh(biposh, (len(modes), len(spectra.x)))
    first, last = (0, biposh.shape[1] - 1) if ell_range is None else ell_range
    if not 0 <= first <= last:
        raise InputError(f"ell_range = {first}, {last} is no range of degrees; give its first and its last one, >= 0.")
    if any(L == 0 for L, _, _ in modes):
        raise InputError("the signal of L=0 is that of C_l, not of an anisotropy; give modes with L >= 1.")
    variance = isotropic_variance(modes, spectra)[:, first : last + 1]
    signal = abs(biposh[:, first : last + 1]) ** 2
    ratio = divided(signal, variance)
    weight = np.array([1.0 if M == 0 else 2.0 for _, M, _ in modes])
    return np.sqrt(f_sky * weight * ratio.sum(axis=1))


def fisher_information(
    biposh: NDArray[np.complex128], modes: Sequence[Indices], cl_total: NDArray[np.float64], f_sky: float = 1.0
) -> float:
    """Return the information 1/2 Tr[C^-1 dC C^-1 dC] of a BipoSH signal in all maps jointly.

    It is 1/variance of the best unbiased estimate of a small amplitude. ``biposh`` holds dA^{LM}_{l1 l2} of every
    ordered pair of maps per unit of the parameter, uK^2, shape (n_map, n_map, n_mode, lmax + 1); the modes (L, M, d)
    have M >= 0 and d >= 0: d < 0 belongs to the exchanged pair, L = 0 is the part of C_l. ``cl_total`` are the total
    spectra and cross-spectra of the maps, uK^2, shape (n_map, n_map, lmax + 1); degrees where this is singular (such as
    l = 0, 1 without power) are left out. Raise InputError if f_sky is outside (0, 1], a mode has M < 0 or d < 0, or a
    spectrum is not finite.

    Notes
    -----
    f_sky sum_{L, M>=0, l1<=l2} (2 - delta_M0)/(1 + delta_l1l2) Tr[C_l1^-1 dA_l1l2 C_l2^-1 dA_l1l2^+], matrices over
    maps. Equal to the trace over an explicit covariance to 1e-12 (tests/unit/test_predict_detectability.py).
    """
    check_modes(modes)
    _check_f_sky(f_sky)
    _check_biposh(biposh, (*cl_total.shape[:2], len(modes), cl_total.shape[-1]))
    for L, M, d in modes:
        if M < 0 or d < 0:
            raise InputError(f"mode L={L}, M={M}, d={d} repeats information of M >= 0, d >= 0; leave it out.")
    n_map, lmax = len(cl_total), cl_total.shape[-1] - 1
    check_shape(cl_total, (n_map, n_map, lmax + 1), "cl_total")
    check_finite(cl_total, "cl_total")
    spectra = np.moveaxis(cl_total, -1, 0)
    inverse = np.zeros_like(spectra)
    diagonal = np.einsum("lxx->lx", spectra)
    usable = np.flatnonzero((diagonal > 0.0).all(axis=1))
    scale = np.sqrt(diagonal[usable])
    correlation = spectra[usable] / (scale[:, :, None] * scale[:, None, :])
    regular = np.linalg.eigvalsh(correlation)[:, 0] > 1e-12
    usable, scale, correlation = usable[regular], scale[regular], correlation[regular]
    inverse[usable] = np.linalg.inv(correlation) / (scale[:, :, None] * scale[:, None, :])
    total = 0.0
    for i, (L, M, d) in enumerate(modes):
        l2 = np.flatnonzero(existing(L, d, lmax))
        signal = np.moveaxis(biposh[:, :, i, l2], -1, 0)
        trace = np.einsum("lab,lbc,lcd,lad->", inverse[l2 - d], signal, inverse[l2], signal.conj(), optimize=True)
        total += (1.0 if M == 0 else 2.0) / (2.0 if d == 0 else 1.0) * float(trace.real)
    return f_sky * total


def _check_f_sky(f_sky: float) -> None:
    if not 0.0 < f_sky <= 1.0:
        raise InputError(f"f_sky = {f_sky} is not a fraction of the sky; give 0 < f_sky <= 1.")


def _check_biposh(biposh: NDArray[np.complex128], shape: tuple[int, ...]) -> None:
    if biposh.shape != shape:
        raise InputError(f"the BipoSH have shape {biposh.shape}, modes and spectra ask for {shape}; give those.")
