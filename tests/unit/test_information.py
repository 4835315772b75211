"""Fisher information of maps: against the likelihood itself, closed forms, and random probes against whole matrices."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
import xarray as xr
from scipy.linalg import cho_factor, cho_solve
from typer.testing import CliRunner

import mcsim
from datasets import undescribed
from likelihoods import LMAX, NSIDE, channel, effect, expected_log_likelihood, model, moments_of, quiet
from mcsim import config, systematics
from mcsim.bipolar import estimate, estimator
from mcsim.bipolar.theory import fisher_information
from mcsim.cli import app
from mcsim.datavector.campaign import with_effects
from mcsim.information.api import describe, widths
from mcsim.information.figure import limit_figure
from mcsim.information.result import Limits, canonical_correlations, marginalised
from mcsim.simulation import simulate
from mcsim.simulation.inverse_covariance import unit_skies
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix
from mcsim.sphere.spectra import load
from refusals import refused


def one_map(nside: int = 16, sigma0_uk: float = 300.0) -> config.RunConfig:
    only = {
        "name": "W1",
        "frequency_ghz": 94.0,
        "beam": {"kind": "gaussian", "fwhm_arcmin": 1200.0},
        "noise": {"sigma0_uk": sigma0_uk},
        "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
    }
    return config.load(
        {
            "schema": 1,
            "name": "one",
            "sky": {"spectrum": "wmap7", "lmax": 6},
            "map": {"nside": nside},
            "channel": [only],
            "biposh": {"L_max": 2},
        }
    )


COMPARED = (
    "beam_ellipticity",
    "dipole_modulation",
    "dipole_residual",
    "gain_drift",
    "noise_level",
    "pixelization",
    "boost",
)


@cache
def limits(dense: bool) -> Limits:
    return mcsim.limit(model(), settings=mcsim.LimitSettings(only=COMPARED, dense=dense, orders=2))


@pytest.mark.parametrize("name", ["spin_synchronous_offset", "orbital_dipole", "sidelobe_pickup"])
def test_signals_of_samples_change_the_mean(name: str) -> None:
    """Two maps of the sky tell what is added to one of them: at least an eighth of what noise alone would allow."""
    run, settings = model(), mcsim.LimitSettings(only=(name,), dense=True)
    found = next(one for one in mcsim.limit(run, settings=settings).effects if one.channel == "V1")
    step = systematics.get(name).step
    maps = [
        simulate.maps(survey(with_effects(run, [effect(name, "V1", amplitude)])), 0)[:2] for amplitude in (step, 0.0)
    ]
    noise = np.array([m.noise_uk for m in survey(run).channels[0].maps])
    seen = np.array([m.weight > 0 for m in survey(run).channels[0].maps])
    best = np.sqrt(np.sum(((maps[0] - maps[1])[seen] / step / noise[seen]) ** 2))
    assert 1.0 / best < found.sigma * np.sqrt(2.0)
    assert found.sigma < 8.0 / best


def test_orders_above_those_that_a_diagnosis_measures_are_taken() -> None:
    """They were refused for bins of a diagnosis, which nobody had given. Each order adds less than the one before."""
    strong = config.BeamEllipticalGaussian(fwhm_major_arcmin=1200.0, fwhm_minor_arcmin=600.0, m_max=6)
    run = replace(model(), channels=(replace(model().channels[0], beam=strong),))
    sigma = []
    for orders in (0, 2, 4, 6):
        settings = mcsim.LimitSettings(only=("calibration",), dense=True, orders=orders)
        sigma.append(mcsim.limit(run, settings=settings).effects[0].sigma)
    changes = np.abs(np.diff(sigma)) / sigma[-1]
    assert 0.0 < changes[2] < 0.1 * changes[1] < 0.1 * 0.1 * changes[0]


def test_noise_that_hits_samples_at_random_has_no_limit() -> None:
    with refused("excess_noise", "noise_level"):
        mcsim.limit(model(), settings=mcsim.LimitSettings(only=("excess_noise",)))
    # Its map changes as the root of the amplitude: sigma went with the root of the step, 0.09 to 0.009.
    for asked in ({"only": ("lensing",)}, {"nuisances": {"lensing": 0.1}}):
        with refused("lensing", "amplitude"):
            mcsim.limit(model(), settings=mcsim.LimitSettings(**asked))


def test_an_effect_of_a_file_has_a_limit_and_one_that_cannot_act_has_none() -> None:
    file = str(Path(__file__).parents[2] / "docs" / "howto" / "gain_step.py")
    found = mcsim.limit(model(), settings=mcsim.LimitSettings(only=(file,), dense=True))
    assert {one.name for one in found.effects} == {"gain_step"}
    still = replace(model(), channels=tuple(replace(c, scan=config.ScanParallelTransport()) for c in model().channels))
    with refused("gain_drift", "V1", "hit_averaged"):
        mcsim.limit(
            replace(still, map=replace(still.map, splits=())), settings=mcsim.LimitSettings(only=("gain_drift",))
        )


def test_an_effect_of_a_file_is_a_nuisance() -> None:
    """It was refused: "nuisance 'gain_step:V1' is no effect of this model"."""
    file = str(Path(__file__).parents[2] / "docs" / "howto" / "gain_step.py")
    declared = replace(model(), nuisances=(config.Nuisance(effect=file, width=(1.0,), channel="V1"),))
    ways = ((model(), {}), (declared, {}), (model(), {f"{file}:V1": 1.0}))
    alone, *beside = (
        mcsim.limit(run, settings=mcsim.LimitSettings(only=("gain_drift",), nuisances=own, dense=True))
        for run, own in ways
    )
    assert beside[0].effects[0].channel == "V1"
    assert beside[0].effects[0].sigma > 1.01 * alone.effects[0].sigma
    np.testing.assert_array_equal(beside[0].fisher, beside[1].fisher)
    assert "gain_step:V1" in beside[1].unknowns


@pytest.mark.parametrize("name", ["beam_width", "pointing_offset"])
def test_a_beam_changes_what_samples_off_their_pixel_centres_see(name: str) -> None:
    """F = 1/2 Tr[C^-1 dC C^-1 dC] + dmu' C^-1 dmu, from whole covariances of the simulator with those samples."""
    run = model()
    run = replace(run, map=replace(run.map, offset_order=2))
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=(name,), dense=True, orders=2))
    pixels = np.flatnonzero(np.concatenate([m.weight > 0 for c in survey(run).channels for m in c.maps]))
    step = 0.1 * systematics.get(name).step
    ends = [moments_of(with_effects(run, [effect(name, "V1", sign * step)])) for sign in (1.0, -1.0)]
    mean, covariance = ((a - b) / (2.0 * step) for a, b in zip(*ends, strict=True))
    factor = cho_factor(moments_of(run)[1][np.ix_(pixels, pixels)], lower=True)
    filtered = cho_solve(factor, covariance[np.ix_(pixels, pixels)])
    expected = 0.5 * np.sum(filtered * filtered.T) + mean[pixels] @ cho_solve(factor, mean[pixels])
    # The inverse covariance has samples at the centres of their pixels.
    assert found.fisher[0, 0] == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
def test_dense_matrix_is_the_curvature_of_the_likelihood() -> None:
    """F_ij = - d^2 <ln L> / d theta_i d theta_j, by finite differences of whole covariances and means."""
    found = limits(dense=True)
    run = model()
    at = moments_of(run)
    seen = np.concatenate([m.weight > 0 for c in survey(run).channels for m in c.maps])
    basis = np.eye(seen.size)[:, seen]
    directions = {
        "beam_ellipticity (V1)/0": lambda t: effect("beam_ellipticity", "V1", t),
        "beam_ellipticity (V1)/1": lambda t: effect("beam_ellipticity", "V1", t, angle_deg=45.0),
        "dipole_modulation (all)/2": lambda t: effect("dipole_modulation", None, t, lat_deg=90.0),
        "dipole_residual (W1)/0": lambda t: effect("dipole_residual", "W1", t),
        "gain_drift (V1)/1": lambda t: effect("gain_drift", "V1", t, phase_deg=90.0),
        "noise_level (W1)/0": lambda t: effect("noise_level", "W1", t),
        "pixelization (V1)/0": lambda t: effect("pixelization", "V1", t),
    }
    zero = expected_log_likelihood(run, basis, at)

    def curvature(*makers: Any) -> float:
        rows = [found.components.index(name) for name in makers]
        step = [0.03 / np.sqrt(found.fisher[row, row]) for row in rows]
        ends = []
        for sign in (1.0, -1.0):
            changed = [directions[name](sign * h) for name, h in zip(makers, step, strict=True)]
            ends.append(expected_log_likelihood(with_effects(run, changed), basis, at))
        return -(ends[0] + ends[1] - 2.0 * zero) / 0.03**2

    for name in directions:
        assert curvature(name) == pytest.approx(1.0, rel=4e-3), name
    for a, b in (
        ("beam_ellipticity (V1)/0", "dipole_modulation (all)/2"),
        ("gain_drift (V1)/1", "dipole_residual (W1)/0"),
        ("noise_level (W1)/0", "pixelization (V1)/0"),
    ):
        i, j = found.components.index(a), found.components.index(b)
        rho = found.fisher[i, j] / np.sqrt(found.fisher[i, i] * found.fisher[j, j])
        assert (curvature(a, b) - 2.0) / 2.0 == pytest.approx(rho, abs=4e-3), (a, b)


@pytest.mark.slow
def test_random_probes_agree_with_whole_matrices() -> None:
    exact, drawn = limits(dense=True), limits(dense=False)
    assert exact.components == drawn.components
    for one, other in zip(exact.effects, drawn.effects, strict=True):
        # What is known from the dipole needs no probes.
        assert 0.0 <= other.error < 0.2
        assert other.sigma == pytest.approx(one.sigma, rel=max(4.0 * other.error, 1e-4)), one.label
    assert sum(other.error > 0.005 for other in drawn.effects) >= 5
    assert np.linalg.eigvalsh(drawn.fisher / np.outer(size := np.sqrt(np.diag(drawn.fisher)), size))[0] > 0.0
    size = np.sqrt(np.diag(exact.fisher))
    departure = (drawn.fisher - exact.fisher) / np.outer(size, size)
    # The error of sigma is half of that of the information, and of an effect's components together.
    error = np.concatenate([[2.0 * one.error * np.sqrt(one.components)] * one.components for one in drawn.effects])
    assert np.all(np.abs(departure) < 4.0 * np.sqrt(np.add.outer(error**2, error**2)) + 0.05)
    assert np.sqrt(np.mean(departure**2)) < 0.05


def test_errors_of_random_probes_are_those_of_what_nuisances_leave() -> None:
    """The dipole tells a calibration without probes, but for a beam width: its error was 1e-5, and 4 % when drawn."""
    settings = mcsim.LimitSettings(only=("calibration",), nuisances={"beam_width": 0.5}, probes=24)
    exact = mcsim.limit(model(), settings=replace(settings, dense=True)).effects
    pulls = []
    for seed in range(4):
        drawn = mcsim.limit(model(), settings=replace(settings, seed=seed)).effects
        pulls += [(one.sigma / known.sigma - 1.0) / one.error for one, known in zip(drawn, exact, strict=True)]
    # The mean square of 8 normal numbers is 1 with a scatter of a half.
    assert 0.0 < np.mean(np.square(pulls)) < 1.0 + 4.0 * 0.5
    assert max(one.error for one in exact) == 0.0 < 0.01 < min(one.error for one in drawn) < 0.1


@pytest.mark.slow
def test_one_map_has_the_information_of_its_bipolar_coefficients() -> None:
    """F = sum (2 - delta_M0) |dA|^2 / ((1 + delta_l1l2) C_l1 C_l2) over l1 <= l2, L, M; these effects end at L = 2."""
    run = one_map()
    names = ("quadrupole_modulation", "dipole_modulation", "beam_width", "boost")
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=names, dense=True))
    lmax, shared = run.sky.lmax, survey(run)
    window = shared.channels[0].response.factors[0].real
    cl = load("wmap7", lmax)
    noise = 4.0 * np.pi / (12 * 16**2) * 300.0**2
    tables = estimator(2, lmax)
    wanted = [mode for mode in tables.modes if mode.d >= 0]
    at = [tables.modes.index(mode) for mode in wanted]
    steps = {
        "boost (all)/2": effect("boost", None, 1e-3, lat_deg=90.0),
        "beam_width (W1)/0": effect("beam_width", "W1", 0.005),
        "dipole_modulation (all)/0": effect("dipole_modulation", None, 0.01),
        "quadrupole_modulation (all)/1": effect(
            "quadrupole_modulation", None, 0.01, components=(0.0, 1.0, 0.0, 0.0, 0.0)
        ),
    }
    for name, step in steps.items():
        ends = [
            with_effects(run, [replace(step, parameters={**step.parameters, "amplitude": sign * a})])
            for sign in (1, -1)
            for a in (step.parameters["amplitude"],)
        ]
        mean = []
        for end in ends:
            made, found_here = quiet(end), 0.0
            for ell, sky in unit_skies(lmax):
                alm = healpix.analysis(simulate.maps(made, 0, sky=sky)[0], lmax, iterations=3)
                found_here = found_here + cl[ell] * estimate(tables, alm, None)
            mean.append(found_here)
        change = (mean[0] - mean[1])[at] / (2.0 * step.parameters["amplitude"])
        expected = fisher_information(np.nan_to_num(change)[None, None], wanted, (cl * window**2 + noise)[None, None])
        row = found.components.index(name)
        assert found.fisher[row, row] == pytest.approx(expected, rel=5e-3), name


def test_additive_effect_has_its_signal_to_noise() -> None:
    """F = s' C^-1 s; the sky has no dipole of its own, so that C is the noise there."""
    run = one_map()
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=("dipole_residual",), dense=True))
    shared = survey(run)
    signal = shared.channels[0].response.factors[0, 1].real * healpy.pix2vec(16, np.arange(12 * 16**2))[2]
    assert found.fisher[2, 2] == pytest.approx(np.sum(signal**2) / 300.0**2, rel=1e-3)
    np.testing.assert_allclose(found.fisher, found.fisher[2, 2] * np.eye(3), atol=1e-3 * found.fisher[2, 2])
    assert found.effects[0].sigma == pytest.approx(1.0 / np.sqrt(found.fisher[2, 2]), rel=1e-3)
    assert found.to_json()["effects"][0]["separable"] is None  # there is no other effect


@pytest.mark.slow
def test_unknown_dipole_hides_one_that_all_maps_share() -> None:
    """The variance of a residual dipole is that of the noise and that of the sky's: d.n of rms d has it d^2."""
    run = one_map()
    settings = mcsim.LimitSettings(only=("dipole_residual",), probes=4)
    known = mcsim.limit(run, settings=settings)
    found = mcsim.limit(run, settings=replace(settings, unknown_dipole_uk=5.0))
    assert found.effects[0].sigma ** 2 == pytest.approx(known.effects[0].sigma ** 2 + 25.0, rel=1e-3)
    modulated = replace(settings, only=("dipole_modulation",), dense=True)
    known, found = (mcsim.limit(run, settings=replace(modulated, unknown_dipole_uk=rms)) for rms in (0.0, 1e3))
    assert found.effects[0].sigma > 1.1 * known.effects[0].sigma
    assert (len(known.no_dipole), found.no_dipole) == (1, ())
    assert "unknown-dipole" in known.lines()[-1]
    assert "unknown-dipole" not in found.unknowns


@pytest.mark.slow
def test_orders_of_the_fiducial_beams_change_little() -> None:
    """The inverse covariance of circular beams in place of the elliptical ones: sigma within 2 %."""
    exact = limits(dense=True)
    settings = mcsim.LimitSettings(only=COMPARED, dense=True)
    circular = mcsim.limit(model(), settings=settings)
    for one, other in zip(exact.effects, circular.effects, strict=True):
        assert other.sigma == pytest.approx(one.sigma, rel=0.02), one.label


def test_marginalising_is_inverting_a_covariance() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(5, 9))
    fisher, widths = root @ root.T, np.array([0.3, 0.1])
    whole = fisher.copy()
    whole[[1, 3], [1, 3]] += 1.0 / widths**2
    covariance = np.linalg.inv(whole)[np.ix_([0, 2, 4], [0, 2, 4])]
    np.testing.assert_allclose(marginalised(fisher, [1, 3], widths), np.linalg.inv(covariance), rtol=1e-10)
    np.testing.assert_allclose(
        marginalised(fisher, [1], [1e-12]), fisher[np.ix_([0, 2, 3, 4], [0, 2, 3, 4])], rtol=1e-9
    )
    one = fisher[0, 2] / np.sqrt(fisher[0, 0] * fisher[2, 2])
    assert canonical_correlations(fisher, [[0], [2]])[0, 1] == pytest.approx(abs(one))


@pytest.mark.slow
def test_nuisance_widens_what_it_resembles_and_conventions_are_textbook() -> None:
    plain = limits(dense=True)
    settings = replace(plain.settings, nuisances={"pixelization:V1": 0.05})
    other = mcsim.limit(model(), settings=settings)
    assert [one.label for one in other.effects] == [
        one.label for one in plain.effects if one.label != "pixelization (V1)"
    ]
    by_label = {one.label: one for one in plain.effects}
    assert all(one.sigma >= by_label[one.label].sigma * (1.0 - 1e-9) for one in other.effects)
    assert other.tests == plain.tests - 1
    noise = by_label["noise_level (V1)"]
    assert noise.amplitude_90_known / noise.sigma == pytest.approx(3.24, abs=0.005)
    assert noise.amplitude_90 / noise.sigma > 4.2


def test_effects_and_nuisances_of_the_run_stay_in_their_channel() -> None:
    effect = {"name": "gain_drift", "channel": "W1", "amplitude": 0.001}
    nuisance = {"effect": "beam_width", "channel": "W1", "width": 0.01}
    settings = mcsim.LimitSettings(only=("pixelization",), dense=True)
    declared = mcsim.limit(model(effect=[effect], nuisance=[nuisance]), settings=settings)
    given = mcsim.limit(model(effect=[effect]), settings=replace(settings, nuisances={"beam_width:W1": 0.01}))
    np.testing.assert_array_equal(declared.fisher, given.fisher)
    assert (declared.tests, declared.lines()) == (given.tests, given.lines())
    assert declared.lines()[-1] == "Marginalised over beam_width:W1 ± 0.01."
    several = {"effect": "dipole_residual", "channel": "V1", "width": [1.0, 2.0, 3.0]}
    with refused("dipole_residual:V1", "dipole_residual:V1=3"):
        mcsim.limit(model(nuisance=[several]))


@pytest.mark.parametrize(
    ("nuisance", "where", "target", "rows"),
    [("foreground_residual", None, "monopole_residual", [0]), ("beam_sidelobe", "Q1", "calibration", [0, 1])],
)
def test_nuisance_has_its_own_coordinates(nuisance: str, where: str | None, target: str, rows: list[int]) -> None:
    """At its own index and calibration: a sidelobe of unknown calibration made sigma of the gain 100 times as large."""
    channels = [
        channel(name, "A", (1150.0, 900.0), 200.0) | {"frequency_ghz": ghz}
        for name, ghz in (("Q1", 41.0), ("V1", 61.0), ("W1", 94.0))
    ]
    run = model(map={"nside": NSIDE}, channel=channels)
    declared = replace(run, nuisances=(config.Nuisance(effect=nuisance, width=(2.0,), channel=where),))
    every, found = (
        mcsim.limit(each, settings=mcsim.LimitSettings(only=only, dense=True))
        for each, only in ((run, (target, nuisance)), (declared, (target,)))
    )
    names, head = every.components, f"{nuisance} ({where or 'all'}"
    kept, own = (np.flatnonzero([name.startswith(one) for name in names]) for one in (target, head))
    both = every.fisher[np.ix_([*kept, *own[rows]], [*kept, *own[rows]])]
    expected = marginalised(both, range(len(kept), len(both)), [2.0] * len(rows))
    np.testing.assert_allclose(found.fisher, expected, atol=1e-7 * expected.max())
    assert ("mean shape" in found.unknowns) == (nuisance == "foreground_residual")


def test_a_nuisance_of_single_splits_is_one_for_each() -> None:
    """That of the first split alone left sigma of a calibration a quarter of what it is."""
    settings = mcsim.LimitSettings(only=("calibration", "split_calibration"), dense=True)
    every = mcsim.limit(model(), settings=settings)
    own = replace(settings, only=("calibration",), nuisances={"split_calibration": 0.003})
    found = mcsim.limit(model(), settings=own)
    kept = [k for k, name in enumerate(every.components) if name.startswith("calibration")]
    assert len(every.components) == 3 * len(kept)  # two splits
    others = [k for k in range(len(every.components)) if k not in kept]
    expected = marginalised(every.fisher, others, [0.003] * len(others))
    np.testing.assert_allclose(found.fisher, expected, rtol=1e-6, atol=1e-9 * expected.max())
    of_one = {"effect": "split_calibration", "channel": "V1", "width": 0.003, "parameters": {"split": "half2"}}
    with refused("split_calibration:V1=0.003"):
        mcsim.limit(model(nuisance=[of_one]), settings=settings)


def test_noise_that_is_not_white_is_refused() -> None:
    noise = {"kind": "correlated", "sigma0_uk": 200.0, "f_knee_hz": 1e-5, "f_min_hz": 1e-7, "alpha": 1.0}
    with refused("V1:half1", "V1", "white"):
        mcsim.limit(model(channel=[channel("V1", "A", (1150.0, 900.0), 200.0) | {"noise": noise}]))


@pytest.mark.parametrize(
    ("key", "given"),
    [
        ("simulator", {"simulator": "a:B"}),
        ("ensemble.maps", {"ensemble": {"maps": "{realization}/{channel}_{split}.fits"}}),
    ],
)
def test_maps_of_another_program_have_no_limit(key, given) -> None:
    with refused(key, "mcsim.biposh"):
        mcsim.limit(model(**given))


def test_limits_are_written_and_say_what_they_are(tmp_path) -> None:
    found = mcsim.limit(model(), tmp_path / "out", settings=mcsim.LimitSettings(only=("noise_level",), dense=True))
    written = json.loads((tmp_path / "out" / "limit.json").read_text())
    assert written["effects"][0]["sigma"] == found.effects[0].sigma
    assert written["effects"][0]["similar"]["channel"] == "W1"
    assert undescribed(found.to_dataset()) == []
    with xr.open_zarr(tmp_path / "out" / "limit.zarr") as stored:
        np.testing.assert_array_equal(stored.fisher, found.fisher)
    assert (tmp_path / "out" / "limit.png").stat().st_size > 10_000
    with refused(str(tmp_path / "out"), found.model, "another"):
        mcsim.limit(replace(model(), name="another"), tmp_path / "out")
    odd = tuple(replace(one, title="a$_$b", unit="c$_$d") for one in found.effects)  # what matplotlib cannot parse
    limit_figure(replace(found, effects=odd)).draw_without_rendering()
    assert any(line.startswith("noise_level (V1)") for line in found.lines())
    long = replace(found, effects=tuple(replace(one, label=8 * "letters ") for one in found.effects))
    assert max(map(len, long.lines()[: 3 * len(found.effects)])) <= 120
    assert sum(line.count("letters") for line in long.lines()) == 16 * len(found.effects)
    unknown = replace(found, settings=replace(found.settings, nuisances={"beam_width": 0.01}, unknown_dipole_uk=10.0))
    assert unknown.lines()[-1] == "Marginalised over beam_width ± 0.01, a monopole and dipole of 10 µK rms."
    assert unknown.to_dataset().attrs["unknowns"] == unknown.lines()[-1]
    assert (unknown.to_json()["unknown_dipole_uk"], written["unknown_dipole_uk"]) == (10.0, 0.0)
    assert "noise_level" not in describe(model(), mcsim.LimitSettings())


def test_the_picture_hatches_what_an_effect_cannot_have() -> None:
    found = mcsim.limit(model(), settings=mcsim.LimitSettings(only=("noise_level",), dense=True))
    first, second = found.effects
    lines = []
    for share in (np.inf, 2.0):
        bounded = replace(found, effects=(replace(first, amplitude_max=share * first.sigma), second))
        axes = limit_figure(bounded).axes[0]
        lines.append(len(axes.get_legend().get_texts()))
        hatched = [bar.get_x() for bar in axes.patches if bar.get_hatch() and bar.get_width() > 0.0]
        assert hatched == pytest.approx([share] if np.isfinite(share) else [])
        assert bounded.impossible == np.isfinite(share)
    assert lines[1] == lines[0] + 1


def test_command_says_what_it_would_cost_and_reads_nuisances() -> None:
    said = CliRunner().invoke(app, ["limit", "demo-model", "--dry-run", "--dense", "--only", "noise_level"])
    assert said.exit_code == 0
    assert said.output.startswith("demo-model: 2 effects of 2 components, 4 maps")
    assert widths(["beam_width=0.01", "gain_drift:W1=1e-4"]) == {"beam_width": 0.01, "gain_drift:W1": 1e-4}
    with refused("beam_width"):
        widths(["beam_width"])


def test_bad_input_is_refused() -> None:
    for noise in ({"sigma0_uk": 0.0}, {"kind": "depth", "depth_uk_arcmin": 0.0}):
        with refused("V1:half1", "noise.sigma0_uk", "noise.depth_uk_arcmin"):
            mcsim.limit(model(channel=[channel("V1", "A", (1150.0, 900.0), 0.0) | {"noise": noise}]))
    with refused("no_such"):
        mcsim.limit(model(), settings=mcsim.LimitSettings(only=("no_such",)))
    with refused("beam_width", "--without"):  # of two effects, the other alone was computed
        both = ("noise_level", "beam_width")
        mcsim.limit(model(), settings=mcsim.LimitSettings(only=both, without=both[1:], dense=True))
    with refused("beam_width:X"):
        mcsim.limit(model(), settings=mcsim.LimitSettings(nuisances={"beam_width:X": 0.1}))
    with refused("beam_width", 0):
        mcsim.limit(model(), settings=mcsim.LimitSettings(nuisances={"beam_width": 0.0}))
    with refused("probes", 2):
        mcsim.limit(model(), settings=mcsim.LimitSettings(probes=2))
    for name in ("power", "separation"):
        with refused(name, 0.05):
            mcsim.LimitSettings(**{name: 0.05})


@pytest.mark.parametrize("dense", [True, False])
def test_noise_that_rounding_hides_is_refused(dense: bool) -> None:
    """Of a sky 10^7 times the noise sigma of a noise level was a tenth of what it is; whole matrices were a traceback.

    That of a map with noise alone in all but n modes of its N pixels is 1 / sqrt(2 (N - n)), whatever the noise is.
    """
    settings = mcsim.LimitSettings(only=("noise_level",), dense=dense, probes=32)
    [found] = mcsim.limit(one_map(8, sigma0_uk=1e-4), settings=settings).effects
    assert found.sigma == pytest.approx((2 * (768 - 45)) ** -0.5, rel=0.01 if dense else 0.1)
    with refused("W1", 1e-5, "noise.sigma0_uk"):
        mcsim.limit(one_map(8, sigma0_uk=1e-5), settings=settings)


def test_an_effect_that_cannot_act_is_named_beside_one_that_can() -> None:
    """It was left out without a word."""
    still = model(sky={"spectrum": "wmap7", "lmax": LMAX})
    with refused("nonlinearity", "sky.dipole_uk"):
        mcsim.limit(still, settings=mcsim.LimitSettings(only=("noise_level", "nonlinearity")))


def test_two_frequencies_of_two_degrees_have_limits() -> None:
    """Their contrast by latitude ended in "negative shift count"."""
    two = [channel("V1", "A", (1150.0, 900.0), 200.0), channel("W1", "A", (1150.0, 900.0), 200.0)]
    run = model(sky={"spectrum": "wmap7", "lmax": 2}, channel=[two[0], two[1] | {"frequency_ghz": 61.0}])
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=("noise_level",), dense=True))
    pixels = sum(np.sum(m.weight > 0.0) for m in survey(run).channels[0].maps)
    # The sky hides five modes of each half at most.
    assert 1.0 / np.sqrt(2.0 * pixels) < found.effects[0].sigma < 1.0 / np.sqrt(2.0 * (pixels - 2 * 5))
