"""Correlated noise: its spectrum, the covariance of its maps, destriping, streams of random numbers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import toeplitz

from mcsim import config
from mcsim.config.noise import NoiseCorrelated
from mcsim.ensemble import plan
from mcsim.instrument.scan import MapGrid, ScanModel
from mcsim.simulation import sampled, simulate, timestream, tod
from mcsim.simulation.channels import check_effects, scan_model
from mcsim.simulation.survey import survey
from refusals import refused

NSIDE = 4
PERIOD_S = 400.0
SCAN = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": PERIOD_S, "line_of_sight": "A"}
NOISE = {"kind": "correlated", "sigma0_uk": 2.0, "f_knee_hz": 5e-4, "f_min_hz": 1e-6, "alpha": 1.5}
DESTRIPED = NOISE | {"map_making": "destriped", "baseline_s": 8000.0}
SHORT_DAYS = 12.0


def run_with(noise=NOISE, splits=(), split_by="time", **changes):
    channel = {"name": "W", "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0}, "scan": SCAN, "noise": noise}
    base = {
        "name": "stripes",
        "sky": {"spectrum": "wmap7", "lmax": 8},
        "map": {"nside": NSIDE, "splits": list(splits), "split_by": split_by},
        "channel": [channel],
        "ensemble": {"realizations": 2, "seed": 3},
    }
    return config.load(base | changes)


def model_of(run, days=SHORT_DAYS):
    return replace(scan_model(run.channels[0], run.channels[0].scan, None), duration_days=days)


def short(noise, days=SHORT_DAYS):
    """Return the noise of a short survey, and the pixel and the time of its samples."""
    run = run_with(noise)
    model, grid = model_of(run, days), MapGrid(NSIDE)
    made = timestream.correlated_noise(run.channels[0].noise, model, grid, "noise/W")
    [chunk] = tod.samples(model, model.select()[0], grid)
    return made, chunk.pixel, chunk.time_s


def pointing(pixel):
    return (pixel[:, None] == np.arange(12 * NSIDE**2)).astype(float)


def formula(frequency, noise):
    ratio = (frequency**2 + noise.f_knee_hz**2) / (frequency**2 + noise.f_min_hz**2)
    return noise.sigma0_uk**2 * ratio ** (noise.alpha / 2.0)


def autocovariance(noise, number, period_s=PERIOD_S):
    """Return that of the formula, by a transform over a time much longer than 1 / f_min."""
    length = 2**18
    return np.fft.irfft(formula(np.fft.rfftfreq(length, period_s), noise))[:number]


@pytest.mark.parametrize("alpha", [1.0, 1.7, 2.0])
def test_the_spectrum_of_the_samples_is_that_of_the_formula(alpha):
    """Averages of 64 periodograms in bins of at least 8 degrees of freedom each: 4.5 sigma, and the filter's 4 %."""
    noise = NoiseCorrelated(sigma0_uk=3.0, f_knee_hz=0.5, f_min_hz=0.02, alpha=alpha)
    length, number = 4096, 64
    following = timestream.noise_samples(noise, 10.0, np.random.default_rng(1))
    pieces = np.stack([following(length) for _ in range(number)]) * np.hanning(length)
    power = np.mean(np.abs(np.fft.rfft(pieces)) ** 2, axis=0) / np.sum(np.hanning(length) ** 2)
    frequency = np.fft.rfftfreq(length, 0.1)
    for low, high in ((8, 20), (20, 60), (60, 200), (200, 600), (600, 2000)):
        expected = formula(frequency[low:high], noise)
        sigma = np.sqrt(1.5 / number / (high - low))  # a Hann window correlates neighbours
        assert np.mean(power[low:high] / expected) == pytest.approx(1.0, abs=4.5 * sigma + 0.04)


def test_the_noise_is_stationary_from_the_first_sample():
    noise = NoiseCorrelated(sigma0_uk=1.0, f_knee_hz=0.5, f_min_hz=0.05, alpha=1.5)
    draws = 1000
    first = [timestream.noise_samples(noise, 10.0, np.random.default_rng(n))(1)[0] for n in range(draws)]
    expected = autocovariance(noise, 1, 0.1)[0]
    assert np.mean(np.square(first)) == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 / draws) + 0.04)


def test_pieces_make_the_same_noise():
    noise = NoiseCorrelated(sigma0_uk=1.0, f_knee_hz=0.5, f_min_hz=0.05, alpha=1.5)
    whole, cut = (timestream.noise_samples(noise, 10.0, np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(whole(1000), np.concatenate([cut(n) for n in (1, 499, 500)]))


def gls(pixel, time_s, baseline_s):
    """Return the matrix from samples to the destriped map, by dense least squares with offsets of any size."""
    p = pointing(pixel)
    f = (np.floor(time_s / baseline_s)[:, None] == np.arange(int(time_s[-1] // baseline_s) + 1)).astype(float)
    without = np.eye(len(pixel)) - f @ np.linalg.pinv(f)
    made = np.linalg.pinv(p.T @ without @ p, rcond=1e-9, hermitian=True) @ p.T @ without
    hits = p.sum(axis=0)
    return np.where(hits[:, None] > 0, made - (hits @ made) / hits.sum(), 0.0)


def binned(pixel):
    p = pointing(pixel)
    hits = p.sum(axis=0)
    return np.divide(p.T, hits[:, None], out=np.zeros_like(p.T), where=hits[:, None] > 0)


def test_destriping_is_the_generalised_least_squares_solution():
    made, pixel, time_s = short(DESTRIPED)
    rng = np.random.default_rng(5)
    samples = rng.standard_normal(pixel.size) + 100.0 * np.sin(time_s / 1e5)
    sums = np.bincount(pixel, weights=samples, minlength=made.hits.size)
    baseline = np.floor(time_s / 8000.0).astype(int)
    in_baselines = np.bincount(baseline, weights=samples, minlength=made.pairs.shape[0])
    found = timestream.destriped(sums, in_baselines, made.pairs, made.hits)
    assert found == pytest.approx(gls(pixel, time_s, 8000.0) @ samples, abs=1e-7)
    assert np.std(found) < 0.2 * np.std(binned(pixel) @ samples)


def test_destriping_leaves_a_sky_as_it_is():
    """But for its mean, and for what is not one value per pixel."""
    made, pixel, time_s = short(DESTRIPED)
    sky = np.sin(np.arange(made.hits.size))
    samples, baseline = sky[pixel], np.floor(time_s / 8000.0).astype(int)
    sums = np.bincount(pixel, weights=samples, minlength=made.hits.size)
    found = timestream.destriped(sums, np.bincount(baseline, samples, made.pairs.shape[0]), made.pairs, made.hits)
    mean = np.sum(made.hits * sky) / made.hits.sum()
    assert found[made.hits > 0] == pytest.approx((sky - mean)[made.hits > 0], abs=1e-7)


@pytest.mark.parametrize("noise", [NOISE, DESTRIPED], ids=["binned", "destriped"])
def test_the_covariance_of_maps_is_that_of_brute_force(noise):
    """Eigenmodes of the expected covariance have its eigenvalues for their variance: 4 sigma, and the filter's 4 %."""
    made, pixel, time_s = short(noise)
    matrix = binned(pixel) if noise is NOISE else gls(pixel, time_s, 8000.0)
    expected = matrix @ toeplitz(autocovariance(made.noise, pixel.size)) @ matrix.T
    draws = 150
    maps = np.stack([made.draw(1, number) for number in range(draws)])
    seen = np.flatnonzero(made.hits > 0)
    found, expected = (maps.T @ maps / draws)[np.ix_(seen, seen)], expected[np.ix_(seen, seen)]
    value, mode = np.linalg.eigh(expected)
    kept = value > 1e-6 * value[-1]
    ratio = np.diag(mode[:, kept].T @ found @ mode[:, kept]) / value[kept]
    assert np.abs(ratio - 1.0).max() < 5.0 * np.sqrt(2.0 / draws) + 0.04
    assert ratio.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / draws / kept.sum()) + 0.04)
    variance = np.diag(expected)
    z = (found - expected) / np.sqrt((np.outer(variance, variance) + expected**2) / draws)
    assert np.abs(z).max() < 6.0


def test_destriping_takes_stripes_away():
    white = 2.0 / np.sqrt(short(NOISE)[0].hits.clip(1.0))
    levels = [np.mean(short(noise)[0].level_uk / white) for noise in (NOISE, DESTRIPED)]
    assert levels[0] > 3.0 * levels[1]
    assert levels[1] > 0.9


def test_maps_of_a_run_have_the_noise_of_their_realization():
    run = run_with(splits=("a", "b"))
    shared, quiet = survey(run), survey(run_with({"sigma0_uk": 0.0}, splits=("a", "b")))
    sky = simulate.draw_sky(shared, 1)
    noisy = simulate.maps(shared, 1, sky=sky) - simulate.maps(quiet, 1, sky=sky)
    for own, m, other in zip(noisy, shared.channels[0].maps, quiet.channels[0].maps, strict=True):
        seen = m.moments.hits > 0
        assert np.array_equal(m.moments.hits, other.moments.hits)
        assert own[seen] == pytest.approx(m.noise(3, 1)[seen], abs=1e-9)
    assert abs(np.corrcoef(noisy[0], noisy[1])[0, 1]) < 0.5


def test_lines_of_sight_have_noise_of_their_own():
    """Nearly white noise of both sides of the model: the variance is that of all samples."""
    noise = NoiseCorrelated(sigma0_uk=2.0, f_knee_hz=2e-5, f_min_hz=1e-5)
    model = ScanModel.load("wmap").with_lines_of_sight("A", "B").with_sampling(PERIOD_S)
    made = timestream.correlated_noise(noise, model, MapGrid(NSIDE), "noise/W")
    assert made.hits.sum() == 2.0 * model.samples(model.select()[0])
    drawn = made.hits * made.draw(1, 0) ** 2
    assert np.mean(drawn) == pytest.approx(4.0, rel=4.0 * np.sqrt(2.0 / drawn.size) + 0.06)


def test_samples_have_the_noise_of_the_default_route():
    run = run_with()
    noisy, quiet = (sampled.maps(survey(each), 0, epsilon=1e-3)[0][1] for each in (run, run_with({"sigma0_uk": 0.0})))
    assert noisy - quiet == pytest.approx(survey(run).channels[0].maps[0].noise(3, 0), abs=1e-9)


@pytest.mark.parametrize("noise", [NOISE, DESTRIPED], ids=["binned", "destriped"])
def test_another_knee_is_that_of_a_model_that_has_it(noise):
    """Of the same random numbers, bit for bit, in both routes; at no knee the noise is white."""
    effect = [{"name": "noise_knee", "channel": "W", "amplitude": 0.5}]
    moved, own = survey(run_with(noise, effect=effect)), survey(run_with(noise | {"f_knee_hz": 7.5e-4}))
    a, b = (each.making.channels[0].maps[0] for each in (moved, own))
    assert np.array_equal(a.drawn.draw(3, 0), b.drawn.draw(3, 0))
    assert not np.allclose(a.noise(3, 0), survey(run_with(noise)).channels[0].maps[0].noise(3, 0), atol=1e-3)
    quiet = survey(run_with({"sigma0_uk": 0.0}))
    by_default = simulate.maps(moved, 0)[0] - simulate.maps(quiet, 0)[0]
    by_samples = sampled.maps(moved, 0)[0][1] - sampled.maps(quiet, 0)[0][1]
    for found in (by_default, by_samples):
        assert found == pytest.approx(a.noise(3, 0), abs=1e-9)


def test_noise_with_a_knee_at_its_lowest_frequency_is_white():
    made = short(NOISE)[0].with_knee(0.0)
    fresh, number = np.random.default_rng(4), int(np.ceil(1.0 / PERIOD_S / made.noise.f_min_hz))
    found = timestream.noise_samples(made.noise, 1.0 / PERIOD_S, np.random.default_rng(4))(100)
    assert found == pytest.approx(2.0 * fresh.standard_normal(number + 100)[number:], abs=1e-6)


@pytest.mark.parametrize(
    ("noise", "amplitude", "named"),
    [
        ({"sigma0_uk": 2.0}, 0.5, ("noise_knee", "correlated")),
        ({"sigma0_uk": 0.0}, 0.5, ("noise_knee", "correlated")),
        (NOISE, -1.5, ("noise_knee", -1.5)),
    ],
)
def test_a_knee_that_no_noise_has_is_refused(noise, amplitude, named):
    with refused(*named):
        check_effects(run_with(noise, effect=[{"name": "noise_knee", "channel": "W", "amplitude": amplitude}]))


def test_a_knee_beyond_what_the_sampling_shows_is_refused():
    with refused(1.5e-3, 0.5 / PERIOD_S, "scan.sample_period_s"):
        check_effects(run_with(effect=[{"name": "noise_knee", "channel": "W", "amplitude": 2.0}]))


def test_a_diagnosis_may_try_a_knee_beyond_what_the_sampling_shows():
    made = short(NOISE)[0]
    assert made.with_knee(1.0).noise.f_knee_hz == pytest.approx(0.5 / PERIOD_S)
    assert np.isfinite(made.with_knee(1.0).draw(3, 0)).all()


def test_a_survey_that_spins_backwards_has_noise():
    run = run_with(DESTRIPED | {"baseline_s": None})
    model = replace(model_of(run), spin_period_s=-model_of(run).spin_period_s)
    made = timestream.correlated_noise(run.channels[0].noise, model, MapGrid(NSIDE), "noise/W")
    assert np.isfinite(made.draw(1, 0)[made.hits > 0]).all()


def test_chunks_change_no_bit(monkeypatch):
    whole = short(DESTRIPED)[0].draw(1, 2)
    made = short(DESTRIPED)[0]
    monkeypatch.setattr(tod, "CHUNK", 300)
    cut = made.draw(1, 2)
    assert cut == pytest.approx(whole, abs=1e-10)


def test_rings_share_a_time_stream():
    """Slow noise is common to alternate rings: their maps are nearly the same, as those of two halves are not."""
    slow = NOISE | {"f_knee_hz": 1e-3, "alpha": 2.0, "sigma0_uk": 0.1}
    correlation = {}
    for split_by in ("rings", "time"):
        maps = survey(run_with(slow, ("a", "b"), split_by)).channels[0].maps
        a, b = (m.noise(3, 0) for m in maps)
        seen = (maps[0].moments.hits > 5) & (maps[1].moments.hits > 5)
        correlation[split_by] = np.corrcoef(a[seen], b[seen])[0, 1]
    assert correlation["rings"] > 0.8 > 0.6 > abs(correlation["time"])


def test_the_plan_says_what_it_costs():
    text = "\n".join(plan.cost(run_with(DESTRIPED)).lines(2, 1))
    assert f"noise   W 1/f, {365.25 * 86400 / PERIOD_S:.3g} samples" in text
    assert "destriped" in text


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"f_min_hz": 1e-3}, ("f_min_hz", 1e-3, "f_knee_hz", 5e-4)),
        ({"alpha": 2.5}, ("channel[W].noise.alpha", 2.5, 2)),
        ({"baseline_s": 100.0}, ("baseline_s", "binned", "destriped")),
        ({"map_making": "madam"}, ("channel[W].noise.map_making", "madam", "binned", "destriped")),
        ({"sigma0_uk": 0.0}, ("channel[W].noise.sigma0_uk", 0)),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, named):
    with refused(*named):
        run_with(NOISE | changes)


def test_what_the_survey_cannot_show_is_refused(monkeypatch):
    with refused("noise.f_knee_hz", 2e-3, 0.5 / PERIOD_S, "scan.sample_period_s"):
        survey(run_with(NOISE | {"f_knee_hz": 2e-3}))
    with refused("noise.f_min_hz", 1e-9):
        survey(run_with(NOISE | {"f_min_hz": 1e-9}))
    scan = {"kind": "parallel_transport"}
    beam = {"kind": "gaussian", "fwhm_arcmin": 900.0}
    with refused("channel[W].noise.kind", "correlated", "parallel_transport", "hit_averaged"):
        run_with(channel=[{"name": "W", "beam": beam, "scan": scan, "noise": NOISE}])
    monkeypatch.setattr(timestream, "LARGEST", 10)
    with refused(10, "noise.baseline_s", "map.nside"):
        survey(run_with(DESTRIPED | {"baseline_s": 3000.0}))
