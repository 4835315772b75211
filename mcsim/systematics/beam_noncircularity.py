"""A measured beam of which the simulation leaves orders out."""

from dataclasses import dataclass, replace

import numpy as np

from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording


@dataclass(frozen=True, kw_only=True)
class BeamNoncircularity(Effect):
    """The orders that the channel's ``beam.m_max`` cuts off, times the amplitude; at 1 the beam is as measured.

    Notes
    -----
    b_lm + amplitude b_lm of the whole beam at the orders m > m_max. With m_max = 0 that is all that makes the beam
    non-circular: its ellipse, its coma, and what no closed form has. The whole beam has the orders that it would have
    without m_max, and four at least where its source has them. Of a differencing scan both sides' beams must be cut.
    """

    name = "beam_noncircularity"
    scope = "channel"
    unit = "share of the orders beyond m_max"
    title = "beam non-circularity"
    wording = Wording("{} of the orders beyond m_max", " %", 100.0)
    cause = "Simulations with the circular part of a measured beam, or with too few of its orders."
    signature = "L of the orders left out: 2 and 4 of an ellipse, 1 and 3 of a lopsided beam, in the scan's frame."
    source = "Joshi et al. arXiv:1210.7318, Sec. IV"
    step = 0.05
    bounds = (
        Bound(
            "amplitude",
            -2.0,
            2.0,
            "1 is the beam as measured; a prior of this library: at most twice that",
        ),
    )

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Add a share of the orders that were left out."""
        whole, kept = site.whole_beam(self.name), site.beam.mmax + 1
        blm = np.zeros((max(beam.mmax, whole.mmax) + 1, beam.lmax + 1), dtype=np.complex128)
        blm[: beam.mmax + 1] = beam.blm
        blm[kept : whole.mmax + 1] += self.amplitude * whole.blm[kept:]
        return replace(beam, blm=blm, neglected_power=whole.neglected_power)
