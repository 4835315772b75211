"""A calibration that is off by a constant factor."""

from dataclasses import dataclass, replace

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording


@dataclass(frozen=True, kw_only=True)
class Calibration(Effect):
    """Gain 1 + amplitude of sky and dipole alike, at all times; the noise stays as it is.

    Notes
    -----
    It acts as a beam of the integral 1 + amplitude. The dipole is subtracted with the fiducial gain, 1: amplitude times
    the dipole is left.
    """

    name = "calibration"
    scope = "channel"
    unit = "fraction"
    title = "calibration"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "Absolute calibration on a dipole that is known, or was measured, with an error."
    signature = "L = 0 and the dipole: the same factor at all degrees and times, in this channel alone."
    source = "Jarosik et al. 2011, ApJS 192, 14 (0.2 %); Planck 2015 results V, A&A 594, A5"
    step = 1e-3
    bounds = (Bound("amplitude", -0.5, 0.5, "a prior of this library: half of the dipole is seen by eye"),)

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Scale the beam."""
        if self.amplitude <= -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} leaves no signal; choose one above -1."
            )
        return replace(beam, blm=(1.0 + self.amplitude) * beam.blm)
