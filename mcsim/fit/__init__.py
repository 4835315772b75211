"""Effective beams from measured or simulated BipoSH."""

from mcsim.fit.data import QUADRUPOLE, Measurement, from_store, with_covariance_of
from mcsim.fit.effective_beam import Fit, comparisons, fit, measurement
from mcsim.fit.likelihood import Comparison, Solution, compare, solve, solve_each
from mcsim.fit.models import MODELS
from mcsim.fit.orientation import Orientation, orientation
from mcsim.fit.report import report
from mcsim.fit.table import read_table

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
