"""What goes wrong around a run: two writers, changed files, cuts at awkward moments, stores that do not fit."""

import errno
import fcntl
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
import zarr
from distributed import Client
from zarr.storage import _local

from mcsim import Moments, config, open_ensemble, open_summary
from mcsim.ensemble import plan, runner, store
from mcsim.ensemble.lock import holder, locked
from mcsim.errors import RunError
from mcsim.instrument.scan import write_moments_fits
from refusals import refused

from .conftest import ensemble, table
from .test_runner import assert_same


def test_second_writer_is_refused_by_name(small_store: Path, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    lock = tmp_path / "x.zarr.lock"
    lock.write_text(f"{socket.gethostname()} {os.getppid()}")
    with refused("x.zarr", os.getppid(), socket.gethostname()):
        runner.run(table(), path, workers=client)
    assert not path.exists()
    lock.unlink()
    with locked(path), refused("x.zarr", os.getpid(), socket.gethostname()):
        runner.run(table(), path, workers=client)
    assert not lock.exists()
    lock.write_text("another-host 1")
    with refused("x.zarr", 1, "another-host"):
        runner.run(table(), path, workers=client)
    assert lock.exists()


def test_a_store_behind_a_link_is_that_store(
    small_store: Path, short_store: Path, client: Client, tmp_path: Path
) -> None:
    """A link may lead to another disk, from which nothing can be renamed, and others may use the store itself."""
    real, link = tmp_path / "disk" / "x.zarr", tmp_path / "link.zarr"
    shutil.copytree(short_store, real)
    link.symlink_to(real)
    with locked(real), refused("x.zarr", os.getpid(), socket.gethostname()):
        runner.run(table(), link, workers=client)
    runner.run(table(), link, workers=client)
    assert_same(real, small_store)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["disk", "link.zarr"]  # scratch files and log are beside it
    link.unlink()
    link.symlink_to(tmp_path / "disk" / "merged.zarr")
    runner.merge([small_store], link)
    assert_same(tmp_path / "disk" / "merged.zarr", small_store)


def lock_of_the_dead(path: Path) -> Path:
    """Make the lock of a store whose process is gone."""
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    lock = path.with_name(f"{path.name}.lock")
    lock.write_text(f"{socket.gethostname()} {dead.stdout.strip()}")
    return lock


def test_a_disk_without_kernel_locks_keeps_no_lock_of_a_dead_process(tmp_path: Path, monkeypatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    path = tmp_path / "x.zarr"
    lock = lock_of_the_dead(path)
    with locked(path):
        assert lock.read_text() == holder()
        with refused("x.zarr", os.getpid()), locked(path):
            pass


def test_what_a_killed_run_or_merge_left_goes_with_its_lock(small_store: Path, client: Client, tmp_path: Path) -> None:
    """It took a --resume, which nobody asks of a store that is finished."""
    run, merged = tmp_path / "x.zarr", tmp_path / "m.zarr"
    runner.run(table(**ensemble(4)), run, workers=client)
    left = [tmp_path / ".m.zarr.abcd1234", tmp_path / ".x.zarr.abcd1234", run / "cl" / "zarr.0123456789abcdef.partial"]
    for path in left:
        path.touch()
        os.utime(path, (0, 0))
    (looking := tmp_path / ".x.zarr.efgh5678").touch()  # as another run has it that is about to look for the lock
    runner.run(table(), run, workers=client)
    assert all(one.exists() for one in left)  # those of others, for all that is known
    left.append(run / ".x.zarr.abcd1234")
    left[-1].mkdir()
    lock_of_the_dead(run)
    runner.run(table(**ensemble(11)), run, workers=client)
    lock_of_the_dead(merged)
    runner.merge([small_store], merged)
    assert not any(one.exists() for one in left)
    assert looking.exists()
    assert_same(merged, small_store)


def test_lock_of_a_dead_process_is_taken_over(small_store: Path, client: Client, tmp_path: Path) -> None:
    lock_of_the_dead(tmp_path / "x.zarr")
    runner.run(table(), tmp_path / "x.zarr", workers=client)
    assert_same(tmp_path / "x.zarr", small_store)
    assert not (tmp_path / "x.zarr.lock").exists()
    (tmp_path / "x.zarr.lock").write_text(f"{socket.gethostname()} {os.getpid()}")  # a dead one of the same number
    shutil.rmtree(tmp_path / "x.zarr" / "summary")
    assert runner.run(table(), tmp_path / "x.zarr", workers=client).computed == 0


def test_worker_does_not_use_what_a_file_held_before(client: Client, tmp_path: Path) -> None:
    """One client, one path, two contents: each store holds the numbers that its hash stands for."""
    mask = np.ones(3072)
    results = []
    for number, start in enumerate((0, 1500)):
        mask[:] = 1.0
        mask[start : start + 1000] = 0.0
        healpy.write_map(tmp_path / "mask.fits", mask, overwrite=True, dtype=np.float64)
        run = config.load(table(map={"nside": 16, "mask": str(tmp_path / "mask.fits")}, **ensemble(1)))
        path = tmp_path / f"{number}.zarr"
        runner.run(run, path, workers=client)
        results.append((config.digest(run), open_ensemble(path).cl.values))
    assert results[0][0] != results[1][0]
    assert not np.allclose(results[0][1][..., 2:], results[1][1][..., 2:], rtol=1e-3)


def test_lost_summary_is_made_again(small_store: Path, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    shutil.copytree(small_store, path)
    shutil.rmtree(path / "summary")
    with refused("x.zarr", "summary", "--resume"):
        open_summary(path)
    assert runner.run(table(), path, workers=client).computed == 0
    assert_same(path, small_store)


@pytest.mark.parametrize("grown", [(), ("biposh",), ("biposh", "cl", "realization")])
def test_extension_that_was_cut_short_is_made_good(
    grown: tuple[str, ...], small_store: Path, short_store: Path, client: Client, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(short_store, tmp_path / "x.zarr"))
    group = zarr.open_group(path, mode="r+", use_consolidated=False)
    for name in grown:
        array = group[name]
        assert isinstance(array, zarr.Array)
        array.resize((10, *array.shape[1:]))
    runner.run(table(), path, workers=client)
    assert_same(path, small_store)


def test_merge_refuses_different_contents_and_leaves_nothing(small_store: Path, client: Client, tmp_path: Path) -> None:
    kept = tmp_path / "kept.zarr"
    runner.run(table(**ensemble(2, keep_maps=True)), kept, workers=client)
    for order in ([small_store, kept], [kept, small_store]):
        with refused("ensemble.keep_maps", "True", "False"):
            runner.merge(order, tmp_path / "merged.zarr")
    assert sorted(p.name for p in tmp_path.glob("*.zarr")) == ["kept.zarr"]


def test_merge_of_a_store_with_itself_is_refused_by_name(small_store: Path, tmp_path: Path) -> None:
    """Typed in place of another slice, it was taken twice without a word."""
    (tmp_path / "link.zarr").symlink_to(small_store)
    for other in (small_store, small_store.parent / "." / small_store.name, tmp_path / "link.zarr"):
        with refused(small_store, other):
            runner.merge([small_store, other], tmp_path / "merged.zarr")
    assert not (tmp_path / "merged.zarr").exists()


def test_merge_of_a_short_and_a_long_ensemble_is_the_long_one(
    small_store: Path, client: Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.zarr"
    runner.run(table(**ensemble(4)), short, workers=client)
    runner.merge([short, small_store], tmp_path / "merged.zarr")
    assert_same(tmp_path / "merged.zarr", small_store)
    runner.merge([short], tmp_path / "short-merged.zarr", quiet=False)
    assert "merge: 4/4 realizations" in capsys.readouterr().err
    attributes = store.attributes(tmp_path / "merged.zarr")
    assert attributes["configuration"] == store.attributes(small_store)["configuration"]


def test_two_merges_into_one_store_are_refused_by_name(
    small_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "merged.zarr"
    with locked(path), refused("merged.zarr", os.getpid(), socket.gethostname()):
        runner.merge([small_store], path)
    real = store.check_writable

    def overtaken(target: Path) -> Path:
        shutil.copytree(small_store, target)
        return real(target)

    monkeypatch.setattr(store, "check_writable", overtaken)
    with refused("merged.zarr"):
        runner.merge([small_store], path)
    assert [p.name for p in tmp_path.iterdir()] == ["merged.zarr"]


def test_merge_on_a_full_disk_names_the_store_to_make(
    small_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for module, name in ((_local, "_put"), (store, "write_files")):
        with monkeypatch.context() as patch, refused("merged.zarr", by=RunError, errno=errno.ENOSPC) as caught:
            patch.setattr(module, name, full)
            runner.merge([small_store], tmp_path / "merged.zarr")
        assert "--resume" not in str(caught.value)
        assert str(tmp_path / "merged.zarr") in str(caught.value)
        assert not list(tmp_path.iterdir())


def test_damaged_chunk_is_named_and_nothing_is_merged(small_store: Path, tmp_path: Path) -> None:
    path = tmp_path / "damaged.zarr"
    shutil.copytree(small_store, path)
    chunk = path / "biposh" / "c" / "1" / "0" / "0" / "0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 0xFF
    chunk.write_bytes(bytes(data))
    with refused("damaged.zarr", "--verify", "--resume", by=RunError):
        runner.merge([path], tmp_path / "merged.zarr")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["damaged.zarr"]


def test_slices_without_a_name_go_to_stores_of_their_own(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert runner.run(table(), realizations=slice(0, 5), workers=client).store == Path("small.0-5.zarr")


def test_bad_sky_is_found_before_a_store_is_made(client: Client, tmp_path: Path) -> None:
    for r in range(2):
        (tmp_path / f"sky_{r}.fits").write_text("not a map")
    sky = {"lmax": 32, "map": str(tmp_path / "sky_{realization}.fits")}
    with refused("sky_0.fits"):
        runner.run(table(sky=sky, **ensemble(2)), tmp_path / "x.zarr", workers=client)
    assert not list(tmp_path.glob("x.zarr*"))


def test_units_and_frames_of_skies(client: Client, tmp_path: Path) -> None:
    """A sky in mK is that sky; one in another frame is refused."""
    sky = np.random.default_rng(1).normal(size=3072)
    spectra = []
    for scale, unit in ((1.0, "uK"), (1e-3, "mK")):
        healpy.write_map(
            tmp_path / "sky.fits", scale * sky, column_units=unit, coord="E", overwrite=True, dtype=np.float64
        )
        path = tmp_path / f"{unit}.zarr"
        runner.run(table(sky={"lmax": 32, "map": str(tmp_path / "sky.fits")}, **ensemble(1)), path, workers=client)
        spectra.append(open_ensemble(path).cl.values[..., 2:])
    np.testing.assert_allclose(spectra[0], spectra[1], rtol=1e-12)
    for coord, unit, named in (("G", "uK", "galactic"), ("E", "Jy", "'Jy'")):
        healpy.write_map(tmp_path / "sky.fits", sky, column_units=unit, coord=coord, overwrite=True, dtype=np.float64)
        with refused("sky.fits", named):
            runner.run(
                table(sky={"lmax": 32, "map": str(tmp_path / "sky.fits")}), tmp_path / "bad.zarr", workers=client
            )


@pytest.mark.parametrize(("number", "value"), [(8, None), (16, 2.0), (16, 0.0)])
def test_a_dry_run_reads_masks_and_moments(number: int, value: float | None, tmp_path: Path) -> None:
    """A mask of numbers above one or of nothing is refused, as the run would, and moments of another nside."""
    changes: dict[str, Any] = {"map": {"nside": 16}}
    if value is None:
        moments = Moments.parallel_transport(number)
        write_moments_fits(tmp_path / "m.fits", moments)
        scan = {"kind": "moments", "path": str(tmp_path / "m.fits")}
        changes["channel"] = [table()["channel"][0] | {"scan": scan}]
    else:
        healpy.write_map(tmp_path / "mask.fits", np.full(12 * number**2, value), dtype=np.float64)
        changes["map"] |= {"mask": str(tmp_path / "mask.fits")}
    run = config.load(table(**changes))
    with refused("W1" if value == 0.0 else str(tmp_path)):
        plan.describe(run)
