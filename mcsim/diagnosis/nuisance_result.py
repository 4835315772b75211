"""What the data make of the nuisances of a model: posterior, prior and pull."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mcsim.datavector.nuisances import Regression
from mcsim.simulation.nuisance import Nuisance
from mcsim.support.arrays import Vector

LEAST = 0.1  #: share of the prior variance that the data have to remove for a pull to be given


@dataclass(frozen=True)
class NuisanceResult:
    """One linear component of a nuisance: its prior, and what the data make of it."""

    #: name, channel, component, parameters, unit, label: of the effect; ``channel`` None: all; ``component`` counts
    #: from 1, None for an effect of one
    name: str
    channel: str | None
    component: int | None
    parameters: dict[str, float | str | tuple[float, ...]]
    unit: str
    label: str
    #: prior_mean, prior_width, amplitude, sigma: mean and standard deviation before and after the data
    prior_mean: float
    prior_width: float
    amplitude: float
    sigma: float
    #: shift of the mean over the standard deviation that it has if the prior is right; None if the data do not
    #: constrain the component
    pull: float | None
    words: str  #: posterior and prior as people read them


def results(nuisances: Sequence[Nuisance], regression: Regression, x: Vector) -> Iterator[NuisanceResult]:
    """Yield the components of nuisances with their posterior for data, shape (p_raw,)."""
    found, after = regression.posterior(x, np.concatenate([one.mean for one in nuisances]))
    start = 0
    for one in nuisances:
        k = len(one.widths)
        for place, (mean, width) in enumerate(zip(one.mean, one.sigma, strict=True)):
            now, sigma = float(found[start + place]), float(after[start + place])
            gained = float(width**2 - sigma**2)
            pull = float(now - mean) / float(np.sqrt(gained)) if gained > LEAST * width**2 else None
            before = one.effect.format_amplitude(float(mean), float(width))
            yield NuisanceResult(
                name=one.effect.name,
                channel=one.channel,
                component=place + 1 if k > 1 else None,
                parameters={**one.settings, **{f"{key}_width": value for key, value in one.parameter_widths.items()}},
                unit=one.effect.unit,
                label=one.title + (f", component {place + 1}" if k > 1 else ""),
                prior_mean=float(mean),
                prior_width=float(width),
                amplitude=now,
                sigma=sigma,
                pull=pull,
                words=f"{one.effect.format_amplitude(now, sigma)} (prior {before})",
            )
        start += k
