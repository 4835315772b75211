"""Bipolar spherical harmonics: modes, the estimator and its normalisations; ``theory`` predicts them."""

from mcsim.bipolar.estimation import Estimator, by_degree, estimate, estimator, power_spectrum
from mcsim.bipolar.modes import Mode, bennett_factor, modes, parse_mode, to_bennett

__all__ = [
    "Estimator",
    "Mode",
    "bennett_factor",
    "by_degree",
    "estimate",
    "estimator",
    "modes",
    "parse_mode",
    "power_spectrum",
    "to_bennett",
]
