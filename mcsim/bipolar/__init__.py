"""Bipolar spherical harmonics: modes, the estimator and its normalisations; ``theory`` predicts them."""

from mcsim.bipolar.estimation import Estimator, Mode, bennett_factor, estimate, estimator, modes, power_spectrum

__all__ = ["Estimator", "Mode", "bennett_factor", "estimate", "estimator", "modes", "power_spectrum"]
