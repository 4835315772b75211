"""What is simulated ahead is asked for once; observed skies are seen through the effect that is fitted."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.same_skies import SameSkies, _key
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix


def test_effects_are_asked_for_at_once_and_then_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then only skies without effects are simulated, once for both effects."""

    def jobs(own: Any, found: Any, constrained: bool, skies: int, there: Any = ()) -> list[Any]:
        name = "".join(effect.name for effect in found)
        return [SimpleNamespace(simulated=name, first=0, count=skies, given=b"", source=None)]

    def ask(wanted: Any) -> list[np.ndarray]:
        asked.append([job.simulated for job in wanted])
        return [np.full((job.count, 2), float(len(job.simulated))) for job in wanted]

    asked: list[list[str]] = []
    monkeypatch.setattr(SameSkies, "_jobs", jobs)
    monkeypatch.setattr(SameSkies, "skies_of", lambda *_: "constrained")
    monkeypatch.setattr("mcsim.datavector.same_skies.replace", lambda job, **_: job)
    skies = SameSkies(None, ask, ())  # type: ignore[arg-type]
    effects = [config.Effect(name=name) for name in ("a", "bb")]
    skies.ahead(effects, 3)
    pairs = [skies.pair([effect], 3, True) for effect in effects]
    assert asked == [["a", "bb"], [""]]
    for size, (before, after) in enumerate(pairs, 1):
        np.testing.assert_array_equal(before, np.zeros((3, 2)))
        np.testing.assert_array_equal(after, np.full((3, 2), size))
    skies.pair(effects[:1], 3, True)
    assert len(asked) == 2
    skies.pair(effects[:1], 5, True)
    assert asked[2:] == [[""], ["a"]]


@pytest.mark.parametrize("listed", [("a",), ("a", "b")])
def test_what_two_effects_draw_together_is_of_one_simulator(monkeypatch: pytest.MonkeyPatch, listed: Any) -> None:
    """One that knows a alone would draw another pattern of it than mcsim does of both."""

    def source_of(found: Any, given_sky: bool = False) -> str | None:
        return "another program" if {one.name for one in found} <= {*listed} else None

    def jobs(own: Any, found: Any, constrained: bool, skies: int, there: Any = ()) -> list[Any]:
        return [replace(job, simulated=str(len(found)), source=source_of(there or found))]

    def ask(wanted: Any) -> list[np.ndarray]:
        asked.extend(one.source for one in wanted)
        return [np.zeros((3, 2)) for _ in wanted]

    asked: list[Any] = []
    run = config.load(two_channels("patterns"))
    job = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width")).job(run)
    monkeypatch.setattr(SameSkies, "_jobs", jobs)
    both = [config.Effect(name="a"), config.Effect(name="b")]
    for found in (both, both[:1], both[1:]):
        skies = SameSkies(SimpleNamespace(source_of=source_of), ask, ())  # type: ignore[arg-type]
        skies.pair(found, 3, False, acting=both)
    assert asked == ["another program" if len(listed) > 1 else None] * 6


def test_keys_tell_all_skies_apart_and_hold_none_of_them() -> None:
    """At nside 512 every one of hundreds of keys held 8 MB of a sky."""
    run = config.load(two_channels("keys"))
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))
    sky, spread = np.ones(10_000, dtype=np.complex128), np.ones(41)
    job = replace(analysis.job(run), count=4)
    given = [replace(job, observed=one) for one in (sky, 2.0 * sky)]
    given += [
        replace(given[0], negative=True),
        replace(given[0], spread=spread),
        replace(given[0], spread=2.0 * spread),
    ]
    keys = {_key(one) for one in (job, replace(job, first=4), replace(job, count=3), *given)}
    assert len(keys) == 3 + len(given)
    assert {len(skies) for _, _, _, skies, _ in keys} == {16}
    assert _key(given[0]) == _key(replace(job, observed=sky.copy()))


def test_the_sky_of_maps_with_a_gain_is_found_without_it() -> None:
    """Responses are those in the sky itself: in a sky with the gain they would be larger by it."""
    run = config.load(two_channels("gains", sigma0_uk=1.0))
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))

    def ask(jobs: Any) -> list[np.ndarray]:
        return [data_vectors(job) for job in jobs]

    plain = list(simulate.maps(survey(run), 0))
    wider = config.Effect(name="beam_width", channel="V1", parameters={"amplitude": 0.005})
    for amplitude in (0.2, -0.2):
        gain = [
            config.Effect(name="calibration", channel=name, parameters={"amplitude": amplitude})
            for name in ("V1", "W1")
        ]
        maps = list(simulate.maps(survey(with_effects(run, gain)), 0))
        skies, expected = SameSkies(analysis, ask, maps), SameSkies(analysis, ask, plain)
        before, other = (one.pair(own, 2, True)[0].ravel() for one, own in ((skies, gain), (expected, [])))
        np.testing.assert_allclose(before @ other / (other @ other), 1.0, rtol=0.03)
        for one, size in zip((skies.observed, skies.observed_with(gain)), (1.0 + amplitude, 1.0), strict=True):
            np.testing.assert_allclose(np.std(one) / np.std(expected.observed), size, rtol=0.01)
        np.testing.assert_array_equal(skies.observed_with([wider]), skies.observed)
        small = [config.Effect(name="calibration", channel="V1", parameters={"amplitude": 1e-3})]
        np.testing.assert_array_equal(skies.observed_with(small), skies.observed)


@pytest.mark.parametrize("amplitude", [0.3, -0.3])
def test_the_sky_of_maps_of_which_one_has_a_gain_is_found_without_it(amplitude: float) -> None:
    """A sky with a weight w of the map would have 1 + w g of that in it, and a fit give g/(1 + w g)."""
    run = config.load(two_channels("one split", sigma0_uk=1.0))
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))
    plain = SameSkies(analysis, lambda _: [], list(simulate.maps(survey(run), 0))).observed
    split = run.map.splits[1]
    library = (*analysis.library, ("split_calibration", systematics.get("split_calibration")))
    gain = config.Effect(name="split_calibration", channel="W1", parameters={"amplitude": amplitude, "split": split})
    maps = list(simulate.maps(survey(with_effects(run, [gain])), 0))
    skies = SameSkies(replace(analysis, library=library), lambda _: [], maps)
    without, off = (
        np.linalg.norm(one - plain) / np.linalg.norm(plain) for one in (skies.observed_with([gain]), skies.observed)
    )
    assert off > 0.05
    assert without < 0.2 * off


@pytest.mark.parametrize("frame", ["ecliptic", "galactic"])
def test_the_sky_of_modulated_maps_is_found_without_the_modulation(frame: str) -> None:
    """Both modulations act in the frame of the maps, which preparation turns into another one."""
    table = two_channels("modulated", sigma0_uk=1.0)
    if frame != "ecliptic":
        table["preparation"] = [{"kind": "rotate", "frame": frame}]
    run = config.load(table)
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if "modulation" not in name))
    plain = SameSkies(analysis, lambda _: [], list(simulate.maps(survey(run), 0))).observed
    for name, given in (
        ("dipole_modulation", {"lon_deg": 30.0, "lat_deg": 40.0}),
        ("quadrupole_modulation", {"components": (0.0, 1.0, 0.0, 0.0, 0.5)}),
    ):
        found, slight = (config.Effect(name=name, parameters={"amplitude": a, **given}) for a in (0.3, 0.005))
        skies = SameSkies(analysis, lambda _: [], list(simulate.maps(survey(with_effects(run, [found])), 0)))
        without, off = (np.linalg.norm(one - plain) for one in (skies.observed_with([found]), skies.observed))
        assert off > 0.1 * np.linalg.norm(plain)
        assert without < 0.15 * off
        np.testing.assert_array_equal(skies.observed_with([slight]), skies.observed)


@pytest.mark.parametrize("masked", [False, True])
def test_the_sky_of_maps_with_another_beam_is_found_through_it(masked: bool) -> None:
    """The power of the sky is the same for a beam 30 % wider or narrower in both channels.

    Behind the mask degrees mix, otherwise for another beam: their power scatters by 15 %.
    """
    table = two_channels("beams", sigma0_uk=0.1)
    if masked:
        seen = np.abs(healpy.pix2vec(16, np.arange(12 * 16**2))[2]) > 0.3
        table["map"]["mask"] = seen.astype(float)
    run = config.load(table)
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))
    plain = SameSkies(analysis, lambda _: [], list(simulate.maps(survey(run), 0))).observed
    power = healpy.alm2cl(plain)[2:21]
    for amplitude in (0.3, -0.3):
        beams = [
            config.Effect(name="beam_width", channel=name, parameters={"amplitude": amplitude}) for name in ("V1", "W1")
        ]
        skies = SameSkies(analysis, lambda _: [], list(simulate.maps(survey(with_effects(run, beams)), 0)))
        found = healpy.alm2cl(skies.observed_with(beams))[2:21]
        np.testing.assert_allclose(found, power, rtol=0.2 if masked else 0.02)
        np.testing.assert_allclose(np.mean(found / power), 1.0, rtol=0.05)
        assert np.abs(healpy.alm2cl(skies.observed)[2:21] / power - 1.0).max() > 0.2
        factors = skies.factors(beams)
        ell = np.arange(analysis.model.lmax + 1)
        variance = (np.deg2rad(350.0 / 60.0) / np.sqrt(8.0 * np.log(2.0))) ** 2
        expected = np.exp(-0.5 * ell * (ell + 1) * variance * ((1.0 + amplitude) ** 2 - 1.0))
        np.testing.assert_allclose(factors[0], expected, rtol=1e-6)
        assert skies.factors(beams[:1])[1] == (1.0,) * len(ell)


def test_the_sky_of_maps_with_an_ellipse_is_found_through_it() -> None:
    """What the ellipse adds to a map is no sky; a small one stays, as in the skies of linear responses."""
    run = config.load(two_channels("ellipses", sigma0_uk=1.0))
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))
    expected = SameSkies(analysis, list, list(simulate.maps(survey(run), 0))).observed
    for amplitude, both in ((0.6, True), (-0.6, False)):
        parameters = {"amplitude": amplitude, "angle_deg": 30.0}
        names = ("V1", "W1") if both else ("W1",)
        ellipse = [config.Effect(name="beam_ellipticity", channel=name, parameters=parameters) for name in names]
        skies = SameSkies(analysis, list, list(simulate.maps(survey(with_effects(run, ellipse)), 0)))
        circular = skies._through(skies.factors(ellipse), (), skies.maps)
        off, left = (np.linalg.norm(one - expected) for one in (circular, skies.observed_with(ellipse)))
        assert left < 0.3 * off
    slight = [config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": 0.02})]
    assert not any(skies.seen(slight))


ADDED = [
    ("dipole_residual", "W1", {"amplitude": 60.0, "lon_deg": 40.0, "lat_deg": 20.0}),
    ("calibration", "V1", {"amplitude": 0.02}),  # of the dipole of 3.4 mK
    ("monopole_residual", "V1", {"amplitude": 40.0}),
]


@pytest.mark.parametrize(("name", "channel", "parameters"), ADDED)
def test_the_sky_of_maps_with_added_signals_is_found_without_them(
    name: str, channel: str | None, parameters: Any
) -> None:
    """Behind a mask a dipole of 60 uK was taken for sky in part, so that half of it, added to that sky, fitted."""
    table = two_channels("added", sigma0_uk=100.0)
    table["map"]["mask"] = (np.array(healpy.pix2vec(16, np.arange(12 * 16**2))).T @ [0.6, 0.0, 0.8] < 0.4).astype(float)
    run = config.load(table)
    analysis = analysis_of(run, without=tuple(one for one in systematics.catalogue() if one != name))
    expected = SameSkies(analysis, list, list(simulate.maps(survey(run), 0))).observed
    effect = [config.Effect(name=name, channel=channel, parameters=parameters)]
    skies = SameSkies(analysis, list, list(simulate.maps(survey(with_effects(run, effect)), 0)))
    off, left = (np.linalg.norm(one - expected) for one in (skies.observed, skies.observed_with(effect)))
    assert left < 0.01 * off
    assert off > 0.2 * np.linalg.norm(expected)
    step = analysis.candidates[0].basis[0].amplitude
    small = [config.Effect(name=name, channel=channel, parameters={**parameters, "amplitude": step})]
    assert not any(skies.seen(small))


def test_the_dipole_that_a_gain_leaves_in_the_only_channel_is_a_residual_one() -> None:
    """A calibration that is 2 % too high leaves 2 % of the dipole of 3364.5 uK, and among two channels nothing."""
    table = two_channels("left")
    gain = [config.Effect(name="calibration", channel="V1", parameters={"amplitude": 0.02})]
    others = [name for name in systematics.catalogue() if name != "calibration"]
    assert SameSkies(analysis_of(config.load(table), without=others), list, ()).dipole_left(gain) == []
    table["channel"] = table["channel"][:1]
    skies = SameSkies(analysis_of(config.load(table), without=others), list, ())
    (left,) = skies.dipole_left(gain)
    found = systematics.build(systematics.catalogue()[left.name], dict(left.parameters))
    dipole = skies.analysis.model.survey.channels[0].site.dipole_uk
    assert (left.name, left.channel) == ("dipole_residual", "V1")
    np.testing.assert_allclose(found.vector, 0.02 * dipole, rtol=1e-9)  # type: ignore[attr-defined]
    assert skies.dipole_left([config.Effect(name="noise_level", channel="V1", parameters={"amplitude": 0.1})]) == []


def test_the_dipole_that_a_gain_leaves_in_turned_maps_is_that_of_maps_as_they_are_made() -> None:
    """An effect acts on these: it had the galactic components of the dipole as ecliptic ones, 100 degrees off."""
    table = two_channels("left", nside=8, lmax=16)
    table["channel"] = table["channel"][:1]
    others = [name for name in systematics.catalogue() if name != "calibration"]
    found = []
    for steps in ([], [{"kind": "rotate", "frame": "galactic"}]):
        analysis = analysis_of(config.load(table | {"preparation": steps}), without=others)
        gain = [config.Effect(name="calibration", channel="V1", parameters={"amplitude": 0.02})]
        left = SameSkies(analysis, list, ()).dipole_left(gain)
        made, expected = (
            simulate.maps(survey(with_effects(analysis.run, own)), 0, sky=np.zeros(17 * 18 // 2, dtype=complex))
            for own in (left, gain)
        )
        assert np.std(made - expected) < 1e-3 * np.std(expected)
        found.append(left[0].parameters)
    np.testing.assert_allclose(list(found[0].values()), list(found[1].values()), rtol=1e-9)


@pytest.mark.parametrize("name", ["beam_width", "beam_ellipticity"])
def test_a_beam_of_smoothed_maps_changes_as_before_they_were_smoothed(name: str) -> None:
    """The target of 900' was 8 % wider as a whole, and not the beam of 600' in it: the change was twice as large."""
    table = two_channels("smoothed", nside=8, lmax=16, fwhm_arcmin=600.0, period_s=121.0)
    effect = [config.Effect(name=name, channel="V1", parameters={"amplitude": 0.5})]
    others = [each for each in systematics.catalogue() if each != "noise_level"]
    made, smoothed = (
        SameSkies(analysis_of(config.load(table | {"preparation": steps}), without=others), list, ())
        for steps in ([], [{"kind": "smooth", "fwhm_arcmin": 900.0}])
    )
    lmax = min(skies.analysis.model.lmax for skies in (made, smoothed))
    one, other = (np.array(skies.factors(effect))[:, : lmax + 1] for skies in (made, smoothed))
    np.testing.assert_allclose(one, other, rtol=1e-6)
    variance = (np.deg2rad(10.0) ** 2 - np.deg2rad(15.0) ** 2) / (8.0 * np.log(2.0))
    ell = np.arange(lmax + 1)
    window = np.exp(0.5 * ell * (ell + 1) * variance)
    before, after = (
        (
            np.frombuffer(skies.orders(effect)[0], dtype=complex).reshape(-1, skies.analysis.model.lmax + 1)
            for skies in (made, smoothed)
        )
        if name == "beam_ellipticity"
        else (np.zeros((1, lmax + 1)),) * 2
    )
    np.testing.assert_allclose(after[:, : lmax + 1], before[:, : lmax + 1] * window, rtol=1e-6, atol=1e-9)


def test_other_noise_is_counted_in_the_pixels_that_are_seen(tmp_path: Path) -> None:
    """At the poles noise with a pattern of mean 1 over the sky is more; the filter did not know."""
    path, z = str(tmp_path / "polar.fits"), healpix.centres(16)[2]
    healpy.write_map(path, (z > 0.8).astype(float), dtype=np.float64)
    table = two_channels("polar", lmax=20)
    table["map"] |= {"mask": path}
    others = [name for name in systematics.catalogue() if name != "noise_anisotropy"]
    skies = SameSkies(analysis_of(config.load(table), without=others), list, ())
    noise = [config.Effect(name="noise_anisotropy", channel="V1", parameters={"amplitude": 0.4})]
    variance = sum(1.0 / np.maximum(part.moments.hits, 1.0) for part in skies.analysis.model.parts[:2])[z > 0.8]
    expected = np.average(1.0 + 0.4 * (3.0 * z[z > 0.8] ** 2 - 1.0), weights=variance)
    np.testing.assert_allclose(skies.noise_of(noise), (expected, 1.0), rtol=1e-4)
    assert expected > 1.5


def test_noise_alone_is_compared_in_all_skies_that_there_are_without_it() -> None:
    """What it adds to the scatter of the data is known from as many skies as were simulated."""
    settings = DiagnosisSettings.quick()
    context = SimpleNamespace(
        settings=settings,
        analysis=SimpleNamespace(library=tuple(systematics.catalogue().items())),
        extended_reference=lambda found: np.zeros((settings.noisy_skies, 4)),
    )
    data = ObservedMaps(context, (), list)  # type: ignore[arg-type]
    vars(data)["_measured"] = (np.zeros(3),)
    vars(data)["same_skies"] = SimpleNamespace(
        of_reference=lambda found: np.ones((settings.noisy_skies, 4)), dipole_left=lambda found: []
    )
    before, after = data.pair([config.Effect(name="noise_level", channel="W1")])
    assert before.shape == after.shape == (settings.noisy_skies, 3)
