"""Models of f_l."""

import numpy as np
import pytest

from mcsim.beamfit.models import MODELS, model
from refusals import refused

ELL = np.arange(0.0, 101.0)


@pytest.mark.parametrize("name", MODELS)
def test_every_model_contains_the_constant_one(name):
    functions = model(name, (10, 90)).functions(ELL)
    theta, *_ = np.linalg.lstsq(functions.T, np.ones(len(ELL)).astype(functions.dtype), rcond=None)
    np.testing.assert_allclose(theta @ functions, 1.0, atol=1e-12)


def test_linear_parameters_are_value_at_zero_and_slope():
    np.testing.assert_array_equal(np.array([0.7, 0.01]) @ model("linear", (0, 100)).functions(ELL), 0.7 + 0.01 * ELL)


def test_spline_parameters_are_its_values_and_it_holds_lines():
    spline = model("spline", (10, 90), knots=5)
    assert spline.parameters == ("f(10)", "f(30)", "f(50)", "f(70)", "f(90)")
    places = np.array([10.0, 30.0, 50.0, 70.0, 90.0])
    np.testing.assert_allclose(spline.functions(places), np.eye(5), atol=1e-12)
    values = (0.7 + 0.01 * places) @ spline.functions(ELL)
    np.testing.assert_allclose(values, 0.7 + 0.01 * ELL, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("cubic", (0, 100)), ("cubic", "spline")),
        (("spline", (0, 100), 2), ("2 knots", "3 knots")),
        (("spline", (0, 3), 9), ("9 knots", 3)),
    ],
)
def test_refusals(arguments, named):
    with refused(*named):
        model(*arguments)
