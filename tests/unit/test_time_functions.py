"""Functions of time of a shape of their own, against the functions that their names say."""

import numpy as np
import pytest

from mcsim.reconstruction.scores import HISTORY
from mcsim.reconstruction.time_functions import DECAYS, LOBES, histories

DAYS = 365.0


def test_parts_of_a_survey_have_what_their_names_say() -> None:
    day, found = DAYS * np.arange(HISTORY) / HISTORY, histories(DAYS)
    assert len(found) == 3 * (HISTORY - 1) + 2 * len(DECAYS)
    for kind, values in found.items():
        what, number = kind.split()
        there = day >= float(number) - 0.1
        lasting = np.exp(-day / float(number))
        expected = {
            "from": [there],
            "until": [~there],
            "step": [np.ones(HISTORY), np.where(there, 1.0, -1.0)],
            "decay": [lasting],
            "rise": [lasting[::-1]],
        }
        np.testing.assert_allclose(values, np.array(expected[what], dtype=float), rtol=1e-2)


@pytest.mark.parametrize("name", ["crossing 0 2", "crossing 105 2", "crossing 315 2"])
def test_the_sun_in_a_lobe_is_exponential_in_the_cosine(name: str) -> None:
    """Over its value at the peak; a constant is the coefficient of a sphere's first harmonic."""
    _, phase, narrow = name.split()
    constant, waves = LOBES[name][0, 0] / np.sqrt(4.0 * np.pi), LOBES[name][0, 1:].reshape(-1, 2)
    turns, k = np.linspace(0.0, 2.0 * np.pi, 50), np.arange(1, len(waves) + 1)[:, None]
    found = constant + waves[:, 0] @ np.cos(k * turns) + waves[:, 1] @ np.sin(k * turns)
    expected = np.exp(float(narrow) * (np.cos(turns - np.deg2rad(float(phase))) - 1.0))
    np.testing.assert_allclose(found, expected, atol=1e-3)
