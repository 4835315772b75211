"""Simulators of others, on runs of ours: the same maps as ours, and what their own arguments change is named."""

import importlib
from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey

pytestmark = pytest.mark.filterwarnings("ignore")  # theirs
FOLDER = Path(__file__).parents[2] / "workflows" / "simulators"
PACKAGES = {"litebird": "litebird_sim", "toast3": "toast", "totalconvolve": "ducc0", "healpy_pipeline": "healpy"}
ACCURACY = {"litebird": 1e-4, "toast3": 1e-6, "totalconvolve": 1e-6, "healpy_pipeline": 1e-3}
DIFFERENT = {
    "litebird": ({"turned_deg": 90.0}, "psi_offset"),
    "toast3": ({"calibrate": False}, "calibration"),
    "totalconvolve": ({"centred": True}, "pixel_centres"),
    "healpy_pipeline": ({"nest": True}, "ordering"),
}


def _run(circular: bool) -> config.RunConfig:
    beam = {
        "kind": "elliptical_gaussian",
        "fwhm_major_arcmin": 400.0,
        "fwhm_minor_arcmin": 400.0 - 80.0 * (not circular),
    }
    scan = {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "A", "sample_period_s": 121.0}
    return config.load(
        {
            "schema": 1, "name": "small", "sky": {"spectrum": "wmap7", "lmax": 40},
            "map": {"nside": 16, "splits": ["half1", "half2"]},
            "channel": [{"name": "W1", "beam": beam, "scan": scan}], "ensemble": {"seed": 5},
        }
    )  # fmt: skip


@pytest.mark.parametrize("name", PACKAGES)
def test_a_simulator_of_others_makes_our_maps_and_its_arguments_are_named(name, monkeypatch, tmp_path):
    pytest.importorskip(PACKAGES[name])
    monkeypatch.syspath_prepend(str(FOLDER))
    inputs, theirs = importlib.import_module("inputs"), importlib.import_module(name)
    run = _run(circular=name == "healpy_pipeline")
    given = inputs.of(run)
    ours = dict(sampled.maps(survey(run), 0))
    made = theirs.simulate(given)
    inputs.write(tmp_path, made, given.frame)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["W1_half1.fits", "W1_half2.fits"]
    assert healpy.read_map(tmp_path / "W1_half1.fits") == pytest.approx(made["W1_half1"])
    found = mcsim.compare(list(ours.values()), list(made.values()), run)
    assert found.verdict == "identical"
    assert found.accuracy < ACCURACY[name]
    arguments, difference = DIFFERENT[name]
    found = mcsim.compare(list(ours.values()), list(theirs.simulate(given, **arguments).values()), run)
    assert [d.name for d in found.channels[0].differences] == [difference]
    assert all(np.isfinite(m).all() for m in made.values())
