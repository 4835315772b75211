"""Nuisances: what is drawn, what is simulated, how the tests marginalise them, and their posterior."""

from dataclasses import replace

import healpy
import numpy as np
import pytest
from scipy import stats

import mcsim
from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of, simulated_maps
from mcsim.datavector.candidate import Candidate, numbered
from mcsim.datavector.nuisances import Regression, half_given_other, with_nuisances, with_priors
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element
from mcsim.diagnosis.api import _key, describe
from mcsim.information.result import marginalised
from mcsim.simulation import simulate
from mcsim.simulation.nuisance import DisturbedSurvey, Nuisance, check_nuisances, draws, nuisances_of, tables
from mcsim.simulation.survey import survey
from mcsim.sphere.sky import dipole_alm
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import TAIL, calibrate, calibrate_on, global_test
from refusals import refused

NSIDE, LMAX = 8, 16


def model(*nuisances, **changes):
    table = two_channels("nuisances", lmax=LMAX, nside=NSIDE, fwhm_arcmin=800.0, period_s=300.0)
    table |= {"map": {"nside": NSIDE, "splits": ["a", "b"]}, "nuisance": list(nuisances)}
    return config.load(table | changes)


MANY = (
    {"effect": "calibration", "channel": "V1", "width": 0.003},
    {"effect": "beam_width", "channel": "W1", "width": 0.01},
    {"effect": "beam_ellipticity", "channel": "W1", "width": 0.05},
    {"effect": "pixelization", "channel": "V1", "width": 0.1},
    {"effect": "noise_level", "channel": "W1", "width": 0.05},
    {"effect": "gain_drift", "channel": "W1", "width": [0.001, 0.002]},
    {"effect": "dipole_residual", "channel": "V1", "width": 5.0},
    {"effect": "monopole_residual", "channel": "V1", "width": 5.0},
    {"effect": "spectrum", "width": 0.05},
    {
        "effect": "foreground_residual",
        "width": 4.0,
        "parameters": {"spectral_index": -2.0},
        "parameter_widths": {"spectral_index": 0.5},
    },
    {"effect": "point_sources", "width": 0.01},
)
IN_B = {"effect": "split_calibration", "channel": "V1", "width": 0.003, "parameters": {"split": "b"}}
STEPS = [{"kind": "smooth", "fwhm_arcmin": 1200.0}, {"kind": "subtract_dipole"}]


def test_maps_of_rings_have_the_drift_of_their_own():
    drifting = {"effect": "gain_drift", "channel": "W1", "width": [0.001, 0.002]}
    run = model(drifting, map={"nside": NSIDE, "splits": ["a", "b"], "split_by": "rings"})
    found = {channel.name: channel.maps for channel in DisturbedSurvey.of(run).at(0).channels}
    acting = replace(run, effects=tuple(tables(run, run.ensemble.seed, 0)))
    for channel in survey(acting).channels:
        if channel.name == "W1":
            for one, other in zip(found["W1"], channel.maps, strict=True):
                np.testing.assert_allclose(one.gain, other.gain, atol=1e-12)
            assert np.abs(channel.maps[0].gain - channel.maps[1].gain).max() > 1e-6


@pytest.mark.parametrize("preparation", [[], STEPS], ids=["plain", "prepared"])
def test_a_disturbed_survey_is_that_of_a_run_with_the_effects_that_are_drawn(preparation):
    run = model(*MANY, IN_B, preparation=preparation)
    own = {"name": "gain_drift", "channel": "W1", "amplitude": 0.003}
    run = config.load(config.to_dict(run) | {"effect": [own]})
    disturbed = DisturbedSurvey.of(run)
    for realization in (0, 5):
        drawn = tables(run, run.ensemble.seed, realization)
        acting = replace(run, effects=(*run.effects, *drawn))
        expected = simulate.maps(survey(acting, orders=disturbed.survey.channels[0].maps[0].moments.smax), realization)
        shared = disturbed.at(realization)
        found = simulate.maps(shared, realization)
        assert np.abs(found - expected).max() < 1e-9
        # They are not small, and another realization has others.
        plain = simulate.maps(disturbed.survey, realization)
        assert np.all(np.std(found - plain, axis=1) > (0.1 if preparation else 1.0))
        assert np.array_equal(simulate.realize(shared, realization)["cl"], simulate.realize(shared, realization)["cl"])


def test_a_signal_follows_the_parameters_that_are_drawn_with_it():
    lobe = {"effect": "sidelobe_pickup", "channel": "W1", "width": 0.001}
    run = model(lobe | {"parameter_widths": {"angle_deg": 15.0, "galaxy_uk": 200.0}})
    disturbed = DisturbedSurvey.of(run)
    for realization in (0, 1):
        drawn = tables(run, run.ensemble.seed, realization)
        expected = survey(replace(run, effects=tuple(drawn))).channels[1].maps
        for one, other in zip(disturbed.at(realization).channels[1].maps, expected, strict=True):
            assert np.std(other.signal_uk) > 0.01
            np.testing.assert_allclose(one.signal_uk, other.signal_uk, atol=1e-9)


def test_a_signal_is_that_of_where_drawn_offsets_leave_the_samples():
    added = {"effect": "orbital_dipole", "channel": "V1", "width": [0.5, 0.5]}
    run = model(added, {"effect": "pixelization", "channel": "V1", "width": 0.5})
    own = {"name": "orbital_dipole", "channel": "V1", "amplitude": 0.2}
    run = config.load(config.to_dict(run) | {"effect": [own]})
    found = DisturbedSurvey.of(run).at(0).channels
    for one, other in zip(found, survey(replace(run, effects=_with_drawn(run))).channels, strict=True):
        for m, expected in zip(one.maps, other.maps, strict=True):
            assert (m.signal_uk is None) == (expected.signal_uk is None)
            if m.signal_uk is not None:
                np.testing.assert_allclose(m.signal_uk, expected.signal_uk, atol=1e-9)


def _with_drawn(run):
    return (*run.effects, *tables(run, run.ensemble.seed, 0))


def test_a_calibration_multiplies_sky_and_dipole_in_all_pixels():
    run = model()
    off = replace(run, effects=(config.Effect(name="calibration", channel="W1", parameters={"amplitude": 0.01}),))
    quiet = [replace(one, channels=tuple(replace(c, noise=config.Noise()) for c in one.channels)) for one in (run, off)]
    before, after = (simulate.maps(survey(one), 0) for one in quiet)
    site = survey(run).channels[1].site
    alm = dipole_alm(site.dipole_uk, LMAX)
    dipole = healpy.alm2map(alm * healpy.almxfl(np.ones_like(alm), site.beam.window), NSIDE, pixwin=False)
    np.testing.assert_array_equal(after[:2], before[:2])
    # The window of the pixels and the offset of their samples change the dipole by some per cent.
    change = after[2] - 1.01 * before[2]
    assert change @ dipole / (dipole @ dipole) == pytest.approx(0.01, rel=0.02)
    assert np.std(change - 0.01 * dipole) < 0.05 * np.std(change)
    with refused("calibration", -1.5):
        systematics.get("calibration")(amplitude=-1.5).beam(site.beam, site)


@pytest.mark.slow
def test_draws_have_the_widths_and_do_not_depend_on_each_other():
    run = model(*MANY)
    known = nuisances_of(run)
    rows = np.stack([draws(known, 3, r)[0] for r in range(4000)])
    mean, sigma = (np.concatenate([getattr(one, key) for one in known]) for key in ("mean", "sigma"))
    assert rows.shape[1] == len(mean) == 1 + 1 + 2 + 1 + 1 + 2 + 3 + 1 + 6 + 1 + 1
    assert np.all(np.abs(rows.mean(axis=0) - mean) < 4.0 * sigma / np.sqrt(4000))
    assert np.all(np.abs(rows.std(axis=0) / sigma - 1.0) < 4.0 * np.sqrt(0.75 / 4000))
    assert np.abs(np.corrcoef(rows.T) - np.eye(len(mean))).max() < 4.5 / np.sqrt(4000)
    assert np.all(rows[:, -1] > 0.0)  # sources add power
    indices = [draws(known, 3, r)[1][-2][1].spectral_index for r in range(400)]
    assert abs(np.mean(indices) + 2.0) < 4.0 * 0.5 / 20.0
    assert abs(np.std(indices) - 0.5) < 4.0 * 0.5 / np.sqrt(800)
    wider = nuisances_of(model({**MANY[0], "width": 0.03}, *MANY[1:3]))
    found = np.stack([draws(wider, 3, r)[0] for r in range(20)])
    np.testing.assert_allclose(found, rows[:20, :4] * [10.0, 1.0, 1.0, 1.0])
    # The effect is the one that the coordinates say.
    for one, effect in draws(known, 3, 7)[1][2:3]:
        np.testing.assert_allclose(one.effect.parametrization.coordinates(effect), rows[7, 2:4])


def test_a_limit_takes_the_scatter_of_a_prior_of_one_sign():
    """Draws of |z| scatter by 0.6 of the width, which a limit took whole: sigma was up to 1.7 times too large."""
    run = model({"effect": "pointing_jitter", "channel": "W1", "width": 4000.0}, map={"nside": NSIDE})
    drawn = np.array([draws(nuisances_of(run), 3, r)[0][0] for r in range(1000)])
    names = ("beam_width", "pointing_jitter")
    both, found = (
        mcsim.limit(one, settings=mcsim.LimitSettings(only=names[:many], dense=True))
        for one, many in ((replace(run, nuisances=()), 2), (run, 1))
    )
    rows = [both.components.index(f"{name} (W1)/0") for name in names]
    fisher = both.fisher[np.ix_(rows, rows)]
    ends = (drawn.std() * (1.0 + sign * 4.0 * np.sqrt(0.75 / drawn.size)) for sign in (-1.0, 1.0))
    low, high = (1.0 / np.sqrt(marginalised(fisher, [1], [width])[0, 0]) for width in ends)
    sigma = next(one.sigma for one in found.effects if one.channel == "W1")
    assert low < sigma < high


@pytest.mark.parametrize(
    ("nuisance", "named"),
    [
        ({"effect": "calibraton", "width": 0.1}, ("calibration",)),
        ({"effect": "calibration", "width": 0.1}, ("calibration", 'channel = "V1"')),
        ({"effect": "calibration", "channel": "Q1", "width": 0.1}, ("calibration", "Q1", "V1")),
        ({"effect": "spectrum", "channel": "V1", "width": 0.1}, ("spectrum", "V1")),
        ({"effect": "spectrum", "width": [0.1, 0.1]}, ("spectrum", 6)),
        ({"effect": "spectrum", "width": 0.3}, ("spectrum", "width")),
        ({"effect": "noise_level", "channel": "V1", "width": 0.3}, ("noise_level", "width")),
        ({"effect": "calibration", "channel": "V1", "width": 0.0}, ("nuisance[0].width[0]", 0)),
        ({"effect": "calibration", "channel": "V1", "width": []}, ("nuisance[0].width",)),
        ({"effect": "calibration", "channel": "V1"}, ("nuisance[0].width",)),
        ({"effect": "calibration", "channel": "V1", "width": 0.1, "amplitude": 1.0}, ("nuisance[0].amplitude",)),
        (
            {"effect": "beam_ellipticity", "channel": "V1", "width": 0.1, "parameters": {"angle_deg": 3.0}},
            ("beam_ellipticity", "angle_deg"),
        ),
        (
            {"effect": "foreground_residual", "width": 1.0, "parameter_widths": {"template": 3.0}},
            ("foreground_residual", "template", "parameter_widths"),
        ),
        (
            {"effect": "foreground_residual", "width": 1.0, "parameters": {"template": "absent.fits"}},
            ("nuisance[0].parameters.template",),
        ),
        # What acts on nothing that the channel has did nothing, in silence.
        ({"effect": "transmission_imbalance", "channel": "V1", "width": 0.01}, ("V1", "differencing")),
        ({"effect": "noise_knee", "channel": "V1", "width": 0.1}, ("noise_knee", "correlated")),
    ],
)
def test_what_cannot_be_a_nuisance_is_refused(nuisance, named):
    with refused(*named):
        check_nuisances(model(nuisance))


def test_a_nuisance_is_declared_once():
    one = {"effect": "calibration", "channel": "V1", "width": 0.01}
    check_nuisances(model(one, one | {"channel": "W1"}))
    with refused("calibration", "V1", "twice"):
        check_nuisances(model(one, one | {"width": 0.02}))
    # A parameter that is spelled out is the same as its default, and another value another nuisance.
    one = {"effect": "foreground_residual", "width": 3.0}
    usual = systematics.get("foreground_residual")().spectral_index
    with refused("foreground_residual", "twice"):
        check_nuisances(model(one, one | {"parameters": {"spectral_index": usual}}))
    check_nuisances(model(one, one | {"parameters": {"spectral_index": usual + 1.0}}))


def test_nuisances_are_part_of_a_diagnosis_and_not_of_an_ensemble(tmp_path):
    healpy.write_map(tmp_path / "t.fits", np.arange(192.0), coord="E", dtype=np.float64)
    given = {"effect": "foreground_residual", "width": 2.0, "parameters": {"template": "t.fits"}}
    plain = model()
    run = config.load(config.to_dict(plain) | {"nuisance": [given]}, base=tmp_path)
    assert run.nuisances[0].parameters["template"] == str(tmp_path / "t.fits")
    assert config.load(config.to_dict(run)) == config.from_json(config.to_json(run)) == run
    assert config.digest(run) == config.digest(plain)
    assert "nuisance" not in config.science(plain)
    settings = DiagnosisSettings(without=tuple(name for name in systematics.catalogue() if name != "noise_level"))
    analysis = analysis_of(run, settings.without, settings=settings)
    key = _key(run, analysis)
    assert _key(plain, analysis) != key
    assert _key(replace(run, nuisances=(replace(run.nuisances[0], width=(3.0,)),)), analysis) != key
    healpy.write_map(tmp_path / "t.fits", np.arange(192.0) ** 2, coord="E", dtype=np.float64, overwrite=True)
    assert _key(run, analysis) != key
    assert "nuisance: residual foreground, template" in describe(run, settings)
    assert "2.0 µK" in describe(run, settings)
    assert "nuisance: " not in describe(plain, settings)


def test_a_template_that_is_written_anew_is_read_anew(tmp_path):
    """A process kept the survey of the old one, and responses were those to its pattern."""
    given = {"effect": "noise_anisotropy", "channel": "V1", "width": 0.1, "parameters": {"template": "t.fits"}}
    maps = []
    for power in (1, 4):
        healpy.write_map(
            tmp_path / "t.fits", np.linspace(0, 1, 192) ** power, coord="E", dtype=np.float64, overwrite=True
        )
        run = config.load(config.to_dict(model()) | {"nuisance": [given]}, base=tmp_path)
        own = {"amplitude": 0.5} | run.nuisances[0].parameters
        table = config.Effect(name="noise_anisotropy", channel="V1", parameters=own)
        analysis = analysis_of(run, tuple(name for name in systematics.catalogue() if name != "noise_level"))
        maps += simulated_maps(replace(analysis.job(replace(run, effects=(table,))), count=1))
    assert not np.array_equal(maps[0][0], maps[1][0])


def ensemble_of(simulations, nuisances, folds=None):
    count = simulations.shape[1]
    folds = [None] * count if folds is None else folds
    elements = tuple(Element(str(k), "map", ("A",), fold=fold) for k, fold in enumerate(folds))
    nothing = np.zeros((0, 0))
    rest = simulations[:0], *[nothing] * 4
    return NullEnsemble(simulations, np.zeros(count), elements, *rest, nuisances=nuisances)


def linear(rng, p, count, t, widths):
    """Simulations of a correlated data vector of p elements to which nuisances add t times their draws."""
    root = np.tril(rng.normal(size=(p, p))) / np.sqrt(p) + np.eye(p)
    drawn = rng.normal(size=(count, len(widths))) * widths
    return root, drawn, rng.normal(size=(count, p)) @ root.T + drawn @ t.T


@pytest.mark.slow
def test_the_posterior_is_that_of_brute_force():
    """The product of likelihood and priors on a grid of two nuisances and an effect of any size."""
    rng = np.random.default_rng(1)
    p, count, widths = 5, 200_000, np.array([0.8, 0.1])
    t, effect = rng.normal(size=(p, 2)), rng.normal(size=(p, 1))
    root, drawn, simulations = linear(rng, p, count, t, widths)
    known = ensemble_of(simulations, drawn)
    x = root @ rng.normal(size=p) + t @ [1.1, -0.05] + 3.0 * effect[:, 0]
    axes = np.linspace(-4.0, 4.0, 161) * 0.8, np.linspace(-5.0, 5.0, 81) * 0.1, np.linspace(-4.0, 10.0, 281)
    one, two, three = np.meshgrid(*axes, indexing="ij")
    inverse = np.linalg.inv(root @ root.T)
    for fitted, size in ((None, 0), (effect, 1)):
        place = slice(None) if size else slice(80, 81)  # an amplitude of 0
        a, b, c = one[..., place], two[..., place], (three if size else 0.0 * three)[..., place]
        left = x - a[..., None] * t[:, 0] - b[..., None] * t[:, 1] - c[..., None] * effect[:, 0]
        chi2 = np.einsum("...i,ij,...j", left, inverse, left) + (a / widths[0]) ** 2 + (b / widths[1]) ** 2
        weight = np.exp(-0.5 * (chi2 - chi2.min()))
        weight /= weight.sum()
        mean = np.array([np.sum(weight * v) for v in (a, b)])
        sigma = np.sqrt([np.sum(weight * v**2) for v in (a, b)] - mean**2)
        found, error = Regression.of(known, known.gaussian, fitted).posterior(x, np.zeros(2))
        # The slopes have errors of sigma sqrt(chi^2/N).
        assert np.all(np.abs(found - mean) < 5.0 * sigma * np.sqrt(60.0 / count))
        np.testing.assert_allclose(error, sigma, rtol=5.0 / np.sqrt(2.0 * count) + 1e-3)


def test_posteriors_from_few_simulations_have_unit_pulls():
    """Over the prior, one ensemble for each data set: nuisances that are known, half known and not at all."""
    rng = np.random.default_rng(2)
    p, count, widths = 12, 80, np.ones(3)
    t = rng.normal(size=(p, 3)) * [3.0, 0.4, 0.0]
    pulls, sigmas = [], []
    for _ in range(500):
        _, drawn, simulations = linear(rng, p, count + 1, t, widths)
        known = ensemble_of(simulations[:-1], drawn[:-1])
        mean, sigma = Regression.of(known, known.gaussian).posterior(simulations[-1], np.zeros(3))
        pulls.append((mean - drawn[-1]) / sigma)
        sigmas.append(sigma)
    pulls = np.array(pulls)
    assert np.all(np.abs(pulls.mean(axis=0)) < 4.0 / np.sqrt(500))
    assert np.all(np.abs(pulls.std(axis=0) - 1.0) < 4.0 / np.sqrt(1000) + 0.05)
    typical = np.median(sigmas, axis=0)
    assert typical[0] < 0.5 < typical[1] < 1.0
    assert typical[2] == pytest.approx(1.0, abs=0.1)


def test_narrow_priors_give_the_tests_without_and_wide_ones_a_projection():
    rng = np.random.default_rng(3)
    p, count = 10, 4000
    t, effect = rng.normal(size=(p, 1)), rng.normal(size=(p, 1))
    root, drawn, simulations = linear(rng, p, count, 0.0 * t, np.ones(1))
    x = root @ rng.normal(size=p) + 2.0 * effect[:, 0] + 0.7 * t[:, 0]
    without = ensemble_of(simulations, None).gaussian
    narrow = ensemble_of(simulations + 1e-7 * drawn @ t.T, 1e-7 * drawn).gaussian
    assert narrow.chi2(x) == pytest.approx(without.chi2(x), rel=1e-5)
    before, after = without.fit(x, effect), narrow.fit(x, effect)
    np.testing.assert_allclose(after.amplitudes, before.amplitudes, rtol=1e-5)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-5)
    # All elements would be redundant beside the nuisance, were it counted.
    wide = ensemble_of(simulations + 1e4 * drawn @ t.T, 1e4 * drawn).gaussian
    assert wide.dimension == p
    projected = without.fit(x, np.concatenate([effect, t], axis=1))
    alone = wide.fit(x, effect)
    # The regression of the simulations on the nuisance has errors of 1/sqrt(N).
    np.testing.assert_allclose(alone.amplitudes[0], projected.amplitudes[0], atol=4 * projected.errors[0] / count**0.5)
    np.testing.assert_allclose(alone.errors[0], projected.errors[0], rtol=0.05)
    assert abs(alone.amplitudes[0] - before.amplitudes[0]) > 0.1


def test_elements_that_follow_squares_are_not_tested():
    rng = np.random.default_rng(4)
    t = rng.normal(size=(6, 2))
    _, drawn, simulations = linear(rng, 6, 1500, t, np.array([1.0, 3.0]))
    simulations[:, 2] += 2.0 * (drawn[:, 0] ** 2 - 1.0)
    simulations[:, 4] += 0.5 * drawn[:, 0] * drawn[:, 1]
    known = ensemble_of(simulations, drawn)
    assert np.array_equal(known.tested, [True, True, False, True, False, True])
    assert known.gaussian.dimension == 4
    assert not known.gaussian.whitening[:, ~known.tested].any()
    assert ensemble_of(simulations, None).tested.all()


def test_held_out_simulations_are_those_of_explicit_refits():
    rng = np.random.default_rng(5)
    p, count = 6, 40
    simulations, t = rng.normal(size=(count, p)), rng.normal(size=(p, 3))
    columns = [(0,), (1, 2)]
    null = SimulatedGaussian.from_simulations(simulations)
    groups = null.whiten_groups(t, columns)
    base = calibrate(null, groups)
    expected = []
    for row in range(count):
        others = SimulatedGaussian.from_simulations(np.delete(simulations, row, axis=0))
        own = others.whiten_groups(t, columns)
        y = others.whiten(simulations[row])
        scores = others.nested_test(own.delta_chi2(y), y @ y, own.sizes)
        expected.append(float(base.global_pvalue(scores.min())))
    found = calibrate_on(base, null, groups, simulations)
    np.testing.assert_allclose(found.held_out_smallest, np.sort(expected), rtol=1e-9)


def test_pvalues_are_uniform_where_the_scatter_depends_on_a_nuisance():
    """As of a foreground whose response differs from sky to sky: too many alarms by F, the right number by rank."""
    rng = np.random.default_rng(6)
    p, count, tests = 20, 1000, 1000

    def made(number):
        z = rng.normal(size=(number, 1))
        return z, rng.normal(size=(number, p)) * np.sqrt(1.0 + z**2) + 5.0 * z

    z, simulations = made(count)
    null, t = ensemble_of(simulations, z).gaussian, np.eye(p)[:, :5]
    groups = null.whiten_groups(t, [(k,) for k in range(5)])
    base = calibrate(null, groups)
    ranked = calibrate_on(base, null, groups, simulations)
    data = made(tests)[1]
    gaussian = replace(null, scale_variance=0.0)
    pairs = ((gaussian, base), (null, ranked))
    p_base, p_ranked = ([global_test(own, x, groups, one).pvalue for x in data] for own, one in pairs)
    assert np.mean(np.array(p_base) < 0.05) > 0.1
    # Binomial errors of the data and of the ranks.
    assert abs(np.mean(np.array(p_ranked) < 0.05) - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 * (1.0 / tests + 1.0 / count))
    assert stats.ks_2samp(p_ranked, np.linspace(0.0, 1.0, count)).pvalue > 1e-3
    # Beyond the ranks they go on falling, without a step.
    edge = ranked.held_out_combined[TAIL - 1]
    low = np.array([0.01, 0.5, 0.999, 1.0]) * edge
    found = [float(ranked.combine(0.5 * value, 1.0)) for value in low]
    assert np.all(np.diff(found) > 0.0)
    assert found[-1] < 1.2 * (TAIL + 1.0) / (count + 1.0)


def test_one_half_says_what_the_nuisances_are_in_the_other():
    rng = np.random.default_rng(7)
    p, count = 8, 3000
    _, drawn, simulations = linear(rng, p, count, np.zeros((p, 1)), np.ones(1))
    independent = rng.normal(size=(count, p)) + drawn @ np.full((1, p), 2.0)
    known = ensemble_of(independent, drawn, [0, 1] * (p // 2))
    turn = half_given_other(known)
    after = known.remix(turn)
    used, fresh = slice(0, None, 2), slice(1, None, 2)
    cross = np.corrcoef(after.simulations.T)[used, fresh]
    assert np.abs(np.corrcoef(independent.T)[used, fresh]).min() > 0.7
    assert np.abs(cross).max() < 5.0 / np.sqrt(count)
    # What is left of the nuisance in the one half is its posterior scatter from the other.
    assert np.mean(np.var(after.simulations[:, fresh], axis=0)) == pytest.approx(1.0 + 4.0 / 17.0, rel=0.05)
    np.testing.assert_array_equal(half_given_other(ensemble_of(simulations, None, [0, 1] * 4)), np.eye(p))


def test_means_of_skies_keep_the_scatter_of_the_nuisances():
    rng = np.random.default_rng(8)
    t = np.full((3, 1), 2.0)
    drawn = rng.normal(size=(2000, 1))
    known = ensemble_of(rng.normal(size=(2000, 3)) + drawn @ t.T, drawn)
    covariance = np.cov(known.of_mean(100).simulations.T)
    np.testing.assert_allclose(covariance, 0.01 * np.eye(3) + 4.0, rtol=5.0 * np.sqrt(2.0 / 2000))
    np.testing.assert_allclose(np.cov(known.of_mean(100).quiet.T), 0.01 * np.eye(3), atol=0.002)


def test_results_say_prior_posterior_and_pull():
    rng = np.random.default_rng(9)
    t = np.array([[40.0, 0.0], [0.0, 0.0], [35.0, 0.0]])
    _, drawn, simulations = linear(rng, 3, 4000, t, np.array([0.1, 2.0]))
    known = ensemble_of(simulations, drawn)
    priors = [
        Nuisance(systematics.get("calibration"), "W1", (0.1,)),
        Nuisance(systematics.get("foreground_residual"), None, (2.0,), {}, {"spectral_index": 0.3}),
    ]
    one, two = Regression.of(known, known.gaussian).results(priors, known.simulations.mean(axis=0) + 0.3 * t[:, 0])
    assert (one.name, one.channel, one.component, one.prior_width) == ("calibration", "W1", None, 0.1)
    assert one.amplitude == pytest.approx(0.3, rel=0.1)
    assert one.pull == pytest.approx(one.amplitude / np.sqrt(0.1**2 - one.sigma**2))
    assert "prior 0 % ± 10 % of the gain" in one.words
    assert (two.pull, two.parameters) == (None, {"spectral_index_width": 0.3})
    assert two.sigma == pytest.approx(2.0, rel=0.1)


def test_a_candidate_that_is_a_nuisance_departs_beyond_its_prior_alone():
    """Its template is the direction of the scatter, so that its error has the whole prior; others keep theirs."""
    rng = np.random.default_rng(10)
    t = rng.normal(size=(6, 2)) * [500.0, 0.001]
    _, drawn, simulations = linear(rng, 6, 3000, t, np.array([0.1, 2.0]))
    known = ensemble_of(simulations, drawn)
    kind, foreground = systematics.get("calibration"), systematics.get("foreground_residual")
    priors = [Nuisance(kind, "W1", (0.1,)), Nuisance(foreground, None, (2.0,))]
    candidates = numbered([Candidate(kind, "V1", (0,)), Candidate(kind, "W1", (0,)), Candidate(foreground, None, (0,))])
    bank = np.stack([t[:, 0], t[:, 0] + rng.normal(size=6) * 10.0, t[:, 1]], axis=1)
    found, templates = with_nuisances(known, known.gaussian, priors, candidates, bank)
    assert [one.nuisance for one in found] == [False, True, False]
    np.testing.assert_array_equal(templates[:, [0, 2]], bank[:, [0, 2]])
    np.testing.assert_allclose(templates[:, 1], t[:, 0], atol=5.0 * np.linalg.norm(simulations - drawn @ t.T) / 2000)
    x = simulations.mean(axis=0) + 1.0 * t[:, 0]
    wrong, right = (known.gaussian.fit(x, one[:, 1:2]) for one in (bank, templates))
    assert right.amplitudes[0] == pytest.approx(1.0, rel=0.02)
    assert right.errors[0] > 0.1 > 2.0 * wrong.errors[0]
    assert with_nuisances(known, known.gaussian, priors[:1], candidates[:1], bank)[0][0].nuisance is False


def test_the_error_of_a_weakly_measured_nuisance_has_its_prior():
    """In the sky of the data the response is another one than in the mean, whose scatter the covariance has."""
    rng, p, width = np.random.default_rng(11), 12, 0.1
    mean_sky = rng.normal(size=(p, 1)) * 4.0 / width / np.sqrt(p)
    root, drawn, simulations = linear(rng, p, 3000, mean_sky, np.array([width]))
    known = ensemble_of(simulations, drawn)
    kind = systematics.get("calibration")
    only = numbered([Candidate(kind, "W1", (0,))])
    this_sky = mean_sky + root @ rng.normal(size=(p, 1)) * 3.0 / width / np.sqrt(p)
    (one,), t = with_nuisances(known, known.gaussian, [Nuisance(kind, "W1", (width,))], only, this_sky)
    assert not one.nuisance
    np.testing.assert_array_equal(t, this_sky)
    null, pulls = known.gaussian, []
    for _ in range(500):
        x = simulations.mean(axis=0) + root @ rng.normal(size=p) + this_sky[:, 0] * (0.5 + width * rng.normal())
        fit = null.fit(x, t)
        pulls.append([(each.amplitudes[0] - 0.5) / each.errors[0] for each in (fit, with_priors(null, t, fit, [one]))])
    without, found = np.std(pulls, axis=0)
    assert without > 1.5
    assert abs(found - 1.0) < 4.0 / np.sqrt(2.0 * 500)
    alone = replace(one, known=None)
    assert with_priors(null, t, fit, [alone]) is fit
