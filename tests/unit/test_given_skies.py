"""Skies of one run that are given as files, one for each realization, and their units."""

from pathlib import Path

import healpy
import numpy as np
import pytest
from astropy.io import fits

from instruments import two_channels
from mcsim import config
from mcsim.simulation import skies
from refusals import refused

LMAX, NSIDE = 16, 16


@pytest.fixture(params=["alm", "map"])
def later(request, tmp_path):
    """Return a run whose second sky is the first one times a factor, in a unit that its header says, or not."""
    sky = 100.0 * np.random.default_rng(1).standard_normal(12 * NSIDE**2)

    def written(path: Path, values: np.ndarray, unit: str | None) -> None:
        if request.param == "map":
            healpy.write_map(path, values, coord="E", column_units=unit, dtype=np.float64)
        else:
            healpy.write_alm(path, healpy.map2alm(values, lmax=LMAX), out_dtype=np.float64)
            fits.setval(path, "TUNIT2", value=unit or "", ext=1)

    def made(factor: float, unit: str | None) -> config.RunConfig:
        written(tmp_path / "0.fits", sky, None)
        written(tmp_path / "1.fits", factor * sky, unit)
        given = {"sky": {"lmax": LMAX, request.param: str(tmp_path / "{realization}.fits")}}
        given |= {"ensemble": {"realizations": 2}}
        return config.load(two_channels("skies", lmax=LMAX, nside=NSIDE) | given)

    return made


@pytest.mark.filterwarnings("ignore::UserWarning")  # as in workers, for the driver has read the first
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_sky_in_another_unit_than_the_first_is_refused(later, factor, tmp_path):
    """Where no header says so, mK were a sky a thousand times too faint, without a word."""
    with refused(tmp_path / "0.fits", tmp_path / "1.fits", "TUNIT"):
        skies.given(later(factor, None), 1)


@pytest.mark.parametrize(
    ("factor", "unit", "scale"), [(1e-3, "mK", 1.0), (0.02, "uK", 0.02), (0.2, None, 0.2), (0.0, None, 0.0)]
)
def test_a_sky_in_a_unit_that_is_known_is_taken(later, factor, unit, scale):
    run = later(factor, unit)
    first, second = (skies.given(run, realization) for realization in (0, 1))
    np.testing.assert_allclose(second, scale * first, rtol=1e-6, atol=1e-9)
