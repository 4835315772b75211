"""Light of a pattern that nobody knows, too fine to be measured degree by degree, is found by its power."""

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned_small
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.inference import diagnose_data
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import simulate
from mcsim.sphere import rng

LMAX, NSIDE, FIRST = 40, 16, 9


def scored(jobs):
    return [simulated_scores.scores(job) for job in jobs]


@pytest.fixture(scope="module")
def drawn():
    """Return coefficients of degrees FIRST to LMAX, with a spectrum that falls as l^-2."""
    ell = healpy.Alm.getlm(LMAX)[0]
    draw = rng.generator(5, 0, "pattern").standard_normal((2, len(ell)))
    real = healpy.Alm.getlm(LMAX)[1] == 0
    alm = np.where(real, draw[0] * np.sqrt(2.0), draw[0] + 1j * draw[1])
    return np.where(ell >= FIRST, alm / np.maximum(ell, 1), 0.0)


@pytest.mark.parametrize(("index", "rms_uk"), [(-3.0, 1.0), (1.5, 2.0)])
def test_the_power_of_a_foreground_is_found_with_its_index(drawn, index, rms_uk):
    """With the power of the frequency, in all channels, falling with the degree; and nothing follows it."""
    small = learned_small()
    data = data_of(small.run)
    maps, added = list(simulate.maps(data, 3)), []
    for number, channel in enumerate(data.channels):
        seen = healpy.alm2map(healpy.almxfl(drawn, channel.response.factors[0].real), NSIDE)
        scale = (channel.site.frequency_ghz / 94.0) ** index * rms_uk / np.std(seen)
        added.append(scale * seen)
        maps[2 * number : 2 * number + 2] = [one + scale * seen for one in maps[2 * number : 2 * number + 2]]
    observed = ObservedMaps(small, maps, ask)
    found = unlisted.reconstructed(diagnose_data(observed, "pattern"), observed, scored)
    (first,) = found.unlisted
    assert (first.stage, first.frame, first.kind, first.channel) == ("added", "sky", "power", None)
    assert first.index == index
    assert first.pvalue < 1e-4
    assert "residual foreground" in first.cause
    assert found.unlisted_held_out is None
    # The power of a range is that of its degrees by their S/N, which falls.
    assert first.rms_uk == pytest.approx(np.std(added), rel=0.15)
    sizes = [size for *_, size, _ in first.profile]
    assert sizes[0] > sizes[1] > 0.0
    assert first.profile[0][:2] == (FIRST, 12)
