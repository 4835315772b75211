"""The batch from configuration to store: resumption, extension, slices, refusals, and the same bits every time."""

import errno
import multiprocessing
import os
import shutil
import signal
import sys
from contextlib import nullcontext
from copy import deepcopy
from pathlib import Path

import dask
import distributed
import numpy as np
import pytest
import xarray as xr
from distributed import Client

from mcsim import config, open_ensemble, open_summary
from mcsim.ensemble import opening, prediction, runner, store, summary
from mcsim.ensemble.describe import describe
from mcsim.ensemble.repair import verify
from mcsim.ensemble.runner import cluster
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from refusals import refused

from .conftest import ensemble, table


def assert_same(a: Path, b: Path, attributes: bool = True) -> None:
    """Same arrays, summary and scientific attributes, bit for bit."""
    one, other = (open_ensemble(path).load() for path in (a, b))
    xr.testing.assert_identical(one.drop_attrs(), other.drop_attrs())
    xr.testing.assert_identical(*(opening.open_summary(path).load() for path in (a, b)))
    assert one.done.all()
    assert other.done.all()
    if attributes:
        for key in ("science", "digest", "conventions", "packages"):
            assert store.attributes(a)[key] == store.attributes(b)[key]


def tree(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_store_holds_what_a_realization_gives(small_store: Path) -> None:
    shared = survey(config.load(table()))
    with open_ensemble(small_store) as stored:
        for r in (0, 3, 9):
            values = simulate.realize(shared, r)
            for name, array in values.items():
                np.testing.assert_array_equal(stored[name][r].values, array)
        assert stored.sel(mode="L2M0d0").biposh.dims == ("realization", "pair", "ell")
        assert stored.biposh.attrs["units"] == "uK^2"
        assert all("long_name" in variable.attrs for variable in stored.variables.values())


def test_parts_of_binned_spectra_have_errors_of_their_own(small_store: Path) -> None:
    layout = opening.layout(small_store, 10)
    with open_ensemble(small_store) as stored, opening.open_summary(small_store) as found:
        bins = summary.binned(layout, stored.biposh.values)
        errors = [found[f"biposh_binned_standard_error{part}"].values for part in ("", "_real", "_imag")]
        long_name = found.biposh_binned_standard_error_imag.attrs["long_name"]
    for error, part in zip(errors[1:], (bins.real, bins.imag), strict=True):
        np.testing.assert_allclose(error, part.std(axis=0, ddof=1) / np.sqrt(10.0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(errors[1] ** 2 + errors[2] ** 2, errors[0] ** 2, rtol=1e-12)
    assert "imaginary" in long_name


def test_store_says_all_conventions_that_its_arrays_rest_on(small_store: Path) -> None:
    with open_ensemble(small_store) as stored:
        said = stored.conventions
        assert stored.M.min() == 0
        assert {0, 1} == set(((stored.L + stored.d) % 2).values)
    assert {"temperature", "alm", "psi", "beam", "sample", "biposh", "modes", "normalisation"} <= set(said)
    assert "sum_s e^{-i s psi} S_s" in said["sample"]
    assert "M >= 0, both parities" in said["modes"]


def test_summary_is_that_of_the_realizations(small_store: Path) -> None:
    with open_ensemble(small_store) as stored, opening.open_summary(small_store) as summary:
        difference = (stored.biposh - stored.biposh_circular).values
        for name, sample in {
            "biposh": stored.biposh.values,
            "biposh_difference": difference,
            "cl": stored.cl.values,
        }.items():
            np.testing.assert_allclose(summary[f"{name}_mean"], sample.mean(axis=0), rtol=1e-12, atol=1e-12)
            deviation = sample.std(axis=0, ddof=1)
            np.testing.assert_allclose(summary[f"{name}_standard_deviation"], deviation, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(
                summary[f"{name}_standard_error"], deviation / np.sqrt(10), rtol=1e-9, atol=1e-12
            )
        factor = summary.bin_factor.values
        bins = np.array(
            [np.nanmean((factor * stored.biposh.values[:, 0])[..., a : a + 10], axis=-1) for a in (0, 10, 20)]
        )
        binned = np.moveaxis(bins, 0, -1)
        np.testing.assert_allclose(summary.biposh_binned_mean[0, :, :3], binned.mean(axis=0), rtol=1e-10, atol=1e-12)
        for mode in range(summary.sizes["mode"]):
            expected = np.cov(binned[:, mode].T, ddof=1)
            found = summary.biposh_binned_covariance[0, mode, :3, :3]
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max() + 1e-20)


def test_finished_store_is_left_alone(small_store: Path, client: Client) -> None:
    before = tree(small_store)
    result = runner.run(table(), small_store, workers=client)
    assert (result.finished, result.computed) == (10, 0)
    assert tree(small_store) == before


def test_interrupted_run_continues_to_the_same_bits(small_store: Path, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "interrupted.zarr"
    shutil.copytree(small_store, path)
    # What a killed run leaves: chunks without their done, one of them with half of its data.
    (path / "done" / "c" / "1").unlink()
    shutil.rmtree(path / "biposh" / "c" / "1")
    (path / "done" / "c" / "2").unlink()
    shutil.rmtree(path / "summary")
    result = runner.run(table(), path, resume=True, workers=client)
    assert (result.finished, result.computed) == (10, 6)
    assert_same(path, small_store)


def test_extension_keeps_what_is_there_and_gives_the_bits_of_one_run(
    small_store: Path, client: Client, tmp_path: Path
) -> None:
    path = tmp_path / "extended.zarr"
    assert runner.run(table(**ensemble(3)), path, workers=client).computed == 3
    assert runner.run(table(**ensemble(10)), path, workers=client).computed == 7
    assert_same(path, small_store)


def test_a_store_of_one_realization_is_extended_and_whole(client: Client, tmp_path: Path) -> None:
    """Its only chunk of the coordinate holds zero alone, which stands for what is not written."""
    path = tmp_path / "one.zarr"
    runner.run(table(**ensemble(1)), path, workers=client)
    runner.run(table(**ensemble(3)), path, workers=client)
    assert verify(path).intact
    with open_ensemble(path) as found:
        assert found["realization"].values.tolist() == [0, 1, 2]


def test_a_summary_without_the_latest_realizations_says_so(small_store: Path, client: Client, tmp_path: Path) -> None:
    """What an extension leaves that was interrupted."""
    path, before = tmp_path / "half.zarr", tmp_path / "before"
    runner.run(table(**ensemble(3)), path, workers=client)
    shutil.copytree(path / "summary", before)
    runner.run(table(**ensemble(10)), path, workers=client)
    shutil.rmtree(path / "summary")
    before.rename(path / "summary")
    with pytest.warns(UserWarning, match="of 3 realizations, and 10 are finished"):
        assert int(open_summary(path)["count"]) == 3
    runner.run(table(**ensemble(10)), path, workers=client, resume=True)
    assert int(open_summary(path)["count"]) == 10


def test_an_extension_that_ends_before_the_store_has_grown_is_completed(
    small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "extended.zarr"
    runner.run(table(**ensemble(3)), path, workers=client)
    with monkeypatch.context() as patched:
        patched.setattr("zarr.core.attributes.Attributes.update", lambda self, given: pytest.fail("ends here"))
        with pytest.raises(pytest.fail.Exception):
            runner.run(table(**ensemble(10)), path, workers=client)
    assert runner.run(table(**ensemble(10)), path, workers=client).computed == 7
    assert_same(path, small_store)
    assert store.attributes(path)["configuration"]["ensemble"]["realizations"] == 10


def test_realizations_of_other_packages_are_told_of(client: Client, tmp_path: Path) -> None:
    """In extensions and merged slices, where the packages of the first are not said to be those of all."""
    path = tmp_path / "extended.zarr"
    runner.run(table(**ensemble(2)), path, workers=client)
    now = store.attributes(path)["packages"]
    older = now | {"ducc0": "0.1", "dask": "1.0"}
    store.extend(path, 2, {"packages": older})
    runner.run(table(**ensemble(2)), path, workers=client)  # no realization is new
    assert "other_packages" not in store.attributes(path)
    with pytest.warns(UserWarning, match="ducc0"):
        runner.run(table(**ensemble(3)), path, workers=client)
    assert store.attributes(path)["packages"] == older
    assert store.attributes(path)["other_packages"] == {"ducc0": [now["ducc0"]]}
    other = tmp_path / "other.zarr"
    runner.run(table(**ensemble(3)), other, workers=client)
    merged = tmp_path / "merged.zarr"
    with pytest.warns(UserWarning, match="ducc0 0.1 beside"):
        runner.merge([other, path], merged)
    assert store.attributes(merged)["other_packages"] == {"ducc0": ["0.1"]}
    assert "ducc0 0.1" in describe(merged)


def test_slices_merge_to_the_same_bits(small_store: Path, client: Client, tmp_path: Path) -> None:
    paths = [tmp_path / "a.zarr", tmp_path / "b.zarr"]
    runner.run(table(), paths[0], realizations=slice(0, 5), workers=client)
    runner.run(table(), paths[1], realizations=slice(5, None), workers=client)
    merged = tmp_path / "merged.zarr"
    assert runner.merge(paths, merged).finished == 10
    assert_same(merged, small_store)


@pytest.mark.parametrize("chunk", [1, 16])
def test_chunks_do_not_change_a_bit(chunk: int, small_store: Path, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "chunked.zarr"
    runner.run(table(compute={"chunk": chunk}), path, workers=client)
    assert_same(path, small_store)


def test_a_client_that_is_not_the_default_of_dask_will_do(
    small_store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [channel] = table()["channel"]
    two = table(channel=[channel, channel | {"name": "W2"}])  # three pairs, with modes in both orders
    monkeypatch.setattr(distributed.client, "_global_clients", {})  # those of other tests are defaults
    with Client(client.cluster, set_as_default=False) as own:
        runner.run(table(), tmp_path / "own.zarr", workers=own)
        shared = prediction.predict(two, exact=True, snr=True, workers=own)
        assert own.status == "running"
    assert_same(tmp_path / "own.zarr", small_store)
    xr.testing.assert_allclose(shared, prediction.predict(two, exact=True, snr=True), rtol=1e-12)


def test_separate_processes_give_the_same_bits(small_store: Path, tmp_path: Path) -> None:
    path = tmp_path / "processes.zarr"
    runner.run(table(), path, workers=1)
    assert_same(path, small_store)


def test_another_configuration_is_refused_by_name(small_store: Path, client: Client) -> None:
    before = tree(small_store)
    with refused("ensemble.seed", "7 -> 8", "-o"):
        runner.run(table(**ensemble(seed=8)), small_store, workers=client)
    with refused("biposh.L_max", "2 -> 1"):
        runner.run(table(biposh={"L_max": 1, "summary_bin": 10}), small_store, workers=client)
    with refused("ensemble.keep_maps", "False -> True"):
        runner.run(table(**ensemble(keep_maps=True)), small_store, workers=client)
    assert tree(small_store) == before


def test_resume_needs_a_store(client: Client, tmp_path: Path) -> None:
    with refused("none.zarr", "--resume"):
        runner.run(table(), tmp_path / "none.zarr", resume=True, workers=client)
    assert list(tmp_path.iterdir()) == []


def test_foreign_folder_is_refused(client: Client, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with refused(tmp_path):
        runner.run(table(), tmp_path, workers=client)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_unreachable_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "ANSWER_S", 0.4)
    before = dask.config.get("scheduler", None)
    with refused("tcp://127.0.0.1:1", "0.4 s"):
        runner.run(table(), tmp_path / "x.zarr", workers="tcp://127.0.0.1:1")
    assert list(tmp_path.iterdir()) == []
    assert dask.config.get("scheduler", None) == before  # else no store could be opened in this session


@pytest.mark.parametrize("workers", [0, -1])
def test_a_run_without_workers_is_refused(workers: int, tmp_path: Path) -> None:
    with refused("workers", workers):
        runner.run(table(), tmp_path / "x.zarr", workers=workers)
    assert list(tmp_path.iterdir()) == []


def test_unwritable_store(client: Client, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file where a folder is needed")
    with refused("x.zarr", "-o", errno=errno.ENOTDIR):
        runner.run(table(), blocked / "x.zarr", workers=client)
    assert blocked.read_text() == "a file where a folder is needed"


def test_a_failing_realization_does_not_stop_the_others(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = simulate.realize

    def realize(shared, r: int, nthreads: int = 1):
        if r == 4:
            raise FloatingPointError("cosmic ray")
        return real(shared, r, nthreads)

    monkeypatch.setattr(simulate, "realize", realize)
    path = tmp_path / "x.zarr"
    result = runner.run(table(), path, workers=client)
    assert result.finished == 9
    assert [(f.realization, f.reason) for f in result.failures] == [(4, "FloatingPointError: cosmic ray")]
    assert np.isnan(open_ensemble(path).biposh[4]).all()
    monkeypatch.undo()
    assert runner.run(table(), path, workers=client).computed == 1
    assert open_ensemble(path).done.all()


def test_kept_maps(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "x.zarr"
    runner.run(table(**ensemble(2, keep_maps=True)), path, workers=client)
    with open_ensemble(path) as stored:
        assert stored["observed_map"].sizes == {"realization": 2, "map_name": 1, "pixel": 3072}
        assert stored["observed_map"].attrs["units"] == "uK"
        shared = survey(config.load(table(**ensemble(2, keep_maps=True))))
        expected = simulate.realize(shared, 1)["observed_map"]
        np.testing.assert_array_equal(stored["observed_map"][1], expected.astype(np.float32))


def test_merge_refuses_what_does_not_belong_together(small_store: Path, client: Client, tmp_path: Path) -> None:
    other = tmp_path / "other.zarr"
    runner.run(table(**ensemble(2, seed=8)), other, workers=client)
    with refused("other.zarr", "small.zarr", "ensemble.seed", "7 -> 8"):
        runner.merge([small_store, other], tmp_path / "merged.zarr")
    assert not (tmp_path / "merged.zarr").exists()
    with refused("other.zarr"):
        runner.merge([small_store], other)


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forks on Linux")
def test_workers_are_forks_with_the_environment_of_their_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """One process loads the modules for all clusters; a variable that has changed since, has changed in workers too."""

    def facts() -> tuple[int, str | None, str | None]:
        return os.getppid(), os.environ.get("MCSIM_DATA"), os.environ.get("OMP_NUM_THREADS")

    monkeypatch.setenv("MCSIM_DATA", "before")
    with runner.local_client(2) as processes:
        before = processes.run(facts)
    monkeypatch.delenv("MCSIM_DATA")
    with runner.local_client(1) as processes:
        after = processes.run(facts)
    (server,) = {parent for parent, *_ in (before | after).values()}
    assert server != os.getpid()
    assert set(before.values()) == {(server, "before", "1")}
    assert set(after.values()) == {(server, None, "1")}


def test_a_process_that_was_forked_starts_workers_afresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot wait for the server of its parent (CPython, Lib/multiprocessing/forkserver.py)."""
    monkeypatch.setattr(multiprocessing, "parent_process", multiprocessing.current_process)
    assert cluster.start_method() == "spawn"


@pytest.mark.parametrize("times", [1, 2])
def test_workers_start_before_an_interruption_ends_them(times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while they start is put off until they have; a second one is not."""
    started = []

    def interrupted(**settings: object) -> nullcontext[None]:
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        started.append(settings["n_workers"])
        return nullcontext()

    monkeypatch.setattr(cluster, "LocalCluster", interrupted)
    monkeypatch.setattr(cluster, "Client", nullcontext)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # commands have handlers of their own
    try:
        with pytest.raises(KeyboardInterrupt), runner.local_client(3):
            pytest.fail("The interruption is lost.")
        assert started == ([3] if times == 1 else [])
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_clusters_of_two_threads_leave_dask_and_the_script_as_they_were() -> None:
    """The one that ended last restored what the other one had set."""
    main = sys.modules["__main__"]
    before, spec = deepcopy(dask.config.config), main.__spec__
    first, last = cluster._settings_of_all(), cluster._settings_of_all()
    first.__enter__()
    last.__enter__()
    first.__exit__(None, None, None)
    assert dask.config.get("distributed.worker.multiprocessing-method") == cluster.start_method()
    last.__exit__(None, None, None)
    assert dask.config.config == before
    assert main.__spec__ is spec
