"""Effective beams from measured or simulated BipoSH."""

from mcsim.beamfit.data import QUADRUPOLE, Measurement, Selection, from_store, with_covariance_of
from mcsim.beamfit.effective_beam import Fit, comparisons, fit, fit_each, fit_models, measurement
from mcsim.beamfit.likelihood import Comparison, Solution, compare, solve, solve_each
from mcsim.beamfit.models import MODELS
from mcsim.beamfit.report import Orientation, orientation, report
from mcsim.beamfit.table import read_table
from mcsim.beamfit.templates import ORDERS

__all__ = [
    "MODELS",
    "ORDERS",
    "QUADRUPOLE",
    "Comparison",
    "Fit",
    "Measurement",
    "Orientation",
    "Selection",
    "Solution",
    "compare",
    "comparisons",
    "fit",
    "fit_each",
    "fit_models",
    "from_store",
    "measurement",
    "orientation",
    "read_table",
    "report",
    "solve",
    "solve_each",
    "with_covariance_of",
]
