"""Fisher information of effects that add power alone, of a random sky."""

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pytest

import mcsim
from mcsim import config, systematics
from mcsim.simulation.survey import survey
from mcsim.sphere.spectra import load
from mcsim.support.arrays import Alm
from mcsim.systematics.foregrounds import PointSources
from refusals import refused


def model(*frequencies_ghz: float) -> config.RunConfig:
    channels = [
        {
            "name": f"F{frequency:g}",
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 1200.0},
            "noise": {"sigma0_uk": 300.0},
            "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
        }
        for frequency in frequencies_ghz
    ]
    sky = {"spectrum": "wmap7", "lmax": 6}
    table = {"schema": 1, "name": "sources", "sky": sky, "map": {"nside": 16}, "biposh": {"L_max": 2}}
    return config.load(table | {"channel": channels})


@dataclass(frozen=True, kw_only=True)
class Steep(PointSources):
    """Sources that are four times as bright, in power, at half the frequency."""

    name = "steep_sources"

    def sky(self, sky: Alm, site: systematics.Site, draw: systematics.Draw) -> Alm:
        assert site.frequency_ghz is not None
        bright = replace(self, amplitude=self.amplitude * (94.0 / site.frequency_ghz) ** 2)
        return PointSources.sky(bright, sky, site, draw)


def fisher(monkeypatch: pytest.MonkeyPatch, run: config.RunConfig, scope: Literal["common", "channel"]) -> Any:
    """Return the Fisher information of steep sources of a scope."""
    known = {"steep_sources": type("Scoped", (Steep,), {"scope": scope})}
    monkeypatch.setattr(systematics, "catalogue", lambda: MappingProxyType(known))
    return mcsim.limit(run, settings=mcsim.LimitSettings(only=("steep_sources",), dense=True)).fisher


def test_power_of_random_sources_is_that_of_their_spectrum() -> None:
    """F = sum (2l + 1)/2 (B_l^2 / C_l)^2 over l >= 2 for a flat spectrum, by draws that are 64 for each mode."""
    run = model(94.0)
    found = mcsim.limit(run, settings=mcsim.LimitSettings(only=("point_sources",), dense=True))
    window = survey(run).channels[0].response.factors[0].real ** 2
    ell, cl = np.arange(7), load("wmap7", 6)
    noise = 4.0 * np.pi / (12 * 16**2) * 300.0**2
    each = (2 * ell + 1) / 2 * (window / (cl * window + noise)) ** 2
    scatter = np.sqrt(np.sum((each[2:] * 2.0) ** 2 * 2.0 / (64 * (2 * ell[2:] + 1)))) / each[2:].sum()
    assert found.fisher[0, 0] == pytest.approx(each[2:].sum(), rel=4.0 * scatter)


def test_power_that_a_single_channel_sees_is_that_at_its_frequency(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two channels, the second has the power that it would have alone; that of the first was taken for it."""
    alone = fisher(monkeypatch, model(47.0), "channel")[0, 0]
    beside = fisher(monkeypatch, model(94.0), "channel")[0, 0]
    assert alone == pytest.approx(16.0 * beside, rel=1e-9)
    both = fisher(monkeypatch, model(94.0, 47.0), "channel")
    one = fisher(monkeypatch, model(94.0, 94.5), "channel")
    assert both[1, 1] == pytest.approx(16.0 * (94.5 / 94.0) ** 4 * one[1, 1], rel=1e-9)


def test_common_power_that_differs_between_channels_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with refused("steep_sources", "sign", "channel"):
        fisher(monkeypatch, model(94.0, 47.0), "common")
