"""An ensemble with inverse-covariance filtering: store, resumption, slices, summary, prediction and cost."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client

from mcsim import config, fit, merge, open_ensemble, open_summary, predict, run
from mcsim.beamfit import Measurement, measurement
from mcsim.beamfit.data import SUMMARY, Row
from mcsim.bipolar import parse_mode
from mcsim.ensemble import plan
from mcsim.ensemble.summary import reduce_rows
from mcsim.ensemble.tables import write
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.wishart import inverse_variance
from refusals import refused

REALIZATIONS = 12


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Two maps of an elliptical beam, half of the sky masked, noise, few bins."""
    mask = tmp_path_factory.mktemp("mask") / "mask.npy"
    pixel = np.arange(12 * 16**2)
    np.save(mask, (abs(pixel - 1500) > 400).astype(float))
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 700.0, "fwhm_minor_arcmin": 400.0}
    channel = {"beam": beam, "scan": {"kind": "parallel_transport"}, "noise": {"sigma0_uk": 20.0}}
    return {
        "name": "filtered",
        "sky": {"spectrum": "wmap7", "lmax": 20},
        "map": {"nside": 16, "mask": str(mask)},
        "channel": [channel | {"name": name} for name in "AB"],
        "biposh": {"L_max": 1, "summary_bin": 10, "filter": "inverse_covariance", "probes": 24},
        "ensemble": {"realizations": REALIZATIONS, "seed": 5},
        "compute": {"chunk": 4},
    }


@pytest.fixture(scope="module")
def store(table: dict, client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(table, tmp_path_factory.mktemp("store") / "whole.zarr", workers=client).store


def test_store_has_what_a_realization_gives_and_says_what_it_is(table, store: Path) -> None:
    values = simulate.realize(survey(config.load(table)), 7)
    with open_ensemble(store) as stored, open_summary(store) as found:
        for name, array in values.items():
            np.testing.assert_array_equal(stored[name][7].values, array)
        assert stored.biposh_qml.dims == ("realization", "pair", "mode", "bin")
        assert stored["bin"].values.tolist() == found["bin"].values.tolist() == [4.5, 14.5, 20.0]
        for name in ("biposh_qml_mean", "biposh_qml_circular_mean", "biposh_qml_difference_standard_error"):
            assert found[name].dims == ("pair", "mode", "bin")
            assert found[name].attrs["units"] == "uK^2"
            assert "maximum-likelihood" in found[name].attrs["long_name"]
        assert found.biposh_qml_covariance.dims == ("pair", "mode", "bin", "bin_2")
        mean = stored.biposh_qml.mean("realization").values
        np.testing.assert_allclose(found.biposh_qml_mean.values, mean, rtol=1e-10)


@pytest.mark.parametrize("kind", ["", "_circular", "_difference"])
def test_errors_of_means_have_that_of_their_normalisation(table, store: Path, kind: str) -> None:
    """As F itself has it, in quadrature: with 24 probes as large as the scatter of 12 differences, larger of powers."""
    filtering = survey(config.load(table)).filtering
    assert filtering is not None
    with open_ensemble(store) as stored, open_summary(store) as found:
        every = {name: stored[f"biposh_qml_score{name}"] for name in ("", "_circular")}
        every["_difference"] = every[""] - every["_circular"]
        scores = every[kind].mean("realization").values
        means, errors = (found[f"biposh_qml{kind}_{name}"].values for name in ("mean", "standard_error"))
        scatters = found[f"biposh_qml{kind}_standard_deviation"].values / np.sqrt(REALIZATIONS)
        variances = found.biposh_qml_circular_standard_deviation.values**2
    for row, (bands, (x, y), (matrix, unbiased)) in enumerate(
        zip(filtering.bands, filtering.pairs, filtering.fisher(), strict=True)
    ):
        mode, place, part = bands.numbers
        alpha, q = (
            np.where(part == 0, one.real[mode, place], one.imag[mode, place]) for one in (means[row], scores[row])
        )
        estimate = unbiased * np.linalg.solve(matrix, q)
        np.testing.assert_allclose(estimate, alpha, rtol=1e-8, atol=1e-8 * np.abs(alpha).max())
        total, pairs = float(alpha @ matrix @ alpha) / unbiased, 24 * 23 / (2.0 if x == y else 1.0)
        shared = inverse_variance(variances[row], np.abs(means[row]) ** 2, total, bands.size, pairs)
        np.testing.assert_allclose(errors[row], np.sqrt(scatters[row] ** 2 + shared), rtol=1e-8)
        ratio = np.sqrt(np.nanmean(shared) / np.nanmean(scatters[row] ** 2))
        assert 0.5 < ratio < 5.0 if kind == "_difference" else ratio > 1.0


def test_slices_and_resumption_give_the_same_bits(table, client: Client, store: Path, tmp_path: Path) -> None:
    parts = [
        run(table, tmp_path / f"{a}.zarr", realizations=slice(a, b), workers=client).store for a, b in ((0, 8), (8, 12))
    ]
    merge(parts, tmp_path / "merged.zarr")
    assert run(table, store, resume=True, workers=client).computed == 0
    with open_ensemble(store) as one, open_ensemble(tmp_path / "merged.zarr") as other:
        assert one.load().drop_attrs().identical(other.load().drop_attrs())
    with open_summary(store) as one, open_summary(tmp_path / "merged.zarr") as other:
        assert one.load().drop_attrs().identical(other.load().drop_attrs())
    with refused("biposh.summary_bin", 10, 5):
        run(table | {"biposh": table["biposh"] | {"summary_bin": 5}}, store, workers=client)


def test_mean_without_mean_field_is_the_prediction_of_the_full_sky(table, store: Path) -> None:
    """C_l through an elliptical beam, in bins, within 4.5 errors; normalised to what 24 probes can (10 %)."""
    with open_summary(store) as found:
        expected = predict(table, exact=True)
        one = {"mode": "L0M0d0", "pair": ["A,A", "B,B"]}
        bins = slice(1, 2)
        mean = found.biposh_qml_difference_mean.sel(**one).values.real[:, bins]
        error = found.biposh_qml_difference_standard_error.sel(**one).values[:, bins]
        wanted = expected.biposh_qml_difference_mean.sel(**one).values.real[:, bins]
        assert np.all(abs(mean - wanted) < 4.5 * error + 0.1 * abs(wanted))


def test_a_prediction_does_not_know_the_noise_of_hidden_pixels(table) -> None:
    """Nor that of pixels without samples, which have none."""

    def expected(maps: dict, level: np.ndarray):
        noise = {"kind": "variance", "variance": level}
        channel = table["channel"][0] | {"noise": noise}
        return predict(table | {"map": maps, "channel": [channel]}, snr=True)

    pixel = np.arange(12 * 16**2)
    seen = abs(pixel - 1500) > 400
    level = xr.DataArray(np.full(pixel.size, 1e4), dims="pixel", attrs={"units": "uK^2"})
    full, masked = expected({"nside": 16}, level), expected(table["map"], level)
    hidden = expected(table["map"], level.where(seen, 1e8))
    unhit = expected({"nside": 16}, level.where(seen, np.nan))
    for name in ("cl_mean", "biposh_mean", "biposh_standard_deviation", "signal_to_noise"):
        xr.testing.assert_allclose(hidden[name], masked[name], rtol=1e-10)
        xr.testing.assert_allclose(unhit[name], masked[name], rtol=1e-10)
    xr.testing.assert_allclose(full.cl_mean, masked.cl_mean, rtol=1e-10)


def test_dry_run_counts_the_passes_over_samples_once(table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "_timed", lambda *sizes: (1e-6, 1e-6))  # seconds of a transform, of an estimate
    once_s = []
    for period_s in (60.0, 30.0):
        scan = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": period_s}
        run = config.load(table | {"channel": [one | {"scan": scan} for one in table["channel"]]})
        found = plan.with_scans(plan.cost(run), run)
        assert "samples, once" in dict(found.parts)["scan"]
        once_s.append(found.once_s)
    assert once_s[1] == pytest.approx(2.0 * once_s[0], rel=1e-4)
    assert found.lines(1, 1)[-1] != plan.cost(run).lines(1, 1)[-1]


def test_dry_run_says_what_the_filter_costs(table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "_timed", lambda *sizes: (1.0, 1.0))  # seconds of a transform, of an estimate
    found = plan.cost(config.load(table))
    assert "24 random maps" in dict(found.parts)["filter"]
    plain = config.load(table).unfiltered()
    assert "filter" not in dict(plan.cost(plain).parts)
    assert found.each_s > 3.0 * plan.cost(plain).each_s


def test_dry_run_counts_the_memory_of_many_pairs(table, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers held 0.8 GB where 0.3 were said, for their sums and results on the way; and 1.4 for 0.3 with matrices."""
    monkeypatch.setattr(plan, "_timed", lambda *sizes: (1.0, 1.0))  # seconds of a transform, of an estimate
    narrow = table | {"biposh": table["biposh"] | {"summary_bin": 1, "probes": None}}
    runs = [config.load(narrow | {"biposh": narrow["biposh"] | {"pairs": pairs}}) for pairs in ("auto", "all")]
    few, many = (plan.cost(run.unfiltered()) for run in runs)
    held = []
    for layout in (few.layout, many.layout):
        sizes = layout.sizes()
        shapes = {name: [sizes[dim] for dim in dims] for name, (dims, *_) in layout.variables().items()}
        rows = {name: np.zeros((1, *shape), complex if "biposh" in name else float) for name, shape in shapes.items()}
        sums = reduce_rows(layout, rows | {"done": np.array([True])})
        held.append(sum(x.nbytes for kind in (sums.mean, sums.square, sums.comoment) for x in kind.values()))
        assert layout.statistics_bytes() == held[-1]
    assert many.memory - few.memory > 8 * (held[1] - held[0])
    assert many.driver - few.driver > 5 * (held[1] - held[0])
    shared = survey(runs[1])
    matrices = sum(8 * bands.size**2 for bands in shared.filtering.bands)
    assert plan.cost(runs[1]).memory - many.memory > 2 * matrices


def test_a_fit_refuses_filtered_coefficients(table, store: Path, tmp_path: Path) -> None:
    """Behind a mask their response to a beam is not that of its templates; their tables say what they are, too."""
    with open_summary(store) as found:
        write(found.load(), tmp_path / "table.ecsv")
    for data in (store, tmp_path / "table.ecsv"):
        with refused("inverse_covariance", "biposh.filter"):
            fit(data, table)


def test_a_fit_takes_no_covariance_of_filtered_maps_or_of_another_frame(table, store: Path) -> None:
    """Their scatter is not that of the data: with errors of either a fit would be confident for no reason."""
    row = Row(parse_mode("L1M0d1"), 2, 11, True)
    measured = Measurement("data", None, "plain", (row,), SUMMARY, np.ones(1), np.eye(1), None)
    with refused(store, "inverse_covariance", "biposh.filter"):
        measurement(measured, table, covariance=store)
    with refused(store, "ecliptic", "galactic"):
        measurement(measured, table | {"map": {"nside": 16, "frame": "galactic"}}, covariance=store)
