"""A monopole that was not taken off."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class MonopoleResidual(Effect):
    """A constant is added to the channel; it shows where a mask or uneven weights mix it with other degrees."""

    name = "monopole_residual"
    scope = "channel"
    unit = "uK"
    title = "residual monopole"
    wording = Wording("{}", " µK")
    cause = "Zero level of the maps, which differential instruments and destriped maps leave free."
    signature = "l = 0; behind a mask in the lowest degrees of this channel, the same in both halves."
    source = "Bennett et al. 2003, ApJS 148, 97 (zero levels); Eriksen et al. arXiv:0709.1037 (offsets left)"
    step = 0.5
    bounds = (Bound("amplitude", -2.7e6, 2.7e6, "less than the temperature of the sky, 2.7 K"),)
    parametrization = Parametrization(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the constant."""
        changed = sky.copy()
        changed[0] += np.sqrt(4.0 * np.pi) * self.amplitude
        return changed
