"""Damage to a store: files that are missing, cut or changed are named, and computed again, and no more."""

import asyncio
import errno
import json
import os
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client
from zarr.core import sync

from mcsim import cli
from mcsim.ensemble import describe, opening, repair, runner, store, tables
from mcsim.ensemble.lock import locked
from mcsim.errors import RunError
from mcsim.plot.spectra import ensemble_figure
from refusals import refused

from .conftest import ensemble, table
from .test_runner import assert_same


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x10
    file.write_bytes(bytes(data))


def truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-7])


def remove(file: Path) -> None:
    file.unlink()


CHUNKS = {"biposh": "c/1/0/0/0", "biposh_circular": "c/0/0/0/0", "cl": "c/1/0/0", "done": "c/1"}


LOST = {"c/1": range(4, 8), "c/0": range(4), "c/2": range(8, 10)}


@pytest.mark.parametrize("harm", [flip, truncate, remove])
@pytest.mark.parametrize("name", CHUNKS)
def test_damaged_chunk_is_named(name: str, harm: Callable[[Path], None], copy: Path) -> None:
    assert repair.verify(copy).intact
    harm(copy / name / CHUNKS[name])
    verdict = repair.verify(copy)
    if (name, harm) == ("done", remove):  # nothing but done says that a realization exists, and the summary of how many
        assert (verdict.finished, verdict.intact) == (6, False)
        assert "10" in verdict.broken["done"]
        return
    lost = LOST[CHUNKS[name][:3]]
    assert verdict.lost == tuple(lost)
    assert verdict.finished == 10 - len(lost)
    assert f"realizations {lost[0]}-{lost[-1]}: " in verdict.text()


def test_resume_computes_what_is_damaged_and_no_more(small_store: Path, client: Client, copy: Path) -> None:
    flip(copy / "biposh" / "c/2/0/0/0")  # in the last, incomplete chunk
    truncate(copy / "done" / "c/0")
    (copy / "cl" / "c/1/0/0.0123.partial").write_bytes(b"half a file")
    result = runner.run(table(), copy, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 6)
    assert_same(copy, small_store)
    assert {file.relative_to(copy) for file in copy.rglob("*")} == {
        file.relative_to(small_store) for file in small_store.rglob("*")
    }
    log = copy.with_name("copy.zarr.log").read_text()
    assert "damaged, to be computed again: realizations 8-9 (biposh: " in log
    assert "damaged, to be computed again: realizations 0-3 (done: " in log


PARTS = ["biposh/zarr.json", "L/c/0", "mode/c/0", "realization/zarr.json", "summary/count/c", "summary/cl_mean/c/0/0"]


@pytest.mark.parametrize("harm", [truncate, remove])
def test_metadata_coordinates_and_summary_are_made_again(
    harm: Callable[[Path], None], small_store: Path, client: Client, copy: Path
) -> None:
    for part in PARTS:
        harm(copy / part)
    verdict = repair.verify(copy)
    assert not verdict.intact
    assert verdict.broken.keys() >= {"biposh", "L", "mode", "realization"}
    assert any(name.startswith("summary") for name in verdict.broken)
    result = runner.run(table(), copy, resume=True, workers=client)
    assert result.computed == 0
    assert_same(copy, small_store)
    assert repair.verify(copy).intact


@pytest.mark.parametrize("resume", [False, True])
def test_a_summary_that_the_store_does_not_describe_is_made_again(
    resume: bool, small_store: Path, client: Client, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last that a run writes is the metadata of all: a disk may be full by then, or the run killed."""

    def ended(path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    shutil.rmtree(copy / "summary")
    monkeypatch.setattr(store, "_consolidate", ended)
    with refused("copy.zarr", "--resume", by=RunError, errno=errno.ENOSPC):
        runner.run(table(), copy, workers=client)
    monkeypatch.undo()
    verdict = repair.verify(copy)
    assert verdict.broken.keys() == {"summary"}
    assert "repairs this" in verdict.text()
    with refused("copy.zarr", "--resume", by=RunError):
        opening.open_summary(copy)
    result = runner.run(table(), copy, resume=resume, workers=client)
    assert (result.computed, result.summarised) == (0, True)
    assert_same(copy, small_store)
    with opening.open_summary(copy) as found, opening.open_summary(small_store) as expected:
        xr.testing.assert_identical(found.load(), expected.load())


def test_a_summary_that_a_run_replaces_is_waited_for(copy: Path) -> None:
    """Of a store without its lock it is damage. Read beside the metadata of the one that was going it was NaN."""
    expected = opening.open_summary(copy).load()
    store._forget_summary(copy)
    with refused("summary", by=KeyError):  # the reader of xarray is told, too
        xr.open_zarr(copy, group="summary")
    with refused("copy.zarr", by=RunError):
        opening.open_summary(copy)
    with locked(copy):
        later = threading.Timer(0.1, store.write_summary, (copy, expected))
        later.start()
        xr.testing.assert_identical(opening.open_summary(copy).load(), expected)
        later.join()


def test_a_summary_is_never_away_while_it_is_replaced(copy: Path) -> None:
    """Who had opened it read NaN then."""
    summary, missed, end = opening.open_summary(copy).load(), list[bool](), threading.Event()

    def look() -> None:
        while not end.is_set():
            missed.append(not (copy / "summary" / "zarr.json").exists())

    with ThreadPoolExecutor(1) as pool:
        looking = pool.submit(look)
        for _ in range(20):
            store.write_summary(copy, summary)
        end.set()
        looking.result()
    assert missed
    assert not any(missed)
    assert not [entry for entry in copy.parent.iterdir() if entry.name.startswith(".copy")]


@pytest.mark.parametrize("part", ["biposh/c/1", "cl", "ell/c/0", "summary/cl_mean"])
def test_a_finished_store_that_lacks_files_is_not_finished(part: str, copy: Path) -> None:
    assert runner.run(table(), copy).computed == 0
    (shutil.rmtree if (copy / part).is_dir() else os.remove)(copy / part)
    with refused(part, "--resume", by=RunError):
        runner.run(table(), copy)


@pytest.mark.parametrize("part", ["biposh/c/1/0/0/0", "cl/c/0/0/0", "summary/cl_mean/zarr.json"])
def test_a_finished_store_with_files_that_a_power_cut_left_empty_is_not_finished(part: str, copy: Path) -> None:
    (copy / part).write_bytes(b"")
    with refused(part, "--resume", by=RunError):
        runner.run(table(), copy)


BINNED = "summary/biposh_difference_binned_mean/c/0/0/0"


READERS = {
    "summary": lambda path: opening.open_summary(path),
    "info": lambda path: describe.describe(path),
    "export": lambda path: tables.table(opening.read_in(opening.open_summary(path), path)),
    "plot": lambda path: ensemble_figure(path),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_summary_that_lacks_files_is_not_read_as_zeros(reader: str, copy: Path) -> None:
    READERS[reader](copy)
    remove(copy / BINNED)
    with refused(BINNED, "--resume", by=RunError):
        READERS[reader](copy)
    assert opening.open_ensemble(copy).done.all()  # the realizations are there


@pytest.mark.parametrize("reader", ["info", "export", "plot"])
def test_a_damaged_summary_is_a_sentence(reader: str, copy: Path) -> None:
    flip(copy / BINNED)
    with refused(copy, "--verify", "--resume", by=RunError):
        READERS[reader](copy)


@pytest.mark.parametrize("part", ["biposh/c/1/0/0/0", "cl/c/0/0/0", "ell/c/0"])
def test_finished_realizations_that_lack_files_are_not_opened_as_nan(part: str, copy: Path) -> None:
    remove(copy / part)
    with refused(part, "--resume", by=RunError):
        opening.open_ensemble(copy)
    assert int(opening.open_summary(copy)["count"]) == 10


def test_a_finished_realization_that_lacks_one_number_of_its_spectra_is_damaged(copy: Path) -> None:
    """BipoSH that do not exist are none, too, in every realization: of spectra all exist."""
    rows = store.read(copy, 4, 8)
    done, rows["cl"][1, 0, 3] = rows.pop("done"), np.nan
    store.write(copy, 4, rows, done)
    with refused("copy.zarr", 5, "--resume", by=RunError):
        store.read(copy, 4, 8)
    (damage,) = repair.verify(copy).damages
    assert damage.lost == (5,)


def test_absent_numbers_of_a_summary_are_none(copy: Path) -> None:
    """Whoever opens a store without mcsim."""
    for part in ("biposh_mean/c/0/0/0", "cl_mean/c/0/0", "count/c"):
        remove(copy / "summary" / part)
    with xr.open_zarr(copy, group="summary") as found:
        assert np.isnan(found["biposh_mean"].values).all()
        assert np.isnan(found["cl_mean"].values).all()
        assert int(found["count"]) < 0


def test_every_piece_of_a_large_summary_is_missed(copy: Path) -> None:
    """Zarr cuts large arrays along all their dimensions."""
    large = np.ones((2, 1500, 1500))
    store.write_summary(copy, xr.Dataset({"large": (("pair", "mode", "bin"), large)}))
    assert store.absent_files(copy) == []
    remove(copy / "summary/large/c/1/2/1")
    assert store.absent_files(copy) == ["summary/large/c/1/2/1"]


def test_a_read_that_fails_leaves_none_behind(copy: Path) -> None:
    """Zarr begins many reads at once; one that is left complains when Python ends."""
    layout = replace(opening.layout(copy, 256), chunk=1)
    many = copy.with_name("many.zarr")
    store.create(many, layout, store.attributes(copy))
    store.write(many, 0, {}, np.ones(256, dtype=bool))
    truncate(many / "done/c/0")
    with refused(many, "--resume", by=RunError):
        store.done(many)
    assert asyncio.all_tasks(sync._get_loop()) == set()


@pytest.mark.parametrize("harm", [truncate, remove, lambda file: file.write_text(file.read_text().replace("sci", "x"))])
def test_attributes_of_a_store_are_made_again(
    harm: Callable[[Path], None], small_store: Path, client: Client, copy: Path
) -> None:
    harm(copy / "zarr.json")
    truncate(copy / "cl/c/1/0/0")
    for look in (describe.describe, repair.verify, lambda path: runner.run(table(), path)):
        with refused("zarr.json", copy, "--resume", by=RunError):
            look(copy)
    for other in (table(ensemble={"realizations": 10, "seed": 8}), table(**ensemble(10, keep_maps=True))):
        with refused(copy):
            runner.run(other, copy, resume=True, workers=client)
    result = runner.run(table(), copy, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 4)
    assert_same(copy, small_store)
    assert repair.verify(copy).intact
    assert store.attributes(copy) == store.attributes(small_store)


def test_hash_that_is_not_that_of_the_configuration_is_named(small_store: Path, client: Client, copy: Path) -> None:
    root = json.loads((copy / "zarr.json").read_text())
    root["attributes"]["digest"] = "0" * 64
    (copy / "zarr.json").write_text(json.dumps(root))
    assert "attributes" in repair.verify(copy).broken
    runner.run(table(), copy, resume=True, workers=client)
    assert_same(copy, small_store)


def test_every_bit_counts(copy: Path) -> None:
    """Whichever bit of a file is flipped, its realizations are named, or its contents are what they were."""
    file = copy / "done" / "c/1"
    data = file.read_bytes()
    named = 0
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        file.write_bytes(bytes(changed))
        damage = store.examine(copy, 4)
        if damage is None:
            assert store.done(copy).all(), bit
        else:
            assert damage.lost == (4, 5, 6, 7)
            named += 1
    assert named > 7 * len(data)


def test_rows_that_are_missing_are_never_summed(client: Client, copy: Path) -> None:
    """A done that says more than there is, as two writers at once could leave it."""
    (copy / "biposh" / "c/1/0/0/0").unlink()
    shutil.rmtree(copy / "summary")
    with refused("copy.zarr", "4-7", "--resume", by=RunError):
        runner.run(table(), copy, workers=client)
    assert runner.run(table(), copy, resume=True, workers=client).computed == 4


def test_verify_on_the_command_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def verify() -> int:
        with pytest.raises(SystemExit) as end:
            cli.app(["info", "--verify", str(copy)])
        return int(end.value.code or 0)

    assert verify() == 0
    assert "copy.zarr is intact: 10 of 10 realizations" in capsys.readouterr().out
    flip(copy / "cl" / "c/1/0/0")
    assert verify() == 1
    assert "realizations 4-7: cl: " in capsys.readouterr().out
