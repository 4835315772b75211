"""The maps of a run as FITS files: what they hold, what reads them back, and what is refused."""

import errno
import shutil
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
from astropy.io import fits
from distributed import Client

from mcsim import config, open_ensemble
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.map_checks import of_pixel_means, read_maps
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.ensemble import maps as maps_
from mcsim.ensemble import runner
from mcsim.ensemble.maps import write_map, write_maps
from mcsim.errors import RunError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from refusals import refused

from .conftest import SMALL, Command, assert_refused, ensemble, table

SCAN = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 61.0, "line_of_sight": "A"}


def halves(**changes: Any) -> dict[str, Any]:
    """Two channels, two halves of a year, with noise."""
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 400.0, "fwhm_minor_arcmin": 350.0}
    channels = [{"name": name, "beam": beam, "noise": {"sigma0_uk": 30.0}, "scan": SCAN} for name in ("V1", "W1")]
    return table(map={"nside": 16, "frame": "galactic", "splits": ["a", "b"]}, channel=channels) | changes


def test_a_diagnosis_reads_what_is_written(tmp_path: Path) -> None:
    run = config.load(halves())
    folder = tmp_path / "observed"
    assert write_maps(run, folder, 3, nthreads=1) == [folder]
    assert sorted(file.name for file in folder.iterdir()) == ["V1_a.fits", "V1_b.fits", "W1_a.fits", "W1_b.fits"]
    shared = survey(run)
    expected = simulate.maps(shared, 3)
    for found, map_uk in zip(read_maps(model_of(shared, DiagnosisSettings()), folder), expected, strict=True):
        np.testing.assert_array_equal(found, map_uk)
    header = fits.getheader(folder / "V1_b.fits", 1)
    told = {"ORDERING": "RING", "COORDSYS": "G", "NSIDE": 16, "TUNIT1": "uK", "RUN": "small", "REALIZ": 3}
    assert {key: header[key] for key in told} == told
    assert header["DIGEST"] == config.digest(run)
    assert header["POINTING"] == "pixel means"


def test_they_are_the_maps_that_a_store_keeps(client: Client, tmp_path: Path) -> None:
    run = table(**ensemble(3, keep_maps=True))
    runner.run(run, tmp_path / "x.zarr", workers=client)
    folders = write_maps(run, tmp_path / "maps", slice(1, 3))
    assert [folder.name for folder in folders] == ["00001", "00002"]
    kept = open_ensemble(tmp_path / "x.zarr").observed_map
    for r, folder in zip((1, 2), folders, strict=True):
        np.testing.assert_array_equal(healpy.read_map(folder / "W1.fits").astype(np.float32), kept[r, 0].values)


def test_unobserved_pixels_are_unseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bare(*_: object) -> np.ndarray:
        map_uk = simulate_maps(*_)
        map_uk[:, :5] = healpy.UNSEEN
        return map_uk

    simulate_maps = simulate.maps
    monkeypatch.setattr(maps_.simulate, "maps", bare)
    folder = write_maps(table(), tmp_path / "x", 0)[0]
    assert (healpy.read_map(folder / "W1.fits")[:6] == healpy.UNSEEN).tolist() == [True] * 5 + [False]


def test_sample_by_sample(tmp_path: Path) -> None:
    run = config.load(halves())
    folder = write_maps(run, tmp_path / "x", 0, sample_by_sample=True, nthreads=1)[0]
    for name, map_uk in sampled.maps(survey(run), 0):
        np.testing.assert_array_equal(healpy.read_map(folder / f"{name.replace(':', '_')}.fits", dtype=float), map_uk)
    assert fits.getheader(folder / "V1_b.fits", 1)["POINTING"] == "samples"


def test_a_diagnosis_knows_maps_by_the_default_route(tmp_path: Path) -> None:
    run = config.load(halves())
    model = model_of(survey(run), DiagnosisSettings())
    means, samples = (
        write_maps(run, tmp_path / str(dense), 0, sample_by_sample=dense, nthreads=1)[0] for dense in (False, True)
    )
    assert of_pixel_means(model, means)
    assert not of_pixel_means(model, samples)
    shutil.copy(samples / "W1_b.fits", means)
    assert not of_pixel_means(model, means)
    (means / "W1_b.fits").unlink()
    write_map(means / "W1_b.fits", np.ones(12 * 16**2), "galactic")  # of another program
    assert not of_pixel_means(model, means)


@pytest.mark.parametrize(
    ("run", "options", "key"),
    [
        (table(), {"realizations": 10}, "10"),
        (table(), {"realizations": -1}, "-1"),
        (table(), {"realizations": slice(5, 3)}, "5:3"),
        (table(), {"sample_by_sample": True}, "W1"),
        (table(map={"grid": "gl"}), {}, "map.grid"),
        (
            halves(map={"nside": 16, "splits": ["a", "b_a"]}, channel=[halves()["channel"][0] | {"name": n} for n in
                   ("V", "V_b")]),
            {},
            "V_b_a.fits",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_refused_before(
    run: dict[str, Any], options: dict[str, Any], key: str, tmp_path: Path
) -> None:
    with refused(key):
        write_maps(run, tmp_path / "x", **options)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_over_and_nothing_is_left_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, folder = table(**ensemble(3)), tmp_path / "x"
    write_maps(run, folder, slice(1, 2))
    file = folder / "00001" / "W1.fits"
    before = file.read_bytes()
    with refused(folder, "-o"):
        write_maps(run, folder, 0)
    with refused(file, "DIGEST", "-o"):
        write_maps(table(**ensemble(3, seed=9)), folder)
    (folder / "00001" / "notes.txt").write_text("mine")
    with refused(folder / "00001", "-o"):
        write_maps(run, folder)
    (folder / "00001" / "notes.txt").unlink()
    assert file.read_bytes() == before

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(healpy, "write_map", full)
    with refused(folder / "00002", by=RunError, errno=errno.ENOSPC):
        write_maps(run, folder, slice(2, 3))
    assert [file.name for file in folder.iterdir()] == ["00001"]
    with refused(tmp_path / "y", by=RunError, errno=errno.ENOSPC):
        write_maps(run, tmp_path / "y", 0)
    assert not (tmp_path / "y").exists()


def test_an_interrupted_call_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, folder, made = table(**ensemble(3)), tmp_path / "x", []
    write_maps(run, folder, slice(0, 2))
    before = [(folder / f"{r:05d}" / "W1.fits").stat().st_mtime_ns for r in range(2)]
    (folder / "00000" / "W1.fits").rename(tmp_path / "broken")
    (folder / "00000" / "W1.fits").write_bytes((tmp_path / "broken").read_bytes()[:3000])
    with refused(folder / "00000" / "W1.fits", "-o"):
        write_maps(run, folder)
    (tmp_path / "broken").replace(folder / "00000" / "W1.fits")
    monkeypatch.setattr(simulate, "maps", lambda _, r, threads, own=simulate.maps: made.append(r) or own(_, r, threads))
    assert write_maps(run, folder) == [folder / f"{r:05d}" for r in range(3)]
    assert made == [2]
    assert [(folder / f"{r:05d}" / "W1.fits").stat().st_mtime_ns for r in range(2)] == before


def test_the_command(mcsim: Command, tmp_path: Path) -> None:
    toml = tmp_path / "small.toml"
    toml.write_text(SMALL)
    assert mcsim("maps", "small.toml", "-o", "one", "--realization", 4)[0] == 0
    assert mcsim("maps", "small.toml", "-o", "some", "--realizations", "4:6")[0] == 0
    assert (tmp_path / "one" / "W1.fits").read_bytes() == (tmp_path / "some" / "00004" / "W1.fits").read_bytes()
    assert mcsim("maps", "small.toml", "-o", "one", "--realization", 4)[0] == 0  # they are there
    for words in (
        ("small.toml", "-o", "one", "--realization", 5),
        ("small.toml", "-o", "x", "--realization", 4, "--realizations", "4:6"),
        ("small.toml", "-o", "x", "--realization", 10),
        ("small.toml", "-o", "x", "--realizations", "6:4"),
        ("small.toml", "-o", "x", "--sample-by-sample"),
        ("small.toml", "-o", "small.toml"),
        ("small.toml", "-o", "/proc/x"),
        ("nothing.toml", "-o", "x"),
    ):
        assert_refused(mcsim("maps", *words))
    assert mcsim("maps", "small.toml")[0] == 2
    assert not (tmp_path / "x").exists()
