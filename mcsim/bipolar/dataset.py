"""BipoSH and power spectra of given maps as a labelled dataset."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from mcsim.bipolar.estimation import estimate, estimator, power_spectrum
from mcsim.bipolar.modes import CONVENTION, NORMALISATION
from mcsim.errors import InputError
from mcsim.sphere import alm as alm_


def biposh(alm: ArrayLike, alm2: ArrayLike | None = None, L_max: int = 2) -> xr.Dataset:
    """Return the BipoSH coefficients and the power spectrum of one map, or of an ordered pair of maps.

    Parameters
    ----------
    alm
        Coefficients in healpy's m-major order, uK, shape ((lmax + 1)(lmax + 2)/2,).
    alm2
        Coefficients of a second map up to the same lmax: ``alm`` then carries l1 and ``alm2`` carries l2. ``None``: the
        same map twice.
    L_max
        Largest bipolar degree L, 0 to lmax.

    Returns
    -------
    xarray.Dataset
        ``biposh`` (mode, ell), complex, uK^2, at ell = l2, NaN where a coefficient does not exist; ``cl`` (ell), uK^2.
        Coordinates ``mode`` ("L2M0d0"), ``L``, ``M``, ``d`` = l2 - l1 and ``parity``, as in the store of an ensemble:
        M >= 0, and 0 <= d <= L for one map, -L <= d <= L for a pair. Attributes state the conventions.

    Raises
    ------
    InputError
        If the coefficients are incomplete, not finite or of different lmax, or L_max is out of range.

    Notes
    -----
    The Hajian-Souradeep normalisation; :func:`mcsim.bipolar.bennett_factor` leads to that of Bennett et al. (WMAP).
    Under isotropy and L > 0, E|A|^2 = C_l1 C_l2 (1 + delta_l1l2) for one map. Agrees with an explicit sum over exact
    Clebsch-Gordan coefficients to 1e-13 (tests/unit/test_biposh.py).

    Examples
    --------
    >>> import numpy as np
    >>> import mcsim
    >>> rng = np.random.default_rng(1)
    >>> alm = rng.standard_normal(33 * 34 // 2) + 0j  # a made-up sky up to l = 32
    >>> result = mcsim.biposh(alm, L_max=2)
    >>> result.biposh.sel(mode="L2M0d0").dims
    ('ell',)
    >>> L0 = result.biposh.sel(mode="L0M0d0")  # (-1)^l sqrt(2l + 1) C_l
    >>> bool(np.allclose(abs(L0), np.sqrt(2 * result.ell + 1) * result.cl))
    True
    """
    x, lmax = alm_.whole(alm, "alm")
    y, lmax2 = (x, lmax) if alm2 is None else alm_.whole(alm2, "alm2")
    if lmax2 != lmax:
        raise InputError(f"alm has lmax = {lmax}, alm2 has lmax = {lmax2}; give both up to the same lmax.")
    tables = estimator(L_max, lmax, both_orders=alm2 is not None)
    found = tables.modes
    numbers = {"L": "bipolar degree", "M": "bipolar order", "d": "l2 - l1", "parity": "parity of l1 + l2 + L"}
    labels = {
        key: ("mode", [getattr(mode, key) for mode in found], {"long_name": text}) for key, text in numbers.items()
    }
    labels["mode"] = ("mode", [mode.name for mode in found], {"long_name": "BipoSH mode"})
    result = xr.Dataset(
        {
            "biposh": (("mode", "ell"), estimate(tables, x, None if alm2 is None else y)),
            "cl": ("ell", power_spectrum(x, y, lmax)),
        },
        coords={"ell": ("ell", np.arange(lmax + 1), {"long_name": "degree l2"}), **labels},
        attrs={"biposh": CONVENTION, "normalisation": NORMALISATION, "alm": "healpy m-major order", "lmax": lmax},
    )
    for name in ("ell", "L", "M", "d"):
        result[name].attrs["units"] = "1"
    result["biposh"].attrs |= {"units": "uK^2", "long_name": "BipoSH coefficient A^{LM}_{l2-d,l2} at ell = l2"}
    result["cl"].attrs |= {"units": "uK^2", "long_name": "power spectrum C_l"}
    return result
