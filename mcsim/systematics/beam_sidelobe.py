"""A ring of low response around the beam."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization, Vector
from mcsim.systematics.shape import shape

CALIBRATIONS = ("none", "dipole")


@dataclass(frozen=True, kw_only=True)
class _RoundAndQuadrupole(Parametrization):
    """Fit a ring as a mixture of a round one and one with all of its quadrupole, q = 1."""

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        """Return both rings."""
        return {}, {"quadrupole": 1.0}

    def coordinates(self, effect: Any) -> Vector:
        """Return (a - a q, a q)."""
        return np.array([1.0 - effect.quadrupole, effect.quadrupole]) * effect.amplitude

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return a, the sum of both, and q, the share of the second."""
        amplitude = float(coordinates.sum())
        return {"amplitude": amplitude, "quadrupole": float(coordinates[1]) / amplitude if amplitude else 0.0}


@dataclass(frozen=True, kw_only=True)
class BeamSidelobe(Effect):
    """The beam less a ring a exp(-((r/sigma - r0)/width)^2/2) (1 + q cos 2 phi), relative to its peak.

    Attributes
    ----------
    amplitude
        a: positive where the response is negative.
    quadrupole
        q: how much stronger the ring is along the scan (phi = 0) than on average.
    radius_sigmas, width_sigmas
        r0 and width of the ring, in sigmas of the Gaussian with the beam's solid angle.
    calibrated
        "none": the peak stays, and the beam's integral changes: it picks up a share of the dipole. "dipole": the gain
        is set by the dipole, so that none of it is left; the rest of the signal is rescaled by that.
    """

    name = "beam_sidelobe"
    scope = "channel"
    unit = "fraction of the peak"
    wording = Wording("negative ring of {} of the peak", " %", 100.0, negative="ring of {} of the peak")
    cause = "Spill-over, struts or panels of the mirror; negative where two horns are subtracted."
    signature = "A halo at low l, pick-up of the plane and the dipole, and with q the m = 2 part of b_lm."
    source = "Barnes et al. 2003, ApJS 148, 51 (WMAP's sidelobes, negative and positive); the shape is a model"
    step = 1e-5
    bounds = (
        Bound("amplitude", -0.08, 0.08, "beyond it the default ring holds more than the main beam"),
        Bound("quadrupole", -1.0, 1.0, "the ring has one sign all around"),
        Bound("radius_sigmas", 0.0, 20.0, "a ring around the main beam, by definition; fixed in a fit"),
        Bound("width_sigmas", 0.5, 20.0, "narrower rings are none that the beam's coefficients hold; fixed in a fit"),
    )
    parametrization = _RoundAndQuadrupole()
    variants = ({"calibrated": "none"}, {"calibrated": "dipole"})

    quadrupole: float = 0.0
    radius_sigmas: float = 5.0
    width_sigmas: float = 1.0
    calibrated: str = "none"

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Take the ring off."""
        if self.calibrated not in CALIBRATIONS:
            raise InputError(
                f"effect {self.name}: calibrated = {self.calibrated!r} must be one of {', '.join(CALIBRATIONS)}."
            )
        if self.width_sigmas < 0.5 or self.radius_sigmas < 0.0:
            raise InputError(
                f"effect {self.name}: a ring of radius_sigmas = {self.radius_sigmas:g} and width_sigmas = "
                f"{self.width_sigmas:g} is none that the beam's coefficients hold; give width >= 0.5 and radius >= 0."
            )
        form = shape(beam, 2)
        ring = np.exp(-0.5 * ((form.theta / form.sigma - self.radius_sigmas) / self.width_sigmas) ** 2)
        ring = ring * (1.0 + self.quadrupole * np.cos(2.0 * form.phi))
        changed = form.with_added(-self.amplitude * form.peak * ring, 2 if self.quadrupole else 0, keep_integral=False)
        if self.calibrated == "none":
            return changed
        scale = beam.blm[0, 1].real / changed.blm[0, 1].real
        return Beam(scale * changed.blm, changed.neglected_power, changed.integral)
