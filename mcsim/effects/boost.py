"""Our motion: aberration and modulation of the sky."""

from dataclasses import dataclass

import numpy as np

from mcsim import alm as alm_
from mcsim.effects.base import Alm, Draw, Site
from mcsim.effects.product import multiplied
from mcsim.effects.vectors import DirectedEffect
from mcsim.errors import InputError

FARTHEST = 2.0
"""Largest l beta: beyond it the change of the smallest scales is larger than they are themselves."""


@dataclass(frozen=True, kw_only=True)
class Boost(DirectedEffect):
    """The sky as an observer of velocity beta sees it: (1 + beta . n) T(n - grad(beta . n)), to first order.

    Attributes
    ----------
    amplitude
        Length of beta; ours is 1.23e-3.
    lon_deg, lat_deg
        Its direction in the frame of the maps.

    Notes
    -----
    To first order T + f T - grad f . grad T with f = beta . n, and since Laplacian f = -2 f,
    2 grad f . grad T = Laplacian(f T) - f Laplacian T + 2 f T: the change is half of l(l+1) (f T)_lm less
    (f l'(l'+1) T)_lm, two products and no gradient. The dipole that the boost makes of the monopole is not in it: that
    is ``sky.dipole_uk``. First order means l beta well below one: at our beta and l = 1000 the change is as large as
    the sky, and more orders are needed.
    """

    name = "boost"
    scope = "common"
    unit = "v/c"
    cause = "The Solar System moves against the cosmic background."
    signature = "L = 1, d = 1, growing as l: to be seen from l of about 1000 on."
    source = "Challinor & van Leeuwen 2002, Phys. Rev. D 65, 103001; Planck 2013 results XXVII"
    step = 1e-4
    own_score = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Boosted."""
        if self.amplitude == 0.0:
            return sky
        if abs(self.amplitude) * site.lmax > FARTHEST:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} moves the sky by more than {FARTHEST:g} / l at "
                f"l = {site.lmax}, which first order cannot say; choose at most {FARTHEST / site.lmax:.3g}."
            )
        a, b, c = self.coordinates()
        ell = np.arange(site.lmax + 1)
        squared = ell * (ell + 1.0)

        def projected(alm: Alm) -> Alm:
            return multiplied(alm, site.lmax, lambda x, y, z: a * x + b * y + c * z, 1)

        change = alm_.multiply(projected(sky), squared, site.lmax)
        change -= projected(alm_.multiply(sky, squared, site.lmax))
        return sky + 0.5 * change
