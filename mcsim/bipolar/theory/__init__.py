"""Prediction of mean BipoSH without Monte Carlo, from b_lm of a beam, the moments of a scan and C_l.

Only the modes' names and normalisation are shared with the convolution and the estimator of the ensembles, so that
each checks the other.
"""

from mcsim.bipolar.theory.beam_biposh import ScannedBeam, beam_biposh
from mcsim.bipolar.theory.cmb_biposh import cmb_biposh_exact, cmb_biposh_leading, noise_biposh
from mcsim.bipolar.theory.detectability import (
    FULL_SKY,
    Overlap,
    Spectra,
    fisher_information,
    isotropic_variance,
    overlap,
    signal_to_noise,
)
from mcsim.bipolar.theory.harmonics import map_harmonics, orientation_harmonics, parallel_transport_harmonics
from mcsim.bipolar.theory.pseudo_spectrum import pseudo_spectrum

__all__ = [
    "FULL_SKY",
    "Overlap",
    "ScannedBeam",
    "Spectra",
    "beam_biposh",
    "cmb_biposh_exact",
    "cmb_biposh_leading",
    "fisher_information",
    "isotropic_variance",
    "map_harmonics",
    "noise_biposh",
    "orientation_harmonics",
    "overlap",
    "parallel_transport_harmonics",
    "pseudo_spectrum",
    "signal_to_noise",
]
