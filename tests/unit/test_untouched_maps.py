"""Maps of channels without an effect, kept for the next effect."""

from typing import Any

import numpy as np
import pytest

from mcsim import config
from mcsim.datavector import untouched_maps
from mcsim.datavector.untouched_maps import UntouchedMaps, without_effects
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey


def run(*effects: dict[str, Any]) -> config.RunConfig:
    """Two channels of one beam, one of which an effect may change."""
    channels = [
        {
            "name": name,
            "frequency_ghz": 94.0,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0},
            "noise": {"sigma0_uk": 20.0},
            "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
        }
        for name in ("W1", "W2")
    ]
    sections = {"sky": {"spectrum": "wmap7", "lmax": 16}, "map": {"nside": 8}, "ensemble": {"seed": 3}}
    return config.load({"schema": 1, "name": "two", "channel": channels, "effect": list(effects), **sections})


def test_maps_without_an_effect_are_made_once_for_all_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second effect in the same sky, and the same maps but for rounding; another sky is another map."""
    made = []
    maps_of = simulate.maps_of
    monkeypatch.setattr(simulate, "maps_of", lambda *given: made.append(given[1].name) or maps_of(*given))
    kept = UntouchedMaps()
    wider, louder = ({"name": name, "channel": "W1", "amplitude": 0.1} for name in ("beam_width", "noise_level"))
    for effect, realization, new in ((wider, 0, ["W1", "W2"]), (louder, 0, ["W1"]), (louder, 1, ["W1", "W2"])):
        acting = run(effect)
        own = survey(acting)
        found = kept.maps(own, realization, None, without_effects(config.to_json(acting)))
        assert made == new
        np.testing.assert_allclose(found, simulate.maps(own, realization), rtol=0.0, atol=1e-10)  # of 50 uK rms
        made.clear()


@pytest.mark.parametrize(("maps", "expected"), [(5, 5), (1, 4)])
def test_no_more_maps_are_kept_than_the_memory_holds(monkeypatch: pytest.MonkeyPatch, maps: int, expected: int) -> None:
    """But those of two realizations, which the next effects need."""
    monkeypatch.setattr(untouched_maps, "MEMORY", maps * 8 * 12 * 8**2)
    kept, own = UntouchedMaps(), survey(run({"name": "beam_width", "channel": "W1", "amplitude": 0.1}))
    for realization in range(7):
        kept.maps(own, realization, None, "")
    assert len(kept._kept) == expected
