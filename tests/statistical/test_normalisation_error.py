"""The error that random probes give to the normalisation of filtered estimates, against many sets of probes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from mcsim import config
from mcsim.ensemble.few_probes import warn_of_probes
from mcsim.simulation.filtering import Filtering
from mcsim.simulation.normalisation_error import normalisation_error
from mcsim.simulation.survey import survey

PROBES, SETS = 16, 60


RUN: dict[str, Any] = {
    "name": "filtered",
    "sky": {"spectrum": "wmap7", "lmax": 32},
    "map": {"nside": 16},
    "channel": [
        {
            "name": "A",
            "beam": {"kind": "gaussian", "fwhm_arcmin": 500.0},
            "scan": {"kind": "parallel_transport"},
            "noise": {"sigma0_uk": 20.0},
        }
    ],
    "biposh": {"L_max": 1, "summary_bin": 16, "filter": "inverse_covariance", "probes": PROBES},
}


@pytest.fixture(scope="module")
def filtering() -> Filtering:
    """Twelve numbers of a map of nside 16, a fifth of which is masked."""
    mask = (abs(np.arange(12 * 16**2) - 1500) > 300).astype(float)
    found = survey(config.load(RUN | {"map": {"nside": 16, "mask": mask}})).filtering
    assert found is not None
    return found


def test_the_error_is_the_scatter_over_sets_of_probes(filtering: Filtering) -> None:
    """Of the estimate of a mean of several S/N, the root of the mean variance within three of its errors."""
    [bands], [one] = filtering.bands, filtering.filters
    probes = [(one.probe(number),) for number in range(PROBES * SETS)]
    exact = filtering.response(probes[:300], 0).matrix
    errors = np.sqrt(np.diag(np.linalg.inv(exact)))
    first = np.array([mode.L for mode in bands.modes])[bands.numbers[0]] == 0
    for numbers in (np.where(first, 10.0 * errors, 0.0), np.where(first, 0.0, 3.0 * errors)):
        found = []
        for row in range(SETS):
            matrix, unbiased = filtering.response(probes[row * PROBES : (row + 1) * PROBES], 0)
            found.append(unbiased * np.linalg.solve(matrix, exact @ numbers))
        mode, place, _ = bands.numbers
        mean = bands.spectra(numbers)[None]
        expected = normalisation_error(filtering, mean)[0]
        both = np.zeros(expected.shape)
        np.add.at(both, (mode, place), np.var(found, axis=0, ddof=1))
        ratio = np.mean(both[mode, place] / expected[mode, place] ** 2)
        assert abs(ratio - 1.0) < 3.0 * np.sqrt(2.0 / (SETS - 1))


def test_few_probes_are_warned_of(filtering: Filtering) -> None:
    """With the number of probes that the warning names there is none."""
    [bands] = filtering.bands
    shape = (1, len(bands.modes), len(bands.first))
    mean = np.ones(shape, dtype=complex)
    error = normalisation_error(filtering, mean)
    assert np.isfinite(error).sum() == len(set(zip(*bands.numbers[:2], strict=True)))

    def summary(ratio: float) -> xr.Dataset:
        dims = ("pair", "mode", "bin")
        return xr.Dataset({"biposh_qml_mean": (dims, mean), "biposh_qml_standard_error": (dims, error / ratio)})

    with pytest.warns(UserWarning, match=rf"{PROBES} random probes.* 5 times .*biposh.probes = {10 * PROBES} or more"):
        warn_of_probes(filtering, summary(5.0))
    warn_of_probes(filtering, summary(0.4))
    more = replace(filtering, probes=10 * PROBES)
    left = normalisation_error(more, mean)
    known = np.isfinite(left)
    assert np.sqrt(np.mean((5.0 * left[known] / error[known]) ** 2)) < 0.55


def test_uniform_noise_on_the_full_sky_needs_no_probes() -> None:
    exact = survey(config.load(RUN)).filtering
    assert exact is not None
    [bands] = exact.bands
    mean = np.ones((1, len(bands.modes), len(bands.first)), dtype=complex)
    assert np.nanmax(normalisation_error(exact, mean)) == 0.0
