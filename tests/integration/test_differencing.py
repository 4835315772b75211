"""Maps from the differences of two beams as a batch: skies, controls, splits, noise, masks, refusals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
from distributed import Client

import mcsim
from mcsim import bipolar, config
from mcsim.ensemble import prediction, runner
from mcsim.ensemble.detectability import sky_fraction
from mcsim.simulation import convolve, differencing, mapmaking, simulate
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from refusals import refused, unnamed

from .conftest import ensemble, table

NSIDE, LMAX = 16, 32
ROUND = {"kind": "gaussian", "fwhm_arcmin": 275.0}
LONG = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 250.0, "angle_deg": 20.0}

# A year at rates that see every pixel of nside 16 in 200,000 samples; the sides are no mirror images.
MODEL = """
schema = 1
name = "toy"
spin_period_s = 129.3
precession_period_s = -3600.0
precession_angle_deg = 22.5
orbit_period_s = 31557600.0
sample_period_s = 157.8
duration_days = 365.25
[[line_of_sight]]
name = "A"
boresight_angle_deg = 70.5
azimuth_deg = 2.0
[[line_of_sight]]
name = "B"
boresight_angle_deg = 68.0
azimuth_deg = 177.0
[pairs]
D = ["A", "B"]
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "toy.toml"
    path.write_text(MODEL)
    return path


@pytest.fixture(scope="module")
def year(model):
    """Configuration of a differencing run; ``scan`` and ``channel`` change those tables, the rest whole sections."""

    def make(scan: dict[str, Any] | None = None, channel: dict[str, Any] | None = None, **sections: Any):
        pair = {"kind": "differencing", "model": str(model), "pair": "D"} | (scan or {})
        return config.load(table(channel=[{"name": "W1", "beam": LONG, "scan": pair} | (channel or {})], **sections))

    return make


def hits(model: Path) -> dict[str, Any]:
    """Both sides' samples without their differences."""
    return {"kind": "hit_averaged", "model": str(model)}


def realize(run: config.RunConfig, r: int = 0) -> dict[str, np.ndarray]:
    return simulate.realize(survey(run), r)


def beam_part(values: dict[str, np.ndarray]) -> np.ndarray:
    return values["biposh"] - values["biposh_circular"]


@pytest.mark.parametrize("x", [0.0, 0.02])
def test_equal_round_beams_recover_the_sky(year, x):
    """No noise: the map is the smoothed sky, its spectrum that of the sky through beam and pixel."""
    run = year({"transmission_imbalance": x}, {"beam": ROUND}, biposh={"iterations": 8}, **ensemble(keep_maps=True))
    shared = survey(run)
    values, sky = simulate.realize(shared, 0), simulate.draw_sky(shared, 0)
    smooth = healpix.synthesis(convolve.circular_alm(sky, shared.channels[0].response)[None], NSIDE, LMAX)[0]
    # The monopole is not seen at x = 0, and to tol / 2 x^2 at others; this sky has none in its a_lm.
    np.testing.assert_allclose(
        values["observed_map"][0], smooth - np.mean(smooth) * (x == 0.0), atol=1e-7 * smooth.std()
    )
    seen = alm_.multiply(sky, shared.channels[0].beam.window, LMAX)
    np.testing.assert_allclose(values["cl"][0, 2:], bipolar.power_spectrum(seen, seen, LMAX)[2:], rtol=1e-5)
    np.testing.assert_array_equal(values["biposh"], values["biposh_circular"])


def test_map_is_that_of_the_whole_beams_solved_at_once(year):
    """The sum of the circular-beam control and of the rest, against one solution for the whole beams."""
    shared = survey(year(**ensemble(keep_maps=True)))
    channel = shared.channels[0]
    assert channel.side_b is not None
    np.testing.assert_array_equal(channel.side_b.beam.blm, channel.beam.mirrored().blm)
    sky = simulate.draw_sky(shared, 3)
    sides = [mapmaking.side_maps(sky, response, NSIDE) for response in (channel.response, channel.side_b.response)]
    (pairs,) = [m.pairs for m in channel.maps]
    expected, report = mapmaking.solve(
        pairs, mapmaking.rhs_from_maps(pairs, [tuple(sides)])[0], rule=mapmaking.StoppingRule(1e-10)
    )
    assert report.converged
    found = simulate.realize(shared, 3)["observed_map"][0]
    np.testing.assert_allclose(found, expected, atol=1e-6 * expected.std())


def test_unequal_round_beams_have_their_own_control(year):
    """Without power in m > 0 there is nothing to add to the control; its map is neither that of A nor that of B."""
    other = {"kind": "gaussian", "fwhm_arcmin": 200.0}
    equal, unequal = (realize(year(channel={"beam": ROUND, "beam_b": b})) for b in (ROUND, other))
    np.testing.assert_array_equal(unequal["biposh"], unequal["biposh_circular"])
    wide, narrow = (gaussian_window(fwhm) for fwhm in (275.0, 200.0))
    ratio = np.sqrt(unequal["cl"][0, 25:] / equal["cl"][0, 25:])
    mean = 0.5 * (1.0 + narrow / wide)[25:]
    # To leading order each side contributes half of the map, whatever its beam.
    np.testing.assert_allclose(ratio, mean, rtol=0.05)
    assert np.all(ratio > 1.05)


def gaussian_window(fwhm_arcmin: float) -> np.ndarray:
    ell, sigma = np.arange(LMAX + 1), np.deg2rad(fwhm_arcmin / 60.0) / np.sqrt(8.0 * np.log(2.0))
    return np.exp(-0.5 * ell * (ell + 1) * sigma**2)


def test_a_dipole_leaves_the_control_as_the_circular_parts_see_it(year):
    """An effect that does nothing adds it to the sky and takes it off again, of each part what that part sees."""
    blm = mcsim.Beam.elliptical(300.0, 250.0, lmax=LMAX).blm.copy()
    blm[1, 1:] = 0.1 * blm[0, 1:]
    lopsided, sky = mcsim.Beam.from_blm(blm), {"spectrum": "wmap7", "lmax": LMAX, "dipole_uk": 3364.5}
    idle = {"name": "calibration", "channel": "W1", "amplitude": 0.0}
    found, wanted = (realize(year(channel={"beam": lopsided}, sky=sky, effect=one)) for one in ([idle], []))
    for name, values in wanted.items():  # the residual of a map-making is 1e-8
        np.testing.assert_allclose(found[name], values, rtol=0.0, atol=1e-6 * np.nanmax(abs(values)))


def test_opposite_beams_cancel_what_equal_ones_show(year):
    """Side B's ellipse across side A's: the mean of the two b_l2 vanishes, and with it A^{20}."""
    along = LONG | {"angle_deg": 0.0}
    across = LONG | {"angle_deg": 90.0}
    same, opposite = (realize(year(channel={"beam": along, "beam_b": b})) for b in (along, across))
    mode = [m.name for m in survey(year()).estimator.modes].index("L2M0d0")
    scale = np.sum(np.abs(beam_part(same)[0, mode, 2:]))
    assert np.sum(np.abs(beam_part(opposite)[0, mode, 2:])) < 0.3 * scale
    mirror = realize(year(channel={"beam": along}))
    # An ellipse along or across the scan is its own mirror image.
    np.testing.assert_allclose(beam_part(mirror)[0, mode, 2:], beam_part(same)[0, mode, 2:], atol=1e-9 * scale)


def test_noise_is_shared_with_the_control_and_independent_in_splits(year):
    splits = {"nside": NSIDE, "splits": ["a", "b"], "pixel_window": "none"}
    quiet, noisy = (survey(year(channel={"noise": {"sigma0_uk": sigma}}, map=splits)) for sigma in (0.0, 1e5))
    assert noisy.map_names == ("W1:a", "W1:b")
    assert noisy.channels[0].maps[0].noise_uk is None
    hits = [m.moments.hits for m in noisy.channels[0].maps]
    assert hits[0].sum() == hits[1].sum() == noisy.channels[0].maps[0].pairs.samples * 2
    # The control has the noise of its map; what the beam adds to a_lm is the same with and without noise.
    alone, loud = (simulate.realize(shared, 0) for shared in (quiet, noisy))
    assert np.all(loud["cl"][[0, 2], 2:] > 1e3 * alone["cl"][[0, 2], 2:])
    np.testing.assert_allclose(loud["cl_circular"][0, 2:], loud["cl"][0, 2:], rtol=0.05)
    cl = np.mean([simulate.realize(noisy, r)["cl"] for r in range(12)], axis=0)[:, 10:]
    weight = 2.0 * np.arange(10, LMAX + 1) + 1.0
    auto, cross, _ = (cl * weight).sum(axis=1) / weight.sum()
    # Well above the scales of the separation of the beams the noise is white with sigma0^2 / hits per pixel.
    white = 1e10 * np.mean(1.0 / hits[0]) * 4.0 * np.pi / hits[0].size
    assert abs(auto / white - 1.0) < 0.1
    assert abs(cross) < 5.0 * auto / np.sqrt(12 * weight.sum())


def test_masked_batch_has_a_mean_field_which_the_difference_is_free_of(
    year, model: Path, client: Client, tmp_path: Path
):
    """The mask alone makes an A^{20} far above the beam's; the paired difference shows the beam's."""
    theta, _ = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
    healpy.write_map(tmp_path / "m.fits", (np.abs(theta - np.pi / 2) > 0.3).astype(float), dtype=np.float64)
    masked = {"nside": NSIDE, "mask": str(tmp_path / "m.fits"), "mask_apodisation_deg": 15.0}
    assert runner.run(year(map=masked), tmp_path / "s.zarr", workers=client).failures == ()
    found = mcsim.open_summary(tmp_path / "s.zarr").load().sel(mode="L2M0d0", pair="W1,W1")
    bins = slice(1, 3)
    mean = {k: found[f"biposh_{k}_binned_mean"].values.real[bins] for k in ("circular", "difference")}
    assert np.all(mean["circular"] > 10.0 * found["biposh_circular_binned_standard_error"].values[bins])
    assert np.all(mean["circular"] > 5.0 * np.abs(mean["difference"]))
    averaged = table(map=masked, channel=[{"name": "W1", "beam": LONG, "scan": hits(model)}])
    predicted = prediction.predict(averaged).sel(mode="L2M0d0", pair="W1,W1")["biposh_difference_binned_mean"]
    # The beam's part under the mask is that of the moments W^2 w_s; ten skies leave 5 % of it, what differencing adds
    # to the hit average at such low l and the coupling by the mask itself as much again.
    np.testing.assert_allclose(mean["difference"], predicted.values.real[bins], rtol=0.2)
    fraction = sky_fraction(survey(year(map=masked)), (0, 0))
    assert 0.5 < fraction < 1.0 - np.sin(0.3)


def test_chunks_and_slices_give_the_same_bits(year, client: Client, tmp_path: Path):
    stores = []
    for name, chunk, parts in (("a", 4, [None]), ("b", 1, [slice(2, 3), slice(0, 2), slice(3, 4)])):
        run = year(channel={"noise": {"sigma0_uk": 10.0}}, compute={"chunk": chunk}, **ensemble(4))
        for part in parts:
            runner.run(run, tmp_path / f"{name}.zarr", realizations=part, workers=client)
        stores.append(mcsim.open_ensemble(tmp_path / f"{name}.zarr").load())
    for variable in ("biposh", "biposh_circular", "cl", "cl_circular"):
        np.testing.assert_array_equal(stores[0][variable], stores[1][variable])


def test_maps_that_do_not_converge_are_failures_and_can_be_made_later(year, client: Client, tmp_path: Path):
    hasty = year({"max_iterations": 3}, ensemble={"realizations": 2, "seed": 1})
    result = runner.run(hasty, tmp_path / "s.zarr", workers=client)
    assert (result.finished, [failure.realization for failure in result.failures]) == (0, [0, 1])
    assert unnamed(result.failures[0].reason, "map W1", "3 iterations", "1e-08", "max_iterations") == []
    patient = year(ensemble={"realizations": 2, "seed": 1})
    assert runner.run(patient, tmp_path / "s.zarr", workers=client).finished == 2


def test_threads_do_not_change_a_map(year):
    shared = survey(year(channel={"noise": {"sigma0_uk": 10.0}}, **ensemble(keep_maps=True)))
    one, two = (simulate.realize(shared, 0, nthreads)["observed_map"] for nthreads in (1, 2))
    # ducc0's transforms may differ in the last bits.
    np.testing.assert_allclose(one, two, rtol=1e-9)


def test_part_of_the_sky(year, model: Path, tmp_path: Path):
    """Pixels that were not observed have no weight and are marked in kept maps."""
    short = tmp_path / "short.toml"
    short.write_text(MODEL.replace("duration_days = 365.25", "duration_days = 20.0").replace("157.8", "9.1"))
    run = year({"model": str(short), "tolerance": 1e-4}, **ensemble(keep_maps=True))
    shared = survey(run)
    (m,) = shared.channels[0].maps
    unseen = m.moments.hits == 0
    assert 0.05 < unseen.mean() < 0.9
    assert m.weight is not None
    values = simulate.realize(shared, 0)
    np.testing.assert_array_equal(values["observed_map"][0] == healpy.UNSEEN, unseen)
    assert np.all(np.isfinite(values["cl"]))


@pytest.mark.parametrize(
    ("scan", "named"),
    [
        ({"pair": "E"}, ("toy", "'E'", "D")),
        ({"sample_period_s": 1e9}, ("toy", "1e+09 s", "duration_days")),
    ],
)
def test_scans_that_cannot_be(year, scan, named):
    with refused(*named):
        survey(year(scan))


@pytest.mark.parametrize(("period_s", "other_s", "missed"), [(129.3, 50.0, True), (50.0, 129.3, False)])
def test_few_phases_of_the_spin_are_those_of_the_pair(year, model, tmp_path, recwarn, period_s, other_s, missed):
    """Not those of the lines of sight that the model takes where none are asked for."""
    line = f'[[line_of_sight]]\nname = "C"\nboresight_angle_deg = 60.0\nsample_period_s = {other_s}\n'
    text = model.read_text().replace("duration_days = 365.25", 'duration_days = 50.0\ndefault_lines = ["C"]')
    path = tmp_path / "few.toml"
    path.write_text(text.replace("= 157.8", f"= {period_s}").replace("[pairs]", f"{line}[pairs]"))
    survey(year({"model": str(path)}))
    assert any("phase" in str(one.message) for one in recwarn) == missed


@pytest.mark.parametrize("other", [{}, {"beam_b": LONG | {"angle_deg": 70.0, "m_max": 0}}])
def test_orders_that_were_left_out_come_back_on_both_sides(year, other):
    effect = config.Effect(name="beam_noncircularity", channel="W1", parameters={"amplitude": 1.0})
    fiducial = year(channel={"beam": LONG | {"m_max": 0}} | other)
    whole = year(channel={side: beam | {"m_max": 4} for side, beam in ({"beam": LONG} | other).items()})
    found, expected = survey(replace(fiducial, effects=(effect,))), survey(whole)
    for a, b in zip(found.channels, expected.channels, strict=True):
        np.testing.assert_array_equal(a.beam.blm, b.beam.blm)
        np.testing.assert_array_equal(a.side_b.beam.blm, b.side_b.beam.blm)


def test_noise_and_signals_of_samples_of_one_beam_are_refused(year):
    for name in ("excess_noise", "orbital_dipole", "gain_spin"):
        with refused(name, "W1"):
            survey(year(effect=[{"name": name, "channel": "W1", "amplitude": 0.1}]))
    split = {"name": "split_calibration", "channel": "W1", "amplitude": 0.1, "split": "b"}
    with refused("split_calibration", "W1", "differences"):
        survey(year(effect=[split], map={"nside": NSIDE, "splits": ["a", "b"]}))


def test_survey_of_another_scan_has_no_side_b():
    shared: Survey = survey(config.load(table()))
    assert shared.channels[0].side_b is None
    assert sky_fraction(shared, (0, 0)) == 1.0


def test_words_and_time_of_a_run(year):
    mirror, own = year(), year(channel={"beam_b": ROUND})
    assert "mirrored" in differencing.sides(mirror)["W1"]
    assert differencing.sides(own) == {"W1": "its own beam (beam_b)"}
    assert differencing.sides(config.load(table())) == {}
    # 200,000 samples in the year.
    assert differencing.seconds(mirror) == pytest.approx(differencing.SECONDS_PER_SAMPLE * 200_000, rel=1e-3)
    assert differencing.seconds(config.load(table())) == 0.0
