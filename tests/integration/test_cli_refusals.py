"""What the command line refuses: exit code 2, one sentence that names what is wrong, nothing left behind."""

import errno
import os
from pathlib import Path

import pytest
from astropy.table import Table

from mcsim import cli
from refusals import unnamed

from .conftest import SMALL, Command, assert_refused


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("run", "no-such-run"), ("no-such-run", "quickstart")),
        (("run", "quickstart", "--realizations", "5"), ("--realizations", 5, "A:B")),
        (("run", "quickstart", "--realizations", "50:20"), ("50:20", "0:64")),
        (("run", "quickstart", "--resume"), ("quickstart.zarr", "--resume")),
        (("run", "quickstart", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1"), ("--workers", "--scheduler")),
        (("run", "quickstart", "-o", "/proc/x.zarr"), ("/proc/x.zarr", "-o")),
        (("info", "nothing.zarr"), ("nothing.zarr", "exist")),
        (("plot", "nothing.zarr"), ("nothing.zarr",)),
        (("merge", "nothing.zarr", "-o", "x.zarr"), ("nothing.zarr",)),
        (("scan", "no-such-scan"), ("no-such-scan", "planck")),
        (("scan", "wmap", "--nside", "100"), ("nside", 100)),
        (("config",), ("--schema",)),
        (("rnu",), ("rnu", "-h")),
        (("--bar",), ("--bar", "-h")),
        (("diagnose", "demo-model"), ("DATA", "-h")),
        (("run", "tiny", "--workrs", "2"), ("--workrs", "-h")),
        (("run", "tiny", "extra"), ("extra", "-h")),
        (("run", "tiny", "-o"), ("-o", "-h")),
        (("challenge", "foo"), ("foo", "-h")),
        (("challenge", "draws"), ("CONFIG", "-h")),
        (("beam", "nothing.fits"), ("nothing.fits", "FITS")),
        (("beam", "."), (" . ", "FITS")),
        (("beam", "quickstart", "--pixel-deg", "-1"), ("pixel_deg", "--pixel-deg")),
        (("beam", "quickstart", "--m-max", "2"), ("m_max", "--m-max")),
        (("beam", "quickstart", "-o", "x"), ("x", ".png")),
        (("scan", "wmap", "-o", "x.foo"), ("x.foo", ".png")),
        (("info", "."), (" . ",)),
        (("info", ".", "--verify"), (" . ",)),
        (("info", "nothing.zarr", "--verify", "--export", "x.nc"), ("--verify", "x.nc", "--export")),
        (("config", "quickstart", "--schema"), ("--schema", "quickstart")),
        (("plot", "."), (" . ",)),
        (("plot", ".", "--predict", "nothing.zarr"), (" . ",)),
        (("plot", ".", "--exact"), ("--exact", "--predict")),
        (("merge", ".", ".", "-o", "x.zarr"), (" . ",)),
        (("fit", "nothing.zarr", "quickstart"), ("nothing.zarr",)),
        (("predict", "quickstart", "-o", "x.txt"), ("x.txt", ".ecsv")),
        (("predict", "nothing.toml"), ("nothing.toml",)),
        (("scan", "wmap", "--smax", "2", "--nside", "-4"), ("nside", -4)),
        (("scan", "wmap", "--sample-period-s", "nan"), ("sample_period_s", "nan")),
        (("scan", "wmap", "--sample-period-s", "-1"), ("sample_period_s", -1)),
        (("scan", "wmap", "--frame", "lunar"), ("frame", "lunar")),
        (("scan", "wmap", "--line-of-sight", "Z"), ("'Z'", "A, B")),
        (("bench", "--nside", "3"), ("map.nside", 3)),
        (("bench", "--nside", "4", "--lmax", "40"), ("biposh.lmax", 40, "map.nside", 4, 11)),
        (("effects", "gain_drit"), ("gain_drit", "gain_drift")),
        (("run", "quickstart", "--realizations", "-1:3"), ("--realizations", "-1:3", "A:B")),
        (("run", "quickstart", "--realizations", "0:1000"), ("0:1000", "0:64")),
        (("run", "quickstart", "--scheduler", "nonsense"), ("nonsense", "5 s")),
        (("run", "quickstart", "--dry-run", "--scheduler", "nonsense"), ("nonsense", "5 s")),
        (("diagnose", "tiny", "x", "--dry-run", "--scheduler", "nonsense"), ("nonsense", "5 s")),
        (("diagnose", "tiny", "x", "--workers", "-1"), ("--workers", -1, 0)),
        (("run", "quickstart", "--workers", "two"), ("--workers", "two")),
        (("challenge", "make", "quickstart", "-o", "x", "--cases", "0"), ("--cases", 0, 1)),
    ],
)
def test_bad_input_is_one_sentence(
    words: tuple[str, ...], named: tuple[object, ...], mcsim: Command, tmp_path: Path
) -> None:
    assert_refused(mcsim(*words), *named)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--kind", "paired"), "paired"),
        (("--model", "cubic"), "cubic"),
        (("--model", "linear", "--model", "linear"), "linear, linear"),
        (("--model", "spline", "--knots", 2), "2 knots"),
        (("--order", "second"), "second"),
        (("--mode", "L2M0"), "L2M0"),
        (("--mode", "L2M3d0"), "L2M3d0"),
        (("--mode", "L2M0d-2"), "L2M0d-2"),
        (("--mode", "L3M0d1"), "L3M0d1"),
        (("--mode", "L2M0d0", "--mode", "L2M0d0"), "L2M0d0"),
        (("--pair", "V1,V1"), "V1,V1"),
        (("--ell-min", 20, "--ell-max", 15), "20"),
        (("--ell-min", 900), "900"),
        (("--covariance", "nothing.zarr"), "nothing.zarr"),
    ],
)
def test_options_of_fit_that_mean_nothing(
    options: tuple[object, ...], named: str, mcsim: Command, small_store: Path, tmp_path: Path
) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    assert_refused(mcsim("fit", small_store, "small.toml", *options), named)
    assert [path.name for path in tmp_path.iterdir()] == ["small.toml"]


@pytest.mark.parametrize("words", [("small.toml", "STORE"), ("nothing.zarr", "small.toml"), ("STORE", "nothing.toml")])
def test_files_of_fit_that_are_none(words: tuple[str, str], mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    assert_refused(mcsim("fit", *(small_store if word == "STORE" else word for word in words)))


def test_a_disk_that_fails_is_one_sentence(mcsim: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "picture.png")

    monkeypatch.setattr(cli, "app", full)
    code, _, err = mcsim("effects")
    assert (code, err.count("\n")) == (1, 1)
    assert unnamed(err, "picture.png") == []


def test_too_little_memory_is_one_sentence(mcsim: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def large() -> None:
        raise MemoryError("Unable to allocate 49.2 TiB")

    monkeypatch.setattr(cli, "app", large)
    code, _, err = mcsim("effects")
    assert (code, err.count("\n")) == (1, 1)
    assert unnamed(err, "49.2", "nside", "lmax", "smax") == []


@pytest.mark.parametrize("name", ["nothing.zarr", "nothing.ecsv", "store.zarr", "text.ecsv", "columns.ecsv"])
def test_a_file_that_is_no_prediction_is_refused(name: str, mcsim: Command, small_store: Path, tmp_path: Path) -> None:
    (tmp_path / "store.zarr").symlink_to(small_store)
    (tmp_path / "text.ecsv").write_text("no table")
    Table({"L": [2], "value": [1.0]}).write(tmp_path / "columns.ecsv", format="ascii.ecsv")
    assert_refused(mcsim("plot", small_store, "--predict", name, "-o", "x.png"), name)
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("effect", "key"),
    [
        ('[[effects]]\nname = "gain_drift"', "[[effect]]"),
        ('[[effect]]\nname = "gain_drit"', "gain_drift"),
        ('[[effect]]\nname = "boost"\namplitude = 0.0\n[[effect]]\nname = "gain_drit"', "effect[1]"),
        ('[[effect]]\nname = "gain_drift"\nchanel = "W1"', "channel"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "W1"\namplitude = [1.0, 2.0]', "[1.0, 2.0]"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "W1"\namplitude = 0.3', "channel[W1]"),
        ('[[effect]]\nname = "gain_drift"', "channel"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "W1"\nphase = 3.0', "phase"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "W1"\namplitude = "large"', "amplitude"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "W1"\namplitude = 0.1', "pointed"),
        ('[[effect]]\nname = "gain_drift"\nchannel = "V9"', "V9"),
        ('[[effect]]\nname = "dipole_modulation"\nchannel = "W1"', "common"),
        ('[[effect]]\nname = "beam_noncircularity"\nchannel = "W1"\namplitude = 1.0', "m_max"),
    ],
)
def test_config_refuses_effects_that_run_refuses(effect: str, key: str, mcsim: Command, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(f"{SMALL}{effect}\n")
    refused_by_config_and_run(mcsim, key)
    assert [file.name for file in tmp_path.iterdir()] == ["small.toml"]


def test_config_refuses_a_beam_that_run_refuses(mcsim: Command, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.replace("major_arcmin = 300.0", "major_arcmin = 6000.0"))
    refused_by_config_and_run(mcsim, "6000.0")


def test_config_refuses_a_preparation_that_run_refuses(mcsim: Command, tmp_path: Path) -> None:
    steps = "".join(f'[[preparation]]\nkind = "smooth"\nfwhm_arcmin = {width}\n' for width in (1200.0, 320.0))
    (tmp_path / "small.toml").write_text(f"{SMALL}\n{steps}")
    refused_by_config_and_run(mcsim, "preparation[1]")


def refused_by_config_and_run(mcsim: Command, key: str) -> None:
    """Check that ``config``, ``run`` and ``run --dry-run`` refuse small.toml with one sentence, by file and key."""
    answers = [
        mcsim(*words) for words in (("config", "small.toml"), ("run", "small.toml"), ("run", "small.toml", "--dry-run"))
    ]
    for answer in answers:
        assert_refused(answer, "small.toml", key)
    assert len({err for _, _, err in answers}) == 1


@pytest.mark.parametrize(
    ("scan", "key"),
    [
        ('{ kind = "hit_averaged", model = "mine.toml" }', "spin_speed"),
        ('{ kind = "hit_averaged", model = "wmap", line_of_sight = "left" }', "left"),
        ('{ kind = "differencing", model = "wmap_focal_plane", pair = "W9" }', "W9"),
        ('{ kind = "hit_averaged", model = "wmap", sample_period_s = 1e9 }', "channel[W1]"),
    ],
)
def test_config_refuses_scans_that_run_refuses(scan: str, key: str, mcsim: Command, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\nspin_speed = 3.0\n')
    (tmp_path / "small.toml").write_text(SMALL.replace('{ kind = "parallel_transport", psi0_deg = 20.0 }', scan))
    refused_by_config_and_run(mcsim, key)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("make", "quickstart", "-o", "made", "--cases", "-3"), "--cases"),
        (("make", "quickstart", "-o", "made", "--sampled-share", "1.5"), "--sampled-share"),
        (("make", "quickstart", "-o", "made", "--inventions", "nowhere.py"), "nowhere.py"),
        (("make", "nowhere.toml", "-o", "made"), "nowhere.toml"),
        (("draws", "quickstart", "-o", "made", "--number", "0"), "--number"),
        (("draws", "quickstart", "-o", "made", "--weakest", "30"), "from 30 to 20"),
        (("run", "nowhere"), "nowhere"),
        (("score", "nowhere"), "nowhere"),
    ],
)
def test_a_challenge_refuses_wrong_options(mcsim: Command, tmp_path: Path, words: tuple[str, ...], named: str) -> None:
    code, _, error = mcsim("challenge", *words)
    assert code == 2
    assert named in error
    assert not list((tmp_path / "made").rglob("*.json"))


@pytest.mark.parametrize(
    "words",
    [
        ("merge", "copy.zarr", "-o", "copy.zarr/sub"),
        ("merge", "copy.zarr", "-o", "copy.zarr/deep/sub"),
        ("run", "small.toml", "-o", "copy.zarr/sub"),
        ("run", "small.toml", "--dry-run", "-o", "copy.zarr/sub"),
        ("info", "copy.zarr", "--export", "copy.zarr/sub.zarr"),
        ("info", "copy.zarr", "--export", "copy.zarr/sub.ecsv"),
        ("plot", "copy.zarr", "-o", "copy.zarr/sub.png"),
        ("predict", "small.toml", "-o", "link/sub.nc"),
        ("maps", "small.toml", "-o", "copy.zarr/sub"),
        ("maps", "small.toml", "--realization", "0", "-o", "copy.zarr/sub"),
        ("diagnose", "small.toml", "maps", "-o", "copy.zarr"),
    ],
)
def test_nothing_is_written_into_a_store(words: tuple[str, ...], mcsim: Command, copy: Path, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "link").symlink_to(copy)
    if words[0] == "diagnose":
        assert mcsim("maps", "small.toml", "--realization", "0", "-o", "maps")[0] == 0
    before = sorted(copy.rglob("*"))
    named = {"link/sub.nc": tmp_path / "link", "copy.zarr": "copy.zarr"}
    assert_refused(mcsim(*words), named.get(words[-1], copy))
    assert sorted(copy.rglob("*")) == before


def test_a_store_may_stand_in_a_group_of_stores(mcsim: Command, copy: Path, tmp_path: Path) -> None:
    group = tmp_path / "all.zarr"
    group.mkdir()
    (group / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    assert mcsim("merge", copy, "-o", "all.zarr/first")[0] == 0
    assert mcsim("merge", copy, "-o", "all.zarr/second")[0] == 0
    assert_refused(mcsim("merge", copy, "-o", "all.zarr/first/biposh/third"), "all.zarr/first/biposh/third")
    (copy / "zarr.json").write_text("cut")
    assert_refused(mcsim("merge", group / "first", "-o", "copy.zarr/sub"), "copy.zarr/sub")
