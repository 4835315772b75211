"""The examples of the documentation: one seed makes one set of maps, which mcsim's own simulation describes."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import xarray as xr
from own_biposh import significance, spectra
from own_simulator import LMAX, HealpySurvey

from mcsim import load_config
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

HERE = Path(__file__).parent


def test_a_seed_fixes_the_maps():
    one, again, other = (HealpySurvey().simulate(seed)["V"]["a"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.std(one - other) > 50.0


def test_the_description_has_its_power():
    run = load_config(HERE / "own_simulator.toml")
    assert run.simulator == f"{HERE / 'own_simulator.py'}:HealpySurvey"
    shared = survey(replace(run, simulator=None))
    own = np.mean([np.var(simulate.maps(shared, r)[0]) for r in range(40)])
    theirs = np.mean([np.var(HealpySurvey().simulate(seed)["V"]["a"]) for seed in range(40)])
    assert abs(own / theirs - 1.0) < 0.2


def test_bipolar_coefficients_of_its_maps_are_isotropic():
    """Means over 40 seeds follow a t distribution of 39 degrees of freedom, in some 800 numbers."""
    each = [spectra(seed) for seed in range(40)]
    maps = HealpySurvey().simulate(0)["V"]
    one, other = (healpy.map2alm(maps[half], lmax=LMAX) for half in ("a", "b"))
    np.testing.assert_allclose(each[0].cl, healpy.alm2cl(one, other), rtol=1e-10)
    ensemble = xr.concat(each, dim="realization")
    found = significance(ensemble.where(ensemble.L > 0, drop=True))
    number = int(found.count())
    assert number > 700
    assert abs(float((found**2).mean()) / (39.0 / 37.0) - 1.0) < 4.0 * np.sqrt(2.0 / number)
