"""A detector whose gain depends on what it sees."""

from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Vector
from mcsim.systematics.product import multiplied


@dataclass(frozen=True, kw_only=True)
class Nonlinearity(Effect):
    """The gain rises with the signal: sky and dipole times 1 + amplitude (dipole / largest dipole).

    Attributes
    ----------
    amplitude
        Relative change of the gain from no dipole to its maximum.

    Notes
    -----
    The signal is a (T + D) with T the sky, D = d . n its dipole, d as long as ``sky.dipole_uk``, and a = 1 + amplitude
    D / |d|: the sky is modulated, and a quadrupole amplitude D^2 / |d| appears. T in a, a fiftieth of D, is left out.
    The beam acts afterwards, which is the same where the dipole hardly changes across it.
    """

    name = "nonlinearity"
    scope = "channel"
    unit = "fraction"
    wording = Wording("{} of the gain at the dipole's maximum", " %", 100.0)
    cause = "Analogue-to-digital converters or detectors whose response is curved over the range of the dipole."
    signature = "A quadrupole aligned with the dipole, and the sky modulated along it, the same in both halves."
    source = "Planck 2018 results III, A&A 641, A3 (nonlinearity of converters)"
    step = 2e-4
    bounds = (Bound("amplitude", -0.1, 0.1, "a prior of this library: far beyond any converter in use"),)
    proposed = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Multiply sky and dipole."""
        largest = float(np.linalg.norm(site.dipole_uk))
        if largest == 0.0:
            raise InputError(f"effect {self.name} on channel {site.channel} follows the dipole; give sky.dipole_uk.")
        x, y, z = self.amplitude * site.dipole_uk / largest

        def relative(*where: Vector) -> Vector:
            return x * where[0] + y * where[1] + z * where[2]

        return sky + multiplied(sky + dipole_alm(site.dipole_uk, site.lmax), site.lmax, relative, 1)
