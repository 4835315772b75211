"""Noise from the differences of observed splits, and from files of realizations."""

import healpy
import numpy as np
import pytest

import mcsim
from layouts import table
from mcsim import config
from mcsim.datavector.filter_model import model_of
from mcsim.ensemble import plan
from mcsim.ensemble.expectation import noise_mean
from mcsim.simulation import simulate
from mcsim.simulation.noise import difference_level
from mcsim.simulation.survey import survey
from mcsim.support.numbers import measured
from refusals import refused

NSIDE = 32
NPIX = 12 * NSIDE**2
SIGMA = 300.0
HITS = np.random.default_rng(1).integers([[50], [20], [48]], [[81], [77], [91]], (3, NPIX)).astype(np.float64)


def run_with(noise, splits=(), realizations=2, **changes):
    scan = {"kind": "parallel_transport"}
    channel = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0}, "scan": scan, "noise": noise}
    base = {
        "name": "noisy",
        "sky": {"spectrum": "wmap7", "lmax": 32},
        "map": {"nside": NSIDE, "frame": "galactic", "splits": list(splits)},
        "channel": [channel],
        "ensemble": {"realizations": realizations, "seed": 3},
    }
    return config.load(base | changes)


@pytest.fixture
def observed():
    """Three splits of one sky, with an offset each, and noise of SIGMA per observation."""
    rng = np.random.default_rng(7)
    sky, offset = 100.0 * np.sin(np.arange(NPIX)), np.array([0.0, 30.0, -50.0])
    return sky + offset[:, None] + SIGMA / np.sqrt(HITS) * rng.standard_normal(HITS.shape)


@pytest.mark.parametrize("number", [2, 3])
def test_the_level_is_found_with_its_error(observed, number):
    run = run_with({"kind": "difference", "maps": list(observed[:number]), "hits": list(HITS[:number])})
    level = difference_level(run, "W")
    assert level.error_uk == pytest.approx(SIGMA / np.sqrt(2.0 * (NPIX - 1) * (number - 1)), rel=0.05)
    assert abs(level.sigma_uk - SIGMA) < 4.0 * level.error_uk
    assert (level.pixels, level.splits) == (NPIX, number)


def test_it_is_the_half_difference(observed):
    """Of two splits: the rms of the half-difference over its standard deviation per unit of noise."""
    level = difference_level(run_with({"kind": "difference", "maps": list(observed[:2]), "hits": list(HITS[:2])}), "W")
    per_unit = 0.5 * np.sqrt(1.0 / HITS[0] + 1.0 / HITS[1])
    half = 0.5 * (observed[0] - observed[1])
    half -= np.average(half, weights=per_unit**-2)
    assert level.sigma_uk == pytest.approx(np.sqrt(np.mean((half / per_unit) ** 2)), rel=1e-4)


def test_of_few_pixels_one_goes_for_the_offset(observed):
    """Of 6 pixels the level would be 9 % too low if 6 degrees of freedom were counted for 5."""
    mask = np.where(np.arange(NPIX) % (NPIX // 6) == 0, 1.0, 0.0)
    noise = {"kind": "difference", "maps": list(observed[:2]), "hits": list(HITS[:2]), "mask": mask}
    level, used = difference_level(run_with(noise), "W"), mask > 0.0
    weight = 1.0 / (1.0 / HITS[0] + 1.0 / HITS[1])[used]
    difference = (observed[0] - observed[1])[used]
    difference = difference - np.average(difference, weights=weight)
    assert level.pixels == 6
    assert level.sigma_uk == pytest.approx(np.sqrt(np.sum(weight * difference**2) / 5.0), rel=1e-9)


def test_splits_have_the_noise_of_their_hits_and_the_whole_that_of_all(observed):
    noise = {"kind": "difference", "maps": list(observed[:2]), "hits": list(HITS[:2])}
    sigma = difference_level(run_with(noise), "W").sigma_uk
    [whole] = survey(run_with(noise)).channels[0].maps
    assert whole.noise_uk == pytest.approx(sigma / np.sqrt(HITS[:2].sum(axis=0)))
    for made, hits in zip(survey(run_with(noise, ("a", "b"))).channels[0].maps, HITS, strict=False):
        assert made.noise_uk == pytest.approx(sigma / np.sqrt(hits))
        assert made.moments.hits == pytest.approx(hits)


def test_isotropic_noise_of_part_of_the_sky():
    rng = np.random.default_rng(1)
    maps = 7.0 * rng.standard_normal((2, NPIX))
    maps[0, :100] = healpy.UNSEEN
    maps[:, 100:200] += 1e5 * rng.standard_normal((2, 100))
    mask = (np.arange(NPIX) >= 200).astype(float)
    run = run_with({"kind": "difference", "maps": list(maps), "isotropic": True, "mask": mask})
    level = difference_level(run, "W")
    assert level.pixels == NPIX - 200
    assert abs(level.sigma_uk - 7.0) < 4.0 * level.error_uk
    [whole] = survey(run).channels[0].maps
    assert whole.noise_uk[200:] == pytest.approx(np.full(NPIX - 200, level.sigma_uk / np.sqrt(2.0)))
    assert whole.noise_uk[0] == pytest.approx(level.sigma_uk)  # one split alone observed it
    assert np.array_equal(whole.moments.hits, np.ones(NPIX))  # as the scan has them: splits of equal noise count none


def test_hits_stand_beside_the_temperature_and_the_plan_says_the_level(observed, tmp_path):
    paths = [
        table(tmp_path / f"{n}.fits", {"TEMPERATURE": m * 1e-3, "N_OBS": h}, {"TEMPERATURE": "mK"}, ORDERING="NESTED")
        for n, (m, h) in enumerate(zip(observed[:2], HITS, strict=False))
    ]
    run = run_with({"kind": "difference", "maps": paths})
    level = difference_level(run, "W")
    assert abs(level.sigma_uk - SIGMA) < 4.0 * level.error_uk
    assert f"noise   W {measured(level.sigma_uk, level.error_uk, ' uK')} per observation" in "\n".join(
        plan.cost(run).lines(2, 1)
    )


@pytest.mark.parametrize("columns", [{"TEMPERATURE": "mK"}, None], ids=["fits", "npy"])
def test_temperatures_are_not_taken_for_hits(observed, columns, tmp_path):
    """A monopole makes all of them positive."""
    maps = [one + 1000.0 for one in observed[:2]]
    if columns is not None:
        maps = [table(tmp_path / f"{n}.fits", {"TEMPERATURE": one}, columns) for n, one in enumerate(maps)]
    with refused("maps" if columns is None else "0.fits", "N_OBS", "HITS"):
        difference_level(run_with({"kind": "difference", "maps": maps}), "W")


@pytest.mark.parametrize(
    ("changes", "splits", "named"),
    [
        ({"hits": [HITS[0]]}, (), ("hits", 1, 2)),
        ({"isotropic": True}, (), ("hits", "isotropic")),
        ({"hits": ["{split}.npy", "b.npy"]}, (), ("hits", "{split}")),
        ({}, ("a", "b", "c"), ("channel[W].noise.maps", 2, 3)),
        ({"maps": [HITS[0]]}, (), ("channel[W].noise", "maps", 1, 2)),
        ({"maps": [HITS[0], "none.fits"]}, (), ("channel[W].noise.maps[1]", "none.fits")),
    ],
)
def test_splits_that_do_not_fit_are_refused(observed, changes, splits, named):
    noise = {"kind": "difference", "maps": list(observed[:2]), "hits": list(HITS[:2])} | changes
    with refused(*named):
        run_with(noise, splits)


def test_the_hash_is_over_the_contents_of_all_maps(observed):
    noise = {"kind": "difference", "maps": list(observed[:2]), "hits": list(HITS[:2])}
    other = noise | {"maps": [observed[0], observed[2]]}
    assert config.digest(run_with(noise)) == config.digest(run_with(noise)) != config.digest(run_with(other))


def test_equal_maps_have_no_noise(observed):
    run = run_with({"kind": "difference", "maps": [observed[0], observed[0]], "isotropic": True})
    with refused("maps"):
        survey(run)


def test_splits_in_another_unit_are_refused(observed):
    """Of maps in K that say no unit, the noise was a millionth of what it is."""
    with refused("TUNIT", 1e-4):
        survey(run_with({"kind": "difference", "maps": list(1e-6 * observed), "hits": list(HITS)}))


@pytest.fixture
def files(tmp_path):
    """Four maps of noise in K, anisotropic and correlated."""
    rng = np.random.default_rng(2)
    for number in range(4):
        noise = healpy.ud_grade(5.0 * rng.standard_normal(NPIX // 4), NSIDE)
        healpy.write_map(
            tmp_path / f"n_{number:03d}.fits", noise * 1e-6, column_units="K_CMB", dtype=np.float64, coord="G"
        )
    return str(tmp_path / "n_{realization:03d}.fits")


def test_realizations_are_those_of_the_files(files):
    run, quiet = run_with({"kind": "realizations", "files": files}), run_with({"sigma0_uk": 0.0})
    shared = survey(run)
    for number in range(4):
        sky = simulate.draw_sky(shared, number)
        drawn = simulate.maps(shared, number, sky=sky)[0] - simulate.maps(survey(quiet), number, sky=sky)[0]
        stored = 1e6 * healpy.read_map(files.format(realization=number), dtype=float)
        assert drawn == pytest.approx(stored, abs=1e-9)
    level = shared.channels[0].maps[0].noise_uk
    assert level == pytest.approx(np.full(NPIX, np.std(1e6 * healpy.read_map(files.format(realization=0)))), rel=0.01)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(("factor", "unit"), [(0.0, "K"), (1.0, None)])
def test_a_file_without_noise_or_in_another_unit_is_refused(files, number: int, factor: float, unit: str | None):
    """The first file scales all: one of zeros silenced every realization. Noise in K that says no unit was none."""
    path = files.format(realization=number)
    in_kelvin = factor * healpy.read_map(path, dtype=float)
    healpy.write_map(path, in_kelvin, column_units=unit, coord="G", overwrite=True, dtype=np.float64)
    with refused(path, "TUNIT", 1e-4):
        simulate.maps(survey(run_with({"kind": "realizations", "files": files})), number)


def test_the_hash_is_over_the_first_file_and_the_name(files, tmp_path):
    def digest(name):
        return config.digest(run_with({"kind": "realizations", "files": str(tmp_path / name)}))

    before = digest("n_{realization:03d}.fits")
    for number in range(2):
        (tmp_path / f"other_{number:03d}.fits").write_bytes((tmp_path / f"n_{number:03d}.fits").read_bytes())
    assert digest("other_{realization:03d}.fits") != before
    (tmp_path / "n_000.fits").write_bytes((tmp_path / "n_001.fits").read_bytes())
    assert digest("n_{realization:03d}.fits") != before


def test_no_two_maps_have_the_same_noise(files, tmp_path):
    """Without {split} in the name all splits had one and the same noise, and two channels with one template too."""
    noise = {"kind": "realizations", "files": files}
    with refused("channel[W].noise.files", "W:a and W:b", "{split}"):
        run_with(noise, ("a", "b"))
    two = [config.to_dict(run_with(noise))["channel"][0] | {"name": name} for name in ("V", "W")]
    with refused("channel[W].noise.files", "V and W", "{channel}"):
        run_with(noise, channel=two)
    for number in range(4):
        for split in "ab":
            copy = tmp_path / f"{split}_{number:03d}.fits"
            copy.write_bytes((tmp_path / f"n_{number:03d}.fits").read_bytes())
    assert run_with({"kind": "realizations", "files": str(tmp_path / "{split}_{realization:03d}.fits")}, ("a", "b"))


def test_effects_scale_drawn_noise(files):
    effect = [{"name": "noise_level", "channel": "W", "amplitude": 0.5}]
    plain, louder = (
        survey(run_with({"kind": "realizations", "files": files}, effect=changes)) for changes in ([], effect)
    )
    before, after = (s.channels[0].maps[0].noise(3, 1) for s in (plain, louder))
    assert after == pytest.approx(1.5 * before)


def test_too_few_files_are_refused_with_the_number_that_is_needed(files):
    assert run_with({"kind": "realizations", "files": files}, realizations=4)
    with refused("channel[W].noise.files", "n_004.fits", 10, 9):
        run_with({"kind": "realizations", "files": files}, realizations=10)


def test_files_of_noise_that_do_not_fit_are_refused(files, tmp_path):
    with refused("channel[W].noise", "{realization}"):
        run_with({"kind": "realizations", "files": files.replace("{realization:03d}", "001")})
    healpy.write_map(tmp_path / "half_0.fits", np.where(np.arange(NPIX) < 5, healpy.UNSEEN, 1.0), dtype=np.float64)
    with refused("half_0.fits", 5):
        survey(run_with({"kind": "realizations", "files": str(tmp_path / "half_{realization}.fits")}, realizations=1))


def test_what_needs_white_noise_says_so(files):
    shared = survey(run_with({"kind": "realizations", "files": files}))
    with refused("W", "white"):
        noise_mean(shared, 0, shared.estimator.modes)
    with refused("W", "white", "variance", "correlated"):
        model_of(shared, mcsim.DiagnosisSettings())


def test_infinite_pixels_are_no_holes(observed):
    """But those of a variance are: nothing was observed there."""
    broken, hits = observed[:2].copy(), HITS[:2].copy()
    broken[1, :9] = -np.inf
    with refused("9 pixels", "UNSEEN"):
        difference_level(run_with({"kind": "difference", "maps": list(broken), "hits": list(hits)}), "W")
    hits[0, :4] = np.inf
    with refused("4 pixels", "UNSEEN"):
        difference_level(run_with({"kind": "difference", "maps": list(observed[:2]), "hits": list(hits)}), "W")
    variance = np.where(np.arange(NPIX) < 7, np.inf, 100.0)
    [m] = survey(run_with({"kind": "variance", "variance": variance})).maps
    assert np.sum(m.moments.hits == 0) == 7
