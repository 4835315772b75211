"""Splits by time, rings and sets, with their own hits, noise and lines of sight; masks of channels."""

import healpy
import numpy as np
import pytest

import mcsim
from mcsim import config
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from refusals import refused

NSIDE = 8
NPIX = 12 * NSIDE**2
NORTH = np.arange(NPIX) < NPIX // 2


def run_with(splits=("a", "b"), split_by="time", map=None, **changes):
    channel = {
        "name": "W1",
        "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 700.0, "fwhm_minor_arcmin": 500.0},
        "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 20.0, "line_of_sight": "A"},
        "noise": {"sigma0_uk": 2.0},
    }
    return config.load(
        {
            "name": "split",
            "sky": {"spectrum": "wmap7", "lmax": 16},
            "map": {"nside": NSIDE, "splits": list(splits), "split_by": split_by} | (map or {}),
            "channel": [channel | changes],
            "ensemble": {"seed": 5},
        }
    )


def maps_of(run):
    return survey(run).channels[0].maps


def test_rings_share_the_moments_and_divide_the_hits():
    whole, (one, other, third) = maps_of(run_with(()))[0], maps_of(run_with("abc", "rings"))
    for part in (one, other, third):
        assert np.array_equal(part.moments.w, whole.moments.w)
        assert part.moments.hits == pytest.approx(whole.moments.hits / 3.0)
        assert part.noise_uk == pytest.approx(np.sqrt(3.0) * whole.noise_uk)


def test_samples_of_rings_are_those_of_every_other_ring():
    """Both routes agree as they do for the whole survey: 5 % of the sky at this sampling."""
    run = run_with("ab", "rings", noise={"sigma0_uk": 0.0})
    shared = survey(run)
    by_sample = [made for _, made in sampled.maps(shared, 0, epsilon=1e-4)]
    seen = np.all([each != healpy.UNSEEN for each in by_sample], axis=0)
    assert seen.mean() > 0.99
    for own, default in zip(by_sample, simulate.maps(shared, 0), strict=True):
        assert np.std((own - default)[seen]) < 0.2 * np.std(own[seen])
    assert not np.array_equal(*by_sample)


def test_sets_are_of_the_whole_survey_with_their_lines_of_sight():
    scan = {"kind": "hit_averaged", "model": "wmap_focal_plane", "sample_period_s": 20.0}
    sets = maps_of(run_with(("W1A", "V1A"), "sets", scan=scan | {"line_of_sight": "{split}"}))
    for name, made in zip(("W1A", "V1A"), sets, strict=True):
        alone = maps_of(run_with((), scan=scan | {"line_of_sight": name}))[0]
        assert np.array_equal(made.moments.hits, alone.moments.hits)
        assert np.array_equal(made.moments.w, alone.moments.w)
    assert not np.array_equal(sets[0].moments.w, sets[1].moments.w)


def test_sets_of_one_detector_see_the_whole_survey():
    whole, sets = maps_of(run_with(()))[0], maps_of(run_with("ab", "sets"))
    assert all(np.array_equal(each.moments.hits, whole.moments.hits) for each in sets)


def test_splits_have_their_own_noise():
    run = run_with("abc", split_noise={"b": {"sigma0_uk": 6.0}, "c": {"kind": "depth", "depth_uk_arcmin": 50.0}})
    a, b, c = maps_of(run)
    assert a.noise_uk * np.sqrt(a.moments.hits) == pytest.approx(2.0 * (a.moments.hits > 0))
    assert b.noise_uk * np.sqrt(b.moments.hits) == pytest.approx(6.0 * (b.moments.hits > 0))
    assert c.noise_uk == pytest.approx(50.0 / np.rad2deg(healpy.nside2resol(NSIDE)) / 60.0 * (c.moments.hits > 0))
    assert all(m.noise_uk is None for m in maps_of(mcsim.RunConfig(**{**vars_of(run), "channels": quiet(run)})))


def vars_of(run):
    return {key: getattr(run, key) for key in ("name", "sky", "map", "biposh", "ensemble")}


def quiet(run):
    return tuple(channel.without_noise() for channel in run.channels)


def test_a_split_may_have_a_file_of_its_own(tmp_path):
    np.save(tmp_path / "hits_b.npy", np.full(NPIX, 4.0))
    run = run_with(split_noise={"b": {"sigma0_uk": 6.0, "hits": str(tmp_path / "hits_{split}.npy")}})
    own = maps_of(run)[1]
    assert own.noise_uk == pytest.approx(3.0 * (own.moments.hits > 0))
    assert own.moments.hits == pytest.approx(4.0 * (own.moments.hits > 0))


def test_channels_have_their_own_masks():
    run = run_with((), mask=NORTH.astype(float), map={"mask": (~NORTH).astype(float)})
    assert np.array_equal(maps_of(run)[0].weight > 0, NORTH)
    soft = run_with((), mask=NORTH.astype(float), map={"mask_apodisation_deg": 10.0})
    assert len(np.unique(maps_of(soft)[0].weight)) > 2


def test_new_keys_leave_the_hash_of_runs_without_them():
    plain = config.science(run_with())
    assert "split_by" not in plain["map"]
    assert {"split_noise", "mask"}.isdisjoint(plain["channel"][0])
    digests = {
        config.digest(run)
        for run in (
            run_with(),
            run_with(split_by="rings"),
            run_with(mask=NORTH.astype(float)),
            run_with(split_noise={"b": {"sigma0_uk": 6.0}}),
        )
    }
    assert len(digests) == 4


def test_runs_are_read_again():
    run = run_with(split_by="sets", mask=NORTH.astype(float), split_noise={"b": {"sigma0_uk": 6.0}})
    assert config.load(config.to_dict(run)) == config.from_json(config.to_json(run)) == run


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"split_noise": {"c": {"sigma0_uk": 1.0}}}, ("channel[W1].split_noise.c", "a", "b")),
        ({"split_noise": {"b": {"sigma_uk": 1.0}}}, ("channel[W1].split_noise.b.sigma_uk", "sigma0_uk")),
        ({"split_by": "years"}, ("map.split_by", "years", "time", "rings", "sets")),
        ({"splits": (), "split_by": "rings"}, ("map", "split_by", "splits")),
        ({"mask": "none.fits"}, ("channel[W1].mask", "none.fits")),
        (
            {"splits": (), "scan": {"kind": "hit_averaged", "model": "wmap", "line_of_sight": "{split}"}},
            ("channel[W1].scan.line_of_sight", "{split}", "map.splits"),
        ),
        (
            {
                "split_by": "rings",
                "scan": {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1"},
                "noise": {"sigma0_uk": 1.0},
            },
            ("map.split_by", "rings", "channel[W1].scan", "differencing"),
        ),
        (
            {
                "scan": {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1"},
                "noise": {"kind": "depth", "depth_uk_arcmin": 1.0},
            },
            ("noise.kind", "depth", "noise.sigma0_uk"),
        ),
    ],
)
def test_what_cannot_be_is_refused(changes, named):
    with refused(*named):
        run_with(**changes)
