"""Predictions of everything at once: pairs in both orders, noise of uneven hits, scans without symmetry, a mask."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
import xarray as xr
from scipy import stats

import mcsim
from mcsim import beamfit, bipolar, config
from mcsim.beamfit.data import SUMMARY, Row, project
from mcsim.beamfit.templates import templates
from mcsim.bipolar.modes import Mode
from mcsim.ensemble import describe, expectation, prediction, tables
from mcsim.instrument import scan
from mcsim.simulation import simulate
from mcsim.simulation.survey import Survey, survey
from refusals import refused

NSIDE, LMAX, SKIES, BIN = 32, 64, 200, 16
THETA, PHI = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
X, Y, Z = np.sin(THETA) * np.cos(PHI), np.sin(THETA) * np.sin(PHI), np.cos(THETA)


def lopsided_moments(path: Path, psi0: float) -> str:
    """A scan that treats neither the hemispheres nor the longitudes nor the senses of rotation alike."""
    spread = 0.75 + 0.1 * np.cos(2 * THETA) + 0.12 * X * np.cos(psi0) + 0.1 * Y * Z
    hits = 100.0 * (1.0 + 0.6 * Z**2 + 0.3 * X * Y + 0.2 * Y)
    w = np.array([np.exp(-1j * s * (0.4 + psi0)) * spread**s for s in range(1, 5)])
    scan.write_moments_fits(path, scan.Moments(NSIDE, "ecliptic", hits, w))
    return str(path)


def two_channels(folder: Path, noise: float, preparation: tuple[Any, ...] = (), **maps: Any) -> Survey:
    shapes = {"A": (300.0, 250.0, 0.0), "B": (330.0, 270.0, 0.7)}
    channels = [
        {
            "name": name,
            "beam": {
                "kind": "elliptical_gaussian",
                "fwhm_major_arcmin": major,
                "fwhm_minor_arcmin": minor,
                "angle_deg": 10.0,
            },
            "scan": {"kind": "moments", "path": lopsided_moments(folder / f"{name}.fits", psi0)},
            "noise": {"sigma0_uk": noise},
        }
        for name, (major, minor, psi0) in shapes.items()
    ]
    run = {
        "schema": 1,
        "name": "two",
        "sky": {"spectrum": "wmap7", "lmax": LMAX},
        "map": {"nside": NSIDE, **maps},
        "channel": channels,
        "preparation": list(preparation),
        "biposh": {"L_max": 2, "summary_bin": BIN},
        "ensemble": {"realizations": SKIES, "seed": 3},
    }
    return survey(config.load(run))


def vectors(shared: Survey, biposh: np.ndarray, pair: int, mode: int) -> np.ndarray:
    """Binned real and imaginary parts of one mode, shape (..., 4 or 8)."""
    one = shared.estimator.modes[mode]
    rows = [Row(one, low, low + BIN - 1, part) for low in range(0, LMAX, BIN) for part in one.parts]
    return project(rows, SUMMARY, {one: biposh[..., pair, mode, :]})


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, dict[str, np.ndarray]]:
    shared = two_channels(tmp_path_factory.mktemp("noisy"), 60.0)
    skies = [simulate.realize(shared, r) for r in range(SKIES)]
    return shared, {name: np.array([sky[name] for sky in skies]) for name in skies[0]}


def probabilities(shared: Survey, skies: dict[str, np.ndarray], expected: xr.Dataset) -> np.ndarray:
    """Hotelling's T^2 of each pair and mode with L > 0, of the plain mean and of the paired difference."""
    found = []
    for kind, sample in (("", skies["biposh"]), ("_difference", skies["biposh"] - skies["biposh_circular"])):
        mean = expected[f"biposh{kind}_mean"].values
        for pair in range(len(shared.pairs)):
            for mode, one in enumerate(shared.estimator.modes):
                if one.L == 0 or np.isnan(mean[pair, mode]).all():
                    continue
                drawn = vectors(shared, sample, pair, mode)
                residual = drawn.mean(axis=0) - vectors(shared, mean, pair, mode)
                n, p = drawn.shape
                t2 = n * residual @ np.linalg.solve(np.cov(drawn.T), residual)
                found.append(stats.f.sf((n - p) / (p * (n - 1)) * t2, p, n - p))
    return np.array(found)


def test_every_mode_of_every_pair_is_predicted(noisy) -> None:
    """86 spectra (A,A; A,B in both orders; B,B): odd parity, M != 0, the noise's own anisotropy and the beams'."""
    shared, skies = noisy
    found = probabilities(shared, skies, prediction.predict(shared, exact=True, L_moments=24))
    assert found.size == 86
    assert found.min() > 1e-4
    assert stats.kstest(found, "uniform").pvalue > 0.01


def test_leading_order_and_an_even_noise_would_be_found_out(noisy) -> None:
    shared, skies = noisy
    assert probabilities(shared, skies, prediction.predict(shared)).min() < 1e-8
    even = prediction.predict(shared, exact=True, L_moments=24)
    even["biposh_mean"] = even["biposh_mean"] - even["biposh_circular_mean"].where(even["L"] > 0, 0.0)
    assert probabilities(shared, skies, even).min() < 1e-8


def test_spectra_and_scatter(noisy) -> None:
    shared, skies = noisy
    expected = prediction.predict(shared, exact=True, L_moments=24)
    cl = skies["cl"][..., 2:]
    z = (cl.mean(axis=0) - expected["cl_mean"].values[:, 2:]) / (cl.std(axis=0, ddof=1) / np.sqrt(SKIES))
    # 63 nearly independent degrees of each pair.
    assert np.all(np.abs(np.mean(z**2, axis=1) - 1.0) < 4.0 * np.sqrt(2.0 / z.shape[1]))
    rows = [row for row, mode in enumerate(shared.estimator.modes) if mode.L > 0 and mode.in_auto]
    measured = skies["biposh_circular"][:, :, rows, 10:].std(axis=0, ddof=1)
    predicted = expected["biposh_circular_standard_deviation"].values[:, rows, 10:]
    # Each standard deviation is known to about 1/sqrt(2 N) = 5 %; here the mean of 55 degrees, with room for the
    # anisotropy of the noise, which is second order.
    assert np.all(np.abs((measured / predicted).mean(axis=-1) - 1.0) < 0.04)


def test_joint_signal_to_noise_is_at_least_that_of_every_mode_and_less_than_infinite(noisy, tmp_path: Path) -> None:
    shared, _ = noisy
    expected = prediction.predict(shared, snr=True)
    each = expected["signal_to_noise"]
    total = float(expected["signal_to_noise_total"])
    autos = np.sqrt((each.sel(pair="A,A") ** 2).sum())
    assert float(each.max()) < float(autos) < total < np.inf
    bins = np.sqrt((expected["signal_to_noise_binned"] ** 2).sum("bin"))
    xr.testing.assert_allclose(bins.where(np.isfinite(each)), each, rtol=1e-10)
    text = describe.describe_prediction(expected)
    assert "jointly" in text
    # What the beam alone makes stands beside the mean, and errors of rounding are no imaginary parts.
    first = expected.biposh_difference_binned_mean.sel(pair="A,A", mode="L2M0d0").isel(bin=0).real.item()
    assert f" {first:.4g}\n" in text
    assert "e-17j" not in text
    # What all maps say together does not depend on which pairs the ensemble keeps.
    run = shared.config
    autos = prediction.predict(survey(replace(run, biposh=replace(run.biposh, pairs="auto"))), snr=True)
    assert float(autos["signal_to_noise_total"]) == pytest.approx(total, rel=1e-12)
    # Two maps of one sky without noise tell their beams apart from it at will.
    quiet = prediction.predict(two_channels(tmp_path, 0.0), snr=True)
    assert np.isinf(quiet["signal_to_noise_total"])


def test_two_masks_leave_errors_and_a_finite_signal_to_noise(tmp_path: Path) -> None:
    """At low l (C^XY)^2 is above C^XX C^YY of the masked maps; the errors of 150 skies, over all M of odd L."""
    for name, height in (("A", Z), ("B", 0.5 * X + 0.8 * Z)):
        mask = np.clip(np.abs(height) / 0.5, 0.0, 1.0) ** 2
        healpy.write_map(tmp_path / f"mask-{name}.fits", mask, dtype=np.float64, coord="E")
    run = two_channels(tmp_path, 60.0, mask=str(tmp_path / "mask-{channel}.fits")).config
    shared = survey(
        replace(run, sky=replace(run.sky, lmax=24), biposh=replace(run.biposh, summary_bin=8, iterations=1))
    )
    expected = prediction.predict(shared, snr=True, L_moments=24)
    total = float(expected["signal_to_noise_total"])
    assert np.sqrt(float((expected["signal_to_noise"][[0, 2]] ** 2).sum())) < total < 10.0
    assert "each M" in expected.attrs["errors"]
    cl = expected["cl_circular_mean"].values
    assert (cl[1] ** 2 > cl[0] * cl[2])[2:].any()
    skies = np.array([simulate.realize(shared, r)["biposh_circular"][1] for r in range(150)])
    for L in (1, 2):
        rows = [shared.estimator.modes.index(Mode(L, M, 0)) for M in range(L + 1)]
        orders = np.array([1.0] + [2.0] * L) / (2 * L + 1)
        measured = orders @ skies[:, rows, 8:].var(axis=0, ddof=1)
        predicted = orders @ expected["biposh_circular_standard_deviation"].values[1, rows, 8:] ** 2
        # Variances of 2 L + 1 numbers of 150 skies at 17 degrees, which are about independent.
        scatter = np.sqrt(2.0 / (150 * (2 * L + 1) * measured.size))
        assert abs(np.mean(measured / predicted) - 1.0) < 4.0 * scatter


def exact_mean(shared: Survey, monkeypatch: pytest.MonkeyPatch) -> dict[str, np.ndarray]:
    """The expectation of what a run measures: the sum over all coefficients of the sky, one at a time."""
    assert shared.cl is not None
    ell, m = healpy.Alm.getlm(shared.config.sky.lmax)
    total: dict[str, np.ndarray] = {}
    for i in np.flatnonzero(shared.cl[ell] > 0.0):
        for phase in (1.0,) if m[i] == 0 else (np.sqrt(0.5), 1j * np.sqrt(0.5)):
            alm = np.zeros(ell.size, dtype=complex)
            alm[i] = phase * np.sqrt(shared.cl[ell[i]])
            monkeypatch.setattr(simulate, "draw_sky", lambda *_, alm=alm: alm)
            for name, values in simulate.realize(shared, 0).items():
                total[name] = total.get(name, 0.0) + values
    return total


@pytest.mark.parametrize("holes", [False, True])
def test_masks_of_two_maps_are_predicted(holes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two caps that overlap in a belt, or a mask with holes; the control's own coefficients, and all parities."""
    for name, sign in (("A", 1.0), ("B", -1.0)):
        tilted = np.stack([X, Y, Z], axis=-1) @ np.array([0.3, 0.5, sign * 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
        mask = np.sin(0.5 * np.pi * np.clip((tilted + 0.7) / 0.5, 0.0, 1.0)) ** 2
        if holes:
            mask = (tilted > -0.7) * (np.random.default_rng(1).random(mask.size) > 0.1)
        healpy.write_map(tmp_path / f"mask-{name}.fits", mask, dtype=np.float64, coord="E")
    plain = two_channels(tmp_path, 0.0, mask=str(tmp_path / "mask-{channel}.fits")).config
    low = replace(plain, sky=replace(plain.sky, lmax=20), biposh=replace(plain.biposh, iterations=3))
    shared = survey(low)
    found = exact_mean(shared, monkeypatch)
    expected = prediction.predict(shared, exact=True)
    assert 0.5 < expected.attrs["f_sky"] < 0.9
    difference = found["biposh"] - found["biposh_circular"]
    # What scatters from holes smaller than 180/64 degrees is left out.
    for name, size, tolerance in (("_difference", difference, 0.01), ("_circular", found["biposh_circular"], 0.002)):
        mean = expected[f"biposh{name}_mean"].values
        for pair, *_ in enumerate(shared.pairs):
            there = ~np.isnan(mean[pair])
            error = np.abs(mean[pair] - size[pair])[there]
            assert error.max() < (5.0 if holes else 1.0) * tolerance * np.abs(size[pair][there]).max()
    leading = prediction.predict(shared)
    left = np.nanmax(np.abs(leading["biposh_difference_mean"].values - difference))
    assert left < 0.15 * np.nanmax(np.abs(difference))


def test_a_mask_as_a_step_has_the_noise_of_one_of_the_map(tmp_path: Path) -> None:
    mask = np.sin(0.5 * np.pi * np.clip((X + 0.8) / 0.9, 0.0, 1.0)) ** 2
    healpy.write_map(tmp_path / "mask.fits", mask, dtype=np.float64, coord="E")
    masked = two_channels(tmp_path, 600.0, mask=str(tmp_path / "mask.fits")).config
    step = {"kind": "mask", "mask": str(tmp_path / "mask.fits")}
    as_step = two_channels(tmp_path, 600.0, preparation=(step,)).config
    expected, found = (prediction.predict(run, L_moments=16) for run in (masked, as_step))
    for name in ("cl_mean", "biposh_mean", "biposh_standard_deviation"):
        xr.testing.assert_allclose(found[name], expected[name], rtol=1e-10)


SMOOTH = {"kind": "smooth", "fwhm_arcmin": 500.0}
SOFT = np.sin(0.5 * np.pi * np.clip((np.abs(Z) - 0.2) / 0.2, 0.0, 1.0)) ** 2
AVERAGE, HARMONICS = ({"kind": "degrade", "nside": NSIDE // 2, "method": one} for one in ("average", "harmonics"))


def noisy_channel(*steps: dict[str, Any], even: float = 3000.0, sigma0_uk: float = 0.0, **maps: Any) -> dict[str, Any]:
    scan_ = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0, "line_of_sight": "A"}
    noise = {"sigma0_uk": sigma0_uk} if sigma0_uk else {"kind": "depth", "depth_uk_arcmin": even}
    channel = {
        "name": "A",
        "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0},
        "scan": scan_ if sigma0_uk else {"kind": "parallel_transport"},
        "noise": noise,
    }
    return {
        "name": "filtered noise",
        "sky": {"spectrum": "wmap7", "lmax": LMAX},
        "map": {"nside": NSIDE, **maps},
        "channel": [channel],
        "preparation": list(steps),
        "biposh": {"L_max": 2, "lmax": 24},
    }


@pytest.mark.parametrize(
    ("steps", "changes"),
    [
        ([SMOOTH], {"sigma0_uk": 300.0}),
        ([{"kind": "rotate", "frame": "galactic"}, HARMONICS], {"sigma0_uk": 300.0}),
        ([AVERAGE, SMOOTH], {}),
        ([SMOOTH, AVERAGE], {}),
        ([SMOOTH], {"mask": SOFT}),
        ([SMOOTH, {"kind": "mask", "mask": SOFT}], {}),
        ([{"kind": "fill", "mask": np.where(np.abs(Z) > 0.1, 1.0, 0.0)}, SMOOTH], {"mask": SOFT}),
    ],
)
def test_noise_that_steps_in_harmonics_correlate_is_predicted(
    steps: list[dict[str, Any]], changes: dict[str, Any]
) -> None:
    """C_l and every mode of 200 draws, against their scatter at 20 degrees; flat noise misses C_l by its errors."""
    shared = survey(config.load(noisy_channel(*steps, **changes)))
    [made], [m], [channel] = shared.making.maps, shared.maps, shared.channels
    alms = []
    for r in range(SKIES):
        prepared = simulate._finished(made, made.noise(1, r))
        alms.append(simulate._analyse(shared, channel, prepared, m.left_to_apply, 1))
    drawn = np.array([bipolar.estimate(shared.estimator, alm) for alm in alms])[..., 5:]
    expected = expectation.noise_mean(shared, 0, shared.estimator.modes)[:, 5:]
    missed = np.abs(drawn.mean(axis=0) - expected) ** 2 / np.var(drawn, axis=0, ddof=1) * SKIES
    # Of complex modes the real and the imaginary parts count together; neighbours behind a mask are correlated.
    assert np.all(missed.mean(axis=1) < 1.0 + 6.0 * np.sqrt(2.0 / missed.shape[1]))
    assert np.mean(drawn[:, 0].real.mean(axis=0) / expected[0].real) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("step", [SMOOTH, HARMONICS, {"kind": "rotate", "frame": "galactic"}])
def test_a_step_that_adds_no_information_leaves_the_signal_to_noise(step: dict[str, Any]) -> None:
    def of(*steps: dict[str, Any]) -> float:
        run = noisy_channel(*steps, even=20000.0)
        beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 330.0, "fwhm_minor_arcmin": 270.0}
        run["channel"][0]["beam"] = beam
        return float(prediction.predict(run, snr=True)["signal_to_noise_total"])

    assert of(step) == pytest.approx(of(), rel=2e-3)


@pytest.mark.parametrize(
    ("steps", "changes", "named"),
    [
        ([SMOOTH], {"sigma0_uk": 300.0, "mask": SOFT}, ("A", "arcmin", "mcsim")),
        ([{"kind": "mask", "mask": SOFT}, SMOOTH], {}, ("A", "arcmin", "mcsim")),
        ([SMOOTH, {"kind": "mask", "mask": SOFT}, SMOOTH | {"own_fwhm_arcmin": 490.0}], {}, ("A", "mcsim")),
        ([{"kind": "mask", "mask": np.where(Z > 0.9, 1.0, 0.0)}, SMOOTH], {}, ("A", 1, "mask")),
        ([{"kind": "smooth", "fwhm_arcmin": 310.0}, AVERAGE], {}, ("A", 47, 24, 0.1, "degrade")),
    ],
)
def test_filtered_noise_that_cannot_be_predicted_is_refused(
    steps: list[dict[str, Any]], changes: dict[str, Any], named: tuple[object, ...]
) -> None:
    with refused(*named):
        prediction.predict(noisy_channel(*steps, **changes))


@pytest.mark.parametrize(
    ("effect", "scan_"),
    [
        ({"name": "pixelization", "amplitude": -1.0}, {"kind": "hit_averaged", "model": "wmap"}),
        ({"name": "orientation_averaging", "amplitude": 0.7, "model": "wmap"}, {"kind": "parallel_transport"}),
    ],
)
def test_effects_are_predicted_or_refused(
    effect: dict[str, Any], scan_: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 500.0, "fwhm_minor_arcmin": 400.0}
    if scan_["kind"] == "hit_averaged":
        scan_ = scan_ | {"sample_period_s": 61.0}
    run = {
        "name": "acting",
        "sky": {"spectrum": "wmap7", "lmax": 16},
        "map": {"nside": 16, "offset_order": 0},
        "channel": [{"name": "W1", "beam": beam, "scan": scan_}],
        "biposh": {"L_max": 2, "iterations": 3},
        "effect": [effect | {"channel": "W1"}],
    }
    shared = survey(config.load(run))
    found = exact_mean(shared, monkeypatch)
    expected = prediction.predict(shared, exact=True)
    mode = shared.estimator.modes.index(Mode(2, 0, 0))
    difference = (found["biposh"] - found["biposh_circular"])[0, mode, 4:]
    assert expected["biposh_difference_mean"].values[0, mode, 4:] == pytest.approx(difference, rel=0.02)
    assert expected["cl_mean"].values[0, 4:] == pytest.approx(found["cl"][0, 4:], rel=0.01)
    drift = {"name": "gain_drift", "channel": "W1", "amplitude": 0.1}
    scanned = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0}
    changed = run | {"effect": [drift], "channel": [{"name": "W1", "beam": beam, "scan": scanned}]}
    with refused("gain_drift", "W1", "gain"):
        prediction.predict(changed)


@pytest.mark.parametrize(
    "effect",
    [
        {"name": "calibration", "channel": "W1", "amplitude": 0.01},
        {"name": "pointing_offset", "channel": "W1", "amplitude": 60.0, "angle_deg": 90.0},
    ],
)
def test_a_prediction_says_what_dipole_it_lacks(effect: dict[str, Any]) -> None:
    """That of a map of no sky: the dipole, or its gradient along the parallels, a sine of the longitude."""
    scan_ = {"kind": "parallel_transport"}
    run = {
        "name": "left",
        "sky": {"spectrum": "wmap7", "lmax": 16, "dipole_uk": 3364.5},
        "map": {"nside": 16},
        "channel": [{"name": "W1", "beam": {"kind": "gaussian", "fwhm_arcmin": 500.0}, "scan": scan_}],
        "effect": [effect],
    }
    shared = survey(config.load(run))
    with pytest.warns(UserWarning, match="dipole_uk") as told:
        expected = prediction.predict(shared)
    (left_uk,) = expectation.dipoles_left(shared).values()
    assert f"W1: {left_uk:.3g} uK" in str(told[0].message)
    assert f"W1: {left_uk:.3g} uK" in expected.attrs["left_out"]
    towards = shared.channels[0].site.dipole_uk / np.linalg.norm(shared.channels[0].site.dipole_uk)
    share = 1.0 if effect["name"] == "calibration" else np.hypot(*towards[:2])
    empty = np.zeros(17 * 18 // 2, dtype=np.complex128)
    assert np.abs(simulate.maps(shared, 0, sky=empty)).max() == pytest.approx(left_uk * share, rel=0.01)
    for quiet in (
        {"effect": [{"name": "beam_ellipticity", "channel": "W1", "amplitude": 0.02}]},
        {"sky": run["sky"] | {"dipole_uk": 0.0}},
        {"preparation": [{"kind": "subtract_dipole"}]},
    ):
        assert expectation.dipoles_left(survey(config.load(run | quiet))) == {}


def test_what_is_fitted_behind_a_mask_is_the_beam(tmp_path: Path) -> None:
    """In paired differences and in plain spectra, which the mask has a share of."""
    mask = np.sin(0.5 * np.pi * np.clip((X + 0.8) / 0.4, 0.0, 1.0)) ** 2
    healpy.write_map(tmp_path / "mask.fits", mask, dtype=np.float64, coord="E")
    shared = two_channels(tmp_path, 60.0, mask=str(tmp_path / "mask.fits"))
    expected = prediction.predict(shared)
    for one in ("standard_deviation", "standard_error"):
        expected[f"biposh_difference_binned_{one}"] = expected[f"biposh_binned_{one}"]
    tables.write(expected, tmp_path / "two.ecsv")
    for kind in ("plain", "difference"):
        measured = beamfit.measurement(tmp_path / "two.ecsv", shared, beamfit.Selection(kind=kind, pair="A,B"))
        found = beamfit.fit(measured, shared, order="leading")
        assert found.solution.parameters == pytest.approx([1.0], abs=1e-6)


def test_a_plain_spectrum_is_fitted_with_its_noise(tmp_path: Path) -> None:
    """Noise of uneven hits has a quadrupole of its own, which is no part of the factor."""
    shared = two_channels(tmp_path, 60.0)
    tables.write(prediction.predict(shared), tmp_path / "two.ecsv")
    for pair in ("A,A", "A,B"):
        measured = beamfit.measurement(tmp_path / "two.ecsv", shared, beamfit.Selection(kind="plain", pair=pair))
        found = beamfit.fit(measured, shared, order="leading")
        assert found.solution.parameters == pytest.approx([1.0], abs=1e-6)


def test_a_fit_ends_where_the_data_do(tmp_path: Path) -> None:
    """A bin of d < 0 holds l1 up to the lmax of the data, whatever that of the configuration; in tables and stores."""
    run = two_channels(tmp_path, 60.0).config
    longer = survey(run)
    shared = survey(replace(run, biposh=replace(run.biposh, lmax=40), ensemble=replace(run.ensemble, realizations=3)))
    expected = prediction.predict(shared)
    for one in ("standard_deviation", "standard_error"):
        expected[f"biposh_difference_binned_{one}"] = expected[f"biposh_binned_{one}"]
    tables.write(expected, tmp_path / "data.ecsv")
    mcsim.run(shared.config, tmp_path / "data.zarr", workers=1)
    chosen = beamfit.Selection(modes=["L2M0d0", "L2M0d2", "L2M0d-2"], pair="A,B")
    for name in ("data.ecsv", "data.zarr"):
        measured = beamfit.measurement(tmp_path / name, shared, chosen)
        assert measured.rows[-1][:3] == (Mode(2, 0, -2), 32, 40)
        ones = np.ones(LMAX + 1)
        same, other = (templates(one, measured).data(ones) for one in (shared, longer))
        np.testing.assert_allclose(other, same, rtol=1e-10)
        if name == "data.ecsv":
            np.testing.assert_allclose(measured.value, same, rtol=1e-10)
    # Bins up to 31 of d = -2 hold l1 = 33.
    low = beamfit.measurement(tmp_path / "data.ecsv", shared, replace(chosen, ell_range=(0, 31)))
    short = survey(replace(run, biposh=replace(run.biposh, lmax=31)))
    with refused("ell = 33", "31", "lmax"):
        templates(short, low)
