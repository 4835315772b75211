"""Effects on where samples are taken: beside, about or behind the line of sight, at other angles, closer together."""

from dataclasses import dataclass, replace

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import MapGrid, Moments, ScanModel, cached_moments
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Parametrization, Vector
from mcsim.systematics.shape import displaced, smeared
from mcsim.systematics.spacecraft import axes, scan_direction

FARTHEST_ARCMIN = 10800.0  #: to the opposite direction


@dataclass(frozen=True, kw_only=True)
class PointingOffset(Effect):
    """The true direction is the fiducial one plus a vector fixed to the beam.

    Attributes
    ----------
    amplitude
        Length of the vector, arcmin.
    angle_deg
        Its direction, from beam x (along the scan) towards y (towards the spin axis).

    Notes
    -----
    The beam is turned rigidly along the great circle, with its axes carried along: exact, in both routes.
    """

    name = "pointing_offset"
    scope = "channel"
    unit = "arcmin"
    wording = Wording("{}", "′")
    cause = "A boresight calibrated on planets, thermal bending, or an error of the time stamps (along the scan)."
    signature = "The gradient of the sky along or across the scan, through w_1; acts on the dipole too."
    source = "Jarosik et al. 2007, ApJS 170, 263 (WMAP); Planck 2013 results VI, A&A 571, A6 (Planck HFI)"
    step = 0.2
    bounds = (
        Bound("amplitude", 0.0, 120.0, "a prior of this library: reconstructed pointing is never wrong by two degrees"),
    )
    parametrization = Angle()

    angle_deg: float = 0.0

    def pointing(self, beam: Beam, site: Site) -> Beam:
        if abs(self.amplitude) > FARTHEST_ARCMIN:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} arcmin turns the beam by more than half a circle; "
                f"keep it within +-{FARTHEST_ARCMIN:g}."
            )
        return displaced(beam, np.deg2rad(self.angle_deg), np.deg2rad(self.amplitude / 60.0))

    def moved(self, theta: Vector, phi: Vector, psi: Vector) -> tuple[Vector, Vector, Vector] | None:
        if self.amplitude == 0.0:
            return theta, phi, psi
        distance, angle = np.deg2rad(self.amplitude / 60.0), np.deg2rad(self.angle_deg)
        outward, south, east = axes(theta, phi)
        # Along the displacement and to its left; the first turns down, the second stays.
        forward = np.cos(psi + angle) * south + np.sin(psi + angle) * east
        left = np.cos(psi + angle) * east - np.sin(psi + angle) * south
        line = np.cos(distance) * outward + np.sin(distance) * forward
        forward = np.cos(distance) * forward - np.sin(distance) * outward
        axis = np.cos(angle) * forward - np.sin(angle) * left
        width = np.hypot(line[0], line[1])
        # x . e_theta = -x_z / sin(theta) and x . e_phi = (n x x)_z / sin(theta), as the two are orthogonal.
        turned = np.arctan2(line[0] * axis[1] - line[1] * axis[0], -axis[2])
        return np.arctan2(width, line[2]), np.arctan2(line[1], line[0]) % (2.0 * np.pi), turned

    def direction(self) -> str:
        return scan_direction(self.angle_deg)


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
        ell, m = np.arange(beam.lmax + 1.0), np.arange(beam.mmax + 1.0)[:, None]
        reach = np.maximum(ell * (ell + 1.0) - m**2, 0.0) * 0.5 * self.amplitude * np.deg2rad(1.0 / 60.0) ** 2
        if reach.min() < -1.0:
            raise InputError(
                f"effect {self.name}: amplitude = {self.amplitude:g} sharpens the beam by more than a template may; "
                f"keep it above {self.amplitude / -reach.min():.3g}."
            )
        return replace(beam, blm=beam.blm * np.exp(-reach))


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
            "amplitude", -2.0, 2.0, "a prior of this library: far beyond the main time constant of any bolometer in use"
        ),
    )

    def pointing(self, beam: Beam, site: Site) -> Beam:
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


@dataclass(frozen=True, kw_only=True)
class OrientationAveraging(Effect):
    """Orientation moments (1 - amplitude) w + amplitude w of the real scan; at 1 all of the real scan's.

    Attributes
    ----------
    model
        A packaged scan model, or the path of one, that stands for the real scan; left out, it is the scan that the
        channel's pointing is known from. A diagnosis of a run with parallel transport proposes WMAP's.

    Notes
    -----
    The real moments are those of the model's whole survey, in every split. Hits and centroids stay those of the model.
    """

    name = "orientation_averaging"
    scope = "channel"
    unit = "1 = parallel transport assumed, scan real"
    title = "orientations of the scan"
    wording = Wording("{} of the step from parallel transport to the real scan", " %", 100.0)
    cause = "Parallel transport, or one orientation per pixel, in place of the survey's samples."
    signature = "L = 2, M = 0 falls to 0.66 of what parallel transport gives, and other M appear."
    source = "Joshi et al. arXiv:1210.7318, Sec. VI and last appendix"
    step = 0.05
    bounds = (
        Bound("amplitude", 0.0, 1.25, "0 is the model and 1 the real scan; a quarter more for errors of the latter"),
    )
    parametrization = Parametrization(sign=1)
    variants = ({"model": "wmap"},)

    model: str = ""

    def orientations(self, moments: Moments, site: Site) -> Moments:
        """Mix the moments; pixels that the real scan does not reach stay as they are.

        Of a circular beam a file of moments has none to mix.
        """
        if self.amplitude == 0.0 or moments.smax == 0:
            return moments
        if self.model:
            real = ScanModel.load(self.model)
        else:
            pointed = site.pointed(self.name)
            real = pointed.model.with_lines_of_sight(pointed.line.name)
        other = Moments.load(cached_moments(real, MapGrid(moments.nside, moments.frame), moments.smax))
        mixed = (1.0 - self.amplitude) * moments.w + self.amplitude * other.w
        return replace(moments, w=np.where(other.hits > 0.0, mixed, moments.w))


@dataclass(frozen=True, kw_only=True)
class Pixelization(Effect):
    """The samples' offsets from the pixels' centres shrunk to 1 - amplitude; at 1 all stand at the centres.

    Notes
    -----
    The pixel window and the gradient along the mean offset, which the fiducial model has, go with them. A gap of this
    kind lies in the model and not in the instrument: data made of samples at the centres, or the other way round.
    Above 2 the samples would stand outside of their pixels. Below 0 they do, as in pixels larger than the model's.
    """

    name = "pixelization"
    scope = "channel"
    unit = "1 = window and centroid ignored"
    wording = Wording("{} of the window and the centroids of pixels left out", " %", 100.0)
    cause = "Simulations at the pixels' centres, where the survey has samples all over the pixels."
    signature = "Small scales, depending on nside, and the gradient of the sky at pixels that are hit unevenly."
    source = "Gorski et al. 2005, ApJ 622, 759 (HEALPix); the HEALPix Primer (pixel window functions)"
    step = 0.1
    bounds = (Bound("amplitude", -2.0, 2.0, "above it samples stand outside of their pixels, below it far outside"),)
    parametrization = Parametrization(max_amplitude=2.0)

    def spread(self) -> float:
        return 1.0 - self.amplitude
