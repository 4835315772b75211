"""The limit of maps from which templates were fitted and subtracted."""

from functools import cache

import healpy
import numpy as np
import pytest
from scipy.linalg import block_diag, null_space

import mcsim
from likelihoods import NSIDE, effect, expected_log_likelihood, model, moments_of
from mcsim.datavector.campaign import with_effects
from mcsim.information.result import Limits
from mcsim.simulation.survey import survey
from refusals import refused

ONLY = ("beam_ellipticity", "calibration", "gain_drift", "noise_level")
SUBTRACTED = {"kind": "subtract_dipole"}


@cache
def limits(dense: bool) -> Limits:
    return mcsim.limit(model(preparation=[SUBTRACTED]), settings=mcsim.LimitSettings(only=ONLY, dense=dense, orders=2))


@pytest.mark.slow
def test_it_is_the_curvature_of_the_likelihood_of_prepared_maps() -> None:
    """In what four maps have beside a monopole and a dipole of their own."""
    run, found = model(preparation=[SUBTRACTED]), limits(dense=True)
    templates = np.stack([np.ones(12 * NSIDE**2), *healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))], axis=1)
    blocks = []
    for m in survey(run).maps:
        seen = m.weight > 0
        blocks.append(np.eye(seen.size)[:, seen] @ null_space(templates[seen].T))
    basis = block_diag(*blocks)
    at = moments_of(run)
    nothing = expected_log_likelihood(run, basis, at)
    directions = {
        "beam_ellipticity (V1)/0": lambda t: effect("beam_ellipticity", "V1", t),
        "calibration (V1)/0": lambda t: effect("calibration", "V1", t),
        "gain_drift (V1)/1": lambda t: effect("gain_drift", "V1", t, phase_deg=90.0),
        "noise_level (W1)/0": lambda t: effect("noise_level", "W1", t),
    }
    for name, made in directions.items():
        place = found.components.index(name)
        step = 0.003 / np.sqrt(found.fisher[place, place])
        ends = [expected_log_likelihood(with_effects(run, [made(sign * step)]), basis, at) for sign in (1.0, -1.0)]
        assert -(sum(ends) - 2.0 * nothing) / 0.003**2 == pytest.approx(1.0, rel=4e-3), name


def test_random_probes_know_nothing_of_what_was_subtracted_either() -> None:
    """The gain is known from the sky alone: 20 times worse than from its dipole."""
    run, exact, drawn = model(), limits(dense=True), limits(dense=False)
    for one, other in zip(exact.effects, drawn.effects, strict=True):
        assert other.sigma == pytest.approx(one.sigma, rel=max(4.0 * other.error, 1e-4)), one.label
    settings = mcsim.LimitSettings(only=("calibration",), dense=True, unknown_dipole_uk=1e3)
    known = mcsim.limit(run, settings=settings).effects[0].sigma
    found = next(one.sigma for one in exact.effects if one.label == "calibration (V1)")
    assert 10.0 * known < found < np.inf
    # Fits with other weights leave other maps, of which all the same is known.
    half = np.repeat([1.0, 0.0], 6 * NSIDE**2)
    other = mcsim.limit(model(preparation=[SUBTRACTED | {"mask": half}]), settings=exact.settings)
    np.testing.assert_allclose(other.fisher, exact.fisher, rtol=1e-6, atol=1e-6 * np.diag(exact.fisher).max())


@pytest.mark.parametrize("dense", [True, False])
def test_of_what_was_subtracted_nothing_is_known(dense) -> None:
    run, settings = model(preparation=[SUBTRACTED]), mcsim.LimitSettings(only=("dipole_residual",), dense=dense)
    assert [one.sigma for one in mcsim.limit(run, settings=settings).effects] == [np.inf, np.inf]


def test_a_mask_of_the_preparation_hides_what_the_mask_of_the_map_does() -> None:
    mask = (np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) > 0.4).astype(float)
    settings = mcsim.LimitSettings(only=("noise_level",), dense=True)
    given = model(map={"nside": NSIDE, "splits": ["half1", "half2"], "mask": mask})
    found, expected = (
        mcsim.limit(run, settings=settings) for run in (model(preparation=[{"kind": "mask", "mask": mask}]), given)
    )
    np.testing.assert_array_equal(found.fisher, expected.fisher)


@pytest.mark.parametrize("step", [{"kind": "smooth", "fwhm_arcmin": 1500.0}, {"kind": "rotate", "frame": "galactic"}])
def test_what_changes_noise_has_no_limit(step) -> None:
    run = model(map={"nside": NSIDE, "splits": ["half1", "half2"]}, preparation=[step])
    with refused("preparation", "subtracted"):
        mcsim.limit(run, settings=mcsim.LimitSettings(only=("noise_level",)))
