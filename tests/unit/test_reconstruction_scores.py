"""Scores of what may act on a sky, made of its filtered maps."""

from dataclasses import replace

import numpy as np

from instruments import two_channels
from mcsim import config
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix


def test_a_monopole_and_dipole_in_a_map_are_no_gain_of_the_sky() -> None:
    """Their products with the sky are those of few of its modes; the gain of all that is seen has them."""
    table = two_channels("low", lmax=16, nside=8, fwhm_arcmin=600.0, period_s=3011.0)
    table["sky"]["dipole_uk"] = 0.0
    model = model_of(survey(config.load(table), orders=2), DiagnosisSettings())
    scene = simulated_scores.scene_of(model)
    found = wiener_filter(model, list(simulate.maps(model.survey, 3)))
    x, y, z = healpix.centres(scene.nside)
    low, residual, adjoint = 2.0 + x - 0.5 * z + 0.3 * y, np.array(found.residual), np.array(found.adjoint)
    residual[0] += low
    adjoint[0] += healpix.adjoint(low, scene.lmax)
    change = scene.listed_values(replace(found, residual=residual, adjoint=adjoint)) - scene.listed_values(found)
    of_sky, of_all = (
        change[[row for row, key in enumerate(scene.keys) if key[:2] == (kind, 0)]]
        for kind in ("gain of the sky", "gain")
    )
    assert np.linalg.norm(of_all) > 1.0
    # Sums of harmonics over 768 pixels are those of the sphere to a percent.
    assert np.linalg.norm(of_sky) < 0.02 * np.linalg.norm(of_all)
