"""Effective beams: known factors and angles come back from synthetic data, and the templates are those of the beam."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

import mcsim
from comparisons import MODEL as SMALL
from mcsim import config
from mcsim.beamfit import (
    QUADRUPOLE,
    Measurement,
    Selection,
    comparisons,
    fit_each,
    from_store,
    measurement,
    orientation,
    report,
    with_covariance_of,
)
from mcsim.beamfit import fit as fit_to_any_order
from mcsim.beamfit.data import SUMMARY, Row, Scaling, project
from mcsim.beamfit.templates import templates
from mcsim.bipolar import parse_mode
from mcsim.bipolar.theory import ScannedBeam, cmb_biposh_leading
from mcsim.ensemble import expectation, prediction
from mcsim.instrument.beams import Beam
from mcsim.plot.fit import fit_figure
from mcsim.simulation.survey import Survey, survey
from refusals import refused

LMAX = 200
BINS = [(low, low + 19) for low in range(20, 200, 20)]


def configuration(**beam):
    shape = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 70.0, "fwhm_minor_arcmin": 60.0} | beam
    return {
        "schema": 1,
        "name": "synthetic",
        "sky": {"spectrum": "wmap7", "lmax": LMAX},
        "map": {"nside": 128},
        "channel": [{"name": "W1", "beam": shape, "scan": {"kind": "parallel_transport"}}],
    }


@pytest.fixture(scope="module")
def shared() -> Survey:
    return survey(config.load(configuration()))


def expected(shared: Survey, blm: np.ndarray, names=("L2M0d0", "L2M0d2"), error=0.01) -> Measurement:
    """Leading-order data of a beam under the survey's scan."""
    modes = [parse_mode(name) for name in names]
    rows = tuple(Row(mode, a, b, part) for mode in modes for part in mode.parts for a, b in BINS)
    w = expectation.scanned_beams(shared, 2)[0].w
    spectra = cmb_biposh_leading([(m.L, m.M, m.d) for m in modes], shared.cl, LMAX, ScannedBeam(blm, w))
    value = project(rows, SUMMARY, dict(zip(modes, spectra, strict=True)))
    return Measurement("synthetic", None, "plain", rows, SUMMARY, value, error**2 * np.eye(len(rows)), None)


def rescaled(shared: Survey, factor) -> np.ndarray:
    blm = shared.channels[0].beam.blm.copy()
    blm[2] *= factor
    return blm


ELL = np.arange(LMAX + 1.0)


def fit(data, source, name="constant"):
    """Data made to leading order are fitted to leading order; tests/unit/test_fit_exact.py has the others."""
    return fit_to_any_order(data, source, name, order="leading")


def test_two_maps_have_no_noise_in_common_even_if_one_stands_for_both():
    channel = SMALL["channel"][0] | {"noise": {"sigma0_uk": 100.0}}
    noisy = survey(config.load(SMALL | {"map": {"nside": 16}, "channel": [channel]}))
    rows = tuple(Row(parse_mode(name), 8, 24, False) for name in QUADRUPOLE)
    measured = Measurement("synthetic", None, "plain", rows, SUMMARY, np.zeros(2), np.eye(2), None)
    made = templates(noisy, measured)
    alone, itself, other = (
        replace(made, measured=replace(measured, pair=pair)).data(np.ones(33)) for pair in (None, "A,A", "A,B")
    )
    noise = expectation.noise_mean(noisy, 0, measured.modes)
    np.testing.assert_array_equal(alone, itself)
    np.testing.assert_allclose(
        alone - other, project(rows, SUMMARY, dict(zip(measured.modes, noise, strict=True))), rtol=1e-9
    )


def test_covariances_of_two_maps_are_those_of_such_a_pair(tmp_path):
    biposh, ensemble = {"L_max": 2, "summary_bin": 8}, {"realizations": 4, "seed": 3}
    run = SMALL | {"biposh": biposh, "ensemble": ensemble, "compute": {"workers": 1}}
    store = mcsim.run(run, tmp_path / "all.zarr").store
    measured = from_store(store, Selection(modes=["L2M0d0"], pair="W1:half1,W1:half2"))
    own = with_covariance_of(measured, store).covariance
    np.testing.assert_allclose(own, measured.covariance)  # of a mean of as many
    np.testing.assert_allclose(with_covariance_of(replace(measured, count=1), store).covariance, measured.count * own)
    np.testing.assert_array_equal(with_covariance_of(replace(measured, pair="A,B"), store).covariance, own)
    alone = mcsim.run(run | {"biposh": biposh | {"pairs": "auto"}}, tmp_path / "auto.zarr").store
    with refused("auto.zarr"):
        with_covariance_of(replace(measured, pair="A,B"), alone)


def test_spectra_that_are_detected_and_not_fitted_are_named(tmp_path):
    """An ellipse of axis ratio 1.5, in parallel transport and with control, shows in d = 0 and d = 2."""
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 900.0, "fwhm_minor_arcmin": 600.0}
    channel = {"name": "W1", "beam": beam, "scan": {"kind": "parallel_transport"}}
    run = SMALL | {
        "channel": [channel | {"noise": {"sigma0_uk": 0.0}}],
        "map": {"nside": 16},
        "biposh": {"L_max": 2, "summary_bin": 8},
        "ensemble": {"realizations": 24, "seed": 3, "paired": True},
        "compute": {"workers": 1},
    }
    store = mcsim.run(run, tmp_path / "ellipse.zarr").store
    found = fit(from_store(store, Selection(modes=["L2M0d0"])), survey(config.load(run)), "constant")
    assert found.measured.unfitted[0] == "L2M0d2"
    assert "L2M0d2 (--mode" in report([found])
    assert from_store(store).unfitted == ()


@pytest.mark.parametrize(
    ("name", "factor", "truth"),
    [
        ("constant", 0.6575, [0.6575]),
        ("linear", 0.4 + 0.002 * ELL, [0.4, 0.002]),
        ("spline", 0.4 + 0.002 * ELL, None),
    ],
)
def test_known_factors_come_back(shared, name, factor, truth):
    found = fit(expected(shared, rescaled(shared, factor)), shared, name)
    assert found.solution.chi2 < 1e-10
    inside = (found.ell >= 20) & (found.ell < 180)
    np.testing.assert_allclose(found.factor()[0][inside], (factor * np.ones(LMAX + 1))[20:180], rtol=1e-6)
    if truth is not None:
        np.testing.assert_allclose(found.solution.parameters, truth, rtol=1e-8)


def test_a_constant_does_not_fit_a_slope_and_the_comparison_says_so(shared):
    data = expected(shared, rescaled(shared, 0.4 + 0.002 * ELL), error=1.0)
    fits = [fit(data, shared, name) for name in ("constant", "linear", "spline")]
    assert fits[0].solution.probability < 1e-6
    tests = {(small, large): test for small, large, test in comparisons(fits)}
    assert tests["constant", "linear"].probability < 1e-6
    assert tests["linear", "spline"].probability > 0.99
    text = report(fits)
    assert "L2M0d2, ell" in text
    named = [replace(one, measured=replace(one.measured, pair="V1,W1")) for one in fits]
    assert "L2M0d2 of V1,W1, ell" in report(named)
    assert "linear over constant" in text
    assert "correlation" in text


def test_what_other_orders_of_the_beam_do_is_no_part_of_the_factor(shared):
    """An m = 1 part feeds L = 2 too: it stays as configured and is not rescaled."""
    blm = rescaled(shared, 0.5)
    own = shared.channels[0].beam.blm.copy()
    blm[1, 1:] = own[1, 1:] = 0.05 * np.abs(own[0, 1:])
    beam = replace(shared.channels[0].beam, blm=own)
    changed = replace(shared, channels=(replace(shared.channels[0], beam=beam),))
    found = fit(expected(changed, blm), changed)
    assert np.any(found.offset != 0.0)
    np.testing.assert_allclose(found.solution.parameters, [0.5], rtol=1e-8)


def test_angle_between_two_sides_and_their_common_turn(shared):
    """Sides at 7 - 15 and 7 + 15 degrees, made by turning the Gaussian itself."""
    sides = [Beam.elliptical(70.0, 60.0, angle_deg=angle, lmax=LMAX).blm for angle in (-8.0, 22.0)]
    names = ("L2M0d0", "L2M0d1", "L2M0d2")
    angles = orientation(fit(expected(shared, 0.5 * (sides[0] + sides[1]), names), shared, "orientation"))
    assert angles.symmetric_deg == pytest.approx(30.0, abs=1e-4)
    assert angles.common_deg == pytest.approx(7.0, abs=1e-4)
    assert 0.0 < angles.symmetric_error_deg < 1.0


def test_even_parity_alone_leaves_the_common_turn_open(shared):
    sides = [Beam.elliptical(70.0, 60.0, angle_deg=angle, lmax=LMAX).blm for angle in (0.0, 30.0)]
    found = fit(expected(shared, 0.5 * (sides[0] + sides[1])), shared, "orientation")
    angles = orientation(found)
    assert found.model.parameters == ("real",)
    assert angles.common_deg is None
    assert angles.one_sided_deg == pytest.approx(30.0, abs=1e-4)
    assert "deg, one as configured" in report([found])
    assert "L2M0d1" in report([found])


def test_even_parity_alone_leaves_the_turn_of_a_beam_at_an_angle_open(shared):
    """Both parts of the factor have the same template then: the fit had no solution."""
    beam = Beam.elliptical(70.0, 60.0, angle_deg=20.0, lmax=LMAX)
    turned = replace(shared, channels=(replace(shared.channels[0], beam=beam),))
    found = fit(expected(turned, beam.blm), turned, "orientation")
    assert found.model.parameters == ("real",)
    np.testing.assert_allclose(found.solution.parameters, [1.0], rtol=1e-8)
    three = fit(expected(turned, beam.blm, ("L2M0d0", "L2M0d1", "L2M0d2")), turned, "orientation")
    np.testing.assert_allclose(three.solution.parameters, [1.0, 0.0], atol=1e-6)


def test_a_factor_above_one_is_the_angle_zero(shared):
    angles = orientation(fit(expected(shared, rescaled(shared, 1.01)), shared, "orientation"))
    assert angles.symmetric_deg == 0.0
    assert angles.symmetric_error_deg > 0.0
    with refused("orientation", "constant"):
        orientation(fit(expected(shared, rescaled(shared, 1.01)), shared))


def test_bins_end_where_the_other_degree_of_a_pair_does():
    """At d = -1 it is the higher one: data up to l = 5 have l2 up to 4."""
    mode = parse_mode("L1M1d-1")
    raw = Scaling(bennett=False, spectrum=False, summary=False)
    found = project([Row(mode, 2, 7, False)], raw, {mode: np.arange(10.0) + 0j}, highest=5)
    assert found == pytest.approx([3.0])  # of 2, 3 and 4


@pytest.mark.parametrize(("normalisation", "scaling"), [("WMAP", "l(l+1)/2pi"), ("Hajian-Souradeep", "none")])
def test_a_users_table(shared, tmp_path, normalisation, scaling):
    """The sign and size that a user's table means are those of its normalisation: 0.7 comes back from each."""
    summary = prediction.predict(shared)
    rows = []
    for name, d in (("L2M0d0", 0), ("L2M0d2", 2)):
        one = summary.sel(mode=name, pair="W1,W1")
        raw = one["biposh_mean"].values.real
        scaled = one["bin_factor"].values * raw if normalisation == "WMAP" else raw
        rows += [(2, 0, d, a, b, 0.7 * scaled[a : b + 1].mean(), 0.1) for a, b in BINS]
    names = ["L", "M", "d", "ell_min", "ell_max", "value", "error"]
    table = Table(rows=rows, names=names, meta={"normalisation": normalisation, "scaling": scaling})
    table["value"].unit = table["error"].unit = "uK2"
    table.write(tmp_path / "t.ecsv", format="ascii.ecsv")
    np.testing.assert_allclose(fit(tmp_path / "t.ecsv", shared).solution.parameters, [0.7], rtol=1e-8)


def test_numbers_for_json_and_figure(shared, tmp_path):
    fits = [fit(expected(shared, rescaled(shared, 0.7)), shared, name) for name in ("constant", "linear", "spline")]
    plain = json.loads(json.dumps(fits[1].to_dict()))
    assert plain["parameters"]["alpha"] == pytest.approx(0.7)
    assert plain["modes"] == ["L2M0d0", "L2M0d2"]
    figure = fit_figure(fits)
    # Two modes and f_l, above residuals and text; every model is a line among the data.
    assert len(figure.axes) == 6
    drawn = [line.get_label() for line in figure.axes[0].get_lines()]
    assert {"constant", "linear", "spline"} <= set(drawn)
    figure.savefig(tmp_path / "fit.png")


def test_refusals(shared):
    data = expected(shared, rescaled(shared, 0.7))
    with refused("synthetic", "circular"):
        fit(data, configuration(fwhm_minor_arcmin=70.0))
    with refused(199, 100, "lmax"):
        fit(data, configuration() | {"biposh": {"lmax": 100}})
    with refused("synthetic", "ensemble"):
        fit_each(fit(data, shared))
    with refused("selection"):
        measurement(data, shared, Selection(["L2M0d0"]))
    with refused("quadratic", "linear"):
        fit(data, shared, "quadratic")
    two = configuration()
    two["channel"] = [two["channel"][0], two["channel"][0] | {"name": "W2"}]
    with refused("W1, W2"):
        fit(data, two)
    assert fit(replace(data, pair="W2,W2"), two).solution.parameters == pytest.approx([0.7])
    # A bin without a coefficient, of a mode that is imaginary.
    odd = expected(shared, rescaled(shared, 0.7), ["L2M0d1"])
    with refused("L2M0d1", "0-1"):
        fit(replace(odd, rows=(odd.rows[0]._replace(ell_min=0, ell_max=1), *odd.rows[1:])), shared)
    # Circular beyond doubt: what is left has no template.
    blm = rescaled(shared, 0.0)
    flat = replace(shared, channels=(replace(shared.channels[0], beam=Beam(blm)),))
    with refused("parameters"):
        fit(data, flat)
