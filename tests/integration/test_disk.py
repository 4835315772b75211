"""Disks that are really full or read-only: workflows/faults/disk.py in short.

Only root may mount them. test_faults.py holds the same with errors made by hand, for everybody.
"""

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from shutil import which

import numpy as np
import pytest
import xarray as xr
from distributed import Client

from mcsim import config
from mcsim.benchmark import report as scores
from mcsim.benchmark.summary import Score
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.kept import Kept
from mcsim.diagnosis import report
from mcsim.ensemble import repair, runner, store
from mcsim.ensemble.maps import write_maps
from mcsim.ensemble.store import write_dataset
from mcsim.errors import RunError
from mcsim.instrument.scan import Moments
from mcsim.simulation import simulate
from mcsim.support.folders import cached, filling, write_whole
from mcsim.support.npy import make_room
from refusals import refused

from .conftest import table
from .test_runner import assert_same


def may_mount() -> bool:
    """Tried in a namespace of its own, where nobody sees it."""
    return which("unshare") is not None and not subprocess.run(["unshare", "--mount", "true"]).returncode


pytestmark = pytest.mark.skipif(not may_mount(), reason="full and read-only disks must be mounted, which needs root")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 MB of its own."""
    place = tmp_path / "disk"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "mcsim", place], check=True)
    yield place
    subprocess.run(["umount", place], check=True)


def remount(place: Path, *options: str) -> bool:
    command = ["mount", "-o", ",".join(("remount", *options)), place]
    return subprocess.run(command, capture_output=True).returncode == 0


def test_a_full_disk_of_a_report_is_named(disk: Path) -> None:
    assert remount(disk, "size=4096")
    with refused(disk / "out", by=RunError, errno=errno.ENOSPC), filling(disk / "out"):
        (disk / "out" / "report.html").write_bytes(bytes(100_000))


def test_what_is_there_stays_whole_where_the_next_does_not_fit(disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A report was cut off, and a dataset was deleted and begun anew."""
    small, large = (xr.Dataset({"a": ("x", np.random.default_rng(1).normal(size=n))}) for n in (10, 20_000))
    write_dataset(small, disk / "x.zarr")
    write_whole(disk / "report.html", "first")
    assert remount(disk, "size=64k")
    monkeypatch.setattr(report, "page", lambda result: 100_000 * "a")
    with refused(disk, by=RunError, errno=errno.ENOSPC), filling(disk):
        write_dataset(large, disk / "x.zarr")
    with refused(disk, by=RunError, errno=errno.ENOSPC), filling(disk):
        write_whole(disk / "report.html", report.page(None))
    xr.testing.assert_identical(xr.open_zarr(disk / "x.zarr", chunks=None), small)
    assert (disk / "report.html").read_text() == "first"
    assert sorted(path.name for path in disk.iterdir()) == ["report.html", "x.zarr"]


def test_a_score_stays_whole_where_the_next_does_not_fit(disk: Path) -> None:
    """Its report and picture were cut off, and "the output" was named."""
    scores.write(Score("first", []), disk / "score")
    before = {path.name: path.read_bytes() for path in (disk / "score").iterdir()}
    size = os.statvfs(disk)
    assert remount(disk, f"size={(size.f_blocks - size.f_bfree) * size.f_frsize}")
    with refused(disk / "score", by=RunError, errno=errno.ENOSPC):
        scores.write(Score("second", []), disk / "score")
    assert {path.name: path.read_bytes() for path in (disk / "score").iterdir()} == before


def test_full_disk(small_store: Path, client: Client, disk: Path) -> None:
    path = disk / "x.zarr"
    runner.run(table(), path, realizations=slice(0, 4), workers=client)
    used = os.statvfs(disk)
    assert remount(disk, f"size={(used.f_blocks - used.f_bfree) * used.f_frsize + 8192}")
    with refused("x.zarr", "--resume", by=RunError, errno=errno.ENOSPC):
        runner.run(table(), path, workers=client)
    assert sorted(p.name for p in disk.iterdir()) == ["x.zarr", "x.zarr.log"]
    verdict = repair.verify(path)
    assert (verdict.intact, verdict.finished) == (True, 4)
    assert remount(disk, "size=64m")
    result = runner.run(table(), path, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 6)
    assert_same(path, small_store)


def test_merge_on_a_full_disk_names_the_store_to_make(small_store: Path, disk: Path) -> None:
    assert remount(disk, "size=64k")
    with refused(disk / "merged.zarr", by=RunError, errno=errno.ENOSPC) as caught:
        runner.merge([small_store], disk / "merged.zarr")
    assert "--resume" not in str(caught.value)
    assert not list(disk.iterdir())
    assert remount(disk, "size=64m")
    runner.merge([small_store], disk / "merged.zarr")
    assert_same(disk / "merged.zarr", small_store)


def test_disk_without_room_is_refused(client: Client, disk: Path) -> None:
    (disk / "ballast").write_bytes(bytes(1 << 20))
    assert remount(disk, "size=1m")
    with refused("x.zarr", by=RunError, errno=errno.ENOSPC) as kept:  # as a notebook keeps the last exception
        runner.run(table(), disk / "x.zarr", workers=client)
    assert kept.value.__cause__ is not None
    assert sorted(p.name for p in disk.iterdir()) == ["ballast"]


def test_disk_that_becomes_read_only(
    small_store: Path, client: Client, disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = disk / "x.zarr"
    real = simulate.realize

    def realize(shared: object, r: int) -> object:
        while r == 5 and not remount(disk, "ro"):  # not while a file is being written
            pass
        return real(shared, r)

    monkeypatch.setattr(simulate, "realize", realize)
    with refused("x.zarr", "--resume", by=RunError, errno=errno.EROFS):
        runner.run(table(), path, workers=client)
    monkeypatch.undo()
    finished = int(store.done(path).sum())
    assert finished < 10
    with refused("x.zarr", "-o", errno=errno.EROFS):
        runner.run(table(), path, workers=client)
    assert remount(disk, "rw")
    result = runner.run(table(), path, resume=True, workers=client)
    assert result.finished == 10
    # What another thread of the first run had begun may end once the disk is writable; it is not computed again either.
    assert 0 < result.computed <= 10 - finished
    assert_same(path, small_store)


def test_an_array_on_a_full_disk_is_named(disk: Path) -> None:
    """numpy said "20700 requested and 17392 written": the caller's input was blamed, or it was a traceback."""
    assert remount(disk, "size=64k")
    moments = Moments.parallel_transport(nside=32)
    with refused(disk / "moments", by=RunError, errno=errno.ENOSPC):
        moments.save(disk / "moments")
    with refused(disk, by=RunError), pytest.MonkeyPatch.context() as patch:
        patch.setenv("MCSIM_CACHE", str(disk))
        cached("other", moments.save)


def test_maps_on_a_full_disk_are_not_blamed_on_the_folder(disk: Path) -> None:
    """astropy repeated itself, and exit code 2 said that the input is wrong."""
    assert remount(disk, "size=16k")
    with refused(disk / "maps", by=RunError, errno=errno.ENOSPC):
        write_maps(table(), disk / "maps", realizations=0, quiet=True)
    assert not [path for path in disk.rglob("*") if path.is_file()]


def test_a_simulation_that_a_full_disk_cannot_keep_leaves_nothing(disk: Path) -> None:
    assert remount(disk, "size=64k")
    run = config.load(table())
    job = analysis_of(run).job(run)
    kept = Kept(disk / "parts", 10)
    with refused(disk, by=RunError, errno=errno.ENOSPC):
        kept.keep(job, np.zeros((10, 4000)))
    assert not [path for path in disk.rglob("*") if path.is_file()]


def test_a_file_that_is_mapped_has_room(disk: Path) -> None:
    """Without room the process was ended by a signal when it wrote."""
    assert remount(disk, "size=64k")
    with refused(by=OSError, errno=errno.ENOSPC):
        make_room(disk / "samples.raw", 1_000_000)
