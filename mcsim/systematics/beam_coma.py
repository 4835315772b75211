"""A beam that leans to one side."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization, Vector
from mcsim.systematics.shape import shape

_WHOLE_SIGMAS = 7.0
_FADED_SIGMAS = 9.0


@dataclass(frozen=True, kw_only=True)
class _FourAngles(Parametrization):
    """Fit k and angle by the responses at 0, 45, 90 and 135 degrees."""

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        """Return the four angles."""
        return tuple({"angle_deg": angle} for angle in (0.0, 45.0, 90.0, 135.0))

    def coordinates(self, effect: Any) -> Vector:
        """Return the coefficients of the four responses that give the response at the angle."""
        return effect.amplitude * _weights(np.deg2rad(effect.angle_deg))

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return the best k and angle: k is linear, the angle is searched."""
        if not precision.any():
            return {"amplitude": 0.0}  # the data do not respond to it
        measured = precision @ coordinates

        def fitted(angle: float) -> tuple[float, float]:
            """Return k at an angle, and what it takes off the distance; the data may not respond to an angle at all."""
            weights = _weights(angle)
            along, size = max(float(weights @ measured), 0.0), float(weights @ precision @ weights)
            return (along / size, along**2 / size) if size > 0.0 else (0.0, 0.0)

        tried = np.linspace(0.0, 2.0 * np.pi, 181)
        first = max(tried, key=lambda angle: fitted(angle)[1])
        near = (first - 0.05, first + 0.05)
        angle = minimize_scalar(lambda a: -fitted(a)[1], bounds=near, method="bounded", options={"xatol": 1e-9}).x
        return {"amplitude": fitted(angle)[0], "angle_deg": float(np.rad2deg(angle)) % 360.0}


def _weights(angle: float) -> Vector:
    """Of the responses at 0, 45, 90 and 135 degrees in that at ``angle`` radians, from their m = 1 and m = 3 parts."""
    c1, s1, c3, s3 = np.cos(angle), np.sin(angle), np.cos(3.0 * angle), np.sin(3.0 * angle)
    even, odd = (c1 - c3) / np.sqrt(2.0), (s1 + s3) / np.sqrt(2.0)
    return 0.5 * np.array([c1 + c3, odd + even, s1 - s3, odd - even])


@dataclass(frozen=True, kw_only=True)
class BeamComa(Effect):
    """The beam times 1 + k (u^3 - 3u), u the coordinate along the angle in sigmas.

    Attributes
    ----------
    amplitude
        k.
    angle_deg
        Direction of u, from beam x (along the scan) towards y.

    Notes
    -----
    u^3 - 3u is the third Hermite polynomial: it moves neither the centroid of a Gaussian nor its width. Sigma is that
    of the Gaussian with the beam's solid angle. Beyond 7 sigma the change fades out, to nothing at 9: there is no beam
    there to lean, but a little noise of its coefficients that the cube would amplify. The change is
    k sigma^-3 times c1 cos a + s1 sin a + c3 cos 3a + s3 sin 3a in the angle a, whatever the beam: m = 1 goes with the
    angle and m = 3 with three times it, so that four components span it.
    """

    name = "beam_coma"
    scope = "channel"
    unit = "k of 1 + k (u^3 - 3u)"
    wording = Wording("k = {}")
    cause = "Third-order aberration of optics off the axis."
    signature = "L = 1 and 3, d = +-1, through w_1 and w_3; changes sign where the scan reverses (half1 - half2)."
    source = "Born & Wolf, Principles of Optics, Sec. 5.3, in the lowest Hermite order that keeps the centroid"
    step = 0.01
    bounds = (Bound("amplitude", -0.5, 0.5, "the response stays positive within two sigmas of the centre"),)
    parametrization = _FourAngles()

    angle_deg: float = 0.0

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Return the beam times the cubic polynomial."""
        form = shape(beam, 4)
        radius = form.theta / form.sigma
        u = radius * np.cos(form.phi - np.deg2rad(self.angle_deg))
        fading = np.clip((_FADED_SIGMAS - radius) / (_FADED_SIGMAS - _WHOLE_SIGMAS), 0.0, 1.0)
        near = fading**3 * (10.0 - 15.0 * fading + 6.0 * fading**2)
        return form.with_added(self.amplitude * form.values * near * (u**3 - 3.0 * u), 3)
