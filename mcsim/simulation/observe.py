"""The map that a beam makes of one sky under a scan: coefficients in, pixels out."""

import healpy
import numpy as np
from numpy.typing import ArrayLike

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments
from mcsim.instrument.scan.files import check_moments
from mcsim.simulation import convolve
from mcsim.simulation.offsets import expansion, offset_maps
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_whole
from mcsim.support.arrays import Map


def observe(
    alm: ArrayLike, beam: Beam, moments: Moments, *, pixel_window: bool | None = None, nthreads: int = 1
) -> Map:
    """Return the map of a sky seen by a beam under a scan.

    Parameters
    ----------
    alm
        Coefficients of the sky in healpy's m-major order, uK, shape ((lmax + 1)(lmax + 2)/2,), in the frame of the
        moments.
    beam
        Known up to at least the lmax of the sky.
    moments
        Of the scan, up to at least the beam's mmax.
    pixel_window
        Whether samples spread over the pixels: the map is then smoothed by the pixel window. ``None``: where the
        moments have centroids (``dtheta``, ``dphi``), that is where they are of samples and not of pixels' centres.
        Moments of offsets beyond the mean (``offset_moments``) bring their own.
    nthreads
        Threads of the transforms.

    Returns
    -------
    ndarray
        RING order, uK, shape (12 nside^2,); ``healpy.UNSEEN`` in pixels without a hit.

    Raises
    ------
    InputError
        If the coefficients are not those of a whole sky or not finite, or the beam or the moments end too early.

    Notes
    -----
    T(n) = S_0(n) + 2 Re sum_{s > 0} w_s(n) S_s(n) + d(n) . grad S_0(n), with S_s(n) = sum_lm k_l a_lm b_ls sY_lm(n),
    k_l = sqrt(4 pi/(2l + 1)), the moments w_s and the centroids d, where known (arXiv:1210.7318, Sec. III). It is the
    mean of the samples that ``ducc0.totalconvolve`` gives one by one, to 1e-12 of the map without pixel window and
    centroids (tests/unit/test_public_api.py). With ``offset_moments`` the gradient term becomes the first of a series
    in the samples' offsets (:mod:`mcsim.simulation.offsets`).

    Examples
    --------
    >>> import numpy as np
    >>> import mcsim
    >>> alm = np.zeros(33 * 34 // 2, dtype=complex)
    >>> alm[2] = 10.0  # a_20, in uK
    >>> beam = mcsim.Beam.elliptical(600.0, 400.0, lmax=32)
    >>> moments = mcsim.Moments.parallel_transport(nside=16, psi0_deg=30.0)
    >>> mcsim.observe(alm, beam, moments).shape
    (3072,)
    """
    sky, lmax = alm_.whole(alm, "alm")
    for given, kind, name in ((beam, Beam, "beam"), (moments, Moments, "moments")):
        if not isinstance(given, kind):
            raise InputError(f"{name} is a {type(given).__name__}; give a mcsim.{kind.__name__}.")
    if not isinstance(pixel_window, bool | np.bool_ | None):
        raise InputError(f"pixel_window is {pixel_window!r}; give True, False or None.")
    check_whole(nthreads, "nthreads")
    beam.check_normalised()
    check_moments(moments, "the moments")
    if moments.smax < beam.mmax:
        raise InputError(
            f"the moments end at s = {moments.smax}, the beam at m = {beam.mmax}; compute moments with "
            f"smax={beam.mmax}, or cut the beam with truncated({moments.smax})."
        )
    nside = moments.nside
    spread = moments.dtheta is not None if pixel_window is None else pixel_window
    response = convolve.response(beam, lmax, healpix.pixel_window(nside, lmax) if spread else None)
    circular = convolve.circular_alm(sky, response)
    terms = expansion(nside, lmax, moments.offset_order) if moments.offset_order > 1 and spread else None
    if terms is not None:
        bare = convolve.circular_alm(sky, convolve.response(beam, lmax))
        circular = alm_.multiply(bare, terms.smooth, lmax)
    total = healpix.synthesis(circular[None], nside, lmax, nthreads=nthreads)[0]
    if terms is not None:
        total = total + offset_maps(bare, terms, [moments], nthreads)[0]
    elif moments.dtheta is not None:
        total = total + convolve.centroid_map(healpix.gradient(circular, nside, lmax, nthreads), moments)
    if spins := convolve.spin_maps(sky, response, nside, nthreads):
        total = total + convolve.noncircular_map(spins, moments)
    return np.where(moments.hits > 0, total, healpy.UNSEEN)
