"""Fits to all orders in the beam: against independent predictions, a brute-force minimum, and ensembles of skies."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from mcsim import config
from mcsim.beamfit import Measurement, Selection, fit, fit_models, report
from mcsim.beamfit.data import SUMMARY, Row, project
from mcsim.beamfit.models import model
from mcsim.beamfit.templates import Templates, templates
from mcsim.bipolar import parse_mode
from mcsim.bipolar.theory import ScannedBeam, cmb_biposh_exact
from mcsim.ensemble import expectation
from mcsim.errors import InputError
from mcsim.simulation import simulate
from mcsim.simulation.survey import Survey, survey
from refusals import refused

LMAX = 64
MODES = ("L2M0d0", "L2M0d2")
ELL = np.arange(LMAX + 1.0)


@pytest.fixture(scope="module")
def shared() -> Survey:
    """An elongated beam on rings, where a prediction leaves nothing out."""
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 240.0, "m_max": 4}
    return survey(
        config.load(
            {
                "schema": 1,
                "name": "rings",
                "sky": {"spectrum": "wmap7", "lmax": LMAX},
                "map": {"grid": "gl"},
                "channel": [{"name": "W1", "beam": beam, "scan": {"kind": "parallel_transport"}}],
                "biposh": {"summary_bin": 8},
                "ensemble": {"realizations": 1, "seed": 5, "paired": True},
            }
        )
    )


ROWS = tuple(
    Row(mode, a, a + 7, part)
    for mode in map(parse_mode, (*MODES, "L2M0d1"))
    for part in mode.parts
    for a in range(8, 64, 8)
)


def predicted(shared: Survey, factor: np.ndarray, rows: tuple[Row, ...] = ROWS) -> np.ndarray:
    """Exact data of b_l2 f_l, from the theory alone."""
    blm = shared.channels[0].beam.blm.copy()
    blm[2] *= factor
    beam = ScannedBeam(blm, expectation.scanned_beams(shared, expectation.L_MOMENTS)[0].w)
    modes = list(dict.fromkeys(row.mode for row in rows))
    return project(rows, SUMMARY, dict(zip(modes, cmb_biposh_exact(modes, shared.cl, LMAX, beam), strict=True)))


def measured(value: np.ndarray, error: float, rows: tuple[Row, ...] = ROWS) -> Measurement:
    covariance = error**2 * (np.eye(len(rows)) + 0.3 * np.ones((len(rows), len(rows))))
    return Measurement("synthetic", None, "difference", rows, SUMMARY, value, covariance, None)


@pytest.fixture(scope="module", autouse=True)
def predicted_once() -> Iterator[None]:
    """Predictions depend on the bins of a measurement, not on its values: fits to the same bins share them."""
    known: dict[tuple[object, ...], np.ndarray] = {}
    predict = Templates.data

    def data(own: Templates, factor: np.ndarray, exact: bool = False, L_moments: int | None = None) -> np.ndarray:
        key = (own.measured.rows, own.measured.kind, factor.astype(complex).tobytes(), exact, L_moments)
        if key not in known:
            known[key] = predict(own, factor, exact, L_moments)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Templates, "data", data)
        yield


@pytest.fixture(scope="module")
def made(shared: Survey) -> Templates:
    """What nested models share is computed once."""
    return templates(shared, measured(np.zeros(len(ROWS)), 1.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "theta"), [("constant", [0.6]), ("linear", [1.4, -0.01]), ("orientation", [0.7, 0.4])]
)
def test_the_exact_data_are_a_polynomial_of_second_degree(shared, made, name, theta):
    chosen = model(name, (8, 63))
    polynomial, expected = made.exact(chosen), predicted(shared, np.array(theta) @ chosen.functions(ELL))
    np.testing.assert_allclose(polynomial.at(np.array(theta)), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    # The tangent is the derivative by central differences, which a polynomial of second degree has without error.
    step = 1e-3 * np.eye(len(theta))
    slope = [(polynomial.at(theta + one) - polynomial.at(theta - one)) / 2e-3 for one in step]
    np.testing.assert_allclose(polynomial.derivative(np.array(theta)), np.transpose(slope), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("name", "factor"), [("constant", 0.8 + 0.0 * ELL), ("linear", 1.2 - 0.005 * ELL)])
def test_exact_data_give_back_their_beam_and_leading_order_does_not(shared, name, factor):
    data = measured(predicted(shared, factor), 0.005)
    found = fit(data, shared, name)
    assert found.order == "exact"
    np.testing.assert_allclose(found.factor()[0], factor[8:64], rtol=1e-7)
    assert found.solution.chi2 < 1e-10
    np.testing.assert_allclose(found.best, data.value, rtol=1e-6, atol=1e-6)
    leading = fit(data, shared, name, order="leading")
    assert leading.order == "leading"
    assert leading.solution.probability < 1e-6
    assert "all orders in the beam" in report([found])


@pytest.mark.slow
def test_the_minimum_is_that_of_a_brute_force_search_over_predictions(shared):
    """Noisy data, each chi^2 of the search from a prediction of its own: equal to a thousandth of an error."""
    rng = np.random.default_rng(3)
    data = measured(predicted(shared, 1.1 + 0.0 * ELL), 40.0)
    data = measured(data.value + 40.0 * rng.normal(size=len(ROWS)), 40.0)
    weight = np.linalg.inv(data.covariance)

    def chi2(alpha: float) -> float:
        residual = data.value - predicted(shared, alpha + 0.0 * ELL)
        return float(residual @ weight @ residual)

    searched = optimize.minimize_scalar(chi2, (1.0, 1.2), tol=1e-7)
    found = fit(data, shared, order="exact").solution
    assert found.parameters[0] == pytest.approx(searched.x, abs=1e-3 * found.errors[0])
    assert found.chi2 == pytest.approx(searched.fun, rel=1e-8)
    # The error of the tangent is that of the chi^2: one error away it is higher by one.
    side = 0.5 * sum(chi2(searched.x + sign * found.errors[0]) for sign in (-1.0, 1.0)) - searched.fun
    assert side == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("imaginary", [0.4, -0.4])
def test_a_sign_that_spectra_do_not_tell_is_said(shared, imaginary):
    """Even parity has the square of the imaginary part: of 0.7 - 0.4 i the fit was 0.7 + 0.4 i, with a small error."""
    data = measured(predicted(shared, 0.7 + imaginary * 1j + 0.0 * ELL), 0.005)
    weak = np.where([row.mode.parity == "odd" for row in ROWS], 1e4, 1.0)
    found = fit(replace(data, covariance=data.covariance * np.outer(weak, weak)), shared, "orientation")
    both = [found.solution.parameters[1], found.other.parameters[1]]
    assert both[0] * both[1] < 0.0
    assert min(abs(one - imaginary) for one in both) < 1e-3
    assert found.solution.chi2 <= found.other.chi2 < found.solution.chi2 + 9.0
    assert "or by" in report([found])
    assert found.to_dict()["other"]["parameters"]["imaginary"] == both[1]
    told = fit(data, shared, "orientation")
    np.testing.assert_allclose(told.solution.parameters, [0.7, imaginary], rtol=1e-7)
    assert told.other is None


def test_leading_order_is_enough_where_the_data_cannot_tell(shared):
    exact = predicted(shared, 1.0 + 0.0 * ELL)
    beyond = fit(measured(exact, 1.0), shared).beyond_leading
    assert beyond > 1.0
    coarse = fit(measured(exact, 20.0 * beyond), shared)
    assert coarse.order == "leading"
    assert coarse.beyond_leading < 0.1
    forced = fit(measured(exact, 20.0 * beyond), shared, order="exact")
    shift = abs(forced.solution.parameters - coarse.solution.parameters) / forced.solution.errors
    assert shift[0] < 0.1
    # Between the two, every model of a comparison is fitted to the same order.
    orders = [one.order for one in fit_models(measured(exact, 10.5 * beyond), shared, ["constant", "linear", "spline"])]
    assert len(set(orders)) == 1


@pytest.mark.slow
def test_ensembles_of_the_same_configuration_are_accepted(shared):
    """Paired differences of 12 ensembles of 48 skies: their p-values are uniform; leading order rejects the whole."""
    modes = {mode.name: number for number, mode in enumerate(shared.estimator.modes)}
    rows = tuple(row for row in ROWS if row.mode.name in MODES)
    skies = [simulate.realize(shared, r) for r in range(576)]
    difference = np.array([sky["biposh"][0] - sky["biposh_circular"][0] for sky in skies])
    drawn = project(rows, SUMMARY, {row.mode: difference[:, modes[row.mode.name]] for row in rows})

    def mean(skies: np.ndarray) -> Measurement:
        value, covariance = skies.mean(axis=0), np.cov(skies.T) / len(skies)
        return Measurement(
            "skies", None, "difference", rows, SUMMARY, value, covariance, len(skies), realizations=skies
        )

    found = [fit(mean(one), shared) for one in drawn.reshape(12, 48, -1)]
    assert {one.order for one in found} == {"exact"}
    assert stats.kstest([one.solution.probability for one in found], "uniform").pvalue > 0.01
    pulls = [(one.solution.parameters[0] - 1.0) / one.solution.errors[0] for one in found]
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(12)
    assert fit(mean(drawn), shared).solution.probability > 0.01
    assert fit(mean(drawn), shared, order="leading").solution.probability < 1e-6


@pytest.mark.parametrize(
    "arguments",
    [
        {"modes": "L2M0d0"},
        {"modes": ()},
        {"modes": ("L2M0d0", "L2M0d0")},
        {"modes": ("L2M0",)},
        {"ell_range": (40, 10)},
        {"ell_range": (-1, 10)},
        {"ell_range": (10, 20, 30)},
        {"ell_range": (10,)},
        {"ell_range": 10},
        {"ell_range": ("10", "20")},
        {"modes": (("L2M0d0", "L2M0d2"),)},
        {"kind": "paired"},
    ],
)
def test_selections_that_mean_nothing_are_refused(arguments):
    with pytest.raises(InputError):
        Selection(**arguments)


def test_misuse_of_fits(shared):
    data = measured(predicted(shared, 1.0 + 0.0 * ELL), 1.0)
    with refused("second", "exact"):
        fit(data, shared, order="second")
    with refused("constant"):
        fit_models(data, shared, ["constant", "constant"])
    with pytest.raises(InputError):
        fit_models(data, shared, [])
    value = data.value.copy()
    value[3] = np.nan
    with refused("finite"):
        fit(measured(value, 1.0), shared)
    nowhere = (*ROWS[:6], Row(parse_mode("L2M0d2"), 0, 1, False))
    with refused("L2M0d2"):
        fit(measured(np.ones(7), 1.0, nowhere), shared)
