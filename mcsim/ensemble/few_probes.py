"""Warning of filtered ensembles whose errors are mostly those of their normalisation, which all realizations share."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from mcsim.simulation.filtering import Filtering
from mcsim.simulation.normalisation_error import normalisation_error

if TYPE_CHECKING:
    import xarray as xr

LARGEST = 0.5
"""Rms error of the normalisation over the standard error that is stored, above which a warning is due: 12 % of it."""


def warn_of_probes(filtering: Filtering, summary: "xr.Dataset") -> None:
    """Warn if the standard errors of ``biposh_qml`` without its mean field leave out an error that is not small."""
    name = "biposh_qml_difference" if "biposh_qml_difference_mean" in summary else "biposh_qml"
    stored = summary[f"{name}_standard_error"].values
    known = np.isfinite(stored) & (stored > 0.0)
    if not filtering.drawn or not known.any():
        return
    shared = normalisation_error(filtering, summary[f"{name}_mean"].values)
    ratio = float(np.sqrt(np.mean((shared[known] / stored[known]) ** 2)))
    if ratio > LARGEST:
        enough = int(np.ceil(filtering.drawn * ratio / LARGEST)) if np.isfinite(ratio) else 2 * filtering.drawn
        warnings.warn(
            f"{name}_standard_error is that of the realizations alone: the normalisation, by {filtering.drawn} random "
            f"probes, has an error of {ratio:.2g} times it (rms over the bins), which more realizations do not lower; "
            f"give biposh.probes = {enough} or more, or add mcsim.simulation.normalisation_error in quadrature.",
            stacklevel=2,
        )
