"""Every effect: found by name, none at zero amplitude, and the same again from its linear components."""

import sys
from dataclasses import dataclass, fields
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from mcsim import systematics
from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import Moments, ScanModel
from mcsim.sphere import alm as alm_
from mcsim.sphere.sky import gaussian_alm
from mcsim.sphere.spectra import load
from mcsim.systematics import Parametrization, registry
from mcsim.systematics.parametrization import Angle
from refusals import refused

LMAX, NSIDE = 48, 8
ON_REQUEST = {
    "sidelobe_pickup",
    "gain_spin",
    "split_calibration",
    "bandpass_mismatch",
    "nonlinearity",
    "orbital_dipole",
    "spin_synchronous_offset",
    "pointing_jitter",
    "lensing",
    "excess_noise",
}
NAMES = {
    "beam_ellipticity",
    "beam_coma",
    "beam_sidelobe",
    "beam_width",
    "calibration",
    "beam_noncircularity",
    "pointing_offset",
    "time_constant",
    "gain_drift",
    "dipole_residual",
    "monopole_residual",
    "transmission_imbalance",
    "noise_anisotropy",
    "noise_level",
    "noise_knee",
    "foreground_residual",
    "point_sources",
    "dipole_modulation",
    "quadrupole_modulation",
    "boost",
    "pixelization",
    "mapmaking_convergence",
    "orientation_averaging",
    "spectrum",
    *ON_REQUEST,
}


def draw(_: str) -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def site() -> systematics.Site:
    model = ScanModel.load("wmap")
    return systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="galactic",
        nside=NSIDE,
        lmax=LMAX,
        beam=Beam.elliptical(330.0, 300.0, angle_deg=20.0, lmax=LMAX),
        pointing=systematics.Pointing(model, model.line_of_sight("A")),
        dipole_uk=np.array([1.0, 2.0, 3.0]),
    )


def test_the_library_holds_what_is_named():
    assert set(systematics.catalogue()) == NAMES
    assert {name for name, kind in systematics.catalogue().items() if not kind.proposed} == ON_REQUEST
    for kind in systematics.catalogue().values():
        assert kind.scope in ("channel", "common")
        assert all((kind.unit, kind.cause, kind.signature, kind.source))
        first = fields(kind)[0]
        assert (first.name, first.default) == ("amplitude", 0.0)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_zero_amplitude_changes_nothing(name, site):
    effect = systematics.get(name)()
    sky = gaussian_alm(load("wmap7", LMAX), np.random.default_rng(1))
    assert systematics.looked_at([effect], sky, site, 1, 0) is sky
    assert systematics.seen_through([effect], site) is site.beam
    assert effect.gain(np.arange(3.0), site) is None
    assert not systematics.adding([effect])
    assert not systematics.disturbing([effect])
    assert effect.noise(site) is None
    assert effect.spread() == 1.0
    assert effect.differencing(0.01, 2) == (0.01, 2)
    moments = Moments.parallel_transport(NSIDE, np.rad2deg(0.3), 2, "galactic")
    assert effect.orientations(moments, site) is moments
    here = tuple(np.array([value]) for value in (0.4, 1.0, 2.0))
    moved = effect.moved(*here)
    assert moved is None or moved == here
    assert effect.lags() in (None, ((1.0, 0.0),))


PARAMETERS = {
    "beam_ellipticity": {"angle_deg": 70.0},
    "beam_coma": {"angle_deg": 200.0},
    "beam_sidelobe": {"quadrupole": -0.4},
    "pointing_offset": {"angle_deg": -120.0},
    "gain_drift": {"phase_deg": 100.0},
    "gain_spin": {"phase_deg": 100.0},
    "orbital_dipole": {"phase_deg": -70.0},
    "spin_synchronous_offset": {"phase_deg": 170.0},
    "dipole_residual": {"lon_deg": 200.0, "lat_deg": -35.0},
    "dipole_modulation": {"lon_deg": 20.0, "lat_deg": 80.0},
    "boost": {"lon_deg": 264.0, "lat_deg": 48.0},
    "quadrupole_modulation": {"components": (0.1, -0.5, 0.7, 0.1, 0.48989794855663565)},
    "spectrum": {"bands": (0.6, -0.8, 0.0, 0.0, 0.0, 0.0)},
}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_coordinates_lead_back_to_the_effect(name):
    kind = systematics.get(name)
    fit, basis = kind.parametrization, systematics.basis_of(kind)
    for row, effect in enumerate(basis):
        # Every element of the basis is a coordinate of its own.
        assert effect.amplitude == kind.step
        coordinates = fit.coordinates(effect)
        assert coordinates[row] > 0.0
        np.testing.assert_allclose(np.delete(coordinates, row), 0.0, atol=1e-15 * kind.step)
    effect = systematics.build(name, {"amplitude": 2.5 * kind.step, **PARAMETERS.get(name, {})})
    mixing = np.random.default_rng(2).standard_normal((len(basis), len(basis)))
    again = kind(**fit.nearest(fit.coordinates(effect), mixing @ mixing.T + np.eye(len(basis))))
    # A search for an angle ends at the square root of round-off.
    assert again.amplitude == pytest.approx(effect.amplitude, rel=1e-6)
    # Angles that differ by whole turns are the same effect.
    np.testing.assert_allclose(fit.coordinates(again), fit.coordinates(effect), atol=1e-7 * effect.amplitude)


def test_coma_off_the_possible_is_brought_to_the_nearest():
    """Four components hold two parameters: the rest is taken off in the metric given, not in that of the components."""
    kind = systematics.get("beam_coma")
    mixing = np.random.default_rng(3).standard_normal((4, 4))
    precision = mixing @ mixing.T + 0.1 * np.eye(4)
    fit = kind.parametrization
    measured = fit.coordinates(kind(amplitude=0.03, angle_deg=80.0)) + np.array([0.002, -0.001, 0.003, 0.001])

    def distance(effect):
        left = measured - fit.coordinates(effect)
        return left @ precision @ left

    best = distance(kind(**fit.nearest(measured, precision)))
    tried = [
        distance(kind(amplitude=amplitude, angle_deg=angle))
        for amplitude in np.linspace(0.001, 0.06, 60)
        for angle in np.arange(0.0, 360.0, 2.0)
    ]
    assert best <= min(tried)


def test_coma_that_the_data_see_at_some_angles_alone():
    """At angle 0 the second component is exactly zero, and so is what the data know of it."""
    seen = np.diag([0.0, 1.0, 0.0, 0.0])
    found = systematics.get("beam_coma").parametrization.nearest(np.array([0.0, 0.02, 0.0, 0.0]), seen)
    again = systematics.get("beam_coma").parametrization.coordinates(systematics.build("beam_coma", found))
    assert again[1] == pytest.approx(0.02)


def test_unknown_effects_and_parameters_are_named():
    with refused("gain_drit", "gain_drift"):
        systematics.get("gain_drit")
    with refused("zzz", "beam_coma", "gain_drift"):
        systematics.get("zzz")
    with refused("beam_coma", "angle", "amplitude", "angle_deg"):
        systematics.build("beam_coma", {"angle": 3.0})
    with refused("amplitude", "large"):
        systematics.build("beam_coma", {"amplitude": "large"})
    with refused("components", "[1.0]", 5):
        systematics.build("quadrupole_modulation", {"components": [1.0]})


@dataclass(frozen=True, kw_only=True)
class Foreign(systematics.Effect):
    name = "foreign"
    scope = "channel"
    unit = "-"
    cause = signature = "a test"
    step = 1.0

    def spread(self):
        return 1.0 - self.amplitude


def test_packages_add_effects(registered):
    class Entry(EntryPoint):
        def load(self):
            return Foreign

    registered(Entry("foreign", "package:Foreign", registry.ENTRY_POINTS))
    assert systematics.get("foreign") is Foreign


def test_broken_packages_are_named(registered):
    registered(EntryPoint("broken", "no_such_package:Thing", registry.ENTRY_POINTS))
    with refused("broken", "no_such_package:Thing"):
        systematics.catalogue()
    registry.catalogue.cache_clear()
    registered(EntryPoint("beam", "mcsim.instrument.beams:Beam", registry.ENTRY_POINTS))
    with refused("mcsim.instrument.beams:Beam", "mcsim.systematics.Effect"):
        systematics.catalogue()


def whole(**changes):
    """An effect of another package, with attributes that differ from a whole one's; None: left out."""
    own = {"name": "foreign", "scope": "channel", "unit": "-", "cause": "a test", "signature": "none", "step": 1.0}
    own["spread"] = lambda self: 1.0 - self.amplitude
    body = {key: value for key, value in (own | changes).items() if value is not None}
    return dataclass(frozen=True, kw_only=True)(type("Thing", (systematics.Effect,), body))


def no_dataclass():
    return type("Thing", (whole(),), {"__annotations__": {"angle_deg": float}, "angle_deg": 0.0})


def no_default():
    return dataclass(frozen=True, kw_only=True)(type("Thing", (whole(),), {"__annotations__": {"angle_deg": float}}))


class Doubled(Parametrization):
    def coordinates(self, effect):
        return np.zeros(2)


@pytest.mark.parametrize("key", ["stochastic", "sign", "coordinates"])
def test_an_effect_that_says_itself_how_it_is_fitted_is_refused(key):
    with refused(key):
        whole(**{key: True})


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        (whole(step=None), "step"),
        (whole(step=0.0), "step"),
        (whole(step="large"), "step"),
        (whole(step=np.inf), "step"),
        (whole(name=None), "name"),
        (whole(name=""), "name"),
        *((whole(name=name), repr(name)) for name in ("gain:W1", "gain=1", "a/b", "a.py", "a b", " ", "-a", "a\n")),
        (whole(rank="first"), "rank"),
        (whole(rank=np.nan), "rank"),
        (whole(scope="everywhere"), "scope"),
        (whole(unit=None), "unit"),
        (whole(cause=None), "cause"),
        (whole(signature=3), "signature"),
        (whole(parametrization=Parametrization(sign=2)), "sign"),
        (whole(parametrization=Parametrization(max_amplitude=-1.0)), "max_amplitude"),
        (whole(parametrization=1.0), "parametrization"),
        (whole(variants=({"no_such": 1.0},)), "no_such"),
        (
            whole(bounds=(systematics.Bound("band", 0.0, 1.0, "a test"),), band="V", __annotations__={"band": str}),
            "band",
        ),
        (whole(bounds=3.0), "bounds"),
        (whole(wording="{} K"), "AttributeError"),
        (whole(format_amplitude=lambda amplitude: 1 / 0), "format_amplitude"),
        (whole(inverse=0.0, __annotations__={"inverse": float}), "inverse"),
        (whole(parametrization=Angle(parameter="no_such")), "no_such"),
        (whole(parametrization=Doubled()), "coordinates"),
        (whole(spread=None), "orientations"),
        (no_dataclass(), "angle_deg"),
        (no_default(), "angle_deg"),
    ],
)
def test_an_effect_that_is_not_whole_is_refused_when_it_is_loaded(kind, key, registered):
    class Entry(EntryPoint):
        def load(self):
            return kind

    registered(Entry("foreign", "package:Thing", registry.ENTRY_POINTS))
    with refused(key):
        systematics.catalogue()


def test_a_package_that_ends_the_program_is_named(registered):
    """The command ended without a word, with the exit code of the package."""

    class Entry(EntryPoint):
        def load(self):
            raise SystemExit(4)

    registered(Entry("foreign", "package:Thing", registry.ENTRY_POINTS))
    with refused("foreign", "package:Thing", "SystemExit: 4"):
        systematics.catalogue()


def test_a_file_that_ends_the_program_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    path = tmp_path / "ending_effect.py"
    path.write_text("raise SystemExit(4)\n")
    with refused(path, "SystemExit: 4"):
        systematics.get(str(path))


@pytest.mark.parametrize("error", [ValueError("too large"), SystemExit(5)])
def test_an_effect_that_cannot_be_made_with_some_values_says_so(error):
    """At the amplitude of a run it ended in a traceback, or without a word."""

    def small(self):
        if self.amplitude > 1.0:
            raise error

    kind = whole(__post_init__=small)
    assert systematics.build(kind, {"amplitude": 1.0}).amplitude == 1.0
    with refused("foreign", "__post_init__", type(error).__name__, "mcsim.InputError", by=systematics.HookError):
        systematics.build(kind, {"amplitude": 2.0})


def test_what_an_effect_refuses_itself_is_said_as_it_is():
    def small(self):
        if self.amplitude > 1.0:
            raise InputError("an amplitude above 1 is too large; give less.")

    with pytest.raises(InputError) as said:
        systematics.build(whole(__post_init__=small), {"amplitude": 2.0})
    assert str(said.value) == "an amplitude above 1 is too large; give less."


def test_variants_that_fail_are_named():
    kind = whole(variants_in=classmethod(lambda cls, splits: ({"split": splits[0]},)))
    assert kind.variants_in(("a", "b")) == ({"split": "a"},)
    with refused("foreign", "variants_in", "IndexError", by=systematics.HookError):
        kind.variants_in(())


@pytest.mark.parametrize(
    ("gain", "named"),
    [
        (lambda self, time_s, site: np.full(time_s.shape, np.nan), ("foreign", "gain", "finite")),
        (lambda self, time_s, site: np.zeros(3), ("gain", "(3,)", "(5,)")),
        (lambda self, time_s, site: time_s.no_such, ("gain", "AttributeError", "no_such")),
    ],
)
def test_a_hook_that_fails_says_which(gain, named, site):
    with refused(*named):
        whole(gain=gain)(amplitude=1.0).gain(np.zeros(5), site)


@pytest.mark.parametrize(
    ("hook", "returned", "named"),
    [
        ("sky", None, ("None", "coefficient")),
        ("sky", np.zeros(5), ("float64", "complex")),
        ("beam", None, ("None", "mcsim.Beam")),
        ("pointing", np.zeros((1, 5), dtype=complex), ("ndarray", "mcsim.Beam")),
        ("gain", np.zeros(5, dtype=complex), ("complex128", "real")),
        ("signal", None, ("None", "times")),
        ("noise", np.ones(3), ("(3,)", "(768,)")),
        ("noise", 1.1, ("()", "(768,)")),
        ("gain", np.zeros(5, dtype=object), ("object", "real")),
        ("knee", None, ("None", "frequency")),
        ("excess", None, ("None", "counts")),
        ("spread", None, ("None", "number")),
        ("spread", "half", ("<U4", "number")),
        ("orientations", None, ("None", "mcsim.Moments")),
        ("differencing", None, ("None", "imbalance")),
        ("moved", (np.zeros(5), np.zeros(5)), ("(2, 5)", "(3, 5)")),
        ("lags", 3.0, ("()", "delay")),
    ],
)
def test_a_hook_that_returns_something_else_says_which(hook, returned, named, site):
    """A return that is forgotten first of all: what is None would fail far from the effect."""
    effect = whole(**{hook: lambda self, *given: returned})(amplitude=1.0)
    given = site if hook == "noise" else np.zeros(5)
    with refused("foreign", hook, *named):
        getattr(effect, hook)(given)


def test_a_hook_cannot_write_to_what_other_channels_see(site):
    """A glow that was added in place in one channel was in all channels, and in the control, too."""

    def glow(self, sky, site, draw):
        sky[0] += self.amplitude
        return sky

    sky = np.zeros(alm_.size(LMAX), dtype=complex)
    with refused("foreign", "sky", "read-only", "copy"):
        systematics.looked_at([whole(sky=glow)(amplitude=1.0)], sky, site, 0, 0)
    assert not sky.any()
    assert sky.flags.writeable


def test_effects_of_one_name_draw_apart(site):
    once = systematics.build("point_sources", {"amplitude": 1.0})
    sky = np.zeros(alm_.size(LMAX), dtype=complex)
    alone = systematics.looked_at([once], sky, site, 1, 0)
    both = systematics.looked_at([once, once], sky, site, 1, 0)
    power = [np.mean(np.abs(one[LMAX + 1 :]) ** 2) for one in (alone, both - alone)]
    assert np.array_equal(systematics.looked_at([once], sky, site, 1, 0), alone)
    correlation = np.mean((alone * (both - alone).conj())[LMAX + 1 :]).real / np.sqrt(power[0] * power[1])
    assert abs(correlation) < 4.0 / np.sqrt(2.0 * alone[LMAX + 1 :].size)


def test_a_file_that_is_written_anew_is_run_anew(tmp_path, monkeypatch):
    """A second diagnosis writes its effects over those of the first, which this process may have used already."""
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    path = tmp_path / "unlisted_of_two.py"
    lines = "from mcsim.reconstruction import AddedPattern\n\n\nclass Of(AddedPattern):\n    name = 'of'\n"
    for value in (1.0, 2.0, 1.0):  # as long as before, and written in the same second
        path.write_text(f"{lines}    coefficients = ({value},)\n")
        kind = systematics.get(str(path))
        assert kind.coefficients == (value,)
        assert systematics.get(str(path)) is kind
        assert vars(sys.modules["unlisted_of_two"])["Of"] is kind  # as workers find it
    path.write_text("1 / 0\n")
    with refused(str(path)):
        systematics.get(str(path))


def test_a_file_that_is_mended_is_run_anew(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    path = tmp_path / "mended_effect.py"
    lines = "from mcsim.reconstruction import AddedPattern\n\n\nclass Of(AddedPattern):\n    name = 'of'\n"
    path.write_text(f"{lines}    unit = ''\n")
    for _ in range(2):
        with refused(str(path), "unit"):
            systematics.get(str(path))
    path.write_text(f"{lines}    unit = 'uK'\n")
    assert systematics.get(str(path)).unit == "uK"


def test_a_file_whose_effect_has_the_name_of_a_built_in_one_is_refused(tmp_path, monkeypatch):
    """It stood in the library for that one, and its verdict would have been read so."""
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    path = tmp_path / "of_a_name.py"
    lines = "from mcsim.reconstruction import AddedPattern\n\n\nclass Of(AddedPattern):\n    name = 'calibration'\n"
    path.write_text(lines)
    with refused(str(path), "calibration"):
        systematics.get(str(path))


def test_a_file_named_like_a_module_of_python_or_no_module_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", "")
    for name in ("time.py", "of.two.py"):
        (tmp_path / name).write_text("x = 1\n")
        with refused(str(tmp_path / name), "rename"):
            systematics.get(str(tmp_path / name))
