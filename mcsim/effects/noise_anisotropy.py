"""Noise that is stronger at the ecliptic poles, or at the equator, than believed."""

from dataclasses import dataclass

import healpy
import numpy as np

from mcsim.effects.base import Effect, Map, Site
from mcsim.errors import InputError
from mcsim.rotation import rotation_matrix


@dataclass(frozen=True, kw_only=True)
class NoiseAnisotropy(Effect):
    """Variance of the samples times 1 + amplitude (3 z^2 - 1), z the sine of ecliptic latitude in every frame."""

    name = "noise_anisotropy"
    scope = "channel"
    unit = "fraction of the variance"
    cause = "Hits that are not those of the survey, flagged or lost samples, or noise that varies through the year."
    signature = "Autos only, L = 2, M = 0 of the ecliptic frame; the variance map of half differences."
    source = "The pattern is the lowest one that a scan symmetric about the ecliptic makes"
    step = 0.05

    def noise(self, site: Site) -> Map | None:
        """1 + a (3 z^2 - 1)."""
        if self.amplitude == 0.0:
            return None
        if not -0.5 < self.amplitude <= 1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} makes a variance negative; "
                "it must lie above -0.5 and be at most 1."
            )
        centres = np.stack(healpy.pix2vec(site.nside, np.arange(12 * site.nside**2)))
        height = rotation_matrix(site.frame, "ecliptic")[2] @ centres
        return np.asarray(1.0 + self.amplitude * (3.0 * height**2 - 1.0))
