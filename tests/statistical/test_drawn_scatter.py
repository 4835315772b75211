"""Errors of amplitudes where patterns are drawn: Monte Carlo, k sigma."""

import numpy as np

from mcsim.stats.gaussian import SimulatedGaussian, with_drawn_scatter

P, SIMULATIONS, DRAWS, TRIALS = 40, 400, 16, 80


def test_pulls_beside_drawn_patterns_have_unit_width() -> None:
    """The pattern moves the amplitudes, and its covariance is that of 16 draws."""
    rng = np.random.default_rng(20140317)
    t, truth = rng.normal(size=(P, 2)), np.array([10.0, 4.0])
    modes = rng.normal(size=(P, 8)) * np.array([3.0, 2.0, 2.0, 1.0, 1.0, 1.0, 0.5, 0.5])
    modes[:, 0] = t @ [3.0, 0.5]
    pulls = []
    for _ in range(TRIALS):
        null = SimulatedGaussian.from_simulations(rng.normal(size=(SIMULATIONS, P)))
        draws = modes @ rng.normal(size=(8, DRAWS))
        scatter = (draws - draws.mean(axis=1, keepdims=True)) * np.sqrt((1.0 + 1.0 / DRAWS) / (DRAWS - 1.0))
        x = t @ truth + modes @ rng.normal(size=8) + rng.normal(size=P)
        found = null.with_extra_covariance(scatter).fit(x, t)
        wide = with_drawn_scatter(null, t, found, [scatter])
        np.testing.assert_array_equal(wide.amplitudes, found.amplitudes)
        pulls.append((found.amplitudes - truth) / wide.errors)
    # A width has an error of 1/sqrt(2 TRIALS), and that of 16 draws of about a sixth averages out: 3.5 sigma.
    widths = np.sqrt(np.mean(np.square(pulls), axis=0))
    np.testing.assert_allclose(widths, 1.0, atol=3.5 / np.sqrt(2.0 * TRIALS))
