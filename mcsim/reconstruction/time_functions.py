"""Functions of time of a shape of their own: of a survey's time, and of the spin phase as the Sun in a lobe is."""

import numpy as np
from scipy.special import ive

from mcsim.reconstruction.scores import ELONGATION, HISTORY
from mcsim.support.arrays import Matrix

CROSSINGS, NARROW = 24, (2.0, 8.0)
"""Of the Sun in a lobe: how many spin phases of it are tried, and which concentrations of a von Mises function."""

HISTORIES = ("from", "until", "step", "decay", "rise")
"""What is there from a day on, until a day, has another value from a day on, falls since the start of the survey, or
rises until its end."""

DECAYS = (1 / 16, 1 / 8, 1 / 4)  #: times in which a decay has fallen by e, as fractions of the survey


def _crossing(phase: float, narrow: float) -> Matrix:
    """Return a constant, and cosines and sines of the spin phase, of exp(narrow cos(phase of the spin - phase)).

    A lobe whose response is exponential in the cosine of the distance from its axis sees the Sun so, whose distance
    from the spin axis is fixed: a von Mises function, of modified Bessel functions.
    """
    k = np.arange(1, ELONGATION + 1)
    waves = ive(k, narrow)[:, None] * np.stack([np.cos(k * phase), np.sin(k * phase)], axis=1)
    return np.append(ive(0, narrow) * np.sqrt(4.0 * np.pi), 2.0 * waves)[None]


LOBES = {
    f"crossing {360 * n // CROSSINGS} {narrow:g}": _crossing(2.0 * np.pi * n / CROSSINGS, narrow)
    for narrow in NARROW
    for n in range(CROSSINGS)
}


def histories(days: float) -> dict[str, Matrix]:
    """Return the values of functions of a survey's time in its equal parts, shape (1 or 2, HISTORY), by their kind."""
    found, part = dict[str, Matrix](), np.arange(HISTORY)
    for first in range(1, HISTORY):
        after, day = (part >= first).astype(float), f"{days * first / HISTORY:.4g}"
        found |= {f"from {day}": after[None], f"until {day}": 1.0 - after[None]}
        found[f"step {day}"] = np.stack([np.ones(HISTORY), 2.0 * after - 1.0])
    for lifetime in DECAYS:
        fallen = np.exp(-part / HISTORY / lifetime)[None]
        found |= {f"decay {days * lifetime:.3g}": fallen, f"rise {days * lifetime:.3g}": fallen[:, ::-1]}
    return found
