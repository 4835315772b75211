"""Our motion: aberration and modulation of the sky."""

from dataclasses import dataclass
from functools import lru_cache

import ducc0
import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import expm_multiply

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.systematics.base import Alm, Bound, DirectedEffect, Draw, Site, Wording
from mcsim.systematics.parametrization import SkyVector


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
        """Boost the sky."""
        if abs(self.amplitude) >= 1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} is not slower than light; keep it within +-1."
            )
        colatitude, longitude = np.deg2rad([90.0 - self.lat_deg, self.lon_deg])
        turned = ducc0.sht.rotate_alm(sky, site.lmax, -longitude, -colatitude, 0.0, nthreads=1)
        boosted = expm_multiply(np.arctanh(self.amplitude) * _generator(site.lmax), turned, traceA=0.0)
        return np.asarray(ducc0.sht.rotate_alm(boosted, site.lmax, 0.0, colatitude, longitude, nthreads=1))


@lru_cache(maxsize=2)
def _generator(lmax: int) -> csr_array:
    """G for a motion towards the pole: it leaves m, which neighbours in healpy's order share, but for A_mm = 0."""
    ell, m = alm_.degrees(lmax), alm_.orders(lmax)
    risen = ell * np.sqrt((ell**2 - m**2) / (4.0 * ell**2 - 1.0))
    return csr_array(diags_array([risen[1:], -risen[1:]], offsets=[-1, 1]))
