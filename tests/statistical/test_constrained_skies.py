"""Skies that maps constrain have the power of the sky: Monte Carlo, k sigma."""

import numpy as np

from instruments import two_channels
from mcsim import config
from mcsim.bipolar import power_spectrum
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.campaign import seeded
from mcsim.datavector.shared_sky import shared_sky
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

SKIES, LMAX, NSIDE = 60, 20, 8


def test_constrained_skies_have_the_power_of_the_sky() -> None:
    """At the last degrees, l > 2 nside, where analyses by quadrature alone leak."""
    run = config.load(two_channels("two", lmax=LMAX, nside=NSIDE, fwhm_arcmin=700.0))
    model = analysis_of(run).model
    of_data, of_draws = (survey(seeded(run, seed)) for seed in (1, 2))
    last, excess = np.arange(2 * NSIDE + 1, LMAX + 1), []
    for number in range(SKIES):
        true, drawn = (simulate.draw_sky(shared, number) for shared in (of_data, of_draws))
        data = list(simulate.maps(of_data, number, sky=true))
        maps = list(simulate.maps(of_draws, number + SKIES, sky=drawn))
        sky = drawn + shared_sky(model, data) - shared_sky(model, maps)
        apart = power_spectrum(sky, sky, LMAX) - power_spectrum(true, true, LMAX)
        excess.append(np.average(apart[last] / model.cl[last], weights=2 * last + 1))
    assert abs(np.mean(excess)) < 4.0 * np.std(excess, ddof=1) / np.sqrt(SKIES)
