"""Scenes of a comparison, and what they share."""

from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import mcsim
from comparisons import Simulator, small
from mcsim.comparison import effects, pairs
from mcsim.comparison.description import quiet
from mcsim.comparison.differences import State
from mcsim.comparison.effects import EffectDifference
from mcsim.comparison.scene import Scene
from mcsim.comparison.shown_sky import with_shown_sky
from mcsim.systematics import HookError, registry
from mcsim.systematics.beams import BeamEllipticity
from refusals import refused

LMAX = 24


def test_scenes_of_one_late_beam_have_the_orders_of_their_own_moments():
    """What one scene keeps, another one with moments of lower order uses: a reversed spin beside a time shift."""
    beam, window = mcsim.Beam.gaussian(600.0, lmax=LMAX), np.ones(LMAX + 1)
    sky = np.zeros((LMAX + 1) * (LMAX + 2) // 2, complex)
    sky[2:] = 1.0
    high, low = (mcsim.Moments.parallel_transport(nside=8, smax=smax) for smax in (6, 3))
    first = Scene(sky, beam, window, (high,), late=1.0, step=0.1)
    second = Scene(sky, beam, window, (low,), late=1.0, step=0.1, kept=first.kept, moved=first.moved)
    assert first.displaced_beam.mmax > second.displaced_beam.mmax == 3
    assert np.std(second.maps()) == pytest.approx(np.std(first.maps()), rel=0.05)


def test_templates_among_late_samples_are_those_of_their_scene():
    """Those of the first scene served all of its beam: 40 % wrong after a turn, 12 % through another window."""
    simulator = Simulator(small(), 0)
    maps = simulator()
    pair = with_shown_sky(pairs.given(maps, maps, simulator.run).pairs[0])
    run = quiet(simulator.run.of_channels(pair.name))
    assert pair.scene is not None
    late = replace(pair.scene, late=0.3, step=0.05)

    def unused() -> EffectDifference:
        return EffectDifference(BeamEllipticity, np.zeros((2, *np.shape(maps))), run, late.sky)

    used = unused()
    for scene in (late, late.turned(0.6), replace(late, window=late.window**2)):
        state = State(pair, scene, np.stack(maps), ())
        np.testing.assert_array_equal(used._templates_in(state), unused()._templates_in(state))


@pytest.mark.parametrize("largest", [0.0, 0.02])
def test_a_hook_that_fails_ends_a_comparison(largest, registered):
    """The effect was left out, without a word, or taken for one that cannot be so large."""

    @dataclass(frozen=True, kw_only=True)
    class Wider(mcsim.Effect):
        name, scope, unit, step = "wider", "channel", "1", 0.01
        cause = signature = "a test"

        def beam(self, beam, site):
            if abs(self.amplitude) > largest:
                raise ZeroDivisionError("of a user")
            return replace(beam, blm=beam.blm * np.exp(-self.amplitude * (np.arange(beam.lmax + 1.0) / 10.0) ** 2))

    class Entry(EntryPoint):
        def load(self):
            return Wider

    registered(Entry("wider", "package:Wider", registry.ENTRY_POINTS))
    simulator = Simulator(small(), 0)
    maps = simulator()
    pair = with_shown_sky(pairs.given(maps, maps, simulator.run).pairs[0])
    with refused("wider", "beam", "ZeroDivisionError", by=HookError):
        *_, wider = effects.effects_of(pair, simulator.run)
        wider.response(np.array([0.5]), pair.scene, pair)
