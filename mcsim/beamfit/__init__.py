"""Effective beams from measured or simulated BipoSH."""

from mcsim.beamfit.data import QUADRUPOLE, Measurement, from_store, with_covariance_of
from mcsim.beamfit.effective_beam import Fit, comparisons, fit, measurement
from mcsim.beamfit.likelihood import Comparison, Solution, compare, solve, solve_each
from mcsim.beamfit.models import MODELS
from mcsim.beamfit.orientation import Orientation, orientation
from mcsim.beamfit.report import report
from mcsim.beamfit.table import read_table

__all__ = [
    "MODELS",
    "QUADRUPOLE",
    "Comparison",
    "Fit",
    "Measurement",
    "Orientation",
    "Solution",
    "compare",
    "comparisons",
    "fit",
    "from_store",
    "measurement",
    "orientation",
    "read_table",
    "report",
    "solve",
    "solve_each",
    "with_covariance_of",
]
