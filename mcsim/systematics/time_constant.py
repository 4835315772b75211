"""A detector that answers late."""

from dataclasses import dataclass

import numpy as np

from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.shape import smeared

_NODES = 7


@dataclass(frozen=True, kw_only=True)
class TimeConstant(Effect):
    """The signal is the mean of the past, weighted by exp(-age / amplitude).

    Notes
    -----
    In the default route the line of sight moves on the circle about the spin axis, at the rate of the spin plus the
    part of the precession along the spin axis (WMAP: -3.3 %). What is left of the precession, 1.4 % of the spin's
    rate, changes direction with every spin and is left out. The sample-by-sample route goes to the true earlier
    pointings, precession and all, by Gauss-Laguerre quadrature. A negative amplitude, for templates, weighs the future.
    """

    name = "time_constant"
    scope = "channel"
    unit = "s"
    wording = Wording("{}", " ms", 1000.0)
    cause = "Heat capacity of a bolometer, or a filter in the electronics, not deconvolved."
    signature = "Lag and smear along beam x: nearly degenerate with a pointing offset along the scan, and with m = 2."
    source = "Planck 2013 results VII, A&A 571, A7 (time response of bolometers)"
    step = 0.001
    bounds = (
        Bound(
            "amplitude",
            -2.0,
            2.0,
            "a prior of this library: far beyond the main time constant of any bolometer in use",
        ),
    )

    def pointing(self, beam: Beam, site: Site) -> Beam:
        """Trail the beam along the circle of the spin."""
        pointed = site.pointed(self.name)
        model = pointed.model
        turns = 1.0 / model.spin_period_s + np.cos(np.deg2rad(model.precession_angle_deg)) / model.precession_period_s
        return smeared(beam, np.deg2rad(pointed.line.boresight_angle_deg), 2.0 * np.pi * turns * self.amplitude)

    def lags(self) -> tuple[tuple[float, float], ...] | None:
        """Return the nodes of the exponential: exact for polynomials in time of degree 13."""
        if self.amplitude == 0.0:
            return ((1.0, 0.0),)
        ages, weights = np.polynomial.laguerre.laggauss(_NODES)
        return tuple((float(weight), float(age) * self.amplitude) for weight, age in zip(weights, ages, strict=True))
