"""Settings that are changed by name: of another kind, negative or beyond a probability they are refused."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from mcsim import DiagnosisSettings, LimitSettings
from refusals import refused


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (DiagnosisSettings, "without", "beam_ellipticity"),
        (DiagnosisSettings, "including", "beam_coma"),
        (DiagnosisSettings, "only", ("beam_coma", 3)),
        (DiagnosisSettings, "simulations", -1),
        (DiagnosisSettings, "simulations", "100"),
        (DiagnosisSettings, "simulations", 100.5),
        (DiagnosisSettings, "simulations", float("inf")),
        (DiagnosisSettings, "controls", -1),
        (DiagnosisSettings, "alpha", 5),
        (DiagnosisSettings, "residual_level", 2.0),
        (DiagnosisSettings, "named_probability", 90),
        (DiagnosisSettings, "shrunk", "no"),
        (DiagnosisSettings, "slice_snr", float("nan")),
        (DiagnosisSettings, "channel_skies", 1),
        (DiagnosisSettings, "sims_per_element", 1),
        (DiagnosisSettings, "beam_bins", (4, 2)),
        (DiagnosisSettings, "beam_bins", (1.5, 1, 1, 1, 1)),
        (DiagnosisSettings, "beam_bins", (0, 1, 1, 1, 1)),
        (DiagnosisSettings, "sky_bins", 0),
        (DiagnosisSettings, "scan_bins", 0),
        (DiagnosisSettings, "scan_L_max", 0),
        (DiagnosisSettings, "scan_sims", 19),
        (DiagnosisSettings, "constrained_skies", 1),
        (DiagnosisSettings, "scatter_skies", 3),
        (DiagnosisSettings, "max_effects", 0),
        (DiagnosisSettings, "odds_cut", 0.5),
        (DiagnosisSettings, "large_scales", 2),
        (DiagnosisSettings, "plane_width", 0.0),
        (DiagnosisSettings, "filter_iterations", 0),
        (DiagnosisSettings, "latitude_edges", (0.5,)),
        (DiagnosisSettings, "latitude_edges", (1.0, 0.0)),
        (DiagnosisSettings, "prior_snr", ()),
        (DiagnosisSettings, "prior_snr", ("a",)),
        (DiagnosisSettings, "beam_orders", 0),
        (LimitSettings, "only", "gain_drift"),
        (LimitSettings, "nuisances", 3),
        (LimitSettings, "nuisances", {3: 0.01}),
        (LimitSettings, "alpha", 2),
        (LimitSettings, "power", 90),
        (LimitSettings, "separation", 1.0),
        (LimitSettings, "probes", 3.5),
        (LimitSettings, "unknown_dipole_uk", -1),
    ],
)
def test_wrong_settings_are_refused(kind, name, value) -> None:
    with refused(name, value):
        kind(**{name: value})


@pytest.mark.parametrize("width", ["0.1", None, 0.0, -1.0, float("nan"), float("inf")])
def test_a_width_of_a_nuisance_that_is_none_is_refused(width) -> None:
    with refused("beam_width", width):
        LimitSettings(nuisances={"beam_width": width})


def test_usual_settings_are_taken() -> None:
    assert DiagnosisSettings(alpha=1, simulations=300, without=["x"], beam_bins=(5, 2, 1, 1, 1)).simulations == 300
    assert DiagnosisSettings.quick(controls=3).sims_per_element < DiagnosisSettings().sims_per_element
    assert LimitSettings(nuisances={"beam_width": 0.01}, dense=True).dense


def test_a_number_of_simulations_that_is_given_is_that_of_a_sample_covariance() -> None:
    assert DiagnosisSettings().shrinks(None)
    assert not DiagnosisSettings(shrunk=False).shrinks(None)
    assert not DiagnosisSettings.quick().shrinks(500)


def test_numbers_of_numpy_are_those_of_python() -> None:
    """A count of np.int64, as of np.arange, was refused with the range that it is in."""
    given = DiagnosisSettings(simulations=np.int64(300), alpha=np.float32(0.5), beam_bins=tuple(np.ones(5, dtype=int)))
    plain = DiagnosisSettings(simulations=300, alpha=0.5, beam_bins=(1, 1, 1, 1, 1))
    assert json.dumps(asdict(given)) == json.dumps(asdict(plain))
    with refused("simulations", -3):
        DiagnosisSettings(simulations=np.int64(-3))
