"""A sky with more power along some axes."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Components, Vector
from mcsim.systematics.product import multiplied


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
    bounds = (Bound("amplitude", 0.0, 1.0, "beyond it the signal changes sign in a part of the sky"),)
    parametrization = Components(parameter="components", count=5, matched_filter=False)

    components: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Modulate the sky."""
        q = self.along("components")

        def field(x: Vector, y: Vector, z: Vector) -> Vector:
            root = np.sqrt(3.0)
            diagonal = q[0] * 0.5 * (3.0 * z**2 - 1.0) + q[3] * 0.5 * root * (x**2 - y**2)
            return np.asarray(diagonal + root * (q[1] * x * z + q[2] * y * z + q[4] * x * y))

        return sky + multiplied(sky, site.lmax, field, 2)
