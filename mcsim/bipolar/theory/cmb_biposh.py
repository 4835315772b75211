"""Mean CMB BipoSH to leading order in the non-circular part of the beam, and those of uneven white noise."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar.modes import Indices, bennett_factor, check_modes, existing
from mcsim.bipolar.theory.beam_biposh import ScannedBeam, beam_biposh
from mcsim.sphere.checks import check_cl, check_shape, check_whole


def cmb_biposh_leading(
    modes: Sequence[Indices],
    cl: NDArray[np.float64],
    lmax: int,
    x: ScannedBeam,
    y: ScannedBeam | None = None,
) -> NDArray[np.complex128]:
    """Return the mean A^{LM}_{l1 l2} of one map, or of the ordered pair X, Y, to leading order.

    Parameters
    ----------
    modes
        (L, M, d) each, with |M|, |d| <= L.
    cl
        C_l of the sky without beam, uK^2, shape (> lmax,).
    lmax
        Highest l1 and l2.
    x, y
        Beams and scans of a_{l1 m1} and of a_{l2 m2}; ``y`` is ``x`` by default.

    Returns
    -------
    ndarray
        uK^2, Hajian-Souradeep normalisation, shape (n_mode, lmax + 1), at ell = l2; NaN where the mode does not exist.

    Raises
    ------
    InputError
        If a mode cannot exist, or the spectrum ends below lmax.

    Notes
    -----
    For L > 0, A = (-1)^{l2} [C_{l2} B^{00,Y}_{l2 l2} B^{LM,X}_{l1 l2}/sqrt(2 l2+1) + (-1)^L C_{l1} B^{00,X}_{l1 l1}
    B^{LM,Y}_{l2 l1}/sqrt(2 l1+1)] (arXiv:1210.7318, eqs. WMAP1 and WMAP2 generalised); for L = 0 the circular spectrum
    (-1)^l sqrt(2l+1) C_l B^X_l B^Y_l. The error is of second order in b_ls: halving b_l2 quarters it
    (tests/unit/test_predict_brute_force.py); :func:`mcsim.bipolar.theory.cmb_biposh_exact` includes it.
    """
    check_modes(modes)
    check_cl(cl, lmax)
    y = x if y is None else y
    for beam in (x, y):
        beam.check(lmax)
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


def noise_biposh(modes: Sequence[Indices], variance: NDArray[np.complex128], lmax: int) -> NDArray[np.complex128]:
    """Return the mean A^{LM}_{l1 l2} of white noise of uneven variance.

    Parameters
    ----------
    modes
        (L, M, d) each.
    variance
        Coefficients v_LM, any M, of (pixel variance) x (pixel area) in uK^2 sr, shape (L_max + 1, 2 L_max + 1),
        ``variance[L, L_max + M]``.
    lmax
        Highest l1 and l2.

    Returns
    -------
    ndarray
        uK^2, shape (n_mode, lmax + 1), zero for odd parity, NaN where the mode does not exist.

    Notes
    -----
    A^{LM}_{l1 l2} = v_LM sqrt((2 l1+1)(2 l2+1)/(4pi (2L+1))) C^{L0}_{l1 0 l2 0}: in the Bennett normalisation
    v_LM/sqrt(4pi), for every l. It follows from int Y* Y V, without the convolution
    (tests/unit/test_predict_cmb_biposh.py compares with an explicit sum).
    """
    check_modes(modes)
    check_whole(lmax, "lmax")
    L_max = len(variance) - 1
    check_shape(variance, (L_max + 1, 2 * L_max + 1), "the variance")
    result = np.full((len(modes), lmax + 1), np.nan, dtype=np.complex128)
    for row, (L, M, d) in zip(result, modes, strict=True):
        v = variance[L, L_max + M] if L_max >= L else 0.0
        exists = existing(L, d, lmax)
        row[exists] = v / np.sqrt(4 * np.pi) / bennett_factor((L, M, d), lmax)[exists] if (L + d) % 2 == 0 else 0.0
    return result
