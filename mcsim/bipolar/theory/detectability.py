"""Detectability of a BipoSH signal: variances under isotropy, signal to noise and Fisher information."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Indices, check_modes, existing
from mcsim.errors import InputError
from mcsim.sphere.checks import check_cl, check_shape
from mcsim.support.arrays import divided


class Spectra(NamedTuple):
    """Total power spectra of a map X, or of a pair X, Y: beam^2 signal + noise, uK^2, shape (lmax + 1,).

    ``cross`` is C_l^{XY}; for one map leave out ``y`` and ``cross``.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64] | None = None
    cross: NDArray[np.float64] | None = None


def isotropic_variance(modes: Sequence[Indices], spectra: Spectra) -> NDArray[np.float64]:
    """Return E|A^{LM}_{l1 l2}|^2 of an isotropic sky for modes (L, M, d), L > 0, of a map or a pair.

    In uK^4, shape (n_mode, lmax + 1), NaN where the mode does not exist.

    Notes
    -----
    C^XX_l1 C^YY_l2 + (-1)^L delta_{l1 l2} (C^XY_l)^2; for one map C_l1 C_l2 (1 + delta_{l1 l2}), L even where l1 = l2.
    Zero where it is less than 1e-12 of its first term.
    """
    check_modes(modes)
    if any(L == 0 for L, _, _ in modes):
        raise InputError("the variance of L=0 is that of C_l, not of an anisotropy; give modes with L >= 1.")
    x = spectra.x
    lmax = len(x) - 1
    y, cross = (x, x) if spectra.y is None else (spectra.y, spectra.cross)
    if cross is None:
        raise InputError("the cross spectrum of the two maps is missing; give cross with y.")
    for name, cl in (("x", x), ("y", y), ("cross", cross)):
        check_cl(cl, lmax, name, cross=name == "cross")
        check_shape(cl, (lmax + 1,), name)
    variance = np.full((len(modes), lmax + 1), np.nan)
    for row, (L, _, d) in zip(variance, modes, strict=True):
        l2 = np.flatnonzero(existing(L, d, lmax))
        product = x[l2 - d] * y[l2]
        row[l2] = product + ((-1) ** L * cross[l2] ** 2 if d == 0 else 0.0)
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
    variance = isotropic_variance(modes, spectra)[:, first : last + 1]
    signal = abs(biposh[:, first : last + 1]) ** 2
    ratio = divided(signal, variance)
    weight = np.array([1.0 if M == 0 else 2.0 for _, M, _ in modes])
    return np.sqrt(f_sky * weight * ratio.sum(axis=1))


def fisher_information(
    biposh: NDArray[np.complex128],
    modes: Sequence[Indices],
    cl_total: NDArray[np.float64],
    f_sky: float = 1.0,
) -> float:
    """Return the information 1/2 Tr[C^-1 dC C^-1 dC] of a BipoSH signal in all maps jointly.

    It is 1/variance of the best unbiased estimate of a small amplitude. ``biposh`` holds dA^{LM}_{l1 l2} of every
    ordered pair of maps per unit of the parameter, uK^2, shape (n_map, n_map, n_mode, lmax + 1); the modes (L, M, d)
    have M >= 0 and d >= 0: d < 0 belongs to the exchanged pair, L = 0 is the part of C_l. ``cl_total`` are the total
    spectra and cross-spectra of the maps, uK^2, shape (n_map, n_map, lmax + 1); degrees where this is singular (such as
    l = 0, 1 without power) are left out. Raise InputError if f_sky is outside (0, 1], or a mode has M < 0 or d < 0.

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
