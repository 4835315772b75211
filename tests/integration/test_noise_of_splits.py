"""Noise that is higher in one split: it is said, for effects on the noise act on all splits of a channel."""

import numpy as np
import pytest

from instruments import ask, data_of, learned_small
from mcsim.diagnosis.noise_of_splits import certain
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def small():
    return learned_small()


def with_noise(small, factors, seed):
    """Return data in which the noise of every map is so many times that of the model."""
    made = data_of(small.run, seed=seed)
    sky = np.array(simulate.maps(made.without_noise, 0))
    noise = np.array(simulate.maps(made, 0)) - sky
    return ObservedMaps(small, list(sky + np.array(factors)[:, None] * noise), ask)


@pytest.mark.parametrize("split", [0, 1])
def test_noise_of_one_split_is_no_level_of_the_channel_and_told_with_its_size(small, split):
    """It was a noise level of the channel, half as large, and parts of the data agreed."""
    factors = np.ones(4)
    factors[2 + split] = 1.3
    found = diagnose_data(with_noise(small, factors, 900), "one split")
    (note,) = (one for one in found.notes if "split_noise" in one)
    name = small.analysis.model.channels[1]
    assert note.startswith(f"The splits of {name} do not")
    told = note.partition("deviation is ")[2].partition(" times")[0].split(", ")
    sizes = [one.partition(" in ")[0].split(" ± ") for one in told]
    for (value, error), factor in zip(sizes, factors[2:], strict=True):
        assert abs(float(value) - factor) < 4.0 * float(error) < 0.3
    assert found.kind == "unknown"
    (refused,) = (one for one in found.contradicted if [own.name for own in one.effects] == ["noise_level"])
    (own,) = (one for (each,) in [refused.effects] for one in each.consistency if one.kind == "splits")
    assert own.pvalue < 1e-4
    assert own.slices == ("half1", "half2")


def test_noise_of_all_splits_alike_is_an_effect_without_a_note(small):
    found = diagnose_data(with_noise(small, [1.0, 1.0, 1.3, 1.3], 900), "alike")
    assert [one.name for one in found.effects] == ["noise_level"]
    assert not any("split_noise" in one for one in found.notes)
    (own,) = (one for one in found.effects[0].consistency if one.kind == "splits")
    assert np.all(np.abs(np.array(own.amplitudes) - 1.0) < 4.0 * np.array(own.errors))
    assert np.all(np.array(own.errors) < 0.15)


def test_perfect_maps_have_no_such_note(small):
    made = data_of(small.run)
    each = (ObservedMaps(small, list(simulate.maps(made, r)), ask).noise_of_splits for r in range(12))
    assert not any(certain(one) for one in each)
