"""What is simulated ahead is asked for once; skies that the data constrain are without the gain that is fitted."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from instruments import two_channels
from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import with_effects
from mcsim.datavector.same_skies import SameSkies
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey


def test_effects_are_asked_for_at_once_and_then_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then only skies without effects are simulated, once for both effects."""

    def jobs(own: Any, found: Any, constrained: bool, skies: int, first: int = 0, there: Any = ()) -> list[Any]:
        name = "".join(effect.name for effect in found)
        return [SimpleNamespace(simulated=name, first=first, count=skies - first, observed=None, source=None)]

    def ask(wanted: Any) -> list[np.ndarray]:
        asked.append([job.simulated for job in wanted])
        return [np.full((job.count, 2), float(len(job.simulated))) for job in wanted]

    asked: list[list[str]] = []
    monkeypatch.setattr(SameSkies, "_jobs", jobs)
    monkeypatch.setattr(SameSkies, "skies_of", lambda *_: "constrained")
    monkeypatch.setattr(SameSkies, "gains", lambda *_: ())
    monkeypatch.setattr("mcsim.datavector.same_skies.replace", lambda job, **_: job)
    skies = SameSkies(None, ask, ())  # type: ignore[arg-type]
    effects = [config.Effect(name=name) for name in ("a", "bb")]
    skies.ahead(effects, 3)
    pairs = [skies.pair([effect], 3, True) for effect in effects]
    assert asked == [["a", "bb"], [""]]
    for size, (before, after) in enumerate(pairs, 1):
        np.testing.assert_array_equal(before, np.zeros((3, 2)))
        np.testing.assert_array_equal(after, np.full((3, 2), size))
    skies.pair(effects[:1], 3, True)  # what was simulated ahead serves once
    assert asked[2:] == [["a"]]


def test_the_sky_of_maps_with_a_gain_is_found_without_it() -> None:
    """Responses are those in the sky itself: in a sky with the gain they would be larger by it."""
    run = config.load(two_channels("gains", sigma0_uk=1.0))
    analysis = analysis_of(run, without=tuple(name for name in systematics.catalogue() if name != "beam_width"))

    def ask(jobs: Any) -> list[np.ndarray]:
        return [data_vectors(job) for job in jobs]

    plain = list(simulate.maps(survey(run), 0))
    wider = config.Effect(name="beam_width", channel="V1", parameters={"amplitude": 0.05})
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
