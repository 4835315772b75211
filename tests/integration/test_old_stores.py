"""Stores of earlier versions: their maps were called ``map``, and their hash covered the bins of the summary."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr
from distributed import Client

from mcsim import open_ensemble, open_summary
from mcsim.ensemble import repair, runner, store
from refusals import refused

from .conftest import ensemble, table


def made_old(path: Path) -> None:
    """Give a store the names and the hash that it had before."""
    shutil.move(path / "observed_map", path / "map")
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    science = group.attrs["science"]
    science["biposh"]["summary_bin"] = group.attrs["configuration"]["biposh"]["summary_bin"]
    canonical = json.dumps(science, sort_keys=True, separators=(",", ":"))
    group.attrs.update({"science": science, "digest": hashlib.sha256(canonical.encode()).hexdigest()})
    with pytest.warns(UserWarning, match="onsolidated"):
        zarr.consolidate_metadata(path)


@pytest.fixture(scope="module")
def new(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("new") / "new.zarr"
    runner.run(table(**ensemble(6, keep_maps=True)), path, workers=client)
    return path


@pytest.fixture(scope="module")
def three(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("old") / "old.zarr"
    runner.run(table(**ensemble(3, keep_maps=True)), path, workers=client)
    made_old(path)
    return path


@pytest.fixture
def old(three: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(three, tmp_path / "old.zarr"))


def assert_maps(old: Path, new: Path) -> None:
    with open_ensemble(old) as found, open_ensemble(new) as expected:
        assert "observed_map" not in found
        np.testing.assert_array_equal(found["map"].values, expected["observed_map"].values)
        np.testing.assert_array_equal(found["biposh"].values, expected["biposh"].values)
        assert found["done"].all()


def test_old_stores_are_extended_under_their_names(old: Path, new: Path, client: Client) -> None:
    assert repair.verify(old).intact
    assert runner.run(table(**ensemble(3, keep_maps=True)), old, workers=client).computed == 0
    assert runner.run(table(**ensemble(6, keep_maps=True)), old, workers=client).computed == 3
    assert_maps(old, new)
    assert repair.verify(old).intact


@pytest.mark.parametrize("lost", [("map/c/0/0/0", "ell/c/0"), ("done/zarr.json", "map/zarr.json")])
def test_old_stores_are_repaired_under_their_names(lost: tuple[str, ...], old: Path, new: Path, client: Client) -> None:
    for part in lost:
        content = (old / part).read_bytes()
        (old / part).unlink()
        assert not repair.verify(old).intact
        if part != lost[-1]:
            (old / part).write_bytes(content)
            assert repair.verify(old).intact
    for part in lost:
        (old / part).unlink(missing_ok=True)
    runner.run(table(**ensemble(6, keep_maps=True)), old, resume=True, workers=client)
    assert_maps(old, new)
    assert repair.verify(old).intact


def test_old_stores_merge_into_a_new_one(old: Path, new: Path, client: Client, tmp_path: Path) -> None:
    other, merged = tmp_path / "other.zarr", tmp_path / "merged.zarr"
    runner.run(table(**ensemble(6, keep_maps=True)), other, realizations=slice(3, 6), workers=client)
    runner.merge([old, other], merged)
    with open_ensemble(merged) as found, open_ensemble(new) as expected:
        np.testing.assert_array_equal(found["observed_map"].values, expected["observed_map"].values)


def test_old_stores_of_another_seed_are_refused(old: Path, client: Client) -> None:
    with refused("old.zarr", "ensemble.seed", "7 -> 8"):
        runner.run(table(**ensemble(3, seed=8, keep_maps=True)), old, workers=client)


def test_maps_say_what_they_are_and_leave_xarrays_method_alone(new: Path) -> None:
    with open_ensemble(new) as found:
        assert found.map(lambda variable: variable).sizes == found.sizes
        attributes = found.observed_map.attrs
        assert (attributes["nside"], attributes["frame"], attributes["ordering"]) == (16, "ecliptic", "RING")
        assert attributes["units"] == "uK"


def test_rows_are_chosen_by_coordinates(new: Path) -> None:
    with open_ensemble(new) as found:
        chosen = found.where(found.L == 2, drop=True)
        assert set(chosen.L.values.astype(int)) == {2}
        assert 0 < chosen.sizes["mode"] < found.sizes["mode"]
        assert found.where(found.done, drop=True).sizes["realization"] == 6
        assert found.biposh.chunks is not None
    with open_summary(new) as found:
        assert found.where(found.L == 2, drop=True).sizes["mode"] == chosen.sizes["mode"]


@pytest.mark.parametrize("age", ["old", "new"])
def test_other_bins_make_the_summary_alone_anew(age: str, new: Path, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    shutil.copytree(new, path)
    if age == "old":
        made_old(path)
    before = {file: file.read_bytes() for file in path.rglob("c/*") if file.is_file() and "summary" not in file.parts}
    asked = table(**ensemble(6, keep_maps=True), biposh={"L_max": 2, "summary_bin": 7})
    result = runner.run(asked, path, workers=client)
    assert (result.finished, result.computed) == (6, 0)
    assert all(file.read_bytes() == content for file, content in before.items())
    fresh = tmp_path / "fresh.zarr"
    runner.run(asked, fresh, workers=client)
    with open_summary(path) as found, open_summary(fresh) as expected:
        assert found.bin_first.values.tolist() == [0, 7, 14, 21, 28]
        for name in expected.data_vars:
            np.testing.assert_array_equal(found[name].values, expected[name].values)
    assert store.attributes(path)["configuration"]["biposh"]["summary_bin"] == 7
    assert repair.verify(path).intact
    written = path / "summary" / "zarr.json"
    time = written.stat().st_mtime_ns
    runner.run(asked, path, workers=client)
    assert written.stat().st_mtime_ns == time
