"""The error that random probes give to the normalisation of filtered estimates, against many sets of probes."""

from typing import Any

import numpy as np
import pytest

from mcsim import config
from mcsim.simulation.filtering import Filtering
from mcsim.simulation.survey import survey
from mcsim.stats.wishart import inverse_variance

PROBES, SETS = 8, 60


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
    """Of the estimate of a mean of several S/N, the mean variance over the expected one within three of its errors.

    With variances over the number of draws, as if the inverse were not one of a few of them, it is 1.6 and 1.9.
    """
    [bands], [one] = filtering.bands, filtering.filters
    probes = [(one.probe(number),) for number in range(PROBES * SETS)]
    exact = filtering.response(probes[:300], 0).matrix
    drawn = [filtering.response(probes[row * PROBES : (row + 1) * PROBES], 0) for row in range(SETS)]
    variances = np.diag(np.linalg.inv(exact))
    first = np.array([mode.L for mode in bands.modes])[bands.numbers[0]] == 0
    for sizes in (np.where(first, 10.0, 0.0), np.where(first, 0.0, 3.0)):
        numbers = sizes * np.sqrt(variances)
        found = [unbiased * np.linalg.solve(matrix, exact @ numbers) for matrix, unbiased in drawn]
        total = float(numbers @ exact @ numbers)
        expected = inverse_variance(variances, numbers**2, total, bands.size, PROBES * (PROBES - 1) / 2.0)
        ratio = np.mean(np.var(found, axis=0, ddof=1) / expected)
        assert abs(ratio - 1.0) < 3.0 * np.sqrt(2.0 / (SETS - 1))


def test_the_variance_is_that_of_inverses_of_gaussian_draws() -> None:
    """Of 20,000 sets of 20 draws: numbers that are zero have the first term alone, of the largest it is half."""
    rng, draws, sets = np.random.default_rng(20170301), 20, 20_000
    matrix = np.diag([2.0, 1.0, 1.0, 3.0]) + 0.3 * (np.eye(4, k=1) + np.eye(4, k=-1))
    numbers, size = np.array([3.0, 0.0, 0.0, -1.0]), len(matrix)
    rows = rng.normal(size=(sets, draws, size)) @ np.linalg.cholesky(matrix).T
    found = np.linalg.solve(np.swapaxes(rows, 1, 2) @ rows, (matrix @ numbers)[:, None])[..., 0] * (draws - size - 1.0)
    total = float(numbers @ matrix @ numbers)
    expected = inverse_variance(np.diag(np.linalg.inv(matrix)), numbers**2, total, size, draws)
    variances, fourth = np.var(found, axis=0), np.mean((found - found.mean(axis=0)) ** 4, axis=0)
    sigma = np.sqrt((fourth / variances**2 - 1.0) / sets)
    np.testing.assert_array_less(abs(variances / expected - 1.0), 4.0 * sigma)
    np.testing.assert_array_less(sigma, 0.03)


def test_too_few_draws_tell_nothing() -> None:
    one = np.ones(1)
    assert np.isinf(inverse_variance(one, one, 1.0, 12, 15.0)).all()
    assert inverse_variance(one, one, 1.0, 12, 1e6) == pytest.approx(2e-6, rel=1e-4)
