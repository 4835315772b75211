"""Properties of the configuration: lossless round trips, and nothing but InputError for anything that is wrong."""

import copy
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcsim import config
from mcsim.errors import InputError
from refusals import refused

# Most draws are narrower than what so few degrees show.
pytestmark = pytest.mark.filterwarnings("ignore:channel.* is narrower than any map:UserWarning")

LABELS = st.text(st.characters(categories=("L", "N", "P", "S"), exclude_characters="/\\:,{}"), min_size=1, max_size=8)
POSITIVE = st.floats(1e-6, 1e4)
ANGLES = st.floats(-1e3, 1e3)


@st.composite
def ellipticals(draw):
    minor, major = sorted((draw(POSITIVE), draw(POSITIVE)))
    beam = {
        "kind": "elliptical_gaussian",
        "fwhm_major_arcmin": major,
        "fwhm_minor_arcmin": minor,
        "angle_deg": draw(ANGLES),
    }
    return beam | draw(st.sampled_from([{}, {"m_max": 0}, {"m_max": 2}]))


BEAMS = st.fixed_dictionaries({"kind": st.just("gaussian"), "fwhm_arcmin": POSITIVE}) | ellipticals()
# Any existing file will do for the keys that name files: this one.
SCANS = (
    st.fixed_dictionaries({"kind": st.just("parallel_transport")}, optional={"psi0_deg": st.floats(-720.0, 720.0)})
    | st.fixed_dictionaries({"kind": st.just("moments"), "path": st.just(__file__)})
    | st.fixed_dictionaries(
        {"kind": st.just("hit_averaged"), "model": st.just(__file__)},
        optional={"sample_period_s": POSITIVE, "line_of_sight": LABELS},
    )
)
CHANNELS = st.lists(
    st.fixed_dictionaries(
        {"name": LABELS, "beam": BEAMS, "scan": SCANS},
        optional={"frequency_ghz": POSITIVE, "noise": st.fixed_dictionaries({"sigma0_uk": st.floats(0.0, 1e9)})},
    ),
    min_size=1,
    max_size=3,
    unique_by=lambda channel: channel["name"],
)


@st.composite
def runs(draw):
    """A valid run as TOML would give it."""
    nside = 2 ** draw(st.integers(1, 9))
    lmax = draw(st.integers(2, 3 * nside - 1))
    splits = draw(st.lists(LABELS, unique=True, max_size=3))
    # One file of moments does not tell spans of time apart.
    kinds = st.fixed_dictionaries({"splits": st.just(splits), "split_by": st.sampled_from(["rings", "sets"])})
    return {
        "schema": 1,
        "name": draw(LABELS),
        "sky": {"spectrum": "wmap7", "lmax": draw(st.integers(lmax, 4000))},
        "map": {"nside": nside, "frame": draw(st.sampled_from(["ecliptic", "galactic", "equatorial"]))}
        | (draw(kinds) if splits else {}),
        "channel": draw(CHANNELS),
        "biposh": {"lmax": lmax, "L_max": draw(st.integers(0, 2))},
        "ensemble": {"realizations": draw(st.integers(1, 10**6)), "seed": draw(st.integers(0, 2**63 - 1))},
    }


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=10,
)
WORDS = st.sampled_from(
    ["schema", "name", "sky", "map", "channel", "biposh", "ensemble", "compute", "kind", "beam", "scan", "path", "lmax"]
)


def leaves(value, trail=()):
    """Every place of a nested structure."""
    yield trail
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from leaves(item, (*trail, key))


@settings(max_examples=60)
@given(runs())
def test_round_trips_are_lossless(plain):
    run = config.load(plain)
    assert config.from_json(config.to_json(run)) == run
    assert config.load(config.to_dict(run)) == run
    assert config.load(json.loads(json.dumps(config.resolved(run)))).channels == run.channels


@settings(max_examples=20)
@given(runs(), st.integers(1, 10**6), st.integers(1, 64), LABELS, st.booleans())
def test_hash_ignores_how_much_and_how_it_is_computed(plain, realizations, workers, name, keep_maps):
    other = copy.deepcopy(plain) | {"name": name, "compute": {"workers": workers}}
    other["ensemble"] |= {"realizations": realizations, "keep_maps": keep_maps}
    assert config.digest(config.load(plain)) == config.digest(config.load(other))


@pytest.mark.slow
@settings(max_examples=150)
@given(st.data())
def test_anything_put_anywhere_loads_or_is_refused_in_a_sentence(data):
    plain = data.draw(runs())
    trail = data.draw(st.sampled_from([place for place in leaves(plain) if place]))
    holder = plain
    for key in trail[:-1]:
        holder = holder[key]
    if isinstance(holder, dict) and data.draw(st.booleans()):
        holder[data.draw(WORDS | st.text(max_size=10))] = data.draw(JSON)
    else:
        holder[trail[-1]] = data.draw(JSON)
    try:
        run = config.load(plain)
    except InputError as refused:
        sentence = str(refused)
    else:
        assert config.from_json(config.to_json(run)) == run
        return
    assert sentence.startswith("configuration")
    assert sentence.endswith(".")
    assert "\n" not in sentence


@pytest.mark.slow
@settings(max_examples=100)
@given(st.dictionaries(WORDS | st.text(max_size=10), JSON, max_size=5))
def test_arbitrary_dicts_are_refused_in_a_sentence(plain):
    with refused("configuration"):
        config.load(plain)
