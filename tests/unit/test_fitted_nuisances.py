"""Scores in which nuisances are marginalised, against a dense covariance."""

from types import SimpleNamespace

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.reconstruction.fitted_nuisances import FittedNuisances, Marginal
from mcsim.reconstruction.structure import ALIKE, Structure
from mcsim.simulation.nuisance import nuisances_of

NUISANCES = [
    {"effect": "calibration", "channel": "V1", "width": 0.002},
    {"effect": "noise_level", "channel": "W1", "width": 0.1},
    {"effect": "pointing_offset", "channel": "W1", "width": 5.0},
    {"effect": "excess_noise", "channel": "W1", "width": 0.1},
]


def structure(rows):
    places = np.array(rows)[:, None]
    return Structure("gain", "sky", "time", "year 1", None, ALIKE, None, places, np.ones(1))


def test_marginal_scores_have_the_covariance_of_their_response():
    """Without nuisances scores have C, which is their response; with them marginalised both are the Schur complement.

    The scores of the nuisances are three of five; C_tot = C + t t' is that with unit priors, and C_tot^-1 C the
    weights of all scores if these are fitted beside nuisances.
    """
    rng = np.random.default_rng(1)
    root = rng.standard_normal((5, 5))
    covariance = root @ root.T
    responses = covariance[:2]  # nuisances that are the first two coordinates
    t = responses[:, :3].T
    inverse = np.linalg.inv(covariance[:3, :3])
    seen = inverse @ t @ np.linalg.inv(np.eye(2) + t.T @ inverse @ t)
    marginal = Marginal(np.arange(5.0), responses, (structure([0, 1]), structure([2])), seen)
    turn = marginal.without(np.eye(5))  # (scores before, after)
    total = covariance + responses.T @ responses
    own, rest = covariance[:2, :2], responses
    expected = covariance - rest.T @ np.linalg.inv(own + np.eye(2)) @ rest
    assert turn.T @ total @ turn == pytest.approx(expected, abs=1e-10)
    assert covariance @ turn == pytest.approx(expected, abs=1e-10)
    assert marginal.of(np.arange(5.0), np.zeros(2)) == pytest.approx(np.arange(5.0))
    z = np.array([0.3, -2.0])
    linear = marginal.of(np.arange(5.0) + z @ responses, np.zeros(2))
    assert marginal.of(np.arange(5.0), z) == pytest.approx(linear)


def test_which_nuisances_are_taken_from_maps():
    """What is random stays in the simulations."""
    run = config.load({**two_channels("small"), "nuisance": NUISANCES})
    found = nuisances_of(run, systematics.catalogue())
    assert [one.effect.name for one in found if one.subtractable] == ["calibration", "pointing_offset"]
    skies = SimpleNamespace(analysis=SimpleNamespace(nuisances=found))
    known = FittedNuisances.of(skies, [(amplitude, 0.5) for amplitude in (-0.5, 1.0, 2.0, 3.0, 4.0)])
    assert known.fitted == pytest.approx([-0.008, 2.0, 3.0])  # calibrations to four prior widths at most
    assert known.z == pytest.approx([-4.0, 2.0 / 5.0, 3.0 / 5.0])
