"""Controls of right models fail at their rate, however many there are."""

import numpy as np
import pytest
from scipy import stats

from mcsim.diagnosis.control_result import LEVEL, Control, Controls
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate, calibrate_in_folds, global_test

MODELS, ELEMENTS, SIMULATIONS, DATA = 40, 40, 60, 500


@pytest.fixture(scope="module")
def pvalues():
    """Return p-values of perfect data of each of some models, each known from simulations of its own."""
    rng, rows = np.random.default_rng(20261127), []
    for _ in range(MODELS):
        null = SimulatedGaussian.from_simulations(rng.normal(size=(SIMULATIONS, ELEMENTS)), shrink=True)
        templates = null.whiten_groups(rng.normal(size=(ELEMENTS, 12)), [(2 * i, 2 * i + 1) for i in range(6)])
        calibration = calibrate_in_folds(calibrate(null, templates, draws=4000), null, templates)
        data = rng.normal(size=(DATA, ELEMENTS))
        rows.append([global_test(null, x, templates, calibration).pvalue for x in data])
    return np.array(rows)


def controls(pvalues, simulations=SIMULATIONS):
    return Controls(tuple(Control(p, "none", ()) for p in pvalues), "x", 0.05, simulations)


@pytest.mark.parametrize("count", [30, DATA])
def test_controls_of_right_models_seldom_fail(pvalues, count):
    """If simulations had no error of their own 19 would fail with all data, without Bonferroni's factor 12 and 40."""
    failed = sum(controls(row[:count]).failed for row in pvalues)
    assert failed <= stats.binom.ppf(0.999, MODELS, 2.0 * LEVEL)


def test_controls_with_too_many_small_p_values_fail():
    wrong = np.random.default_rng(1).uniform(size=1000) ** 1.5  # 13.6 % of them are below 0.05
    found = controls(wrong, 200)
    assert found.uniformity < LEVEL < found.smallest
    assert found.failed


def test_controls_with_one_p_value_that_is_too_small_fail():
    even = (np.arange(100) + 0.5) / 100
    for smallest, failed in ((1.1e-4, False), (0.9e-4, True)):
        found = controls([smallest, *even[1:]])
        assert found.uniformity > 0.9
        assert found.failed == failed
