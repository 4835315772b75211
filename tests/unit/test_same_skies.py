"""What is simulated ahead is asked for once."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mcsim import config
from mcsim.datavector.same_skies import SameSkies


def test_effects_are_asked_for_at_once_and_then_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then only skies without effects are simulated, once for both effects."""

    def jobs(own: Any, found: Any, constrained: bool, skies: int, first: int = 0) -> list[Any]:
        name = "".join(effect.name for effect in found)
        return [SimpleNamespace(simulated=name, first=first, count=skies - first, observed=constrained, source=None)]

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
    skies.pair(effects[:1], 3, True)  # what was simulated ahead serves once
    assert asked[2:] == [["a"]]
