"""What a newcomer gives by mistake to the public names: each ends in the right number or in a sentence."""

import warnings
from pathlib import Path

import healpy
import numpy as np
import pandas
import pytest
import xarray as xr
from astropy import units
from astropy.io import fits

import mcsim
from mcsim import Beam, Moments, config, systematics
from mcsim.beamfit.effective_beam import fit_models
from mcsim.ensemble.maps import write_maps
from mcsim.errors import InputError
from mcsim.instrument.scan import write_moments_fits
from mcsim.simulation.channels import check_effects, known_offsets
from mcsim.simulation.nuisance import check_nuisances
from mcsim.simulation.survey import survey
from refusals import refused

LMAX, NSIDE = 12, 8
ELL = np.arange(LMAX + 1)
CL = 1000.0 / (ELL * (ELL + 1.0)).clip(6.0)
CHANNEL = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0}, "scan": {"kind": "parallel_transport"}}
Y, X = np.mgrid[-20:21, -20:21] * 0.2
IMAGE = np.exp(-(X**2 / 0.8 + Y**2))


def run(**changed: object) -> dict:
    return {
        "name": "run",
        "sky": {"spectrum": CL, "lmax": LMAX},
        "map": {"nside": NSIDE},
        "channel": [CHANNEL],
    } | changed


def test_a_third_width_or_degree_is_no_angle() -> None:
    """Beam.elliptical(60, 50, 300) was a beam up to l = 2048 with its axis at 300 degrees."""
    with pytest.raises(TypeError):
        Beam.elliptical(60.0, 50.0, 300)
    assert Beam.elliptical(60.0, 50.0, lmax=300).lmax == 300


@pytest.mark.parametrize("width", ["60", None, True, np.array([60.0]), 1.0 * units.deg, [60.0, 50.0]])
def test_a_width_is_one_plain_number(width) -> None:
    with refused("fwhm_arcmin"):
        Beam.gaussian(width, lmax=LMAX)
    with refused("fwhm_minor_arcmin"):
        Beam.elliptical(70.0, width, lmax=LMAX)


@pytest.mark.parametrize("width", [-1, 0.0, 1201.0, float("nan")])
def test_a_width_that_cannot_be_is_called_by_its_own_name(width) -> None:
    with refused("fwhm_arcmin", width, 1200) as caught:
        Beam.gaussian(width, lmax=LMAX)
    assert "major" not in str(caught.value)


def test_a_number_of_threads_is_a_number(tmp_path) -> None:
    with refused("nthreads", "'2'"):
        mcsim.write_maps(run(), tmp_path / "maps", nthreads="2")
    with refused("nthreads", "'2'"):
        Beam.gaussian(600.0, lmax=LMAX).values(0.1, 0.2, nthreads="2")


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 0.0])
def test_a_map_in_kelvin_is_not_prepared_as_one_in_microkelvin(factor) -> None:
    model = run(preparation=[{"kind": "subtract_dipole"}])
    map_uk = healpy.alm2map(np.ones(91, dtype=complex), NSIDE)
    assert mcsim.prepare([map_uk], model)[0].shape == map_uk.shape
    with refused("map W", "TUNIT1"):
        mcsim.prepare([factor * map_uk], model)


def test_numbers_of_numpy_are_numbers() -> None:
    assert Beam.gaussian(np.float32(600.0), lmax=np.int32(LMAX)).lmax == LMAX
    assert systematics.build("calibration", {"amplitude": np.float32(0.5)}).amplitude == 0.5
    assert systematics.build("calibration", {"amplitude": np.int64(1)}).amplitude == 1.0


@pytest.mark.parametrize("lmax", ["12", 10**9, True, 0])
def test_a_highest_degree_is_whole_and_possible(lmax) -> None:
    with refused("lmax", repr(lmax), 32768):
        Beam.gaussian(600.0, lmax=lmax)


@pytest.mark.parametrize("more", [{"centre": (20, 20, 20)}, {"centre": 20}, {"pixel_deg": "0.2"}, {"cut_deg": None}])
def test_the_place_of_a_beam_map_is_said_in_numbers(more) -> None:
    with refused(next(iter(more))):
        Beam.from_map(IMAGE, LMAX, **({"pixel_deg": 0.2} | more))


def test_a_beam_map_with_named_axes_is_not_transposed() -> None:
    image = xr.DataArray(IMAGE, dims=("y", "x"))
    expected = Beam.from_map(IMAGE, LMAX, pixel_deg=0.2)
    np.testing.assert_array_equal(Beam.from_map(image, LMAX, pixel_deg=0.2).blm, expected.blm)
    with refused("(x, y)"):
        Beam.from_map(image.T, LMAX, pixel_deg=0.2)


@pytest.mark.parametrize(
    "labelled",
    [
        xr.DataArray(CL[2:], dims="ell", coords={"ell": ELL[2:]}),
        xr.DataArray(CL[::-1], dims="l", coords={"l": ELL[::-1]}),
        pandas.Series(CL[::2], index=pandas.Index(ELL[::2], name="multipole")),
    ],
)
def test_labels_that_say_another_place_are_not_dropped(labelled) -> None:
    """A spectrum from l = 2 on was taken for one from l = 0 on."""
    with refused(labelled.dims[0] if hasattr(labelled, "dims") else labelled.index.name):
        mcsim.load_config(run(sky={"spectrum": labelled, "lmax": 4}))


def test_labels_that_say_the_same_place_are_no_obstacle() -> None:
    labelled = xr.DataArray(CL, dims="ell", coords={"ell": ELL})
    assert config.digest(mcsim.load_config(run(sky={"spectrum": labelled, "lmax": LMAX}))) == config.digest(
        mcsim.load_config(run())
    )
    later = pandas.Series([1.0, 2.0], index=[7, 8])  # rows of a table of samples
    assert Moments.from_pointing(later, later, later, NSIDE).hits.sum() == 2


def test_a_list_is_an_array() -> None:
    listed = mcsim.load_config(run(sky={"spectrum": list(CL), "lmax": LMAX}))
    assert config.digest(listed) == config.digest(mcsim.load_config(run()))
    with refused("map.mask"):
        mcsim.load_config(run(map={"nside": NSIDE, "mask": []}))


@pytest.mark.parametrize("lat_deg", [264.0, -91.0])
def test_a_longitude_is_no_latitude(lat_deg) -> None:
    with refused("lat_deg", lat_deg):
        systematics.build("dipole_modulation", {"amplitude": 0.1, "lon_deg": 48.0, "lat_deg": lat_deg})


def test_a_range_of_time_is_a_pair() -> None:
    with refused("time_range", 0.5):
        Moments.from_model("wmap", NSIDE, time_range=0.5)


def test_moments_that_cannot_be_written_are_named(tmp_path) -> None:
    (tmp_path / "file").touch()
    with refused(tmp_path / "file" / "moments"):
        Moments.parallel_transport(NSIDE).save(tmp_path / "file" / "moments")


@pytest.mark.parametrize("frequency", [94e9, 94e3, -94.0])
def test_a_frequency_is_in_ghz(frequency) -> None:
    with refused("channel[W].frequency_ghz"):
        mcsim.load_config(run(channel=[CHANNEL | {"frequency_ghz": frequency}]))


def test_one_store_to_merge_is_a_path_too(tmp_path) -> None:
    with refused(tmp_path / "a.zarr"):
        mcsim.merge(str(tmp_path / "a.zarr"), tmp_path / "b.zarr")


def test_no_pointing_file_is_no_survey() -> None:
    with pytest.raises(InputError):
        Moments.from_pointing_files([], NSIDE)


def test_the_realization_that_is_not_there_is_named(tmp_path) -> None:
    with refused(5, "ensemble.realizations"):
        mcsim.write_maps(run(ensemble={"realizations": 2}), tmp_path / "maps", realizations=5)


@pytest.mark.parametrize("settings", [{"alpha": 0.1}, {}, "quick", mcsim.LimitSettings])
def test_settings_are_an_object_of_their_own(settings, tmp_path) -> None:
    with refused("mcsim.DiagnosisSettings"):
        mcsim.diagnose(run(), tmp_path, tmp_path / "out", settings=settings)
    with refused("mcsim.LimitSettings"):
        mcsim.limit(run(), settings=settings)


def test_a_unit_or_labels_of_a_compared_map_are_not_dropped() -> None:
    sky = np.sin(np.arange(12.0 * NSIDE**2))
    turned = xr.DataArray(sky[::-1], dims="pixel", coords={"pixel": np.arange(sky.size)[::-1]})
    for given, named in ((sky * units.mK, "mK"), (turned, "pixel"), (sky + 0j, "W")):
        with refused(named):
            mcsim.compare([given], [sky], mcsim.load_config(run()))
    hidden = np.ma.masked_array(sky, np.arange(sky.size) < 20)
    assert mcsim.compare([hidden], [1.01 * sky], mcsim.load_config(run())).channels[0].one_sided == 20


@pytest.mark.parametrize("side", ["A", "B"])
def test_a_side_without_data_is_named(side) -> None:
    sky = np.sin(np.arange(12.0 * NSIDE**2))
    maps = [[np.nan * sky if side == own else sky] for own in "AB"]
    with refused("W", f"side {side}"):
        mcsim.compare(*maps, mcsim.load_config(run()))


def test_sides_of_a_comparison_may_be_given_by_name() -> None:
    sky = healpy.alm2map(np.arange(91) + 0j, NSIDE)
    assert mcsim.compare({"W": sky}, {"W": sky}, mcsim.load_config(run())).verdict == "identical"
    for wrong in ({"V": sky}, {}, {"W": sky, "V": sky}):
        with refused("W"):
            mcsim.compare({"W": sky}, wrong, mcsim.load_config(run()))


@pytest.mark.parametrize("column", ["W_L", "wl", "BL2", "B_l_sq", "INT_2_BEAM"])
def test_a_column_of_the_square_is_no_beam(column, tmp_path) -> None:
    hdu = fits.BinTableHDU.from_columns([fits.Column(column, "D", array=np.exp(-(ELL**2) / 500.0))])
    hdu.writeto(tmp_path / "w.fits")
    with refused("w.fits", column):
        Beam.from_window(tmp_path / "w.fits")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda: mcsim.predict(run(), L_moments=-1), ("L_moments", -1)),
        (lambda: mcsim.predict(run(), L_moments=2.5), ("L_moments", 2.5)),
        (lambda: mcsim.predict(run(), exact=True, L_moments=1), ("L_moments", 1, "biposh.L_max", 2)),
        (lambda: mcsim.predict(run(), exact="x"), ("exact", "'x'", True, False)),
        (lambda: mcsim.predict(run(), snr=1), ("snr", 1, True, False)),
        (lambda: mcsim.predict(run(), nthreads="2"), ("nthreads", "'2'")),
        (lambda: fit_models(None, None, "constant"), ("models", "'constant'")),
        (lambda: fit_models(None, None, None), ("models", None)),
        (lambda: fit_models(None, None, 5), ("models", 5)),
        (lambda: fit_models(None, None, [["linear"], ["linear"]]), ("models", "['linear']")),
        (lambda: Beam.from_map(np.zeros((0, 0)), LMAX, pixel_deg=0.2), ("(0, 0)",)),
        (lambda: Beam.from_map(np.zeros((0, 5)), LMAX, pixel_deg=0.2, centre=(2, 0)), ("(0, 5)",)),
        (lambda: Beam.gaussian(600.0, lmax=LMAX).values(np.nan, 0.0), ("theta",)),
        (lambda: Beam.gaussian(600.0, lmax=LMAX).values(0.0, np.inf), ("phi",)),
        (lambda: mcsim.ScanModel.load("wmap").with_sampling(1e-9), ("1e-09", "3.16e+16", "sample_period_s")),
        (lambda: mcsim.merge(None, "x.zarr"), ("paths", None)),
        (lambda: mcsim.run(run(), realizations=slice("0", "3")), ("realizations",)),
        (lambda: mcsim.LimitSettings(nuisances=["calibration"]), ("nuisances",)),
        (lambda: mcsim.LimitSettings(tolerance=0.0), ("tolerance",)),
        (lambda: Moments.parallel_transport(nside=NSIDE, psi0_deg="x"), ("psi0_deg", "'x'")),
        (lambda: Beam.gaussian(600.0, lmax=LMAX).rotated("x"), ("'x'",)),
        (lambda: Moments.parallel_transport(nside="8"), ("nside", "'8'")),
        (lambda: mcsim.predict(run(sky={"spectrum": np.zeros(0), "lmax": LMAX})), ("spectrum",)),
    ],
)
def test_arguments_of_another_kind_are_named(wrong, named) -> None:
    with refused(*named):
        wrong()


@pytest.mark.parametrize("made", [mcsim.predict, mcsim.run, lambda given: write_maps(given, "maps", realizations=0)])
def test_a_run_of_nothing_is_refused(made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was an ensemble of zeros, without a word; of noise alone, or of effects, it is one."""
    monkeypatch.chdir(tmp_path)
    dark = {"sky": {"spectrum": 0.0 * CL, "lmax": LMAX}, "ensemble": {"realizations": 1}, "compute": {"workers": 1}}
    with refused("sky.lmax", LMAX, "noise.sigma0_uk"):
        made(run(**dark))
    made(run(**dark, channel=[CHANNEL | {"noise": {"sigma0_uk": 1.0}}]))


def test_an_effect_without_amplitude_is_warned_of() -> None:
    with pytest.warns(UserWarning, match="calibration has no amplitude"):
        check_effects(mcsim.load_config(run(effect=[{"name": "calibration", "channel": "W"}])))


@pytest.mark.parametrize("side", [None, 5, mcsim.load_config("tiny")], ids=["none", "number", "run"])
def test_a_side_of_another_type_is_refused(side) -> None:
    with refused(type(side).__name__):
        mcsim.compare(side, side, mcsim.load_config("tiny"))


@pytest.mark.parametrize("accuracy", ["x", None, True, 0.0, 1.0])
def test_an_accuracy_that_is_no_share_is_refused(accuracy) -> None:
    with refused("accuracy", repr(accuracy) if isinstance(accuracy, str) else accuracy):
        mcsim.compare([], [], mcsim.load_config("tiny"), accuracy=accuracy)


@pytest.mark.parametrize(("smax", "warned"), [(2, True), (3, False)])
def test_orders_that_a_file_of_moments_lacks_are_warned_of(smax, warned, tmp_path: Path) -> None:
    """A coma has m = 1 and 3: without the latter its response is another one."""
    path = tmp_path / "moments.fits"
    write_moments_fits(path, Moments.parallel_transport(nside=NSIDE, smax=smax))
    channel = CHANNEL | {"scan": {"kind": "moments", "path": str(path)}}
    coma = {"name": "beam_coma", "channel": "W", "amplitude": 0.1}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_effects(mcsim.load_config(run(effect=[coma], channel=[channel])))
    assert [f"end at s = {smax}, which leaves out 10 %" in str(one.message) for one in told] == [True] * warned


def test_a_file_of_moments_that_names_no_frame_has_that_of_the_maps_beside_effects(tmp_path: Path) -> None:
    """A run took it, and refused it with an effect that gives the beam more orders; so did a comparison."""
    path = tmp_path / "moments.fits"
    write_moments_fits(path, Moments.parallel_transport(nside=NSIDE, smax=4))
    fits.delval(path, "COORDSYS", ext=1)
    ellipse = {"name": "beam_ellipticity", "channel": "W", "amplitude": 0.1}
    model = mcsim.load_config(
        run(effect=[ellipse], channel=[CHANNEL | {"scan": {"kind": "moments", "path": str(path)}}])
    )
    check_effects(model)
    assert known_offsets(model, model.channels[0]) == 0


def test_a_file_of_moments_without_the_orders_of_the_beam_is_refused_whatever_effects_add(tmp_path: Path) -> None:
    """An effect on the beam cut it, at m = 2 here, of which nothing was said where the effect has few orders beyond."""
    path = tmp_path / "moments.fits"
    write_moments_fits(path, Moments.parallel_transport(nside=NSIDE, smax=2))
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 900.0, "fwhm_minor_arcmin": 600.0, "m_max": 4}
    channel = CHANNEL | {"beam": beam, "scan": {"kind": "moments", "path": str(path)}}
    for effects in ([], [{"name": "beam_ellipticity", "channel": "W", "amplitude": 0.1}]):
        model = run(effect=effects, channel=[channel])
        with refused("moments", 4):
            mcsim.run(model, tmp_path / "x.zarr")
        with refused("moments", 4):
            mcsim.predict(model)


@pytest.mark.parametrize(
    ("effect", "named"),
    [
        ({"name": "spectrum", "amplitude": 3.0, "bands": [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0]}, ("spectrum", -3.0)),
        ({"name": "lensing", "amplitude": -0.5}, ("lensing", -0.5)),
        ({"name": "excess_noise", "channel": "W", "amplitude": -0.1}, ("excess_noise", -0.1)),
        ({"name": "excess_noise", "channel": "W", "amplitude": 1e9}, ("excess_noise", 1e9, 1e6)),
        ({"name": "noise_level", "channel": "W", "amplitude": 1e300}, ("noise_level", 1e300, 1e12)),
        ({"name": "pointing_offset", "channel": "W", "amplitude": 1e6}, ("pointing_offset", 1e6, 10800.0)),
        ({"name": "foreground_residual", "amplitude": 1.0, "spectral_index": -1e4}, ("spectral_index", -1e4, 50.0)),
        ({"name": "transmission_imbalance", "channel": "W", "amplitude": 0.01}, ("transmission_imbalance", "W")),
        ({"name": "mapmaking_convergence", "channel": "W", "amplitude": 5.0}, ("mapmaking_convergence", "W")),
        ({"name": "noise_level", "channel": "W", "amplitude": 0.1}, ("noise_level", "W")),
        ({"name": "noise_anisotropy", "channel": "W", "amplitude": 0.1}, ("noise_anisotropy", "W")),
    ],
)
def test_an_effect_that_cannot_be_is_refused_before_a_store_is_made(effect, named, tmp_path: Path) -> None:
    model = mcsim.load_config(run(effect=[effect]))
    for make in (lambda: mcsim.run(model, tmp_path / "x.zarr"), lambda: write_maps(model, tmp_path / "maps", 0)):
        with refused(*named):
            make()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("scan", [{"kind": "parallel_transport"}, {"kind": "hit_averaged", "model": "planck"}])
def test_an_effect_on_differences_is_refused_where_there_are_none(scan) -> None:
    effect = {"name": "transmission_imbalance", "channel": "W", "amplitude": 0.01}
    with refused("transmission_imbalance", "W", "differencing"):
        survey(mcsim.load_config(run(effect=[effect], channel=[CHANNEL | {"scan": scan}])))


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ({"effect": [{"name": "calibraton", "channel": "W"}]}, ("effect[0]", "calibration")),
        ({"effect": [{"name": "calibration", "chanel": "W"}]}, ("effect[0]", "'chanel'", "channel")),
        ({"nuisance": [{"effect": "calibraton", "channel": "W", "width": 0.1}]}, ("nuisance[0]", "calibration")),
        ({"nuisance": [{"effect": "calibration", "channel": "W", "width": 0.1}] * 2}, ("nuisance[1]", "calibration")),
        ({"nuisance": [{"effect": "beam_width", "channel": "W", "width": 0.9}]}, ("nuisance[0]", "beam_width")),
    ],
)
def test_tables_that_a_dict_lists_are_named_by_their_keys(table, named) -> None:
    model = mcsim.load_config(run(**table))
    with refused(*named) as caught:
        check_effects(model)
        check_nuisances(model)
    assert str(caught.value).startswith(named[0])


def test_variances_in_k2_are_no_noise() -> None:
    noise = {"kind": "variance", "variance": np.full(12 * NSIDE**2, 1e-10)}
    with refused("1e-10", "uK^2", "K^2"):
        mcsim.write_maps(run(channel=[CHANNEL | {"noise": noise}]), "maps", realizations=0)
