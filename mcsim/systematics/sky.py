"""Departures of the sky itself, the same in all channels: another spectrum, lensing, motion, modulations."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import ducc0
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import expm_multiply

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.systematics.base import Alm, Bound, DirectedEffect, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Components, Parametrization, SkyVector, Vector
from mcsim.systematics.product import multiplied
from mcsim.systematics.spacecraft import axes

BANDS = 6

LEAST = -0.99
"""Smallest change of a band that is fitted: an error larger than the power itself asks for less than none."""


KNOWN = 0.25  #: error of a band up to which the data constrain its power
DETECTED = 3.0  #: standard errors by which a band that is constrained worse has to change to be fitted all the same


def band_edges(lmax: int) -> Vector:
    """Return the first degrees of all bands but the first, shape (BANDS - 1,), of a sky that ends at ``lmax``."""
    return np.asarray(2 + np.arange(1, BANDS) * (lmax - 1) // BANDS)


@dataclass(frozen=True, kw_only=True)
class _Bands(Components):
    """Fit the fractional changes of the bands."""

    def constrained(self, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Set bands to zero that are neither constrained nor detected, such as those beyond the analysed degrees."""
        errors = np.sqrt(np.diag(np.linalg.pinv(precision)))
        silent = (errors > KNOWN) & (np.abs(coordinates) < DETECTED * errors)
        found = np.where(silent, 0.0, coordinates)
        rows = np.flatnonzero(~silent)
        shift = precision[np.ix_(rows, np.flatnonzero(silent))] @ coordinates[silent]
        found[rows] += np.linalg.lstsq(precision[np.ix_(rows, rows)], shift, rcond=None)[0]
        return found

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return norm and direction, of what leaves every band some power."""
        if np.min(coordinates) < LEAST:
            values, vectors = np.linalg.eigh(precision)
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
            coordinates = lsq_linear(root, root @ coordinates, bounds=(LEAST, np.inf)).x
        return super().nearest(coordinates, precision)


@dataclass(frozen=True, kw_only=True)
class Spectrum(Effect):
    """C_l times one plus the change of its band, in every channel.

    Attributes
    ----------
    amplitude
        Norm of the fractional changes of all bands.
    bands
        Their direction (its length does not matter): six bands of equal width from l = 2 to the sky's lmax, the
        first numbers of which are 2 + i (lmax - 1) // 6.
    """

    name = "spectrum"
    scope = "common"
    unit = "fraction of C_l"
    title = "power spectrum of the sky"
    wording = Wording("{} of C_ℓ", " %", 100.0)
    cause = "A cosmology that is not the one of the simulations."
    signature = "L = 0, every channel alike."
    source = "Follows from the definition"
    step = 0.02
    bounds = (
        Bound("amplitude", 0.0, 3.0, "a prior of this library: no band has more than about three times its power"),
    )
    parametrization = _Bands(parameter="bands", count=BANDS, mean_response=True, matched_filter=False)

    bands: tuple[float, ...] = (1.0,) * BANDS

    def direction(self) -> str:
        """Say which band has more or less, if one alone changes."""
        changed = np.flatnonzero(self.bands)
        if len(changed) != 1:
            return "(norm over bands)"
        band = int(changed[0])
        more = self.amplitude * self.bands[band] > 0.0
        return f"{'more' if more else 'less'}, in band {band + 1} of {BANDS}"

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Rescale the bands by the square roots of their changes in power."""
        change = self.along("bands")
        if np.min(change) < -1.0:
            raise InputError(
                f"effect {self.name}: a band changes by {np.min(change):g}, leaving negative power; keep it above -1."
            )
        ell = np.arange(site.lmax + 1)
        factor = np.sqrt(1.0 + change[np.searchsorted(band_edges(site.lmax), ell, side="right")])
        factor[:2] = 1.0
        return alm_.multiply(sky, factor, site.lmax)


EPSILON = 1e-5  #: accuracy of the interpolation, relative to the sky

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
    phi, the same in all channels. Degrees near lmax lack what comes from beyond, and have what leaves
    there folded back: with lmax 800, 1 % of C_l at the last degree and 0.3 % at 720. phi is independent of the sky.
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


@dataclass(frozen=True, kw_only=True)
class Boost(DirectedEffect):
    """The sky as an observer of velocity beta sees it: T(n) / (gamma (1 - beta . n')) in the direction n' of n.

    Notes
    -----
    The amplitude is the length of beta, for us 1.23e-3; its direction is in the frame of the maps.
    Boosts along one axis are a group in the rapidity eta = artanh beta, and a temperature has the weight for which
    they are unitary: T' = exp(eta G) T, with G T = f T - grad f . grad T and f = the axis . n. With the axis at the
    pole, G takes a_lm to (l + 1) A_{l+1,m} at l + 1 and to -l A_lm at l - 1, A_lm^2 = (l^2 - m^2)/(4 l^2 - 1): exact to
    all orders, but for the l beta highest degrees, that lack what comes from beyond lmax. No power is lost or made.
    The dipole that the boost makes of the monopole is not in it: that is ``sky.dipole_uk``.
    """

    name = "boost"
    scope = "common"
    unit = "v/c"
    title = "Doppler boost"
    wording = Wording("v/c = {}")
    cause = "The Solar System moves against the cosmic background."
    signature = "L = 1, d = 1, growing as l: to be seen from l of about 1000 on."
    source = "Challinor & van Leeuwen 2002, Phys. Rev. D 65, 103001; Planck 2013 results XXVII, A&A 571, A27"
    step = 1e-4
    bounds = (Bound("amplitude", 0.0, 0.01, "a prior of this library: eight times our velocity, v/c = 1.23e-3"),)
    parametrization = SkyVector(max_amplitude=0.01, mean_response=True, matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        if abs(self.amplitude) >= 1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} is not slower than light; keep it within +-1."
            )
        colatitude, longitude = np.deg2rad([90.0 - self.lat_deg, self.lon_deg])
        return boosted(sky, site.lmax, np.arctanh(self.amplitude), colatitude, longitude)


def boosted(sky: Alm, lmax: int, rapidity: float, colatitude: float, longitude: float) -> Alm:
    """Return the a_lm of a sky in the frame of an observer who moves towards these angles, rad, with any rapidity."""
    turned = ducc0.sht.rotate_alm(sky, lmax, -longitude, -colatitude, 0.0, nthreads=1)
    moved = expm_multiply(rapidity * _generator(lmax), turned, traceA=0.0)
    return np.asarray(ducc0.sht.rotate_alm(moved, lmax, 0.0, colatitude, longitude, nthreads=1))


@lru_cache(maxsize=2)
def _generator(lmax: int) -> csr_array:
    """G for a motion towards the pole: it leaves m, which neighbours in healpy's order share, but for A_mm = 0."""
    ell, m = alm_.degrees(lmax), alm_.orders(lmax)
    risen = ell * np.sqrt((ell**2 - m**2) / (4.0 * ell**2 - 1.0))
    return csr_array(diags_array([risen[1:], -risen[1:]], offsets=[-1, 1]))


LARGEST_MODULATION = 0.35
"""Five times the asymmetry of Planck's maps (Planck 2018 results VII, A&A 641, A7)."""

_STRONG = "a prior of this library: five times the asymmetry of Planck's maps"


@dataclass(frozen=True, kw_only=True)
class DipoleModulation(DirectedEffect):
    """The sky times 1 + A . n, in every channel."""

    name = "dipole_modulation"
    scope = "common"
    unit = "fraction"
    title = "dipole modulation of the sky"
    wording = Wording("{} of the signal", " %", 100.0)
    cause = "A sky that is not statistically isotropic: a hemispherical power asymmetry."
    signature = "L = 1, d = 1, the same in every channel and split, at all l."
    source = "Gordon et al. 2005, Phys. Rev. D 72, 103002"
    step = 0.01
    bounds = (Bound("amplitude", 0.0, LARGEST_MODULATION, _STRONG),)
    parametrization = SkyVector(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        a, b, c = self.vector
        return sky + multiplied(sky, site.lmax, lambda x, y, z: a * x + b * y + c * z, 1)


@dataclass(frozen=True, kw_only=True)
class QuadrupoleModulation(Effect):
    """The sky times 1 + Q(n), in every channel.

    Attributes
    ----------
    amplitude
        Norm of Q: its root mean square over the sky is amplitude / sqrt(5).
    components
        Direction of Q (its length does not matter) in the basis (3z^2 - 1)/2, sqrt(3) xz, sqrt(3) yz,
        sqrt(3)/2 (x^2 - y^2), sqrt(3) xy of n = (x, y, z) in the frame of the maps, each of mean square 1/5.
    """

    name = "quadrupole_modulation"
    scope = "common"
    unit = "fraction"
    title = "quadrupole modulation of the sky"
    wording = Wording("{} of the signal", " %", 100.0)
    cause = "A sky that is not statistically isotropic: a preferred axis, as of an anisotropic early expansion."
    signature = "L = 2, the same in every channel and split: nearly degenerate with m = 2 in one channel."
    source = "Ackerman, Carroll & Wise 2007, Phys. Rev. D 75, 083502, with a modulation of the sky in place of P(k)"
    step = 0.01
    bounds = (Bound("amplitude", 0.0, LARGEST_MODULATION, _STRONG),)
    parametrization = Components(parameter="components", count=5, matched_filter=False)

    components: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        q = self.along("components")

        def field(x: Vector, y: Vector, z: Vector) -> Vector:
            root = np.sqrt(3.0)
            diagonal = q[0] * 0.5 * (3.0 * z**2 - 1.0) + q[3] * 0.5 * root * (x**2 - y**2)
            return np.asarray(diagonal + root * (q[1] * x * z + q[2] * y * z + q[4] * x * y))

        return sky + multiplied(sky, site.lmax, field, 2)
