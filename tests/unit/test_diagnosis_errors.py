"""Errors of fitted effects."""

import numpy as np
import pytest

from mcsim import systematics
from mcsim.datavector.candidate import Candidate, tables_beside
from mcsim.diagnosis.assemble import effects_of
from mcsim.stats.gaussian import Fit


def candidate_of(name: str) -> tuple[Candidate, int]:
    """An effect of W1, and the number of its components."""
    size = len(Candidate(systematics.get(name), "W1", ()).basis)
    return Candidate(systematics.get(name), "W1", tuple(range(size))), size


@pytest.mark.parametrize("name", ["beam_coma", "beam_ellipticity", "dipole_residual", "calibration"])
def test_an_amplitude_is_no_more_errors_from_zero_than_chi2_falls(name: str) -> None:
    rng = np.random.default_rng(1)
    candidate, size = candidate_of(name)
    mixing = np.eye(size) - 0.3
    covariance = 1e-6 * mixing @ mixing.T
    for theta in rng.multivariate_normal(np.zeros(size), covariance, 50):
        fall = float(theta @ np.linalg.solve(covariance, theta))
        [found] = effects_of([candidate], [0], Fit(theta, covariance, 1000, fall, 1.0, 0.0, 1, 1.0))
        assert (found.amplitude / found.sigma) ** 2 <= fall * (1.0 + 1e-9)


def test_an_error_where_a_bound_fixes_a_parameter_is_that_along_the_bound() -> None:
    """Round part and quadrupole of a ring are fitted with strongly correlated errors; |quadrupole| is at most 1."""
    effect = systematics.get("beam_sidelobe")
    candidate = Candidate(effect, "W1", (0, 1))
    unit = effect.parametrization.coordinates(effect(amplitude=1.0, quadrupole=-1.0))
    covariance = np.diag([1e-5, 1e-6]) ** 2
    theta = 2e-5 * unit - np.array([1.8e-5, 0.0])  # two errors off: the quadrupole would be -10
    [found] = effects_of([candidate], [0], Fit(theta, covariance, 1000, 400.0, 1.0, 0.0, 1, 1.0))
    assert found.parameters["quadrupole"] == -1.0
    assert found.sigma == pytest.approx(float(unit @ np.linalg.solve(covariance, unit)) ** -0.5, rel=1e-9)


def test_the_error_of_a_whole_number_is_in_its_own_unit() -> None:
    """Coordinates of a map-making that stops early are 1.5^n - 1, not n times those of one iteration."""
    effect = systematics.get("mapmaking_convergence")
    candidate, size = Candidate(effect, "W1", (0,)), 1.5**30
    found_at = Fit(np.array([size - 1.0]), np.array([[(0.1 * size) ** 2]]), 1000, 100.0, 1.0, 0.0, 1, 1.0)
    [found] = effects_of([candidate], [0], found_at)
    assert found.amplitude == pytest.approx(30.0, abs=1e-6)
    assert found.sigma == pytest.approx(np.log(1.1 / 0.9) / (2.0 * np.log(1.5)), rel=1e-6)


@pytest.mark.parametrize(("name", "followed"), [("beam_coma", False), ("beam_ellipticity", True)])
def test_no_slope_is_taken_along_an_amplitude_that_the_effect_cannot_follow(name: str, followed: bool) -> None:
    """The four amplitudes of a coma have two parameters: slopes along each would make a singular matrix."""
    candidate, size = candidate_of(name)
    theta = candidate.parametrization.coordinates(candidate.effect(amplitude=0.02, angle_deg=20.0))
    found = Fit(theta, 1e-6 * np.eye(size), 1000, 400.0, 1.0, 0.0, 1, 1.0)
    tables = [table for _, table in tables_beside([candidate], [0], found, np.full((1, size), 1e9), 0.3)]
    assert [table is not None for table in tables] == size * [followed]
