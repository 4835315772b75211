"""Arrays and objects in place of files: the same realization bit for bit, the same hash for the same content."""

from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np
import pytest

from mcsim import config
from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel, write_moments_fits
from mcsim.simulation import channels, simulate
from mcsim.simulation.survey import survey
from mcsim.sphere.sky import gaussian_alm
from mcsim.support import folders
from refusals import refused

NSIDE, LMAX = 16, 32
ELLIPSE = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 250.0}
TRANSPORT = {"kind": "parallel_transport", "psi0_deg": 20.0}
RNG = np.random.default_rng(7)
CL = np.concatenate([[0.0, 0.0], 1.0 / np.arange(2, LMAX + 1) ** 2])
SKY = gaussian_alm(CL, np.random.default_rng(8))
MASK = (np.random.default_rng(9).random(12 * NSIDE**2) > 0.3).astype(float)
WINDOW = np.exp(-((np.arange(LMAX + 1) / 60.0) ** 2))
MODEL = ScanModel.load("wmap_focal_plane").with_sampling(600.0).with_lines_of_sight("W1A")


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "cache {split}"))


def table(sky=None, map=None, **channel) -> dict:
    return {
        "schema": 1,
        "name": "test",
        "sky": {"lmax": LMAX, **({"spectrum": CL} if sky is None else sky)},
        "map": {"nside": NSIDE, **(map or {})},
        "channel": [{"name": "W1", "beam": ELLIPSE, "scan": TRANSPORT, **channel}],
        "ensemble": {"seed": 3},
    }


def realized(run) -> dict[str, np.ndarray]:
    return simulate.realize(survey(config.from_json(config.to_json(config.load(run)))), 1)


def moments() -> Moments:
    rng = np.random.default_rng(10)
    npix = 12 * NSIDE**2
    w = 0.5 * np.exp(2j * np.pi * rng.random((4, npix)))
    return Moments(NSIDE, "ecliptic", np.ones(npix), w, 1e-3 * rng.random(npix), 1e-3 * rng.random(npix))


def written(folder: Path) -> dict[str, dict]:
    """Runs that differ by one file, by what is in the file."""
    healpy.write_cl(folder / "cl.fits", CL, dtype=float)
    healpy.write_alm(folder / "alm.fits", SKY, out_dtype=float)
    healpy.write_map(folder / "map.fits", healpy.alm2map(SKY, NSIDE, lmax=LMAX), dtype=float, column_units="uK")
    healpy.write_map(folder / "mask.fits", MASK, dtype=float)
    np.save(folder / "window.npy", WINDOW)
    write_moments_fits(folder / "moments.fits", moments())
    healpy.write_alm(folder / "blm.fits", unnormalised(), out_dtype=float)
    return {
        "spectrum": ({"sky": {"spectrum": str(folder / "cl.fits")}}, {"sky": {"spectrum": CL}}),
        "alm": ({"sky": {"alm": str(folder / "alm.fits")}}, {"sky": {"alm": SKY}}),
        "map": (
            {"sky": {"map": str(folder / "map.fits")}},
            {"sky": {"map": healpy.read_map(folder / "map.fits", dtype=float)}},
        ),
        "mask": ({"map": {"mask": str(folder / "mask.fits")}}, {"map": {"mask": MASK}}),
        "window": ({"map": {"pixel_window": str(folder / "window.npy")}}, {"map": {"pixel_window": WINDOW}}),
        "blm": (
            {"beam": {"kind": "blm", "path": str(folder / "blm.fits"), "m_max": 4}},
            {"beam": {"kind": "blm", "path": unnormalised(), "m_max": 4}},
        ),
        "moments": (
            {"scan": {"kind": "moments", "path": str(folder / "moments.fits")}},
            {"scan": moments()},
        ),
        "model": (
            {
                "scan": {
                    "kind": "hit_averaged",
                    "model": "wmap_focal_plane",
                    "sample_period_s": 600.0,
                    "line_of_sight": "W1A",
                }
            },
            {"scan": MODEL},
        ),
        "beam": ({}, {"beam": Beam.elliptical(300.0, 250.0, lmax=LMAX)}),
    }


def unnormalised() -> np.ndarray:
    """Coefficients in healpy's order with every m up to lmax, in a unit of their own."""
    blm = np.zeros((LMAX + 1, LMAX + 1), complex)
    blm[:5] = Beam.elliptical(300.0, 240.0, angle_deg=20.0, lmax=LMAX, mmax=4).blm
    return 3.0 * np.concatenate([blm[m, m:] for m in range(LMAX + 1)])


@pytest.mark.parametrize("name", ["spectrum", "alm", "map", "mask", "window", "blm", "moments", "model", "beam"])
def test_arrays_give_the_realization_of_files_bit_for_bit(tmp_path, name) -> None:
    files, given = written(tmp_path)[name]
    expected, found = realized(table(**files)), realized(table(**given))
    assert expected.keys() == found.keys()
    for key in expected:
        np.testing.assert_array_equal(found[key], expected[key], err_msg=key)


def test_hash_is_of_the_content(tmp_path) -> None:
    digest = config.digest(config.load(table()))
    np.save(tmp_path / "elsewhere.npy", CL)
    assert config.digest(config.load(table({"spectrum": str(tmp_path / "elsewhere.npy")}))) == digest
    assert config.digest(config.load(table({"spectrum": CL.copy()}))) == digest
    assert config.digest(config.load(table({"spectrum": np.nextafter(CL, 1.0)}))) != digest
    for given in ({"beam": Beam.elliptical(300.0, 250.0, lmax=LMAX)}, {"scan": moments()}, {"scan": MODEL}):
        assert config.digest(config.load(table(**given))) == config.digest(config.load(table(**given)))


def test_beam_survives_exactly() -> None:
    beam = replace(Beam.elliptical(300.0, 200.0, angle_deg=35.0, lmax=60), integral=1.0 / 3.0)
    kept = channels.load_beam(config.load(table(beam=beam)).channels[0], 60)
    assert kept.blm.tobytes() == beam.blm.tobytes()
    assert (kept.neglected_power, kept.integral) == (beam.neglected_power, beam.integral)
    assert channels.load_beam(config.load(table(beam=beam)).channels[0], 40).lmax == 40


def test_beam_that_ends_below_the_sky_is_refused() -> None:
    run = config.load(table(beam=Beam.gaussian(300.0, LMAX - 1)))
    with refused("lmax", LMAX - 1, LMAX):
        survey(run)


def test_moments_survive_exactly_and_are_checked() -> None:
    given = moments()
    kept = survey(config.load(table(scan=given))).channels[0].maps[0].moments
    for name in ("hits", "dtheta", "dphi"):
        assert getattr(kept, name).tobytes() == getattr(given, name).tobytes()
    assert kept.w.tobytes() == given.w[: kept.smax].tobytes()
    for wrong in (replace(given, frame="galactic"), Moments.parallel_transport(8), replace(given, w=given.w[:1])):
        with pytest.raises(InputError):
            survey(config.load(table(scan=wrong)))


@pytest.mark.parametrize("name", ["wmap", "planck", "litebird", "wmap_focal_plane"])
def test_scan_model_survives_exactly(tmp_path, name) -> None:
    model = replace(ScanModel.load(name), description='a "quoted" \\ text\nwith an é and \x7f')
    assert ScanModel.load(tmp_path / model.as_table(tmp_path)["model"]) == model


def test_schema_takes_objects_too() -> None:
    """A RunConfig made by hand from arrays is the one that is loaded from a dict with them."""
    loaded = config.load(table(beam=Beam.gaussian(300.0, LMAX), scan=moments(), map={"mask": MASK}))
    channel = config.Channel(name="W1", beam=Beam.gaussian(300.0, LMAX), scan=moments())
    made = config.RunConfig(
        name="test",
        sky=config.Sky(lmax=LMAX, spectrum=CL),
        map=config.Map(nside=NSIDE, mask=MASK),
        channels=(channel,),
        ensemble=config.Ensemble(seed=3),
    )
    assert made == loaded
    assert replace(made, sky=config.Sky(lmax=LMAX, alm=SKY)).sky.alm is not None


def test_an_object_may_stand_under_its_key() -> None:
    turned = {"kind": "blm", "path": Beam.elliptical(300.0, 250.0, lmax=LMAX), "angle_deg": 9.0}
    run = config.load(table(scan={"kind": "hit_averaged", "model": MODEL}, beam=turned))
    assert run == config.load(config.to_dict(run))
    assert run.channels[0].beam.angle_deg == 9.0


def test_arrays_under_other_keys_become_lists() -> None:
    image = np.exp(-(np.hypot(*np.mgrid[-20:21, -20:21]) ** 2) / 40)
    spec = {"kind": "map", "path": image, "pixel_deg": 1.0, "cut_deg": 15.0, "centre_pixel": np.array([20.0, 20.0])}
    run = config.load(table(beam=spec))
    assert run.channels[0].beam.centre_pixel == (20.0, 20.0)
    expected = Beam.from_map(image, LMAX, pixel_deg=1.0, cut_deg=15.0, centre=(20.0, 20.0))
    np.testing.assert_array_equal(channels.load_beam(run.channels[0], LMAX).blm, expected.blm)


@pytest.mark.parametrize(
    "given",
    [np.ma.masked_array(CL, CL > 0.1), np.array(["a", "b"]), np.array([object()])],
)
def test_arrays_that_say_more_than_numbers_are_refused(given) -> None:
    with refused("spectrum"):
        config.load(table({"spectrum": given}))


def test_unit_of_an_array_is_not_dropped() -> None:
    units = pytest.importorskip("astropy.units")
    with refused("K2"):
        config.load(table({"spectrum": CL * units.K**2}))


@pytest.mark.parametrize(
    "changes",
    [
        {"sky": {"spectrum": CL[:-1]}},
        {"sky": {"spectrum": CL + 1j}},
        {"sky": {"alm": SKY[:-1]}},
        {"sky": {"alm": SKY.reshape(1, -1)}},
        {"sky": {"map": np.zeros(100)}},
        {"map": {"mask": np.full(12 * NSIDE**2, 2.0)}},
        {"map": {"pixel_window": WINDOW[:5]}},
        {"beam": {"kind": "blm", "path": np.ones((4, 3))}},
        {"beam": {"kind": "map", "path": np.ones((30, 30))}},
    ],
)
def test_arrays_of_a_wrong_size_are_refused(changes) -> None:
    with pytest.raises(InputError):
        realized(table(**changes))


def test_unwritable_cache_is_named(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "file"))
    with refused("MCSIM_CACHE"):
        config.load(table())


def test_nothing_half_written_is_left() -> None:
    config.load(table(scan=moments()))
    with pytest.raises(InputError):
        config.load(table({"spectrum": np.array([object()])}))
    assert all(path.name.startswith("given-") for path in folders.default_cache_dir().iterdir())
