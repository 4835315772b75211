"""A line of sight that trembles."""

from dataclasses import dataclass, replace

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization


@dataclass(frozen=True, kw_only=True)
class PointingJitter(Effect):
    """The true direction of every sample is off by a random angle, Gaussian along each axis and fresh every time.

    Attributes
    ----------
    amplitude
        Mean square along each axis, arcmin^2: 4 is an rms of 2' along the scan and 2' across.

    Notes
    -----
    The mean over many samples is the sky through b_lm exp(-(l(l+1) - m^2) amplitude / 2), for both routes; what single
    samples scatter about it is left out, as is a correlation over the time in which a beam passes. The mean square
    can be fitted linearly, the rms cannot. A negative amplitude, for templates, sharpens the beam.
    """

    name = "pointing_jitter"
    scope = "channel"
    unit = "arcmin^2"
    wording = Wording("mean square {}", " arcmin²")
    cause = "Thrusters, wheels or star trackers: attitude that is known with noise, or moves within a sample."
    signature = "L = 0, as of a wider beam: degenerate with beam_width for beams that are nearly Gaussian."
    source = "Planck 2013 results VI, A&A 571, A6 (detector pointing and its errors)"
    step = 1.0
    bounds = (Bound("amplitude", 0.0, 400.0, "a variance, and one of (20 arcmin)^2 is no jitter but a broad beam"),)
    parametrization = Parametrization(sign=1)
    proposed = False

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Smear the beam."""
        ell, m = np.arange(beam.lmax + 1.0), np.arange(beam.mmax + 1.0)[:, None]
        reach = np.maximum(ell * (ell + 1.0) - m**2, 0.0) * 0.5 * self.amplitude * np.deg2rad(1.0 / 60.0) ** 2
        if reach.min() < -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} sharpens the beam by more than a template may; "
                f"keep it above {self.amplitude / -reach.min():.3g}."
            )
        return replace(beam, blm=beam.blm * np.exp(-reach))
