"""The sky as the matter in front of it displaces it."""

from dataclasses import dataclass
from functools import lru_cache

import ducc0
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mcsim.errors import InputError
from mcsim.sphere.sky import gaussian_alm
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization
from mcsim.systematics.spacecraft import axes

EPSILON = 1e-5
"""Accuracy of the interpolation, relative to the sky."""

_ELL = (2, 3, 4, 5, 8, 10, 15, 20, 28, 40, 55, 77, 107, 149, 207, 289, 402, 560, 781, 1088, 1515, 2111, 2940, 4096)
_POWER = (
    "5.0161e-8 6.1053e-8 7.0335e-8 7.8364e-8 9.7046e-8 1.0625e-7 1.2203e-7 1.3115e-7 1.3781e-7 1.3812e-7 1.3133e-7 "
    "1.1691e-7 9.7374e-8 7.5615e-8 5.5523e-8 3.8851e-8 2.6059e-8 1.6396e-8 9.9289e-9 5.8803e-9 3.4270e-9 1.9852e-9 "
    "1.1545e-9 6.7405e-10"
)


@dataclass(frozen=True, kw_only=True)
class Lensing(Effect):
    """The sky T(n + grad phi), phi a Gaussian field whose power is the amplitude times the fiducial one.

    Attributes
    ----------
    amplitude
        A_lens: what the spectrum of the sky, lensed itself or not, lacks; 1 for an unlensed spectrum of our Universe.

    Notes
    -----
    Exact: the sky is read at the ends of the arcs grad phi, from Gauss-Legendre rings that hold its lmax. The mean
    spectrum changes by the known smoothing of peaks, and every realization has the off-diagonal covariance of its own
    phi, the same in all channels. Degrees near lmax lack what comes from beyond. phi is independent of the sky.
    Fiducial power: CAMB 2.0.5 with the parameters ``planck2018`` of workflows/spectra, [l(l+1)]^2 C_l / 2 pi at the
    degrees above, by a cubic spline of the logarithms to 0.2 %; rms deflection 2.45'. Four skies of lmax 1500 had the
    change of C_l that CAMB gives within their scatter, 1e-4 to 5e-4 of C_l in six bins, up to l = 1200. It takes about
    six times as long as a transform of the sky.
    """

    name = "lensing"
    scope = "common"
    unit = "A_lens"
    title = "gravitational lensing"
    wording = Wording("A_lens = {}")
    cause = "The matter between the last scattering and us, left out of the model, or more of it than in the model."
    signature = "Smoother peaks of C_l and every L in a single sky, the same in all channels; from l of about 500 on."
    source = "Lewis & Challinor 2006, Phys. Rep. 429, 1; Planck 2018 results VIII, A&A 641, A8"
    step = 1.0
    bounds = (Bound("amplitude", 0.0, 10.0, "a power, and ten times that of the standard model was excluded long ago"),)
    parametrization = Parametrization(
        sign=1, max_amplitude=10.0, stochastic=True, mean_response=True, matched_filter=False
    )
    proposed = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Lens the sky."""
        if self.amplitude < 0.0:
            raise InputError(f"effect {self.name}: amplitude = {self.amplitude:g} is no power; give 0 or more.")
        return remapped(sky, gaussian_alm(self.amplitude * potential(site.lmax), draw("potential")), site.lmax)


@lru_cache(maxsize=4)
def potential(lmax: int) -> NDArray[np.float64]:
    """Return the fiducial power spectrum of the lensing potential, l = 0 ... lmax; zero below 2 and above 4096."""
    ell, last = np.arange(lmax + 1.0), _ELL[-1]
    spline = CubicSpline(np.log(_ELL), np.log([float(value) for value in _POWER.split()]))
    known = (ell >= 2.0) & (ell <= last)
    found = np.zeros(lmax + 1)
    found[known] = 2.0 * np.pi * np.exp(spline(np.log(ell[known]))) / (ell[known] * (ell[known] + 1.0)) ** 2
    return found


def remapped(sky: Alm, phi: Alm, lmax: int) -> Alm:
    """Return the coefficients, up to ``lmax``, of a sky read at n + grad phi along great circles."""
    rings, columns = lmax + 1, 2 * lmax + 2
    colatitude = np.asarray(ducc0.misc.GL_thetas(rings))
    grid = {
        "theta": colatitude,
        "nphi": np.full(rings, columns, dtype=np.uint64),
        "phi0": np.zeros(rings),
        "ringstart": columns * np.arange(rings, dtype=np.uint64),
    }
    south, east = ducc0.sht.synthesis_deriv1(alm=phi[None], lmax=lmax, nthreads=1, **grid)
    theta, along = np.repeat(colatitude, columns), np.tile(2.0 * np.pi * np.arange(columns) / columns, rings)
    length = np.hypot(south, east)
    outward, e_theta, e_phi = axes(theta, along)
    # sinc(t / pi) = sin(t) / t
    end = np.cos(length) * outward + np.sinc(length / np.pi) * (south * e_theta + east * e_phi)
    where = np.stack([np.arctan2(np.hypot(end[0], end[1]), end[2]), np.arctan2(end[1], end[0]) % (2.0 * np.pi)], axis=1)
    seen = ducc0.sht.synthesis_general(alm=sky[None], lmax=lmax, spin=0, loc=where, epsilon=EPSILON, nthreads=1)
    values = seen.reshape(1, rings, columns)
    return np.asarray(ducc0.sht.analysis_2d(map=values, lmax=lmax, spin=0, geometry="GL", nthreads=1)[0])
