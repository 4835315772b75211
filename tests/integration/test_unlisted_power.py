"""Light of a pattern that nobody knows, too fine to be measured degree by degree, is found by its power."""

import healpy
import numpy as np
import pytest

from instruments import ask, data_of, learned_small, scored
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.sphere import rng

LMAX, NSIDE, FIRST = 40, 16, 9


def pattern(first):
    """Return coefficients of degrees from the first to LMAX, with a spectrum that falls as l^-2."""
    ell, m = healpy.Alm.getlm(LMAX)
    draw = rng.generator(5, 0, "pattern").standard_normal((2, len(ell)))
    alm = np.where(m == 0, draw[0] * np.sqrt(2.0), draw[0] + 1j * draw[1])
    return np.where(ell >= first, alm / np.maximum(ell, 1), 0.0)


def described(small, alm, index, rms_uk):
    """Return what is missing in maps with a pattern of this rms at 94 GHz, and what was added to the channels."""
    data, added = data_of(small.run), []
    maps = list(simulate.maps(data, 3))
    for number, channel in enumerate(data.channels):
        seen = healpy.alm2map(healpy.almxfl(alm, channel.response.factors[0].real), NSIDE)
        added.append((channel.site.frequency_ghz / 94.0) ** index * rms_uk / np.std(seen) * seen)
        maps[2 * number : 2 * number + 2] = [one + added[-1] for one in maps[2 * number : 2 * number + 2]]
    observed = ObservedMaps(small, maps, ask)
    return unlisted.reconstructed(diagnose_data(observed, "pattern"), observed, scored), added


@pytest.mark.parametrize(("index", "rms_uk"), [(-3.0, 1.0), (1.5, 2.0)])
def test_the_power_of_a_foreground_is_found_with_its_index(index, rms_uk):
    """With the power of the frequency, in all channels, falling with the degree; and nothing follows it."""
    found, added = described(learned_small(), pattern(FIRST), index, rms_uk)
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


def test_light_of_low_and_high_degrees_is_a_pattern_and_then_a_power():
    """Each alone is less evident than noise of all degrees; two channels hardly tell −2 from −3."""
    found, _ = described(learned_small(), pattern(4), -3.0, 1.0)
    first, second = found.unlisted
    assert (first.stage, first.kind, first.channel) == ("added", "degrees 0-8", None)
    assert (second.stage, second.kind, second.channel) == ("added", "power", None)
    assert {first.index, second.index} <= {-3.0, -2.0}
