"""The documented walk through a stored ensemble, and the examples of the documentation, executed."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from mcsim import open_summary

SCRIPT = Path(__file__).parents[2] / "workflows" / "ensemble" / "walk.py"
spec = importlib.util.spec_from_file_location("walk", SCRIPT)
assert spec is not None
assert spec.loader is not None
walk = importlib.util.module_from_spec(spec)
spec.loader.exec_module(walk)


def test_script_runs(small_store: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["walk.py", str(small_store), "--width", "10"])
    walk.main()
    text = capsys.readouterr().out
    assert "modes with L = 2, d = 0: L2M0d0, L2M1d0, L2M2d0" in text
    assert "paired difference (10 realizations)" in text


def test_walk_finds_what_the_summary_says(small_store: Path) -> None:
    ensemble = walk.finished(small_store)
    assert ensemble["biposh"].chunks is not None, "the walk is to be out of core"
    with open_summary(small_store) as summary:
        mean, error = walk.mean_and_error(walk.choose(ensemble, L=2, M=1)["biposh"])
        expected = summary.isel(mode=np.flatnonzero((summary["L"] == 2) & (summary["M"] == 1)))
        np.testing.assert_allclose(mean, expected["biposh_mean"], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(error, expected["biposh_standard_error"], rtol=1e-9, atol=1e-12)


def test_covariance_is_that_of_numpy(small_store: Path) -> None:
    ensemble = walk.finished(small_store)
    bins = walk.binned(ensemble["biposh"].sel(mode="L2M0d0").isel(pair=0), 10)
    ell = np.arange(33)
    scaled = ensemble["biposh"].sel(mode="L2M0d0").isel(pair=0).values * ell * (ell + 1) / (2 * np.pi)
    by_hand = np.stack([np.nanmean(scaled[:, a : a + 10], axis=1) for a in (0, 10, 20, 30)], axis=1)
    np.testing.assert_allclose(bins.transpose("realization", "bin_first"), by_hand, rtol=1e-12, atol=1e-14)
    found = walk.covariance(bins)
    assert isinstance(found, xr.DataArray)
    np.testing.assert_allclose(found, np.cov(by_hand.T, ddof=1), rtol=1e-9, atol=1e-12)


def test_modes_are_chosen_by_numbers(small_store: Path) -> None:
    ensemble = walk.finished(small_store)
    assert list(walk.choose(ensemble, L=2, M=0)["mode"].values) == ["L2M0d0", "L2M0d1", "L2M0d2"]
    assert walk.choose(ensemble, d=2).sizes["mode"] == 3


@pytest.mark.parametrize(("mode", "turn"), [("L2M0d0", 1.0), ("L2M0d1", 1j), ("L2M1d1", 1j), ("L2M2d0", 1.0)])
def test_the_recipe_of_the_tutorial_finds_a_signal_in_either_part(small_store: Path, mode: str, turn: complex) -> None:
    """Modes with M = 0 are imaginary if their parity is odd; the page took their real part."""
    page = (Path(__file__).parents[2] / "docs" / "tutorials" / "stored-ensemble.md").read_text()
    [cell] = [cell for cell in re.findall(r"```{code-cell}\n(.*?)```", page, re.DOTALL) if "largest bin" in cell]
    summary = open_summary(small_store).load().assign_coords(pair=["V,V"])
    error = summary.biposh_difference_binned_standard_error
    signal = turn * error.where(summary.mode == mode, 0.0) * xr.where(summary.M > 0, np.sqrt(0.5), 1.0)
    summary["biposh_difference_binned_mean"] = 123.0 * signal
    names = {"summary": summary, "xr": xr, "np": np}

    exec(cell, names)
    found = names["z"]
    assert float(found.sel(mode=mode)) == pytest.approx(123.0)
    assert float(found.sum()) == pytest.approx(123.0)


def test_the_tests_of_the_examples_pass_in_their_folder() -> None:
    """As for who copies them: without the options of this project."""
    folder = Path(__file__).parents[2] / "docs" / "howto"
    tests = sorted(folder.glob("test_*.py"))
    assert len(tests) >= 2
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider", *map(str, tests)]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout
