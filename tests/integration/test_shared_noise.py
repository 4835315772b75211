"""Noise that maps have in common: it is said, and nothing is named or detected that is not there."""

from dataclasses import replace

import numpy as np
import pytest

from instruments import ask, data_of, learned_small
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate


@pytest.fixture(scope="module")
def small():
    return learned_small()


def with_noise_in_common(small, pairs, correlation, seed, scale=1.0):
    """Return data in which the second map of each pair has a part of the first one's noise."""
    shared = data_of(small.run, seed=seed)
    sky = np.array(simulate.maps(shared.without_noise, 0))
    noise = np.array(simulate.maps(shared, 0)) - sky
    level = [one.noise_uk for one in shared.maps]
    for a, b in pairs:
        own = np.sqrt(1.0 - correlation**2) * noise[b]
        noise[b] = scale * (correlation * level[b] / level[a] * noise[a] + own)
    return ObservedMaps(small, list(sky + noise), ask)


def found_in(data):
    """Return maps and correlations of the sentence of data, in the order of the model's."""
    names = data.context.analysis.model.survey.map_names
    (sentence,) = data.noise_in_common
    told = [one.split(" (correlation ") for one in sentence.partition(": ")[2].split("), ")]
    return [(tuple(map(names.index, pair.split(" and "))), float(r.split(" ±")[0])) for pair, r in told]


@pytest.mark.parametrize("correlation", [0.5, 0.9])
def test_two_splits_with_noise_in_common_are_unknown_and_nothing_is_detected(small, correlation):
    """Less noise, a residual dipole and a narrower beam were."""
    data = with_noise_in_common(small, [(0, 1)], correlation, 500)
    found = diagnose_data(data, "splits")
    assert (found.kind, found.sets, found.partial) == ("unknown", (), ())
    assert found.verdict["notes"][0].startswith("The model fits (p = ")
    ((pair, r),) = found_in(data)
    assert pair == (0, 1)
    assert r == pytest.approx(correlation, abs=0.1)


def test_noise_that_two_channels_have_in_common_is_noted_where_nothing_departs(small):
    data = with_noise_in_common(small, [(0, 2), (1, 3)], 0.3, 500)
    found = diagnose_data(data, "channels")
    assert found.kind == "none"
    assert found.notes == tuple(data.noise_in_common)
    assert [pair for pair, _ in found_in(data)] == [(0, 2), (1, 3)]
    assert [r for _, r in found_in(data)] == pytest.approx([0.3, 0.3], abs=0.12)


def test_noise_that_all_maps_have_in_common_is_no_set_of_effects(small):
    """It was called a calibration, less noise and a dipole: all maps have it, like the sky."""
    data = with_noise_in_common(small, [(0, 1), (0, 2), (0, 3)], 0.4, 500)
    found = diagnose_data(data, "all")
    assert (found.kind, found.sets) == ("unknown", ())
    assert {(0, 1), (0, 2), (0, 3)} <= {pair for pair, _ in found_in(data)}


def test_perfect_maps_have_no_noise_in_common(small):
    shared = data_of(small.run)
    assert not any(ObservedMaps(small, list(simulate.maps(shared, r)), ask).noise_in_common for r in range(12))


@pytest.mark.parametrize(
    ("name", "amplitude"),
    [("beam_ellipticity", 1.0), ("noise_level", 0.3), ("pointing_offset", 40.0), ("beam_width", 0.1)],
)
def test_effects_are_no_noise_in_common(small, name, amplitude):
    data = ObservedMaps(small, list(simulate.maps(data_of(small.run, name, "W1", amplitude=amplitude), 1)), ask)
    assert data.gap.pvalue < 1e-6
    assert data.noise_in_common == []


def test_what_other_numbers_contradict_is_not_said(small):
    """Noise in common and twice as much of it."""
    assert with_noise_in_common(small, [(0, 1)], 0.5, 500, scale=2.0).noise_in_common == []


def test_maps_without_white_noise_are_not_looked_at(small):
    analysis = small.analysis
    survey = analysis.model.survey.without_noise
    quiet = replace(small, analysis=replace(analysis, model=replace(analysis.model, survey=survey)))
    data = with_noise_in_common(small, [(0, 1)], 0.5, 500)
    assert ObservedMaps(quiet, data.data, ask).noise_in_common == []
