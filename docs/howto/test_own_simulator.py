"""The example of the documentation: the same maps for the same seed, and mcsim's own simulation describes it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from own_simulator import HealpySurvey

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
