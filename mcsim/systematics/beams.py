"""Effects on the shape of a beam: wider, elongated, leaning, with a ring, or with orders that were left out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Parametrization, Vector, reciprocal
from mcsim.systematics.shape import shape, stretched
from mcsim.systematics.spacecraft import scan_direction


@dataclass(frozen=True, kw_only=True)
class BeamWidth(Effect):
    """The beam 1 + amplitude times as wide in every direction, at the same integral: all its orders scale."""

    name = "beam_width"
    scope = "channel"
    unit = "fraction of the FWHM"
    wording = Wording("FWHM {} larger", " %", 100.0, negative="FWHM {} smaller")
    cause = "A beam mapped with an error of its width, or a focus that drifts."
    signature = "L = 0: the power falls off sooner, in this channel alone."
    source = "Huffenberger et al. 2010, A&A 513, A23 (errors of measured beams)"
    step = 0.005
    bounds = (Bound("amplitude", -0.5, 0.5, "a prior of this library: a measured width is known to a half"),)

    def beam(self, beam: Beam, site: Site) -> Beam:
        if not -0.9 <= self.amplitude <= 9.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} leaves no beam to speak of; "
                "choose one between -0.9 and 9."
            )
        return stretched(beam, 1.0 + self.amplitude, 1.0 + self.amplitude, 0.0, 2, 0)

    def inverse(self) -> Self:
        return replace(self, amplitude=reciprocal(self.amplitude))


@dataclass(frozen=True, kw_only=True)
class BeamEllipticity(Effect):
    """The beam stretched to major/minor = 1 + amplitude at the same area; a negative amplitude turns it by 90 deg.

    Attributes
    ----------
    amplitude
        Ratio of the axes less one, of a beam that was round.
    angle_deg
        Direction of the major axis, from beam x (along the scan) towards y.

    Notes
    -----
    It acts before other effects on the shape, wherever it is listed: a coma is in sigmas of the stretched beam.
    """

    name = "beam_ellipticity"
    scope = "channel"
    unit = "major/minor - 1"
    wording = Wording("axis ratio {}", offset=1.0, negative="axis ratio {} (turned by 90°)")
    cause = "Optics off the axis: defocus, coma-free astigmatism, or a horn that looks past the centre of the mirror."
    signature = "Even L, growing as l^2, fixed to the scan through w_2."
    source = "Joshi et al. arXiv:1210.7318, Sec. IV; Fosalba et al. 2002, Phys. Rev. D 65, 063003"
    step = 0.02
    bounds = (
        Bound(
            "amplitude",
            -1.0,
            1.0,
            "a prior of this library: 1.38 is the largest of Planck LFI (Planck 2013 results II, A&A 571, A2)",
        ),
    )
    parametrization = Angle(multiple=2)
    rank = -1

    angle_deg: float = 0.0

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Stretch the beam along the angle and squeeze it across."""
        if abs(self.amplitude) > 2.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} is no beam to speak of; keep it within +-2."
            )
        ratio, angle = 1.0 + abs(self.amplitude), np.deg2rad(self.angle_deg)
        if self.amplitude < 0.0:
            angle += np.pi / 2
        return stretched(beam, np.sqrt(ratio), 1.0 / np.sqrt(ratio), angle, 32, 2)

    def direction(self) -> str:
        return "with the major axis " + scan_direction(self.angle_deg + (90.0 if self.amplitude < 0.0 else 0.0), 180.0)


@dataclass(frozen=True, kw_only=True)
class BeamNoncircularity(Effect):
    """The orders that the channel's ``beam.m_max`` cuts off, times the amplitude; at 1 the beam is as measured.

    Notes
    -----
    b_lm + amplitude b_lm of the whole beam at the orders m > m_max. With m_max = 0 that is all that makes the beam
    non-circular: its ellipse, its coma, and what no closed form has. The whole beam has the orders that it would have
    without m_max, and four at least where its source has them. Of a differencing scan both sides' beams must be cut.
    It acts before all other effects on the beam, wherever it is listed: these change the beam as measured.
    """

    name = "beam_noncircularity"
    scope = "channel"
    unit = "share of the orders beyond m_max"
    title = "beam non-circularity"
    wording = Wording("{} of the orders beyond m_max", " %", 100.0)
    cause = "Simulations with the circular part of a measured beam, or with too few of its orders."
    signature = "L of the orders left out: 2 and 4 of an ellipse, 1 and 3 of a lopsided beam, in the scan's frame."
    source = "Joshi et al. arXiv:1210.7318, Sec. IV"
    step = 0.05
    bounds = (Bound("amplitude", -2.0, 2.0, "1 is the beam as measured; a prior of this library: at most twice that"),)
    rank = -2

    def beam(self, beam: Beam, site: Site) -> Beam:
        whole, kept = site.whole_beam(self.name), site.beam.mmax + 1
        blm = np.zeros((max(beam.mmax, whole.mmax) + 1, beam.lmax + 1), dtype=np.complex128)
        blm[: beam.mmax + 1] = beam.blm
        blm[kept : whole.mmax + 1] += self.amplitude * whole.blm[kept:]
        return replace(beam, blm=blm, neglected_power=whole.neglected_power)


_WHOLE_SIGMAS = 7.0
_FADED_SIGMAS = 9.0


@dataclass(frozen=True, kw_only=True)
class _FourAngles(Parametrization):
    """Fit k and angle by the responses at 0, 45, 90 and 135 degrees."""

    def basis(self) -> tuple[Mapping[str, Any], ...]:
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
    there to lean, but a little noise of its coefficients that the cube would amplify. It acts after an ellipticity,
    which would stretch u as well. The change is
    k sigma^-3 times c1 cos a + s1 sin a + c3 cos 3a + s3 sin 3a in the angle a, whatever the beam: m = 1 goes with the
    angle and m = 3 with three times it, so that four components span it.

    A beam that sky.lmax does not resolve is continued as a Gaussian goes on. Sigma and the change of a measured one are
    a guess then: those of WMAP's W1 are 13.2', 8.6' and 6.1' at lmax 64, 292 and 1500, and the change of b_l1 at l = 60
    has either sign. Where k is to mean the same, raise sky.lmax until the beam has fallen.
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
        form = shape(beam, 4)
        radius = form.theta / form.sigma
        u = radius * np.cos(form.phi - np.deg2rad(self.angle_deg))
        fading = np.clip((_FADED_SIGMAS - radius) / (_FADED_SIGMAS - _WHOLE_SIGMAS), 0.0, 1.0)
        near = fading**3 * (10.0 - 15.0 * fading + 6.0 * fading**2)
        return form.with_added(self.amplitude * form.values * near * (u**3 - 3.0 * u), 3)


CALIBRATIONS = ("none", "dipole")


@dataclass(frozen=True, kw_only=True)
class _RoundAndQuadrupole(Parametrization):
    """Fit a ring as a mixture of a round one and one with all of its quadrupole, q = 1."""

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        return {}, {"quadrupole": 1.0}

    def coordinates(self, effect: Any) -> Vector:
        return np.array([1.0 - effect.quadrupole, effect.quadrupole]) * effect.amplitude

    def typical(self, effect: Any) -> NDArray[np.float64]:
        """Return the ring that the effect is by default, a round one: its quadrupole is seen earlier."""
        return np.array([[1.0], [0.0]])

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

    Notes
    -----
    It acts after all other effects on the shape, which are of the main beam: a coma would amplify the ring. Of a
    measured beam that sky.lmax does not resolve, sigma and peak are as uncertain as for ``beam_coma``.
    """

    name = "beam_sidelobe"
    scope = "channel"
    unit = "fraction of the peak"
    wording = Wording("negative ring of {} of the peak", " %", 100.0, negative="ring of {} of the peak")
    cause = "Spill-over, struts or panels of the mirror; negative, of positive amplitude, where horns are subtracted."
    signature = "A halo at low l, pick-up of the plane and the dipole, and with q the m = 2 part of b_lm."
    source = "Barnes et al. 2003, ApJS 148, 51 (WMAP's sidelobes, negative and positive); the shape is a model"
    step = 1e-5
    bounds = (
        Bound("amplitude", -0.08, 0.08, "beyond it the default ring holds more than the main beam"),
        Bound("quadrupole", -1.0, 1.0, "the ring has one sign all around"),
        Bound("radius_sigmas", 0.0, 20.0, "a ring around the main beam, by definition; fixed in a fit"),
        Bound("width_sigmas", 0.5, 20.0, "narrower rings are none that the beam's coefficients hold; fixed in a fit"),
    )
    parametrization = _RoundAndQuadrupole(proportional=True)
    setting_words: ClassVar[Mapping[str, str]] = {
        "calibrated = none": "calibrated on its peak",
        "calibrated = dipole": "calibrated on the dipole",
    }
    variants = ({"calibrated": "none"}, {"calibrated": "dipole"})
    rank = 1

    quadrupole: float = 0.0
    radius_sigmas: float = 5.0
    width_sigmas: float = 1.0
    calibrated: str = "none"

    def beam(self, beam: Beam, site: Site) -> Beam:
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
