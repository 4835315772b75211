"""Beams: from a width, a beam map or a file to harmonic coefficients b_lm."""

from mcsim.instrument.beams.beam import MMAX_TOLERANCE, Beam, choose_mmax
from mcsim.instrument.beams.beammap import BeamMap, blm_of_map, find_centre, from_map, holds_image, read_map
from mcsim.instrument.beams.files import from_blm_file
from mcsim.instrument.beams.gaussian import elliptical_gaussian, gaussian
from mcsim.instrument.beams.summary import BeamSummary, format_summary, summarize

__all__ = [
    "MMAX_TOLERANCE",
    "Beam",
    "BeamMap",
    "BeamSummary",
    "blm_of_map",
    "choose_mmax",
    "elliptical_gaussian",
    "find_centre",
    "format_summary",
    "from_blm_file",
    "from_map",
    "gaussian",
    "holds_image",
    "read_map",
    "summarize",
]
