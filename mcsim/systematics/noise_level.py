"""More noise than in the model."""

from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.systematics.base import Bound, Effect, Map, Site, Wording
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class NoiseLevel(Effect):
    """Noise per sample sigma0 (1 + amplitude): a fraction of the standard deviation, not of the variance."""

    name = "noise_level"
    scope = "channel"
    unit = "fraction of sigma0"
    wording = Wording("{} more noise", " %", 100.0, negative="{} less noise")
    cause = "Noise estimated on other data, or a gain that is not the fiducial one."
    signature = "Autos only, flat in l, as the hits."
    source = "Jarosik et al. 2011, ApJS 192, 14 (sigma0 per channel, and its error)"
    step = 0.01
    bounds = (Bound("amplitude", -0.9, 3.0, "a prior of this library: noise is known to a factor of four"),)
    parametrization = Parametrization(matched_filter=False)

    def noise(self, site: Site) -> Map | None:
        """Return the same factor everywhere."""
        if self.amplitude == 0.0:
            return None
        if self.amplitude <= -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} leaves less than no noise; keep it above -1."
            )
        return np.full(12 * site.nside**2, (1.0 + self.amplitude) ** 2)
