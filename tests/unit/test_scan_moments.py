import errno
import os
import signal
from dataclasses import replace
from unittest.mock import Mock

import healpy
import numpy as np
import pytest
from astropy.io import fits

from mcsim.errors import InputError, RunError
from mcsim.instrument.scan.accumulate import stream_sums
from mcsim.instrument.scan.files import read_moments, write_moments_fits
from mcsim.instrument.scan.geometry import MapGrid
from mcsim.instrument.scan.model import LineOfSight, ScanModel
from mcsim.instrument.scan.moments import Moments, cached_moments, scan_key
from mcsim.instrument.scan.pointing import pointing
from mcsim.instrument.scan.sampling import warn_of_aliases
from mcsim.support.folders import default_cache_dir
from refusals import refused

LINES = (LineOfSight("A", 70.5), LineOfSight("B", 69.0, 170.0, 3.0))
MODEL = ScanModel("toy", 129.3, -3600.0, 22.5, 31557600.0, 2.0, 1.0, LINES, ("A",))
NSIDE, SMAX = 16, 3


def brute_force(samples, nside, smax):
    """Moments of listed samples by healpy's pixels, numpy's sums and explicit tangent vectors."""
    theta, phi, psi = (np.concatenate(angle) for angle in zip(*samples, strict=True))
    npix = 12 * nside * nside
    pixel = healpy.ang2pix(nside, theta, phi)
    hits = np.bincount(pixel, minlength=npix)
    count = np.maximum(hits, 1)

    def mean(values):
        return np.bincount(pixel, weights=values, minlength=npix) / count

    w = np.array([mean(np.cos(s * psi)) - 1j * mean(np.sin(s * psi)) for s in range(1, smax + 1)])
    centre_theta, centre_phi = healpy.pix2ang(nside, pixel)
    vector = healpy.ang2vec(theta, phi)
    e_theta = np.stack(
        [np.cos(centre_theta) * np.cos(centre_phi), np.cos(centre_theta) * np.sin(centre_phi), -np.sin(centre_theta)]
    )
    e_phi = np.stack([-np.sin(centre_phi), np.cos(centre_phi), 0.0 * centre_phi])
    return hits, w, mean(np.sum(vector.T * e_theta, axis=0)), mean(np.sum(vector.T * e_phi, axis=0))


def assert_same(moments, expected, tolerance):
    hits, w, dtheta, dphi = expected
    np.testing.assert_array_equal(moments.hits, hits)
    assert np.abs(moments.w - w).max() < tolerance
    assert np.abs(moments.dtheta - dtheta).max() < tolerance
    assert np.abs(moments.dphi - dphi).max() < tolerance


@pytest.mark.parametrize(
    ("names", "time_range", "frame"),
    [(None, (0.0, 1.0), "ecliptic"), (["A", "B"], (0.25, 0.5), "galactic"), (["B"], (0.5, 1.0), "equatorial")],
)
def test_streamed_moments_against_brute_force(names, time_range, frame):
    chosen = MODEL if names is None else MODEL.with_lines_of_sight(*names)
    moments = Moments.from_model(chosen, NSIDE, SMAX, frame, time_range)
    samples = []
    for line in MODEL.select(names):
        first, last = (round(edge * MODEL.samples(line)) for edge in time_range)
        samples.append(pointing(MODEL, line, first, last - first, frame))
    assert (moments.nside, moments.frame, moments.smax, moments.npix) == (NSIDE, frame, SMAX, 3072)
    # The phases of the two runs are advanced from different starts: 1e-13 rad, times s / sin(theta) = 60 at the poles.
    assert_same(moments, brute_force(samples, NSIDE, SMAX), 6e-12)


def test_threads_change_no_bit():
    runs = [Moments.from_model(MODEL, NSIDE, SMAX, nthreads=n) for n in (1, 2, 3)]
    for run in runs[1:]:
        for name in ("hits", "w", "dtheta", "dphi"):
            assert getattr(run, name).tobytes() == getattr(runs[0], name).tobytes()


def test_progress_ends_at_one():
    seen = []
    stream_sums(MODEL, MapGrid(NSIDE), SMAX, nthreads=2, progress=seen.append)
    assert seen.count(1.0) == 1
    assert max(seen) == 1.0


def test_an_interruption_ends_the_passes_of_all_threads():
    """A year at 10 kHz would go on for half an hour: a pool of threads joins what it has begun."""
    seen = []

    def interrupt(share: float) -> None:
        seen.append(share)
        if len(seen) == 1:
            os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C does, whichever thread is at work

    with pytest.raises(KeyboardInterrupt):
        stream_sums(MODEL.with_sampling(MODEL.duration_days * 86400.0 / 3e11), MapGrid(1), 1, 2, interrupt)
    assert max(seen) < 0.01


@pytest.mark.parametrize("nthreads", ["2", 0, 1.5])
def test_a_number_of_threads_is_whole(nthreads):
    with refused("nthreads", repr(nthreads)):
        Moments.from_model(MODEL, NSIDE, 2, nthreads=nthreads)


def test_halves_add_up_to_the_whole():
    whole, one, two = (Moments.from_model(MODEL, NSIDE, 2, time_range=part) for part in ((0, 1), (0, 0.5), (0.5, 1)))
    np.testing.assert_array_equal(one.hits + two.hits, whole.hits)
    assert np.abs(one.hits * one.w + two.hits * two.w - whole.hits * whole.w).max() < 1e-11


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"nside": 17}, ("nside", 17)),
        ({"smax": 0}, ("smax", 0)),
        ({"frame": "lunar"}, ("frame", "lunar")),
        ({"time_range": (0.5, 0.5)}, ("time_range", "(0.5, 0.5)")),
        ({"time_range": (0.0, 1.5)}, ("time_range", "(0, 1.5)")),
        ({"time_range": (0.0, 1e-9)}, ("time_range", "(0, 1e-09)")),
    ],
)
def test_streaming_checks_its_input(change, named):
    with refused(*named):
        Moments.from_model(MODEL, **({"nside": NSIDE, "smax": 2} | change))


def test_unknown_line_of_sight_is_refused():
    with refused("'C'", "A, B"):
        MODEL.with_lines_of_sight("C")


def test_parallel_transport_is_constant_and_takes_no_memory():
    moments = Moments.parallel_transport(512, np.rad2deg(0.3), 4)
    assert moments.hits.strides == (0,)
    assert moments.w.strides[1] == 0
    np.testing.assert_allclose(moments.w[:, 7], np.exp(-1j * 0.3 * np.arange(1, 5)), rtol=1e-15)
    assert moments.dtheta is None
    assert moments.dphi is None
    assert moments.hits[0] == 1.0
    with refused("smax", 0):
        Moments.parallel_transport(8, 0.0, 0)


@pytest.mark.parametrize("mmap", [True, False])
def test_save_and_load(tmp_path, mmap):
    moments = Moments.from_model(MODEL, NSIDE, 2)
    moments.save(tmp_path / "m")
    loaded = Moments.load(tmp_path / "m", mmap=mmap)
    assert isinstance(loaded.w.base, np.memmap) is mmap
    for name in ("hits", "w", "dtheta", "dphi"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(moments, name))
    (tmp_path / "m" / "w.npy").write_bytes(b"")
    with refused(tmp_path / "m"):
        Moments.load(tmp_path / "m", mmap=mmap)
    (tmp_path / "m" / "w.npy").unlink()
    with refused("w.npy"):
        Moments.load(tmp_path / "m")


def test_moments_saved_in_the_place_of_others_are_whole_or_none(tmp_path, monkeypatch):
    """What a full disk left was the new hits beside the old orders, and who had the old ones mapped saw them change."""
    old, new = (Moments.parallel_transport(8, psi0_deg, 2) for psi0_deg in (10.0, 20.0))
    old.save(tmp_path / "m")
    mapped = Moments.load(tmp_path / "m")
    new.save(tmp_path / "m")
    np.testing.assert_array_equal(mapped.w, old.w)
    np.testing.assert_array_equal(Moments.load(tmp_path / "m").w, new.w)
    monkeypatch.setattr("mcsim.instrument.scan.moments.write_npy", Mock(side_effect=OSError(errno.ENOSPC, "full")))
    with refused(tmp_path / "m", "full", by=RunError):
        old.save(tmp_path / "m")
    with refused("m"):
        Moments.load(tmp_path / "m")


def test_cache_computes_once_and_leaves_nothing_behind(cache):
    assert default_cache_dir() == cache
    folder = cached_moments(MODEL, MapGrid(NSIDE), 2)
    stamp = (folder / "w.npy").stat().st_mtime_ns
    assert cached_moments(MODEL, MapGrid(NSIDE), 2, nthreads=2) == folder
    assert (folder / "w.npy").stat().st_mtime_ns == stamp
    assert [entry.name for entry in cache.iterdir()] == [folder.name]
    np.testing.assert_array_equal(Moments.load(folder).hits, Moments.from_model(MODEL, NSIDE, 2).hits)


def test_interrupted_computation_leaves_the_cache_empty(cache):
    def interrupt(fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached_moments(MODEL, MapGrid(NSIDE), 2, progress=interrupt)
    assert list(cache.iterdir()) == []


def test_cache_folder_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "file"))
    with refused("MCSIM_CACHE"):
        cached_moments(MODEL, MapGrid(NSIDE), 2)


def test_key_depends_on_every_number_and_on_nothing_else():
    grid = MapGrid(NSIDE)
    base = scan_key(MODEL, grid, 2)
    assert scan_key(replace(MODEL, name="other", source={"spin_period_s": "x"}), grid, 2) == base
    assert scan_key(MODEL.with_lines_of_sight("A"), grid, 2) == base
    changed = [
        scan_key(MODEL, replace(grid, nside=32), 2),
        scan_key(MODEL, grid, 3),
        scan_key(MODEL, replace(grid, frame="galactic"), 2),
        scan_key(MODEL.with_lines_of_sight("B"), grid, 2),
        scan_key(MODEL, replace(grid, time_range=(0.0, 0.5)), 2),
    ]
    for name in [
        "spin_period_s",
        "precession_period_s",
        "precession_angle_deg",
        "orbit_period_s",
        "sample_period_s",
        "duration_days",
        "spin_phase_deg",
        "precession_phase_deg",
        "orbit_phase_deg",
    ]:
        changed.append(scan_key(replace(MODEL, **{name: getattr(MODEL, name) + 1.0}), grid, 2))
    assert len({base, *changed}) == len(changed) + 1


def test_fits_round_trip(tmp_path):
    moments = Moments.from_model(MODEL, NSIDE, SMAX, "galactic")
    path = tmp_path / "moments.fits"
    write_moments_fits(path, moments)
    back = read_moments(path, NSIDE, SMAX, "galactic")
    assert (back.nside, back.frame, back.smax) == (NSIDE, "galactic", SMAX)
    for name in ("hits", "w", "dtheta", "dphi"):
        np.testing.assert_array_equal(getattr(back, name), getattr(moments, name))
    for smax in (0, 2):
        assert read_moments(path, smax=smax).w.shape == (smax, moments.hits.size)


def test_fits_as_healpy_writes_it(tmp_path):
    # Rows of 1024 pixels, single precision; unobserved pixels may hold anything.
    rng = np.random.default_rng(5)
    hits = rng.integers(0, 3, 3072).astype(float)
    w = np.where(hits > 0, 0.5 * np.exp(1j * rng.uniform(0, 6, 3072)), healpy.UNSEEN)
    path = tmp_path / "moments.fits"
    healpy.write_map(
        path, [hits, w.real, w.imag], coord="E", column_names=["HITS", "RE_1", "IM_1"], dtype=np.float32, overwrite=True
    )
    back = read_moments(path)
    assert back.frame == "ecliptic"
    assert back.dtheta is None
    np.testing.assert_array_equal(back.hits, hits)
    np.testing.assert_allclose(back.w[0], np.where(hits > 0, w, 0.0), atol=1e-7)


def damaged(path, change):
    with fits.open(path) as hdus:
        table = hdus[1].copy()
        table.data = hdus[1].data.copy()
    change(table)
    table.writeto(path, overwrite=True)


def drop(name, other=None):
    def change(table):
        table.columns[name].name = other or f"NO_{name}"

    return change


def put(name, value):
    def change(table):
        table.data[name][5] = value

    return change


def header(key, value):
    def change(table):
        if value is None:
            del table.header[key]
        else:
            table.header[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "arguments", "named"),
    [
        (drop("HITS"), {}, ("HITS", "NO_HITS")),
        (drop("IM_2"), {"smax": 2}, ("IM_2", "s = 2")),
        (drop("RE_1"), {}, ("RE_1", "s = 2")),
        (drop("DPHI"), {}, ("DTHETA", "DPHI")),
        (put("HITS", np.nan), {}, ("HITS", "finite", "1 pixels", 5)),
        (put("RE_2", np.inf), {}, ("RE_2", "finite")),
        (put("HITS", -1.0), {}, ("HITS", -1, "pixel 5")),
        (put("RE_1", 1.5), {}, ("modulus", 1.50333)),
        (header("ORDERING", "NESTED"), {}, ("ORDERING", "NESTED", "RING")),
        (header("ORDERING", None), {}, ("no ORDERING", "write RING")),
        (header("COORDSYS", None), {}, ("COORDSYS",)),
        (header("COORDSYS", "X"), {}, ("COORDSYS", "X")),
        (header("NSIDE", 32), {}, ("NSIDE", 32, "3072 pixels")),
        (drop("DTHETA", "PIXEL"), {}, ("PIXEL",)),
        (header("NSIDE", 16), {"nside": 32}, ("nside 16", "nside 32")),
        (header("NSIDE", 16), {"frame": "galactic"}, ("galactic", "ecliptic")),
        (header("NSIDE", 16), {"frame": "lunar"}, ("frame", "lunar")),
    ],
)
def test_bad_fits_files_say_what_is_wrong(tmp_path, change, arguments, named):
    path = tmp_path / "moments.fits"
    npix = 12 * NSIDE**2
    fill = np.full(npix, 0.1)
    write_moments_fits(path, Moments(NSIDE, "ecliptic", fill * 10, np.full((2, npix), 0.1 + 0.1j), fill, fill))
    damaged(path, change)
    with refused(*named):
        read_moments(path, **arguments)


def test_missing_and_truncated_fits_files(tmp_path):
    path = tmp_path / "moments.fits"
    with refused(path.name):
        read_moments(path)
    write_moments_fits(path, Moments.parallel_transport(NSIDE, 0.0, 2))
    path.write_bytes(path.read_bytes()[:30000])
    with refused(path.name):
        read_moments(path)
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(path, overwrite=True)
    with refused("moments.fits"):
        read_moments(path)
    path.write_text("not a fits file")
    with refused(path.name):
        read_moments(path)


def write_pointing(folder, form, theta, phi, psi):
    table = np.stack([theta, phi, psi], axis=1)
    path = folder / {"text": "p.txt", "npy4": "p.npy", "records": "p.npy", "npz": "p.npz", "fits": "p.fits"}[form]
    if form == "text":
        np.savetxt(path, table, header="theta phi psi", fmt="%.17g")
    elif form == "npy4":
        np.save(path, np.column_stack([table, np.arange(len(theta))]))
    elif form == "records":
        np.save(path, np.rec.fromarrays([psi, theta, phi], names="psi,theta,phi"))
    elif form == "npz":
        np.savez(path, theta=theta, phi=phi, psi=psi)
    else:
        columns = [fits.Column(n, "D", array=a) for n, a in (("PSI", psi), ("THETA", theta), ("PHI", phi))]
        fits.BinTableHDU.from_columns(columns).writeto(path)
    return path


@pytest.mark.parametrize("form", ["text", "npy4", "records", "npz", "fits"])
def test_user_pointing_in_every_format(tmp_path, form):
    samples = pointing(MODEL, LINES[0], 100, 3000)
    path = write_pointing(tmp_path, form, *samples)
    # The same numbers on both sides: rounding of a hundred additions.
    assert_same(Moments.from_pointing_files(path, NSIDE, SMAX), brute_force([samples], NSIDE, SMAX), 1e-13)
    assert_same(
        Moments.from_pointing_files([path, path], NSIDE, SMAX), brute_force([samples, samples], NSIDE, SMAX), 1e-13
    )


def test_user_pointing_from_arrays_is_that_from_files(tmp_path):
    samples = pointing(MODEL, LINES[0], 100, 3000)
    arrays = Moments.from_pointing(*samples, NSIDE, SMAX, "galactic")
    files = Moments.from_pointing_files(write_pointing(tmp_path, "npz", *samples), NSIDE, SMAX, "galactic")
    for name in ("hits", "w", "dtheta", "dphi"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(files, name))


@pytest.mark.parametrize("samples", [([], [], []), ([1.0], [1.0, 2.0], [0.0]), ([4.0], [0.0], [0.0])])
def test_bad_arrays_of_pointing(samples):
    with pytest.raises(InputError):
        Moments.from_pointing(*samples, NSIDE)


@pytest.mark.parametrize(
    ("angles", "named"),
    [
        ({"theta": [91.0]}, ("theta", 91)),
        ({"theta": [np.nan]}, ("theta", "finite")),
        ({"theta": []}, ("p.npz", "samples")),
        ({"theta": [1.0, 2.0], "phi": [10.0, 200.0]}, ("phi", 10, 200)),
        ({"theta": [1.0, 2.0], "psi": [-170.0, 1.0]}, ("psi", -170)),
        ({"theta": [1.0, 2.0], "psi": [1e5, np.inf]}, ("psi", "finite")),
        ({"theta": [0.5, 6.0], "phi": [1.0, 3.0]}, ("theta", "phi", "exchanged")),
        ({"theta": [1.0, -1.5]}, ("theta", -1.5, "colatitudes")),
        ({"theta": [1.0, 2.0], "phi": [1.0]}, ("p.npz", "length")),
        ({"theta": [1.0], "psi": [1j]}, ("p.npz", "real")),
    ],
)
def test_bad_user_pointing(tmp_path, angles, named):
    zeros = np.zeros(len(angles["theta"]))
    columns = {"theta": zeros, "phi": zeros, "psi": zeros} | {k: np.array(v) for k, v in angles.items()}
    np.savez(tmp_path / "p.npz", **columns)
    with refused(*named):
        Moments.from_pointing_files(tmp_path / "p.npz", NSIDE, 2)


def test_user_pointing_in_degrees_by_its_header(tmp_path):
    samples = pointing(MODEL, LINES[0], 100, 500)
    expected = brute_force([samples], NSIDE, SMAX)
    path = write_pointing(tmp_path, "fits", *samples)

    def in_degrees(table):
        for name in table.columns.names:
            table.data[name] = np.degrees(table.data[name])

    damaged(path, in_degrees)
    for number in (1, 2, 3):
        fits.setval(path, f"TUNIT{number}", value="deg", ext=1)
    assert_same(Moments.from_pointing_files(path, NSIDE, SMAX), expected, 1e-12)
    fits.setval(path, "TUNIT2", value="m", ext=1)
    with refused("'m'", "arcmin"):
        Moments.from_pointing_files(path, NSIDE, SMAX)


def test_user_pointing_of_another_frame(tmp_path):
    path = write_pointing(tmp_path, "fits", *pointing(MODEL, LINES[0], 100, 500))
    damaged(path, header("COORDSYS", "GALACTIC"))
    assert Moments.from_pointing_files(path, NSIDE, 2, "galactic").frame == "galactic"
    with refused("galactic"):
        Moments.from_pointing_files(path, NSIDE, 2, "ecliptic")


def test_the_south_pole_in_single_precision(tmp_path):
    np.save(tmp_path / "p.npy", np.array([[np.pi, 0.1, 0.2]], dtype=np.float32))
    assert Moments.from_pointing_files(tmp_path / "p.npy", NSIDE, 1).hits[-4:].sum() == 1.0


@pytest.mark.parametrize(
    "name",
    ["phi theta psi", "time theta phi psi", "theta[deg]", "DEGREES", "lat, lon, psi [rad]", "Dec, RA, psi"],
)
def test_user_pointing_whose_header_names_other_columns(tmp_path, name):
    np.savetxt(tmp_path / "p.txt", np.full((3, 3), 0.1), header=name)
    with refused("p.txt", "theta", "phi", "psi", name.replace(" ", ", ") if "theta " in name else name):
        Moments.from_pointing_files(tmp_path / "p.txt", NSIDE, 2)


def test_user_pointing_with_time_first(tmp_path):
    samples = np.stack([np.linspace(0.0, 3.0, 50), *pointing(MODEL, LINES[0], 100, 50)], axis=1)
    samples[:, 1:] %= 3.0
    np.save(tmp_path / "p.npy", samples)
    with refused("p.npy", "theta, phi, psi, time"):
        Moments.from_pointing_files(tmp_path / "p.npy", NSIDE, 2)


def test_centroids_in_other_units(tmp_path):
    moments = Moments.from_model(MODEL, NSIDE, 2)
    path = tmp_path / "moments.fits"
    write_moments_fits(path, moments)

    def in_degrees(table):
        for name in ("DTHETA", "DPHI"):
            table.data[name] = np.degrees(table.data[name])

    damaged(path, in_degrees)  # while the header says rad
    with refused("moments.fits", "nside 16", "DTHETA", "DPHI", "TUNIT"):
        read_moments(path)

    for number in (6, 7):
        fits.setval(path, f"TUNIT{number}", value="deg", ext=1)
    np.testing.assert_allclose(read_moments(path).dtheta, moments.dtheta, rtol=1e-12, atol=1e-15)
    damaged(path, header("COORDSYS", "EQUATORIAL"))
    assert read_moments(path).frame == "equatorial"


def test_unreadable_user_pointing(tmp_path):
    with refused("none.fits"):
        Moments.from_pointing_files(tmp_path / "none.fits", NSIDE, 2)
    np.savez(tmp_path / "p.npz", theta=np.zeros(3), phi=np.zeros(3))
    with refused("p.npz", "psi"):
        Moments.from_pointing_files(tmp_path / "p.npz", NSIDE, 2)
    np.save(tmp_path / "p.npy", np.zeros((3, 2)))
    with refused("p.npy", "(3, 2)"):
        Moments.from_pointing_files(tmp_path / "p.npy", NSIDE, 2)


@pytest.mark.parametrize(
    ("name", "period_s", "phases"),
    [("wmap", 129.3, 1), ("wmap", 3620.4, 1), ("planck", 10.0, 6), ("litebird", 600.0, 2)],
)
def test_samples_that_miss_phases_of_the_spin_are_told(name: str, period_s: float, phases: int) -> None:
    model = ScanModel.load(name).with_sampling(period_s)
    with pytest.warns(UserWarning, match=rf"{period_s:g} s fall on {phases} phase"):
        Moments.on_grid(replace(model, duration_days=20.0), MapGrid(8), smax=1)


@pytest.mark.parametrize(("name", "period_s"), [("wmap", 61.0), ("planck", 7.0), ("litebird", 61.0), ("wmap", 2.0)])
def test_usual_samples_are_not(name: str, period_s: float) -> None:
    for nside in (8, 64, 512):
        warn_of_aliases(ScanModel.load(name).with_sampling(period_s), MapGrid(nside))
