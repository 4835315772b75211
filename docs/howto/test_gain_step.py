"""The example of the documentation: none at zero amplitude, a step else, and known by its name."""

import numpy as np
from gain_step import GainStep

from mcsim.systematics import build

DAYS = 86400.0 * np.array([0.0, 90.0, 92.0, 365.0])


def test_zero_amplitude_is_no_effect():
    assert GainStep(amplitude=0.0).gain(DAYS, site=None) is None


def test_gain_changes_on_the_day():
    np.testing.assert_array_equal(GainStep(amplitude=0.01, day=91.0).gain(DAYS, site=None), [0.0, 0.0, 0.01, 0.01])


def test_a_table_of_a_run_builds_it():
    effect = build(GainStep, {"amplitude": 0.01, "day": 10.0})
    assert effect == GainStep(amplitude=0.01, day=10.0)
