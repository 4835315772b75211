"""The command line as a user meets it: outputs, exit codes, pictures and tables."""

import errno
import inspect
import io
import json
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import xarray as xr
import zarr
from astropy.io import fits
from astropy.table import Table
from distributed import Client, LocalCluster
from matplotlib.figure import Figure

from mcsim import cli, config, open_summary
from mcsim.cli.common import save
from mcsim.ensemble import describe, opening, runner, tables
from mcsim.ensemble.maps import write_map
from mcsim.ensemble.prediction import predict
from mcsim.plot.spectra import ensemble_figure
from refusals import refused, unnamed

from .conftest import SMALL, Command, assert_refused, table


def stamps(store: Path) -> dict[Path, int]:
    """Return when each file of a store was written last."""
    return {file.relative_to(store): file.stat().st_mtime_ns for file in store.rglob("*") if file.is_file()}


def test_help_loads_no_heavy_library() -> None:
    """That keeps it under half a second on any machine."""
    program = (
        "import sys, mcsim.cli\n"
        "sys.argv = ['mcsim', '--help']\n"
        "try:\n    mcsim.cli.main()\n"
        "except SystemExit:\n    print(sorted({'numpy', 'numba', 'dask', 'xarray', 'healpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    for command in ("run", "merge", "info", "plot", "predict", "fit", "beam", "scan", "bench", "config", "maps"):
        assert command in done.stdout
    assert done.stdout.rstrip().endswith("[]")


@pytest.mark.parametrize("command", [one.callback for one in cli.app.registered_commands], ids=lambda one: one.__name__)
def test_help_prints_what_is_written(mcsim: Command, command: Callable[..., None]) -> None:
    """Text in square brackets would be taken for markup, and vanish."""
    _, out, _ = mcsim(command.__name__.rstrip("_"), "--help")
    printed = re.sub(r"[^\w\[\]]", "", out)
    texts = [inspect.getdoc(command).partition("\n\n")[0]]
    texts += [
        one.__metadata__[0].help for one in get_type_hints(command, include_extras=True).values() if get_args(one)
    ]
    missing = [text for text in texts if text and re.sub(r"[^\w\[\]]", "", text) not in printed]
    assert not missing


def test_info_and_exports(mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    code, out, _ = mcsim("info", small_store, "--export", "summary.nc")
    assert code == 0
    assert unnamed(out, "10 of 10", "L2M0d0", "control") == []
    with xr.open_dataset(tmp_path / "summary.nc", engine="scipy") as summary:
        assert summary["biposh_mean_re"].attrs["units"] == "uK^2"
        assert int(summary["count"]) == 10
    assert mcsim("info", small_store, "--export", "summary.ecsv")[0] == 0
    rows = Table.read(tmp_path / "summary.ecsv", format="ascii.ecsv")
    assert set(rows.colnames) >= {"pair", "L", "M", "d", "ell_min", "ell_max", "value", "error"}
    assert str(rows["value"].unit) == "uK2"
    assert "Bennett" in rows.meta["normalisation"]
    for name in ("summary.fits", "summary.csv"):
        code, _, err = mcsim("info", small_store, "--export", name)
        assert (code, "Warning" in err) == (0, False)
        same = Table.read(tmp_path / name)
        assert same.colnames == rows.colnames
        np.testing.assert_allclose(same["value"], rows["value"], rtol=1e-14)
    assert str(Table.read(tmp_path / "summary.fits")["value"].unit) == "uK2"
    assert_refused(mcsim("info", small_store, "--export", "summary.ecsv"), "summary.ecsv", "another")


def test_plot_chooses_modes(mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    assert mcsim("plot", small_store, "--L", 2, "--M", 0, "-o", "a20.png")[0] == 0
    assert (tmp_path / "a20.png").stat().st_size > 10_000
    assert_refused(mcsim("plot", small_store, "--L", 9), "L = 9", "W1,W1")


def test_effects_on_request_are_marked_and_proposed_when_asked_for(mcsim: Command, tmp_path: Path) -> None:
    asked = "--with orbital_dipole"
    assert asked in mcsim("effects", "orbital_dipole")[1]
    assert "--with" not in mcsim("effects", "gain_drift")[1]
    own = "from mcsim.systematics.added import OrbitalDipole\n\n\nclass Own(OrbitalDipole):\n    name = 'own_dipole'\n"
    (tmp_path / "own.py").write_text(own)
    assert "--with own.py" in mcsim("effects", "own.py")[1]
    model = """
schema = 1
name = "small"
sky = { spectrum = "wmap7", lmax = 40 }
map = { nside = 16 }
[[channel]]
name = "W1"
beam = { kind = "gaussian", fwhm_arcmin = 350.0 }
noise = { sigma0_uk = 30.0 }
scan = { kind = "hit_averaged", model = "wmap", sample_period_s = 157.8, line_of_sight = "A" }
"""
    (tmp_path / "small.toml").write_text(model)
    (tmp_path / "data").mkdir()
    write_map(tmp_path / "data" / "W1.fits", 60.0 * np.random.default_rng(1).standard_normal(3072), "ecliptic")
    command = ("diagnose", "small.toml", "data", "-o", "out", "--dry-run", "--simulations", 400)
    sizes = [int(mcsim(*command, *more)[1].splitlines()[0].split()[-1]) for more in ((), asked.split())]
    assert sizes[1] == sizes[0] + 2  # cosine and sine have a matched filter each
    assert_refused(mcsim(*command, "--with", "orbital_dipol"), "orbital_dipol", "orbital_dipole")
    alone = ("--only", "beam_width", "--only", "orbital_dipole", "--without")
    assert int(mcsim(*command, *alone[:-1])[1].splitlines()[0].split()[-1]) < sizes[0]
    assert_refused(mcsim(*command, *alone, "beam_width"), "beam_width", "--only", "--without")
    first, whole = (mcsim("diagnose", "small.toml", "data", "--dry-run", *more)[1] for more in (["--quick"], []))
    assert int(first.split("at most ")[1].split()[0]) < int(whole.split("at most ")[1].split()[0])
    assert_refused(mcsim("diagnose", "small.toml", "data"), "-o")


@pytest.mark.parametrize("name", ["x.nc", "x.ecsv", "x.zarr"])
def test_an_export_is_written_whole_or_not_at_all(name: str, small_store: Path, tmp_path: Path) -> None:
    with open_summary(small_store) as summary:
        whole = summary.load()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))  # as a disk that is full in the middle of a file
    try:
        with refused(name, errno=errno.EFBIG):
            tables.write(whole, tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
    tables.write(whole, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["x.png", "x.SVG", "x.pdf", "x.jpg"])
def test_a_picture_stays_whole_where_the_next_does_not_fit(name: str, tmp_path: Path) -> None:
    """It was cut off, or empty."""
    figure = Figure()
    figure.subplots()
    save(figure, tmp_path / name)
    first = (tmp_path / name).read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    try:
        with refused(name, errno=errno.EFBIG):
            save(figure, tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / name).read_bytes() == first
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_figure_for_a_paper_has_no_title_and_no_notes(mcsim: Command, small_store: Path) -> None:
    words = ("plot", str(small_store), "--L", "2", "--M", "0", "--d", "0", "-o")
    assert mcsim(*words, "whole.svg")[0] == mcsim(*words, "bare.svg", "--no-caption")[0] == 0
    whole, bare = (Path(name).read_text(encoding="utf-8") for name in ("whole.svg", "bare.svg"))
    assert "realizations" in whole
    assert "realizations" not in bare


@pytest.mark.parametrize("chosen", [{}, {"L": 2, "M": 0}])
def test_notes_of_a_wide_and_a_narrow_figure_are_whole(small_store: Path, chosen: dict[str, int]) -> None:
    figure = ensemble_figure(small_store, prediction=predict(table()), **chosen)
    figure.savefig(io.BytesIO(), dpi=figure.dpi)
    box, whole = figure.get_tightbbox(), figure.bbox_inches
    assert box.x0 >= 0.0
    assert box.x1 <= whole.x1


def test_a_store_that_a_run_writes_is_described(
    small_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(small_store, tmp_path / "small.zarr")
    (half := tmp_path / "small.zarr/cl/zarr.ab.partial").write_bytes(b"")
    opened = opening.open_ensemble
    monkeypatch.setattr(opening, "open_ensemble", lambda path: (half.unlink(), opened(path))[1])
    assert "realizations finished" in describe.describe(tmp_path / "small.zarr")


def test_a_name_that_looks_like_a_formula_is_drawn_as_it_is(small_store: Path, tmp_path: Path) -> None:
    os.symlink(small_store, tmp_path / "a$_$b.zarr")
    ensemble_figure(tmp_path / "a$_$b.zarr", L=2, M=0).savefig(io.BytesIO(), dpi=30)


def test_one_realization_is_drawn_without_errors(client: Client, tmp_path: Path) -> None:
    runner.run(table(ensemble={"realizations": 1}), tmp_path / "one.zarr", workers=client)
    [axes] = ensemble_figure(tmp_path / "one.zarr", L=2, M=0, d=0).axes
    assert np.isfinite(np.asarray(axes.lines[0].get_ydata(), float)).all()


def test_a_prediction_in_another_frame_is_not_drawn(small_store: Path) -> None:
    other = predict(table(map={"nside": 16, "frame": "galactic"}))
    with refused("ecliptic", "galactic"):
        ensemble_figure(small_store, prediction=other)


def test_a_signal_is_not_hidden_by_the_mean_field_of_noise(small_store: Path, tmp_path: Path) -> None:
    shutil.copytree(small_store, tmp_path / "small.zarr")
    group = zarr.open_group(tmp_path / "small.zarr" / "summary", mode="r+", use_consolidated=False)
    mean, error = (np.asarray(group[f"biposh_{name}"][...]) for name in ("difference_binned_mean", "binned_mean"))
    group["biposh_binned_mean"][...] = error + 1000.0 * np.abs(mean).max()
    [axes] = ensemble_figure(tmp_path / "small.zarr", L=2, M=0).axes
    points = [line.get_ydata() for line in axes.lines]
    assert np.ptp(axes.get_ylim()) < 3.0 * np.ptp(np.concatenate([np.asarray(one, float) for one in points]))


def test_dry_run_says_the_cost_and_computes_nothing(mcsim: Command, tmp_path: Path) -> None:
    code, out, _ = mcsim("run", "quickstart", "--dry-run")
    assert code == 0
    for word in ("memory", "disk", "files", "time", "realizations", "0.4 GB of the command"):
        assert word in out
    assert list(tmp_path.iterdir()) == []


def test_dry_run_counts_the_workers_of_a_scheduler(mcsim: Command, client: Client, tmp_path: Path) -> None:
    """The two of the fixture are there; of those of a scheduler without any the time is not known."""
    (tmp_path / "small.toml").write_text(SMALL.replace("seed = 7", "seed = 7\n[compute]\nworkers = 7"))
    dry = ("run", "small.toml", "--dry-run")
    assert "7 workers" in mcsim(*dry)[1]
    assert "2 workers" in mcsim(*dry, "--scheduler", client.scheduler.address)[1]
    idle = LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0")
    with idle, Client(idle, set_as_default=False) as connected:
        address = connected.scheduler.address
        assert_refused(mcsim(*dry, "--scheduler", address), address, "--workers")


def test_dry_run_says_what_a_store_holds_and_what_is_left(mcsim: Command, copy: Path, tmp_path: Path) -> None:
    """Ten realizations in chunks of four, of which those of the second chunk are not finished, then one is damaged."""
    (tmp_path / "small.toml").write_text(SMALL)
    dry = ("run", "small.toml", "--dry-run")
    assert mcsim(*dry)[1].startswith("small: 10 realizations in 10 tasks\n")
    assert_refused(mcsim(*dry, "--resume"), "small.zarr", "--resume")
    assert_refused(mcsim("run", "tiny", "--dry-run", "-o", copy), copy, "sky.lmax", "48", "-o")
    code, out, _ = mcsim(*dry, "-o", copy)
    assert (code, out.splitlines()[0]) == (0, "small: 0 realizations in 0 tasks")
    assert len(out.splitlines()) == 2
    assert f"{copy} holds 10 of 10" in out
    (copy / "done" / "c" / "1").unlink()
    before = stamps(copy)
    [first, held, *rest] = mcsim(*dry, "-o", copy)[1].splitlines()
    assert first == "small: 4 realizations in 1 tasks"
    assert held == f"  store   {copy} holds 6 of 10"
    assert any("memory" in line for line in rest)
    assert mcsim(*dry, "-o", copy, "--realizations", "2:6")[1].startswith("small: 2 realizations in 1 tasks\n")
    damaged = next(file for file in (copy / "biposh" / "c" / "0").rglob("*") if file.is_file())
    damaged.write_bytes(b"x")
    [first, held, damage, *_] = mcsim(*dry, "-o", copy, "--resume")[1].splitlines()
    assert first == "small: 8 realizations in 2 tasks"
    assert held == f"  store   {copy} holds 2 of 10"
    assert damage == "  damaged realizations 0-3, computed again"
    (copy / "done" / "zarr.json").rename(tmp_path / "done.json")
    assert mcsim(*dry, "-o", copy, "--resume")[1].startswith("small: 10 realizations in 10 tasks\n")
    (tmp_path / "done.json").rename(copy / "done" / "zarr.json")
    (copy / "zarr.json").write_text("{}")
    assert mcsim(*dry, "-o", copy, "--resume")[1].startswith("small: 10 realizations in")
    assert {file for file, when in stamps(copy).items() if before[file] != when} == {
        damaged.relative_to(copy),
        Path("zarr.json"),
    }


def test_finished_store_says_so(mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    (tmp_path / "small.json").write_text(json.dumps(table()))
    toml = tmp_path / "small.toml"
    toml.write_text(SMALL)
    assert config.digest(config.load(toml)) == config.digest(config.load(table()))
    before = stamps(small_store)
    code, out, _ = mcsim("run", toml, "-o", small_store)
    assert code == 0
    assert unnamed(out, small_store, "10 realizations") == []
    assert stamps(small_store) == before


def test_a_merge_says_what_is_missing(mcsim: Command, small_store: Path, client: Client, tmp_path: Path) -> None:
    runner.run(table(), tmp_path / "part.zarr", realizations=slice(0, 7), workers=client)
    code, out, _ = mcsim("merge", "part.zarr", "-o", "merged.zarr")
    assert code == 0
    assert unnamed(out, "merged.zarr", "7 of 10", 3) == []
    assert "finished" not in out
    code, out, _ = mcsim("merge", "merged.zarr", small_store, "-o", "whole.zarr")
    assert (code, out) == (0, "whole.zarr is finished: 10 realizations; its summary is new.\n")


@pytest.mark.usefixtures("in_this_process")
def test_other_bins_of_a_finished_store_need_no_realization(mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    shutil.copytree(small_store, tmp_path / "small.zarr")
    (tmp_path / "small.toml").write_text(SMALL.replace("summary_bin = 10", "summary_bin = 16"))
    code, out, _ = mcsim("run", "small.toml", "--workers", 1)
    assert code == 0
    assert "summary" in out
    assert open_summary(tmp_path / "small.zarr")["bin_first"].values.tolist() == [0, 16, 32]
    before = stamps(tmp_path / "small.zarr")
    chunks = {file: time for file, time in stamps(small_store).items() if file.parts[:2] == ("biposh", "c")}
    assert chunks
    assert chunks.items() <= before.items()  # a copy keeps the times of its files
    assert mcsim("run", "small.toml")[0] == 0
    assert stamps(tmp_path / "small.zarr") == before


def test_config_checks_and_prints_the_schema(mcsim: Command) -> None:
    code, out, _ = mcsim("config", "quickstart")
    assert code == 0
    assert json.loads(out)["name"] == "quickstart"
    code, out, _ = mcsim("config", "--schema")
    assert json.loads(out)["title"] == "RunConfig"


def test_beam_of_a_configuration_and_of_files(mcsim: Command, tmp_path: Path) -> None:
    code, out, _ = mcsim("beam", "quickstart", "--lmax", 300)
    assert code == 0
    assert "axis ratio" in out
    assert (tmp_path / "quickstart-beam.png").exists()
    y, x = np.mgrid[-40:41, -40:41] * 0.1
    image = np.exp(-(x**2) / 2 / 0.5**2 - y**2 / 2 / 0.4**2)
    header = fits.Header({"CDELT1": 0.1, "CDELT2": 0.1, "CUNIT1": "deg", "CUNIT2": "deg"})
    fits.PrimaryHDU(image, header).writeto(tmp_path / "map.fits")
    code, out, _ = mcsim("beam", "map.fits", "--lmax", 500, "-o", "map.png")
    assert code == 0
    assert "1.25" in out
    assert (tmp_path / "map.png").exists()
    two = Path(__file__).parents[2] / "workflows" / "demo-model.toml"
    assert mcsim("beam", two, "--lmax", 300, "-o", "of.png")[0] == 0
    assert sorted(one.name for one in tmp_path.glob("of*")) == ["of-V1.png", "of-W1.png"]


def test_scan(mcsim: Command, tmp_path: Path) -> None:
    code, out, _ = mcsim("scan", "wmap", "--nside", 32, "--sample-period-s", 30.7, "-o", "scan.png")
    assert code == 0
    assert "three factors" in out
    assert (tmp_path / "scan.png").stat().st_size > 10_000


def test_scan_without_a_limit(mcsim: Command, tmp_path: Path) -> None:
    """Planck precesses with the seasons, so there is no curve of endless time to draw beside its own."""
    code, out, _ = mcsim("scan", "planck", "--nside", 8, "--sample-period-s", 607.0, "-o", "scan.png")
    assert code == 0
    assert "three factors" in out
    assert (tmp_path / "scan.png").stat().st_size > 10_000


def test_predict_plot_and_fit(mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    code, out, _ = mcsim("predict", "small.toml", "--snr", "-o", "expected.ecsv")
    assert code == 0
    assert "signal to noise" in out
    assert "value" in Table.read(tmp_path / "expected.ecsv", format="ascii.ecsv").colnames
    for row in ("L2M0d0", "10-19"):
        assert row in out
    assert mcsim("plot", small_store, "--L", 2, "--M", 0, "--predict", "small.toml", "-o", "both.png")[0] == 0
    assert_refused(mcsim("fit", small_store, "small.toml"), "10 realizations")
    code, out, _ = mcsim("fit", small_store, "small.toml", "--model", "constant", "--ell-min", 10, "-o", "fit.png")
    assert code == 0
    assert "alpha = " in out
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    options = ("--model", "constant", "--ell-min", 10, "-o", "fit.png", "--mode", "L2M0d0", "--kind", "plain", "--json")
    code, out, aside = mcsim("fit", small_store, "small.toml", *options)
    assert code == 0
    assert json.loads(out)[0]["kind"] == "plain"
    assert "wrote fit.png" in aside


def test_a_terminal_without_greek_letters() -> None:
    """What it cannot show is a question mark, and no UnicodeEncodeError."""
    program = "import sys, mcsim.cli\nsys.argv = ['mcsim', 'config', 'µ']\nmcsim.cli.main()"
    ascii_alone = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=ascii_alone, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "?" in done.stderr
    assert "Traceback" not in done.stderr


def test_version(mcsim: Command) -> None:
    code, out, _ = mcsim("--version")
    assert code == 0
    assert out.split() == ["mcsim", version("mcsim")]


@pytest.mark.parametrize("ending", ["zarr", "nc", "ecsv"])
def test_plot_reads_what_predict_wrote(ending: str, mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    assert mcsim("predict", "small.toml", "-o", f"expected.{ending}")[0] == 0
    expected = predict(tmp_path / "small.toml")
    found = tables.read_prediction(tmp_path / f"expected.{ending}")
    assert found.attrs["prediction"] == expected.attrs["prediction"]
    expected = expected.sel(mode=found["mode"].values)
    for kind in ("", "_difference"):
        for name in ("mean", "standard_error"):
            name = f"biposh{kind}_binned_{name}"
            np.testing.assert_allclose(found[name].values, expected[name].values, rtol=1e-12, atol=1e-12)
    for name in ("L", "M", "d", "parity", "bin", "bin_first", "bin_last"):
        assert found[name].values.tolist() == expected[name].values.tolist()
    slash = "/" if ending == "zarr" else ""  # as a shell completes the name of a folder
    code, _, err = mcsim("plot", small_store, "--L", 2, "--predict", f"expected.{ending}{slash}", "-o", "both.png")
    assert (code, err) == (0, "")
    assert (tmp_path / "both.png").stat().st_size > 10_000
    assert_refused(mcsim("plot", small_store, "--predict", f"expected.{ending}", "--exact"), "--exact")


@pytest.mark.parametrize("ending", tables.ENDINGS)
def test_summary_is_exported_into_a_new_folder_and_no_prediction(
    ending: str, mcsim: Command, small_store: Path, tmp_path: Path
) -> None:
    file = f"new/folder/summary{ending}"
    assert mcsim("info", small_store, "--export", file)[0] == 0
    assert (tmp_path / file).exists()
    assert_refused(mcsim("plot", small_store, "--predict", file, "-o", "x.png"), file)
    assert not (tmp_path / "x.png").exists()


def test_pictures_come_beside_what_they_show(mcsim: Command, tmp_path: Path) -> None:
    """And what cannot be written is said before anything is computed."""
    (tmp_path / "sub").mkdir()
    hdu = fits.BinTableHDU.from_columns([fits.Column("B_L", "D", array=np.exp(-(np.arange(40.0) ** 2) / 2e3))])
    hdu.writeto(tmp_path / "sub" / "bl.fits")
    code, out, _ = mcsim("beam", "sub/bl.fits")
    assert code == 0
    assert (tmp_path / "sub" / "bl-beam.png").exists()
    assert "sub/bl-beam.png" in out
    hdu.writeto(tmp_path / "sub" / "packed.fits.gz")
    assert mcsim("beam", "sub/packed.fits.gz")[0] == 0
    assert (tmp_path / "sub" / "packed-beam.png").exists()
    assert_refused(mcsim("scan", "wmap", "-o", "nowhere/scan.png"), "nowhere/scan.png")
    assert_refused(mcsim("fit", "nix.zarr", "tiny", "-o", "nowhere/fit.png"), "nowhere/fit.png")
    (tmp_path / "p.zarr").mkdir()
    code, out, err = mcsim("predict", "tiny", "-o", "p.zarr")
    assert code == 2
    assert not out
    assert "p.zarr" in err


def test_help_shows_no_type_of_flags_and_config_every_default(mcsim: Command) -> None:
    for command in ("run", "diagnose", "challenge"):
        _, out, _ = mcsim(command, "--help")
        assert "bool" not in out
        assert "--help" in out
    assert json.loads(mcsim("config", "tiny")[1])["map"]["offset_order"] == 1


@pytest.mark.parametrize(("stated", "other", "key"), [("uK2", "mK2", "unit"), ("Bennett", "Other", "normalisation")])
def test_plot_draws_no_numbers_of_another_kind(
    stated: str, other: str, key: str, mcsim: Command, tmp_path: Path
) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    assert mcsim("predict", "small.toml", "-o", "expected.ecsv")[0] == 0
    path = tmp_path / "expected.ecsv"
    path.write_text(path.read_text().replace(stated, other))
    with refused(path, key, stated):
        tables.read_prediction(path)
