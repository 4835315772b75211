"""What a frozen change removes of the excess chi^2 of fresh data, and what files say of it."""

import numpy as np
import pytest

from mcsim.stats.excess import Frozen, HeldOut, Measured
from mcsim.stats.gaussian import SimulatedGaussian

P = 6


def test_the_fall_by_a_frozen_change_is_forecast_with_its_error() -> None:
    """The change is wrong by errors of a known covariance, of which 40 draws are given each time."""
    rng, test = np.random.default_rng(5), SimulatedGaussian(np.zeros(P), np.eye(P), 10**9)
    root, truth, draws = np.diag([1.5, 1.0, 1.0, 0.5, 0.3, 0.0]), np.array([1.5, 0.0, 1.0, 0.0, 0.0, 4.0]), 40
    missed, squares = [], []
    for errors in rng.normal(size=(3000, P, draws + 1)):
        own = root @ errors
        change = truth + own[:, 0]
        forecast = Frozen.of(test, change, own[:, 1:]).less(Measured(float(change @ change), 0.0))
        # Of data without noise: chi^2 of the truth less that of what the change leaves of it.
        fall = truth @ truth - np.sum((truth - change) ** 2)
        missed.append(forecast.value - fall)
        squares.append(forecast.sigma**2)
    variance = np.var(missed)
    assert abs(np.mean(missed)) < 4.0 * np.sqrt(variance / 3000)
    # The variance of a normal variable has a relative error of sqrt(2/3000); this one has the tails of squares.
    assert np.mean(squares) == pytest.approx(variance, rel=0.15)


def test_errors_of_a_fraction_stand_beside_it_in_the_verdict() -> None:
    found = HeldOut(*(Measured(10.0 * k, k + 0.5) for k in range(1, 5)), 0.25, "another half").to_json()
    assert [found[key] for key in ("predicted", "sigma_predicted", "achieved", "sigma")] == [10.0, 1.5, 20.0, 2.5]
    assert [found[key] for key in ("gap_before", "sigma_before", "gap_after")] == [30.0, 3.5, 40.0]
    assert (found["p_value_after"], found["data"]) == (0.25, "another half")
