import numpy as np

from mcsim.sphere import rng


def test_stages_and_realizations_differ_and_repeat() -> None:
    draw = {
        key: rng.generator(*key).standard_normal(4).tobytes()
        for key in [(1, 0, "sky"), (1, 1, "sky"), (2, 0, "sky"), (1, 0, "noise/W1"), (1, 0, "noise/W2")]
    }
    assert len(set(draw.values())) == len(draw)
    for key, bits in draw.items():
        assert rng.generator(*key).standard_normal(4).tobytes() == bits


def test_definition_is_fixed() -> None:
    """Stores are extended over years: the generator of a realization must never change."""
    crc_of_sky = 0x62674EF
    expected = np.random.default_rng(np.random.SeedSequence(7, spawn_key=(3, crc_of_sky))).random(5)
    np.testing.assert_array_equal(rng.generator(7, 3, "sky").random(5), expected)
