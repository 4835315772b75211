"""Which modes of a summary are detected."""

import numpy as np
import pytest
import xarray as xr

from mcsim.ensemble.tables import detected


@pytest.mark.parametrize(("sigma", "found"), [(3.2, []), (-3.2, []), (3.4, ["L2M0d0"]), (-3.4, ["L2M0d0"])])
def test_a_single_bin_is_detected_where_either_sign_is_as_rare_as_the_level(sigma: float, found: list[str]) -> None:
    """One in a thousand of both signs are beyond 3.29 sigma, and of one sign beyond 3.09."""
    of_bins = ("pair", "mode", "bin")
    summary = xr.Dataset(
        {
            "biposh_binned_mean": (of_bins, np.array([[[complex(sigma)]]])),
            "biposh_binned_standard_error": (of_bins, np.ones((1, 1, 1))),
        },
        {"pair": ["A,A"], "mode": ["L2M0d0"], "bin": [1.0], "L": ("mode", [2]), "M": ("mode", [0])},
    )
    assert detected(summary, "", "A,A") == found
