"""Surveys with a user's own effects, and with nuisances that are such effects."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

import healpy
import numpy as np
import pytest

import mcsim
from instruments import two_channels
from mcsim import config, systematics
from mcsim.ensemble import store
from mcsim.ensemble.plan import attributes, check_store, layout
from mcsim.simulation import simulate
from mcsim.simulation.channels import check_effects
from mcsim.simulation.nuisance import DisturbedSurvey, tables
from mcsim.simulation.survey import survey
from mcsim.systematics import Site
from refusals import refused, unnamed


@dataclass(frozen=True, kw_only=True)
class Own(mcsim.Effect):
    scope = "common"
    unit = "fraction"
    cause = "A test."
    signature = "None."
    step = 0.01


@dataclass(frozen=True, kw_only=True)
class BentGain(Own):
    name = "bent_gain"

    def gain(self, time_s, site):
        return self.amplitude * np.cos(time_s / 1e6) + 10.0 * self.amplitude**2


@dataclass(frozen=True, kw_only=True)
class BentSignal(Own):
    name = "bent_signal"

    def signal(self, time_s, theta, phi, psi, site):
        return 100.0 * self.amplitude * np.cos(psi) + 1000.0 * self.amplitude**2


@dataclass(frozen=True, kw_only=True)
class HighGain(Own):
    name = "high_gain"

    def gain(self, time_s, site):
        if self.amplitude == 0.0 or site.frequency_ghz < 80.0:
            return None
        return self.amplitude * np.cos(time_s / 1e6)


@dataclass(frozen=True, kw_only=True)
class Rounded(Own):
    name = "rounded"

    def beam(self, beam, site):
        return beam.circular()


def test_an_effect_may_leave_fewer_orders_than_the_model_has():
    """The dipole is taken off through the beam of the model; it is the sky through a circular one that is left."""
    table = two_channels("own", lmax=12, nside=8, sigma0_uk=0.0, period_s=300.0)
    oval = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 900.0, "fwhm_minor_arcmin": 700.0}
    acting, fiducial = (
        config.load(table | {"channel": [channel | {"beam": beam} for channel in table["channel"]], "effect": effects})
        for beam, effects in ((oval, [{"name": "rounded", "amplitude": 1.0}]), (oval | {"m_max": 0}, []))
    )
    found = survey(acting, library={**systematics.catalogue(), "rounded": Rounded})
    np.testing.assert_allclose(simulate.maps(found, 0), simulate.maps(survey(fiducial), 0), atol=1e-9)


FORGOTTEN = """
from dataclasses import dataclass
import mcsim


@dataclass(frozen=True, kw_only=True)
class Forgotten(mcsim.Effect):
    name, scope, unit, step = "forgotten", "channel", "fraction", 0.01
    cause = signature = source = "A test."

    def gain(self, time_s, site):
        self.amplitude * time_s
"""


def test_a_gain_whose_return_is_forgotten_is_told_of(tmp_path):
    """Such a run was the one without the effect, without a word."""
    (tmp_path / "forgotten.py").write_text(FORGOTTEN)
    table = two_channels("own", lmax=12, nside=8, sigma0_uk=0.0, period_s=300.0)
    effect = {"name": str(tmp_path / "forgotten.py"), "channel": table["channel"][0]["name"], "amplitude": 0.1}
    with pytest.warns(UserWarning, match="forgotten") as told:
        check_effects(config.load(table | {"effect": [effect]}))
    assert unnamed(str(told[0].message), "forgotten", effect["channel"], 0.1) == []


def test_a_gain_that_begins_on_some_day_is_no_forgotten_one(tmp_path):
    late = FORGOTTEN.replace(
        "self.amplitude * time_s", "return None if time_s.max() < 4e6 else self.amplitude * time_s"
    )
    (tmp_path / "late.py").write_text(late)
    table = two_channels("own", lmax=12, nside=8, sigma0_uk=0.0, period_s=300.0)
    effect = {"name": str(tmp_path / "late.py"), "channel": table["channel"][0]["name"], "amplitude": 0.1}
    check_effects(config.load(table | {"effect": [effect]}))


def test_a_broken_file_of_effects_is_said_before_another_configuration(tmp_path):
    """Its content is a part of the configuration, and was all that was said."""
    own = tmp_path / "own.py"
    own.write_text(FORGOTTEN.replace("self.amplitude *", "return self.amplitude *"))
    table = two_channels("own", lmax=12, nside=8, sigma0_uk=0.0, period_s=300.0)
    run = table | {"effect": [{"name": str(own), "channel": table["channel"][0]["name"], "amplitude": 0.1}]}
    loaded = config.load(run)
    store.create(tmp_path / "own.zarr", layout(survey(loaded)), attributes(loaded))
    check_store(tmp_path / "own.zarr", loaded, resume=False)
    own.write_text("import no_such_module\n" + own.read_text())
    with refused("no_such_module", own):
        check_store(tmp_path / "own.zarr", config.load(run), resume=False)


@pytest.mark.parametrize("kind", [BentGain, BentSignal, HighGain])
def test_a_nuisance_acts_as_the_effect_that_is_drawn(kind):
    """One that is not linear in its amplitude, too, or that changes nothing in one channel."""
    library = {**systematics.catalogue(), kind.name: kind}
    table = two_channels("own", lmax=12, nside=8, fwhm_arcmin=800.0, period_s=300.0)
    run = config.load(table | {"nuisance": [{"effect": kind.name, "width": 0.05}]})
    acting = replace(run, effects=tuple(tables(run, run.ensemble.seed, 1, library)))
    found = simulate.maps(DisturbedSurvey.of(run, library).at(1), 1)
    expected = simulate.maps(survey(acting, library=library), 1)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found[2:] - simulate.maps(survey(replace(run, nuisances=())), 1)[2:]).max() > 1.0


def test_the_page_on_effects_lists_what_a_hook_can_know_of_its_site():
    page = (Path(__file__).parents[2] / "docs" / "howto" / "effect.md").read_text("utf-8")
    assert [one.name for one in fields(Site) if f"\n| `{one.name}` |" not in page] == []


def imaginary(self, sky, site, draw):
    return sky + 1j


def quits(self, sky, site, draw):
    raise SystemExit(3)


FLAWS = {
    "a variance below zero": ("noise", lambda self, site: np.full(12 * site.nside**2, -2.2), ("-2.2", "0.5", "noise")),
    "a flag for a gain": ("gain", lambda self, time_s, site: time_s >= 0.0, ("bool", "gain")),
    "a gain at amplitude zero": ("gain", lambda self, time_s, site: np.full(np.shape(time_s), 0.01), ("gain", "0.01")),
    "a variance at amplitude zero": ("noise", lambda self, site: np.full(12 * site.nside**2, 2.0), ("noise", "1")),
    "a sky that is not real": ("sky", imaginary, ("sky", "m = 0", "real")),
    "a program's end": ("sky", quits, ("sky", "SystemExit")),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_what_a_hook_must_not_return_is_refused_before_a_run(flaw):
    hook, function, named = FLAWS[flaw]
    kind = dataclass(frozen=True, kw_only=True)(type("Hooked", (Own,), {"name": "hooked", hook: function}))
    site = survey(config.load(two_channels("hooked"))).channels[0].site
    with refused("hooked", *named):
        systematics.tried((kind(amplitude=0.5),), site)


@dataclass(frozen=True, kw_only=True)
class Decaying(Own):
    name = "decaying"

    def gain(self, time_s, site):
        return self.amplitude * np.exp(-time_s / self.amplitude)

    def noise(self, site):
        return healpy.smoothing(1.0 + self.amplitude * np.linspace(0.0, 1.0, 12 * site.nside**2), 0.3)


@dataclass(frozen=True, kw_only=True)
class Brighter(Own):
    name = "brighter"

    def sky(self, sky, site, draw):
        return (1.0 + self.amplitude) * sky


@dataclass(frozen=True, kw_only=True)
class BrighterStill(Brighter):
    name = "brighter_still"

    def sky(self, sky, site, draw):
        return super().sky(super().sky(sky, draw=draw, site=site), site, draw)


@pytest.mark.parametrize("kind", [Decaying, BrighterStill])
def test_effects_that_are_undefined_or_smooth_at_zero_or_inherit_are_let_be(kind):
    site = survey(config.load(two_channels("let"))).channels[0].site
    systematics.tried((kind(amplitude=0.5),), site)
