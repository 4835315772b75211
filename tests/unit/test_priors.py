"""Priors of nuisances: how far draws reach, what must be possible there, and which can be taken from maps."""

from types import SimpleNamespace

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.nuisances import with_priors
from mcsim.simulation.nuisance import Nuisance, check_nuisances
from mcsim.stats.gaussian import SimulatedGaussian
from refusals import refused


def test_draws_end_at_four_widths():
    """No more than that is checked to be possible."""
    kind = systematics.get("foreground_residual")
    one = Nuisance(kind, None, (3.0,), {"spectral_index": -1.0}, {"spectral_index": 0.5})
    far = SimpleNamespace(standard_normal=lambda count: np.array([-5.3, 7.0])[:count])
    coordinates, effect = one.draw(far)
    assert coordinates.tolist() == [-12.0]
    assert (effect.amplitude, effect.spectral_index) == (-12.0, 1.0)


@pytest.mark.parametrize("centre", [5.0, 9.0])
def test_a_parameter_must_be_possible_at_both_ends_of_its_prior(centre):
    """Rings have no radius below 0, where four widths of 2 below 5 would be."""
    ring = {"effect": "beam_sidelobe", "channel": "V1", "width": 1e-4, "parameters": {"radius_sigmas": centre}}
    run = two_channels("ends", lmax=20, nside=8, fwhm_arcmin=800.0)
    run["nuisance"] = [ring | {"parameter_widths": {"radius_sigmas": 2.0}}]
    if centre > 8.0:
        check_nuisances(config.load(run))
        return
    with refused("nuisance[0]", "beam_sidelobe", "radius_sigmas", -3):
        check_nuisances(config.load(run))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("calibration", True),
        ("gain_drift", True),
        ("noise_level", False),
        ("noise_knee", False),  # by its memory alone
        ("pointing_jitter", False),  # of one sign
        ("spectrum", False),
        ("point_sources", False),
    ],
)
def test_what_is_linear_and_not_random_can_be_taken_from_maps(name, expected):
    kind = systematics.get(name)
    widths = (0.1,) * len(kind.parametrization.basis())
    assert Nuisance(kind, "W1", widths).subtractable == expected
    assert not Nuisance(kind, "W1", widths, {}, {"any": 1.0}).subtractable


def test_a_template_that_is_the_scatter_of_a_nuisance_has_its_prior_already():
    """The covariance of the simulations holds it, and the error of the fit with it: it is not added once more."""
    rng = np.random.default_rng(6)
    null = SimulatedGaussian.from_simulations(rng.standard_normal((300, 5)))
    t, x = rng.standard_normal((5, 1)), rng.standard_normal(5)
    fit, kind = null.fit(x, t), systematics.get("calibration")
    measured, other = (Candidate(kind, "W1", (0,), nuisance=own, known=(t, np.array([0.7]))) for own in (True, False))
    assert with_priors(null, t, fit, [measured]) is fit
    assert with_priors(null, t, fit, [other]).errors[0] >= 0.7
