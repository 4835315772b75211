"""A gain that changes once."""

from dataclasses import dataclass

import numpy as np

from mcsim.systematics import Effect


@dataclass(frozen=True, kw_only=True)
class GainStep(Effect):
    """The gain is higher by a fraction from some day on.

    Attributes
    ----------
    amplitude
        Relative change of the gain.
    day
        Days from the start of the survey to the step.
    """

    name = "gain_step"
    scope = "channel"
    unit = "fraction"
    cause = "A change of the bias or of the temperature of an amplifier."
    signature = "What is left of the dipole, in the scan's frame, in one part of the survey."
    source = "An example"
    step = 0.001
    variants = ({"day": 91.0}, {"day": 274.0})

    day: float = 91.0

    def gain(self, time_s, site):
        """Zero before the step, the amplitude after it."""
        if self.amplitude == 0.0:
            return None
        return np.where(time_s < 86400.0 * self.day, 0.0, self.amplitude)
