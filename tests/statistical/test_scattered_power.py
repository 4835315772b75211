"""Errors of predictions where a mask scatters power of bright degrees into faint ones, against ensembles."""

import re
import warnings
from dataclasses import replace
from typing import Any

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.ensemble.prediction import SCATTERED
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

NSIDE, LMAX, REALIZATIONS = 32, 64, 200
LATITUDE_DEG = 90.0 - np.degrees(healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))[0])


def run(**changes: Any) -> config.RunConfig:
    """A beam of 6.7 degrees without noise outside a sharp cut at 20 degrees."""
    channel = {
        "name": "W1",
        "beam": {"kind": "gaussian", "fwhm_arcmin": 400.0},
        "scan": {"kind": "parallel_transport"},
    }
    return config.load(
        {
            "name": "steep",
            "sky": {"spectrum": "wmap7", "lmax": LMAX},
            "map": {"nside": NSIDE, "mask": (abs(LATITUDE_DEG) > 20.0).astype(float)} | changes,
            "channel": [channel],
            "biposh": {"L_max": 1, "summary_bin": 8},
            "ensemble": {"realizations": REALIZATIONS, "seed": 3, "paired": False},
        }
    )


def test_errors_hold_below_the_degree_that_the_warning_names() -> None:
    """In the mean of some degrees within 5 % and 3 of its errors; where all power is scattered they are 3 times off."""
    with pytest.warns(UserWarning, match="scatters power") as said:
        expected = mcsim.predict(run()).cl_standard_deviation.values[0]
    [first, share, worst] = map(int, re.findall(r"l >= (\d+), (\d+) %.* l = (\d+)", str(said[-1].message))[0])
    assert share > 90
    assert worst > first
    whole = survey(run())
    found = np.std([simulate.realize(whole, r)["cl"][0] for r in range(REALIZATIONS)], axis=0, ddof=1)
    ratio = found / expected
    below, beyond = ratio[6:first], ratio[worst - 8 : worst]
    assert abs(np.mean(below) - 1.0) < 0.05 + 3.0 / np.sqrt(2.0 * REALIZATIONS * below.size)
    assert 2.0 < np.mean(beyond) < 4.5
    assert share > 100 * SCATTERED


def test_a_spectrum_that_a_narrow_map_scatters_is_all_there() -> None:
    """Where the beam ends it, all power comes from afar: degrees of weights up to 64 alone had 1e-9 of it at l = 95."""
    height = healpy.pix2vec(64, np.arange(12 * 64**2))[2]
    steep = run(nside=64, mask=np.where(np.abs(height) > 0.34, 1.0, 0.0))
    beam = replace(steep.channels[0], beam=config.BeamGaussian(fwhm_arcmin=600.0))
    whole = replace(steep, sky=replace(steep.sky, lmax=95), channels=(beam,))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        expected = mcsim.predict(whole, L_moments=64).cl_mean.values[0]
    words = "\n".join(str(one.message) for one in said)
    [(least, most)] = re.findall(r"over more than 64 degrees, (\d+) % of .* at l = \d+ and (\d+) % at l = \d+", words)
    assert 10 <= int(least) < 50
    assert 99 <= int(most) <= 100
    simulated = survey(whole)
    maps = np.array([simulate.realize(simulated, r)["cl"][0] for r in range(40)])
    # Neighbours have the scatter of the few bright degrees that their power comes from.
    low, high = expected[20:40].mean(), expected[80:].mean()
    for mean, found in ((low, maps[:, 20:40].mean(axis=1)), (high, maps[:, 80:].mean(axis=1))):
        assert abs(found.mean() - mean) < 4.0 * found.std(ddof=1) / np.sqrt(len(maps))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the mask .* over more than")
        warnings.filterwarnings("ignore", "the mask .* of other degrees")
        itself = mcsim.predict(whole).cl_mean.values[0]  # takes as many as it needs
    np.testing.assert_allclose(itself, expected, rtol=0.01)


@pytest.mark.parametrize("changes", [{"mask": None}, {"mask_apodisation_deg": 30.0}], ids=["full", "apodised"])
def test_nothing_is_said_where_little_is_scattered(changes: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mcsim.predict(run(**changes))


@pytest.mark.parametrize("fwhm_arcmin", [60.0, 600.0])
def test_a_mask_of_two_degrees_scatters_nothing_further(fwhm_arcmin: float) -> None:
    """Rounding of its harmonics was power of the sky, of either sign, and was refused or warned of."""
    height = healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]
    smooth = run(mask=(1.0 + 0.1 * height) / 1.1)
    beam = replace(smooth.channels[0], beam=config.BeamGaussian(fwhm_arcmin=fwhm_arcmin))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "the mask .* of other degrees")  # of the next one, which is far brighter
        found = mcsim.predict(replace(smooth, channels=(beam,)))
    assert "L = 64" in found.attrs["mask"]
    assert np.all(found.cl_mean.values[0] >= 0.0)
