"""A beam wider than the fiducial one."""

from dataclasses import dataclass

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.shape import stretched


@dataclass(frozen=True, kw_only=True)
class BeamWidth(Effect):
    """The beam 1 + amplitude times as wide in every direction, at the same integral: all its orders scale."""

    name = "beam_width"
    scope = "channel"
    unit = "fraction of the FWHM"
    wording = Wording("FWHM {} larger", " %", 100.0, negative="FWHM {} smaller")
    cause = "A beam mapped with an error of its width, or a focus that drifts."
    signature = "L = 0: the power falls off sooner, in this channel alone."
    source = "Huffenberger et al. 2010, A&A 513, A23 (errors of measured beams)"
    step = 0.005
    bounds = (
        Bound(
            "amplitude",
            -0.5,
            0.5,
            "a prior of this library: a measured width is known to a half",
        ),
    )

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Stretch the beam."""
        if not -0.9 <= self.amplitude <= 9.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} leaves no beam to speak of; "
                "choose one between -0.9 and 9."
            )
        return stretched(beam, 1.0 + self.amplitude, 1.0 + self.amplitude, 0.0, 2, 0)
