"""Predictions laid out as summaries: against a small ensemble, and as data of a fit."""

from pathlib import Path

import numpy as np
import pytest
from distributed import Client
from scipy import stats

from mcsim import Beam, beamfit, config, open_ensemble, open_summary
from mcsim.ensemble import prediction, runner, tables
from mcsim.instrument import scan
from refusals import refused

from .conftest import ensemble, table

BEAM = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 220.0, "m_max": 4}


def limit_moments(path: Path, nside: int) -> str:
    """The WMAP-like scan in the limit of endless time, as a file."""
    model = scan.ScanModel.load("wmap")
    scan.write_moments_fits(path, scan.Moments.limit(model, nside, 4))
    return str(path)


def test_layout_is_that_of_the_summary(small_store: Path) -> None:
    expected = prediction.predict(table())
    summary = open_summary(small_store)
    # How the paired difference scatters is not that of an isotropic sky, and not predicted.
    assert set(summary.data_vars) - set(expected.data_vars) == {"biposh_difference_binned_covariance"}
    for name in expected.variables:
        variable = summary[name]
        assert expected[name].dims == variable.dims
        assert expected[name].attrs == variable.attrs
    difference = (summary - expected).biposh_difference_binned_mean
    assert difference.dims == ("pair", "mode", "bin")


def test_covariance_of_bins_is_diagonal_and_says_where_that_leaves_something_out() -> None:
    run = table(biposh={"L_max": 2, "summary_bin": 1})
    mask = np.linspace(0.0, 1.0, 12 * 16**2)
    whole, masked = (prediction.predict(one) for one in (run, run | {"map": {"nside": 16, "mask": mask}}))
    assert ["one bin with another" in one.left_out for one in (whole, masked)] == [False, True]
    covariance, deviation = (masked[f"biposh_binned_{name}"].values for name in ("covariance", "standard_deviation"))
    # Of single degrees some bins are empty, with NaN in their rows and columns, as in a summary.
    empty = np.isnan(deviation)
    assert empty.any()
    np.testing.assert_array_equal(np.isnan(covariance), empty[..., None] | empty[..., None, :])
    diagonal = np.eye(deviation.shape[-1]) * deviation[..., None] ** 2
    np.testing.assert_allclose(np.nan_to_num(covariance), np.nan_to_num(diagonal), rtol=1e-12)


def test_errors_of_the_control_are_those_of_a_circular_beam() -> None:
    beam = Beam.elliptical(300.0, 220.0, lmax=32)
    one = {"name": "W1", "scan": {"kind": "parallel_transport"}, "noise": {"sigma0_uk": 20.0}}
    whole, circular = (
        prediction.predict(table(channel=[one | {"beam": each}]), exact=True) for each in (beam, beam.circular())
    )
    for spectra in ("biposh", "cl"):
        found, wanted = whole[f"{spectra}_circular_standard_error"], circular[f"{spectra}_standard_error"]
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
        # What the other orders of this beam add to its power.
        assert (whole[f"{spectra}_standard_error"] / found).max() > 1.006
    name = "biposh_{}binned_standard_error".format
    np.testing.assert_allclose(whole[name("circular_")], circular[name("")], rtol=1e-12)


@pytest.mark.parametrize("kind", ["parallel_transport", "moments"])
def test_exact_prediction_is_the_mean_of_an_ensemble(kind: str, client: Client, tmp_path: Path) -> None:
    """Hotelling's T^2 of A^{20} (d = 0, 2, four bins) over 60 paired realizations, at a probability above 1e-3."""
    spec = {"kind": kind}
    if kind == "moments":
        spec["path"] = limit_moments(tmp_path / "m.fits", 32)
    run = config.load(
        table(
            map={"nside": 32, "pixel_window": "none"},
            channel=[{"name": "W1", "beam": BEAM, "scan": spec}],
            biposh={"L_max": 2, "summary_bin": 8},
            **ensemble(60),
        )
    )
    runner.run(run, tmp_path / "x.zarr", workers=client)
    stored, factor = open_ensemble(tmp_path / "x.zarr"), open_summary(tmp_path / "x.zarr").bin_factor
    expected = prediction.predict(run, exact=True)

    def vector(biposh: np.ndarray, mode: str) -> np.ndarray:
        scaled = factor.sel(mode=mode).values * biposh
        return np.stack([scaled[..., a : a + 7].real.mean(axis=-1) for a in (4, 11, 18, 25)], axis=-1)

    modes = ("L2M0d0", "L2M0d2")
    difference = (stored.biposh - stored.biposh_circular)[:, 0]
    sample = np.concatenate([vector(difference.sel(mode=m).values, m) for m in modes], axis=-1)
    mean = expected.biposh_difference_mean[0]
    residual = sample.mean(axis=0) - np.concatenate([vector(mean.sel(mode=m).values, m) for m in modes])
    n, p = sample.shape
    t2 = n * residual @ np.linalg.solve(np.cov(sample.T), residual)
    assert stats.f.sf((n - p) / (p * (n - 1)) * t2, p, n - p) > 1e-3
    leading = prediction.predict(run).biposh_difference_mean[0]
    # The test has teeth: a beam 20 % rounder is refused.
    wrong = sample.mean(axis=0) - 0.8 * np.concatenate([vector(leading.sel(mode=m).values, m) for m in modes])
    assert stats.f.sf((n - p) / (p * (n - 1)) * n * wrong @ np.linalg.solve(np.cov(sample.T), wrong), p, n - p) < 1e-6


def test_hit_average_fitted_with_parallel_transport_gives_the_factor_of_a20(tmp_path: Path) -> None:
    """0.6576: int w_2 sin^2 / int sin^2 of the scan, at every l."""
    hit = table(
        map={"nside": 64, "pixel_window": "none"},
        channel=[
            {"name": "W1", "beam": BEAM, "scan": {"kind": "moments", "path": limit_moments(tmp_path / "m.fits", 64)}}
        ],
    )
    tables.write(prediction.predict(hit), tmp_path / "hit.ecsv")
    transported = table(channel=[{"name": "W1", "beam": BEAM, "scan": {"kind": "parallel_transport"}}])
    measured = beamfit.measurement(tmp_path / "hit.ecsv", transported, beamfit.Selection(kind="plain"))
    found = beamfit.fit(measured, transported, "constant")
    assert found.solution.parameters[0] == pytest.approx(0.6576, abs=1e-3)


def test_what_predictions_do_not_cover_is_said() -> None:
    differencing = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1", "sample_period_s": 61.44}
    with refused("W1", "hit_averaged"):
        prediction.predict(table(channel=[{"name": "W1", "beam": BEAM, "scan": differencing}]))
