"""Stored maps of another program: which files a template names, and what their attributes say."""

import multiprocessing
import os
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
import xarray as xr

from mcsim import config
from mcsim.datavector import campaign
from mcsim.datavector.repeats import check_alike
from mcsim.ensemble.external import SEEDS, seed_of, source_of
from mcsim.ensemble.external_maps import FitsMaps, Part, fits_maps, in_order
from mcsim.errors import RunError
from refusals import refused

PARTS = (Part("V", "V", None, None, "galactic"),)


def files(folder: Path, names: list[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()


@pytest.mark.parametrize(
    ("field", "digits"), [("{realization}", 1), ("{realization:03d}", 3), ("{realization:05d}", 5)]
)
def test_all_files_of_a_template_are_realizations(field: str, digits: int, tmp_path: Path) -> None:
    files(tmp_path, [f"V_{r:0{digits}d}.fits" for r in (1, 20, 300)] + ["V_mean.fits", "W_7.fits"])
    assert fits_maps(PARTS, str(tmp_path / f"{{channel}}_{field}.fits")).realizations == (1, 20, 300)


@pytest.mark.parametrize(
    ("field", "names"),
    [
        ("{realization:03d}", ["V_1.fits", "V_20.fits", "V_300.fits"]),
        ("{realization}", ["V_001.fits", "V_300.fits"]),
        ("{realization:05d}", ["00001/V_1.fits"]),
    ],
)
def test_a_file_with_other_digits_is_not_left_out_in_silence(field: str, names: list[str], tmp_path: Path) -> None:
    """Of V_1.fits to V_300.fits, 201 were the ensemble of V_{realization:03d}.fits, and nothing was said."""
    files(tmp_path, names)
    template = "/".join(["{realization:05d}", "V_{realization:05d}.fits"] if "/" in names[0] else [f"V_{field}.fits"])
    with refused(names[0], "{realization}", "{realization:05d}"):
        fits_maps(PARTS, str(tmp_path / template))


def test_maps_of_another_frame_or_order_are_refused() -> None:
    """The stores of a run say both; a galactic ensemble was taken for an ecliptic one."""
    map_ = xr.DataArray(np.arange(12.0), dims="pixel", attrs={"units": "mK", "frame": "galactic", "ordering": "RING"})
    np.testing.assert_array_equal(in_order({"V": map_}, PARTS, "run.zarr")[0], 1000.0 * map_.values)
    other = xr.DataArray(map_.values, dims="pixel", attrs={"Unit": "mK", "order": 0})
    np.testing.assert_array_equal(in_order({"V": other}, PARTS, "run.zarr")[0], 1000.0 * map_.values)
    silent = {"units": "", "unit": "mK"}, {"units": "unknown", "unit": "mK"}
    for attributes in (*silent, {"units": b"mK", "order": 0.0}):  # HDF5 holds bytes
        given = map_.drop_attrs().assign_attrs(attributes)
        np.testing.assert_array_equal(in_order({"V": given}, PARTS, "run.zarr")[0], 1000.0 * map_.values)
    with refused("run.zarr", "NESTED", "RING"):
        in_order({"V": map_.assign_attrs(ordering="", order="NESTED")}, PARTS, "run.zarr")
    map_ = map_.drop_attrs().assign_attrs(units="mK")
    for attribute, value, named in [
        ("frame", "ecliptic", ("run.zarr", "ecliptic", "galactic")),
        ("frame", "of the focal plane", ("run.zarr", "frame", "G")),
        ("ordering", "NESTED", ("run.zarr", "NESTED", "RING")),
        ("COORDSYS", "E", ("run.zarr", "ecliptic", "galactic")),
        ("indexing_scheme", "nested", ("run.zarr", "NESTED", "RING")),
        ("order", "NESTED", ("run.zarr", "NESTED", "RING")),
    ]:
        with refused(*named):
            in_order({"V": map_.assign_attrs({attribute: value})}, PARTS, "run.zarr")


def test_pixels_without_data_are_so_in_any_unit() -> None:
    """UNSEEN is no temperature: in mK it is not a thousand times as much; what is infinite stays to be refused."""
    values = np.where(np.arange(12) < 2, healpy.UNSEEN, 0.5)
    values[2:4] = np.nan, np.inf
    map_ = xr.DataArray(values, dims="pixel", attrs={"units": "mK"})
    expected = [healpy.UNSEEN, healpy.UNSEEN, np.nan, np.inf, *[500.0] * 8]
    np.testing.assert_array_equal(in_order({"V": map_}, PARTS, "run.zarr")[0], expected)


def test_files_are_known_by_their_contents_and_called_by_their_numbers(tmp_path: Path) -> None:
    """What was simulated with others of the same names is not taken for them; the folder may be another."""

    def written(folder: str, value: float) -> FitsMaps:
        (tmp_path / folder).mkdir()
        for r in (4, 9):
            (tmp_path / folder / f"V_{r}.fits").write_text(f"{r} {value}")
        return fits_maps(PARTS, str(tmp_path / folder / "V_{realization}.fits"))

    first, moved, other = written("first", 1.0), written("moved", 1.0), written("other", 2.0)
    assert first.identity() == moved.identity() != other.identity()
    assert "realization 9 of" in first.words(0, 1)


@pytest.mark.parametrize("other", ["V_a", "V/a"])
def test_a_map_that_is_given_under_two_names_is_refused(other: str) -> None:
    """The last one was taken."""
    parts, map_ = (Part("V:a", "V", "a", None, "galactic"),), np.arange(12.0)
    for twice in ({"V:a": map_, other: 2.0 * map_}, {"V": {"a": map_}, other: map_}, {other: map_, "V:a": map_}):
        with refused("V:a", f"'{list(twice)[1]}'", "run.zarr"):
            in_order(twice, parts, "run.zarr")


def test_a_simulator_that_works_in_place_is_given_the_same_sky_and_effects_again() -> None:
    """With a sky that was smoothed once more for each call, a modulation of 0.2 was no longer found."""

    def simulate(seed, effects=(), sky=None):
        sky *= 2.0
        for one in effects:
            sky *= 1.0 + one.parameters.pop("amplitude", 0.0)
        return {"demo": np.full(12, sky[0].real)}

    source = source_of(config.load("tiny"), simulate)
    sky, effects = np.ones(6, dtype=complex), (config.Effect(name="calibration", parameters={"amplitude": 0.5}),)
    for realization in range(2):
        np.testing.assert_array_equal(source.maps(0, realization, effects, sky), [np.full(12, 3.0)])


class Wanders:
    """A simulator that works in its own folder, and has numpy raise errors."""

    def __init__(self, run):
        os.chdir(run.channels[0].name)
        np.seterr(all="raise")

    def simulate(self, seed):
        values = np.loadtxt("own.txt")
        with pytest.raises(FloatingPointError):
            values / 0.0
        os.chdir("..")
        np.seterr(all="call")
        return {"demo": values}


def test_folder_and_numerical_errors_of_a_simulator_are_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where its class went to another folder, data were looked for and results written there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    np.savetxt(tmp_path / "demo" / "own.txt", np.arange(12.0))
    errors = np.geterr()
    source = source_of(config.load("tiny"), Wanders)
    for realization in range(2):
        np.testing.assert_array_equal(source.maps(0, realization), [np.arange(12.0)])
    assert Path.cwd() == tmp_path
    assert np.geterr() == errors


def test_a_realization_with_a_map_of_another_is_not_taken_into_the_covariance() -> None:
    """One of 700 had a map of another sky: the p-value of perfect data was 1."""
    source = source_of(config.load("tiny"), np.zeros((300, 1, 3072)))
    rows = np.random.default_rng(3).standard_normal((300, 5))
    check_alike(np.column_stack([rows, np.zeros(300)]), source, 0)
    rows[7, 2] = 50.0
    with refused(7, 300):
        check_alike(rows, source, 0)
    few = np.random.default_rng(4).standard_normal((2, 60, 50)).prod(axis=0)  # tails of products, of few
    check_alike(few, source, 0)
    few[:, 7] = 0.0
    few[5, 7] = 1e-9
    with refused(5, 60):
        check_alike(few, source, 0)
    rows[20::30, 2] = 50.0  # ten of them, none of which makes much of the variance
    with refused(10, 300):
        check_alike(rows, source, 0)


def test_what_holds_no_maps_is_refused_without_its_numbers(tmp_path: Path) -> None:
    run = config.load("tiny")
    with refused("list", "simulate(seed, effects=())") as caught:
        source_of(run, [np.arange(3072.0)] * 4)
    assert len(str(caught.value)) < 200
    np.save(tmp_path / "objects.npy", np.array([{}, 1], dtype=object))
    (tmp_path / "text.npy").write_text("maps")
    for name in ("objects.npy", "text.npy"):
        with refused(tmp_path / name, "numpy"):
            assert source_of(run, tmp_path / name).count


@pytest.mark.parametrize("lost", ["V_2.fits", "W_2.fits"])
def test_a_realization_that_lacks_a_map_is_not_left_out_in_silence(lost: str, tmp_path: Path) -> None:
    """Where it was the first map of the description, one realization fewer was the ensemble."""
    parts = (*PARTS, Part("W", "W", None, None, "galactic"))
    files(tmp_path, [f"{c}_{r}.fits" for c in "VW" for r in range(4)])
    assert fits_maps(parts, str(tmp_path / "{channel}_{realization}.fits")).count == 4
    (tmp_path / lost).unlink()
    with refused(tmp_path / lost, lost[0], 2):
        fits_maps(parts, str(tmp_path / "{channel}_{realization}.fits"))


def test_seeds_are_unique_and_far_apart() -> None:
    seeds = np.sort([seed_of(stream, r) for stream in (campaign._COVARIANCE, campaign._RESPONSE) for r in range(5000)])
    assert seeds[0] >= 0
    assert seeds[-1] < 2**32
    assert np.diff(seeds).min() > 1000
    every = []
    for stream in (campaign._COVARIANCE, campaign._RESPONSE):  # in steps of one size, so that all need not be asked for
        start, step = seed_of(stream, 0), seed_of(stream, 1) - seed_of(stream, 0)
        every.append((start + step * np.arange(SEEDS)) % 2**32)
        asked = [*range(0, SEEDS, 1009), SEEDS - 1]
        np.testing.assert_array_equal(every[-1][asked], [seed_of(stream, r) for r in asked])
    assert np.unique(every).size == 2 * SEEDS


def test_seeds_depend_on_every_bit_of_the_run() -> None:
    """They were those of its seed modulo 4096."""
    starts = [seed_of(1 + (1 << bit), 0) for bit in range(1, 63)]
    assert len({seed_of(1, 0), *starts}) == 63


def in_a_pool(seed: int, effects: Any = ()) -> dict[str, Any]:
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return {"V": pool.map(abs, range(12))}


def test_a_simulator_with_processes_of_its_own_is_told_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers of Dask are daemonic, so that none is left if the driver is killed; the advice was to mend it."""
    source = source_of(config.load("tiny"), in_a_pool)
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    with refused("in_a_pool", "AssertionError", "--workers 0", by=RunError):
        source.maps(1, 0)
