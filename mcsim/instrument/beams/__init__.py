"""Beams: from a width, a beam map or a file to harmonic coefficients b_lm."""

from mcsim.instrument.beams.beam import Beam
from mcsim.instrument.beams.beammap import PEDESTAL, BeamMap, blm_of_map, find_centre, holds_image, read_map
from mcsim.instrument.beams.coefficients import MMAX_TOLERANCE, choose_mmax
from mcsim.instrument.beams.summary import BeamSummary, format_summary, summarize
from mcsim.instrument.beams.window import holds_window, read_window

__all__ = [
    "MMAX_TOLERANCE",
    "PEDESTAL",
    "Beam",
    "BeamMap",
    "BeamSummary",
    "blm_of_map",
    "choose_mmax",
    "find_centre",
    "format_summary",
    "holds_image",
    "holds_window",
    "read_map",
    "read_window",
    "summarize",
]
