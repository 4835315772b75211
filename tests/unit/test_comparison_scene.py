"""Scenes of a comparison, and what they share."""

import numpy as np
import pytest

import mcsim
from mcsim.comparison.scene import Scene

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
