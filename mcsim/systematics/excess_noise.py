"""Noise with tails: some samples are hit."""

from dataclasses import dataclass

import numpy as np

from mcsim.errors import InputError
from mcsim.systematics.base import Bound, Effect, Wording
from mcsim.systematics.parametrization import Parametrization, Vector


@dataclass(frozen=True, kw_only=True)
class ExcessNoise(Effect):
    """A random fraction of the samples has a Gaussian of a larger size added, each by itself.

    Attributes
    ----------
    amplitude
        Fraction of the samples; a sample may be hit more than once.
    glitch_uk
        Root mean square of what one hit adds, uK.

    Notes
    -----
    The number of hits is Poisson, so that their sum over h samples is sqrt(n) glitch_uk times a standard normal number,
    n Poisson of mean amplitude h: exact in both routes. The variance of a sample grows by amplitude glitch_uk^2; the
    sum's excess kurtosis is 3 / (amplitude h).
    """

    name = "excess_noise"
    scope = "channel"
    unit = "fraction of samples"
    wording = Wording("{} of the samples", " %", 100.0)
    cause = "Cosmic rays whose tails the flags do not cover, or electronics that spike."
    signature = "Autos only, as more noise: degenerate with noise_level, for tails are not measured."
    source = "Planck 2013 results X, A&A 571, A10 (glitches of HFI and what is left of them)"
    step = 1e-3
    bounds = (
        Bound("amplitude", 0.0, 1.0, "a share of the samples"),
        Bound("glitch_uk", 0.0, 1000000.0, "a size; fixed in a fit"),
    )
    parametrization = Parametrization(
        sign=1, max_amplitude=1.0, stochastic=True, mean_response=True, matched_filter=False
    )
    proposed = False

    glitch_uk: float = 500.0

    def excess(self, count: Vector, rng: np.random.Generator) -> Vector:
        """Return the sum of the hits."""
        if self.amplitude < 0.0:
            raise InputError(f"effect {self.name}: amplitude = {self.amplitude:g} is no fraction; give 0 or more.")
        number = rng.poisson(self.amplitude * count)
        return np.asarray(self.glitch_uk * np.sqrt(number) * rng.standard_normal(number.size))
