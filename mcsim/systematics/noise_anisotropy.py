"""Noise that is stronger at the ecliptic poles, or at the equator, than in the model."""

from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_complete
from mcsim.sphere.rotation import rotation_matrix
from mcsim.systematics.base import Bound, Effect, Map, Site, Wording


@dataclass(frozen=True, kw_only=True)
class NoiseAnisotropy(Effect):
    """Variance of the samples times 1 + amplitude t, t = 3 z^2 - 1 with z the sine of ecliptic latitude in every frame.

    Attributes
    ----------
    amplitude
        a.
    template
        Path of a HEALPix map to be taken for t; its frame is what its header says, or that of the maps.
    """

    name = "noise_anisotropy"
    scope = "channel"
    unit = "fraction of the variance"
    wording = Wording("{} of the variance", " %", 100.0)
    cause = "Hits that are not those of the survey, flagged or lost samples, or noise that varies through the year."
    signature = "Autos only, L = 2, M = 0 of the ecliptic frame; the variance map of half differences."
    source = "The pattern is the lowest one that a scan symmetric about the ecliptic makes"
    step = 0.05
    bounds = (Bound("amplitude", -0.5, 1.0, "no variance is negative, the pattern being from -1 to 2"),)

    template: str = ""

    def noise(self, site: Site) -> Map | None:
        """Return 1 + a t."""
        if self.amplitude == 0.0:
            return None
        centres = np.stack(healpy.pix2vec(site.nside, np.arange(12 * site.nside**2)))
        if self.template:
            pattern = _of_file(self.template, site.frame, centres)
        else:
            pattern = 3.0 * (rotation_matrix(site.frame, "ecliptic")[2] @ centres) ** 2 - 1.0
        factor = 1.0 + self.amplitude * pattern
        if factor.min() < 0.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} makes a variance negative, with a pattern from "
                f"{pattern.min():.3g} to {pattern.max():.3g}; choose a smaller one."
            )
        return np.asarray(factor)


def _of_file(path: str, frame: str, centres: NDArray[np.float64]) -> Map:
    """Return a template at these directions in ``frame``."""
    values, found, _ = healpix.read_map(Path(path))
    check_complete(values, path)
    seen = rotation_matrix(frame, found or frame) @ centres
    return np.asarray(values[healpy.vec2pix(healpy.npix2nside(values.size), *seen)])
