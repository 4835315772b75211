"""Arrays that users give: what a conversion would drop in silence is refused wherever they come in."""

import healpy
import numpy as np
import pandas
import pytest
import xarray as xr

import mcsim
from mcsim.errors import InputError
from mcsim.support.arrays import numbers, reals
from refusals import refused

LMAX, NSIDE = 8, 4
ALM = np.arange(45.0) + 1j * (np.arange(45) > LMAX)
MAP = np.cos(np.arange(12.0 * NSIDE**2))
ELL = np.arange(LMAX + 1)
WINDOW = np.exp(-0.5 * ELL * (ELL + 1) * 0.1**2)
ANGLES = np.linspace(0.1, 3.0, 20)
Y, X = np.mgrid[-20:21, -20:21] * 0.2
IMAGE = np.exp(-(X**2 + Y**2) / 2)
CHANNEL = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0}, "scan": {"kind": "parallel_transport"}}
RUN = {"name": "run", "sky": {"spectrum": "wmap7", "lmax": LMAX}, "map": {"nside": NSIDE}, "channel": [CHANNEL]}
PREPARED = RUN | {"biposh": {"lmax": 4}, "preparation": [{"kind": "mask", "mask": np.ones(12 * NSIDE**2)}]}
UNIT = mcsim.Moments.parallel_transport(NSIDE)

TAKES = {
    "biposh": (ALM, mcsim.biposh),
    "observe": (ALM, lambda given: mcsim.observe(given, mcsim.Beam.gaussian(900.0, lmax=LMAX), UNIT)),
    "from_window": (WINDOW, mcsim.Beam.from_window),
    "from_blm": (healpy.blm_gauss(0.1, LMAX), mcsim.Beam.from_blm),
    "from_map": (IMAGE, lambda given: mcsim.Beam.from_map(given, LMAX, pixel_deg=0.2)),
    "from_pointing": (ANGLES, lambda given: mcsim.Moments.from_pointing(ANGLES, ANGLES, given, NSIDE)),
    "load_config": (WINDOW, lambda given: mcsim.load_config(RUN | {"sky": {"spectrum": given, "lmax": LMAX}})),
    "prepare": (MAP, lambda given: mcsim.prepare({"W": given}, PREPARED)),
}


@pytest.fixture(params=TAKES)
def taking(request):
    return TAKES[request.param]


def test_a_unit_is_not_dropped(taking) -> None:
    units = pytest.importorskip("astropy.units")
    array, take = taking
    with refused("deg"):
        take(array * units.deg)


def test_masked_elements_are_not_used(taking) -> None:
    array, take = taking
    masked = np.ma.masked_array(array, np.arange(array.size).reshape(array.shape) == 3)
    if array is MAP:
        assert np.flatnonzero(take(masked)["W"] == healpy.UNSEEN).tolist() == [3]
        return
    with refused(1):
        take(masked)


@pytest.mark.parametrize("kind", [complex, str])
def test_masked_elements_hide_no_type(kind) -> None:
    masked = np.ma.masked_array(MAP.astype(kind), MAP > 0.5)
    with refused("map W"):
        mcsim.prepare({"W": masked}, PREPARED)


def test_texts_are_no_numbers(taking) -> None:
    array, take = taking
    with pytest.raises(InputError):
        take(np.full(array.shape, "a"))


@pytest.mark.parametrize("name", ["from_window", "from_map", "from_pointing", "prepare"])
def test_imaginary_parts_are_not_dropped(name) -> None:
    array, take = TAKES[name]
    with refused("complex128"):
        take(array + 1j)


@pytest.mark.parametrize(
    "kind", [list, pandas.Series, xr.DataArray, np.ma.masked_array, lambda array: array.astype(np.float32)]
)
def test_other_containers_are_taken(kind) -> None:
    np.testing.assert_allclose(numbers(kind(WINDOW), "B_l"), WINDOW, rtol=1e-6)
    assert reals(kind(WINDOW), "B_l").dtype == np.float64


def test_ragged_lists_are_no_array() -> None:
    with refused("B_l"):
        numbers([[1.0], [1.0, 2.0]], "B_l")


def test_coefficients_in_another_order_are_refused() -> None:
    """Coefficients ordered by l first have complex numbers where healpy has the a_l0."""
    by_degree = np.argsort(healpy.Alm.getlm(LMAX)[0], kind="stable")
    with refused("a_l0"):
        mcsim.biposh(ALM[by_degree])


def test_real_coefficients_of_a_file_are_refused(tmp_path) -> None:
    np.save(tmp_path / "alm.npy", ALM.real)
    run = RUN | {"sky": {"alm": str(tmp_path / "alm.npy"), "lmax": LMAX}, "ensemble": {"realizations": 1}}
    with refused("float64"):
        mcsim.write_maps(run, tmp_path / "maps", 0)


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("alm", {"sky": {"alm": np.nan * ALM, "lmax": LMAX}}),
        ("spectrum", {"sky": {"spectrum": np.ones(LMAX), "lmax": LMAX}}),
        ("mask", {"map": {"nside": NSIDE, "mask": np.ones(14)}}),
        ("path", {"channel": [CHANNEL | {"beam": {"kind": "blm", "path": np.ones((1, LMAX))}}]}),
        ("beam", {"channel": [CHANNEL | {"beam": mcsim.Beam.gaussian(900.0, lmax=LMAX - 1)}]}),
        ("moments", {"channel": [CHANNEL | {"scan": mcsim.Moments.parallel_transport(2 * NSIDE)}]}),
    ],
)
def test_messages_name_what_was_given_and_not_its_file_in_the_cache(tmp_path, key, changes) -> None:
    with refused(key) as refusal:
        mcsim.write_maps(RUN | {"ensemble": {"realizations": 1}} | changes, tmp_path / "maps", 0)
    assert "given-" not in str(refusal.value)
