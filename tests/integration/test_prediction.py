"""Predictions laid out as summaries: against a small ensemble, and as data of a fit."""

from pathlib import Path

import healpy
import numpy as np
import pytest
import xarray as xr
from distributed import Client
from scipy import stats

from mcsim import Beam, beamfit, config, open_ensemble, open_summary
from mcsim.bipolar.modes import modes
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


def correlations(dataset: xr.Dataset) -> np.ndarray:
    """Correlations of bins from their covariances, means over all M, for each L and d: shape (L and d, bin, bin)."""
    covariance = dataset.biposh_binned_covariance.values[0].real
    found: dict[tuple[int, int], np.ndarray] = {}
    for own, (L, M, d) in zip(covariance, modes(2, both_orders=False), strict=True):
        found[L, d] = found.get((L, d), 0.0) + own * (2.0 if M else 1.0)
    each = np.stack(list(found.values()))
    deviation = np.sqrt(np.diagonal(each, axis1=-2, axis2=-1))
    return np.asarray(each / (deviation[:, :, None] * deviation[:, None, :]))


def test_bins_are_correlated_behind_a_mask_as_those_of_an_ensemble(client: Client, tmp_path: Path) -> None:
    """Of 300 skies: some 40,000 numbers of which every other one is independent, 4 sigma, and 0.006 as for 2,000."""
    mask = np.clip(2.0 * (healpy.pix2vec(16, np.arange(12 * 16**2))[2] - 0.3), 0.0, 1.0)
    run = table(biposh={"L_max": 2, "summary_bin": 2}, map={"nside": 16, "mask": mask}, **ensemble(300))
    runner.run(config.load(run), tmp_path / "cap.zarr", workers=client)
    sampled, expected = open_summary(tmp_path / "cap.zarr"), prediction.predict(run)
    for n in (1, 2, 3):
        found, own = (np.diagonal(correlations(one), n, axis1=-2, axis2=-1) for one in (sampled, expected))
        assert np.nanmean(found[:, 2:]) == pytest.approx(np.nanmean(own[:, 2:]), abs=0.006 + 4.0 / np.sqrt(40_000))
        assert np.nanmean(own[:, 2:]) > (0.4, 0.02, 0.005)[n - 1]
    # Bins without a coefficient have NaN in their rows and columns in both.
    for one in (sampled, expected):
        empty = np.isnan(one.biposh_binned_standard_deviation.values)
        covariance = one.biposh_binned_covariance.values
        np.testing.assert_array_equal(np.isnan(covariance), empty[..., None] | empty[..., None, :])
    whole = prediction.predict(table()).biposh_binned_covariance.values
    np.testing.assert_array_equal(np.nan_to_num(whole), np.nan_to_num(whole * np.eye(whole.shape[-1])))


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


def test_errors_of_both_parts_of_a_prediction_add_up_to_its_own() -> None:
    """Those of the parts were of two realizations, whatever the run has."""
    found = prediction.predict("tiny")
    for kind in ("", "_circular"):
        whole, *parts = (found[f"biposh{kind}_binned_standard_error{part}"].values for part in ("", "_real", "_imag"))
        np.testing.assert_allclose(np.hypot(*parts), whole, rtol=1e-9)
