"""Samples that stand at the centres of their pixels, unlike those of the model."""

from dataclasses import dataclass

from mcsim.systematics.base import Bound, Effect, Wording
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class Pixelization(Effect):
    """The samples' offsets from the pixels' centres shrunk to 1 - amplitude; at 1 all stand at the centres.

    Notes
    -----
    The pixel window and the gradient along the mean offset, which the fiducial model has, go with them. A gap of this
    kind lies in the model and not in the instrument: data made of samples at the centres, or the other way round.
    Beyond 2 the samples would stand outside of their pixels.
    """

    name = "pixelization"
    scope = "channel"
    unit = "1 = window and centroid ignored"
    wording = Wording("{} of the window and the centroids of pixels left out", " %", 100.0)
    cause = "Simulations at the pixels' centres, where the survey has samples all over the pixels."
    signature = "Small scales, depending on nside, and the gradient of the sky at pixels that are hit unevenly."
    source = "Gorski et al. 2005, ApJ 622, 759 (HEALPix); the HEALPix Primer (pixel window functions)"
    step = 0.1
    bounds = (Bound("amplitude", -2.0, 2.0, "beyond it samples stand outside of their pixels"),)
    parametrization = Parametrization(max_amplitude=2.0)

    def spread(self) -> float:
        """Return 1 - amplitude."""
        return 1.0 - self.amplitude
