"""Signals that are left in a channel, or added to its samples: dipoles, offsets, pick-up far from the beam."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import ducc0
import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotate_alm
from mcsim.sphere.sky import dipole_alm
from mcsim.support.loading import once_per_content
from mcsim.systematics.base import Alm, Bound, DirectedEffect, Draw, Effect, Site, Wording
from mcsim.systematics.galaxy import template_alm
from mcsim.systematics.parametrization import Angle, Parametrization, SkyVector, Vector
from mcsim.systematics.spacecraft import axes, heading, spin_phase


@dataclass(frozen=True, kw_only=True)
class DipoleResidual(DirectedEffect):
    """A dipole d . n is left in the channel, the same at all times."""

    name = "dipole_residual"
    scope = "channel"
    unit = "uK"
    title = "residual dipole"
    wording = Wording("{}", " µK")
    cause = "Error of the dipole that was subtracted, or of the channel's absolute calibration."
    signature = "l = 1, the same in both halves."
    source = "Hinshaw et al. 2009, ApJS 180, 225 (the dipole and its error)"
    step = 0.5
    bounds = (Bound("amplitude", 0.0, 340.0, "a tenth of the CMB's dipole (Hinshaw et al. 2009, ApJS 180, 225)"),)
    parametrization = SkyVector(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        return sky + dipole_alm(self.vector, site.lmax)


@dataclass(frozen=True, kw_only=True)
class MonopoleResidual(Effect):
    """A constant is added to the channel; it shows where a mask or uneven weights mix it with other degrees."""

    name = "monopole_residual"
    scope = "channel"
    unit = "uK"
    title = "residual monopole"
    wording = Wording("{}", " µK")
    cause = "Zero level of the maps, which differential instruments and destriped maps leave free."
    signature = "l = 0; behind a mask in the lowest degrees of this channel, the same in both halves."
    source = "Bennett et al. 2003, ApJS 148, 97 (zero levels); Eriksen et al. arXiv:0709.1037 (offsets left)"
    step = 0.5
    bounds = (Bound("amplitude", -2.7e6, 2.7e6, "less than the temperature of the sky, 2.7 K"),)
    parametrization = Parametrization(matched_filter=False)

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        changed = sky.copy()
        changed[0] += np.sqrt(4.0 * np.pi) * self.amplitude
        return changed


ORBITAL_UK = 270.7  #: 29.78 km/s over the speed of light, times 2.7255 K


LATE = 2.0 * np.pi / (365.25 * 24.0)
"""Largest part of an orbital dipole across the Earth's motion, relative to the whole: an error of time of an hour."""


@dataclass(frozen=True, kw_only=True)
class OrbitalDipole(Effect):
    """A share of the dipole of the Earth's motion about the Sun is left in the samples.

    Attributes
    ----------
    amplitude
        Fraction of the dipole of 270.7 uK.
    phase_deg
        Direction of what is left: 0 along the motion (an error of size), 90 towards the Sun (an error of time).

    Notes
    -----
    The Earth's ellipse in the ecliptic, with the anti-Sun direction of the scan. The rest of the dipole is not
    simulated: it is taken to be subtracted.
    """

    name = "orbital_dipole"
    scope = "channel"
    unit = "fraction of 270.7 uK"
    title = "residual orbital dipole"
    wording = Wording("{} of the orbital dipole", " %", 100.0)
    cause = "Velocity, time stamps or beam efficiency wrong where the annual dipole is subtracted or calibrates."
    signature = "A dipole that turns through the year: of opposite sign in the halves, in the ecliptic plane."
    source = "Hinshaw et al. 2003, ApJS 148, 63, and Planck 2015 results V, A&A 594, A5 (the annual dipole calibrates)"
    step = 2e-3
    bounds = (
        Bound(
            "amplitude", 0.0, 2.0,
            "at 2 an orbital dipole of the right size has the opposite sign; at most 0.00072 across the motion, an "
            "error of time of an hour: a prior of this library, for clocks are good to seconds",
        ),
    )  # fmt: skip
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def within_bounds(self) -> Self:
        """Return the effect with its size, and its part across the motion, within what is possible.

        Towards the Sun a dipole is nearly a monopole where the line of sight keeps its distance from the Sun.
        """
        found, phase = super().within_bounds(), np.deg2rad(self.phase_deg)
        along, across = found.amplitude * np.cos(phase), found.amplitude * np.sin(phase)
        if abs(across) <= LATE * (1.0 + 1e-9):
            return found
        across = np.copysign(LATE, across)
        phase_deg = float(np.rad2deg(np.arctan2(across, along)))
        return replace(found, amplitude=float(np.hypot(along, across)), phase_deg=phase_deg)

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        towards = heading(site.pointed(self.name).model, time_s, site.frame, np.deg2rad(self.phase_deg))
        return np.asarray(self.amplitude * ORBITAL_UK * np.sum(towards * axes(theta, phi)[0], axis=0))


@dataclass(frozen=True, kw_only=True)
class SpinSynchronousOffset(Effect):
    """Samples have amplitude cos(spin phase - phase) added, whatever the sky.

    Attributes
    ----------
    amplitude
        Half of the range, uK.
    phase_deg
        Spin phase at which the signal is highest: angle of the line of sight about the spin axis, from the Sun's side.
    """

    name = "spin_synchronous_offset"
    title = "spin-synchronous offset"
    scope = "channel"
    unit = "uK"
    wording = Wording("{}", " µK")
    cause = "The Sun heats the spacecraft, or power is switched, in step with the spin."
    signature = "A pattern of the ecliptic frame at low l, the same in both halves: stripes are too regular to average."
    source = "Hinshaw et al. 2003, ApJS 148, 63 (limits on the response to the surroundings)"
    step = 0.5
    bounds = (Bound("amplitude", 0.0, 1000.0, "a prior of this library: a mK is seen in the time stream by eye"),)
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        phase = spin_phase(site.pointed(self.name), time_s)
        return np.asarray(self.amplitude * np.cos(phase - np.deg2rad(self.phase_deg)))


NARROWEST_DEG = 3.0
_NSIDE = 512
_PLANE = 0.05
_RINGS = 1024


@dataclass(frozen=True, kw_only=True)
class SidelobePickup(Effect):
    """A share of the response lies in a broad lobe far from the line of sight, which sees the dipole and the Galaxy.

    Attributes
    ----------
    amplitude
        The lobe's share of the response to a uniform sky.
    angle_deg, towards_deg
        Of the lobe's centre: from the line of sight, in the direction from beam x (0) towards y (90, the spin axis).
    width_deg
        FWHM of the lobe, a Gaussian; at least 3.
    galaxy_uk
        Mean brightness of the model of the Galaxy at b = 0, uK, at the channel's frequency; 0: the dipole alone.
    template
        Path of a HEALPix map of the Galaxy in place of the model; its frame and unit are what its header says, or
        galactic and uK.

    Notes
    -----
    Model: galaxy_uk (1 + cos b cos l) / (1 + (sin b / 0.05)^2), a model of our own. What the lobe sees of the cosmic
    background, a thirtieth of the dipole, is left out; so is the gain, which the main beam keeps. The signal of every
    sample follows from its pointing, and is read from the nearest of 0.1 degree pixels.
    """

    name = "sidelobe_pickup"
    scope = "channel"
    unit = "fraction of the response"
    title = "far sidelobe pickup"
    wording = Wording("{} of the response", " %", 100.0)
    cause = "Spill-over past the mirrors and the baffles, left out of the beam or of the calibration."
    signature = "Galaxy and dipole displaced by the lobe's angle, fixed to the spacecraft: different in the halves."
    source = (
        "Planck 2015 results III, A&A 594, A3 (stray light of LFI); Barnes et al. 2003, ApJS 148, 51 (WMAP); "
        "the morphology is a model"
    )
    step = 1e-4
    bounds = (
        Bound("amplitude", -0.1, 0.1, "a prior of this library: a tenth of the response is no far sidelobe"),
        Bound("width_deg", 5.0, 90.0, "a broad lobe; fixed in a fit"),
        Bound("galaxy_uk", 0.0, 100000.0, "the Galaxy is bright; fixed in a fit"),
    )
    proposed = False

    angle_deg: float = 85.0
    towards_deg: float = 90.0
    width_deg: float = 10.0
    galaxy_uk: float = 1000.0
    template: str = ""

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        """Return what the lobe sees."""
        if self.width_deg < NARROWEST_DEG:
            raise InputError(
                f"effect {self.name}: width_deg = {self.width_deg:g} is no broad lobe; give at least {NARROWEST_DEG:g}."
            )
        where = self.width_deg, tuple(map(float, site.dipole_uk)), site.frame
        seen = (
            _on_template(self.template, site.frequency_ghz, *where)
            if self.template
            else _on_model(self.galaxy_uk, *where)
        )
        outward, south, east = axes(theta, phi)
        away, towards = np.deg2rad(self.angle_deg), psi + np.deg2rad(self.towards_deg)
        centre = np.cos(away) * outward + np.sin(away) * (np.cos(towards) * south + np.sin(towards) * east)
        return np.asarray(self.amplitude * seen[healpy.vec2pix(_NSIDE, *centre)])


def _plane_alm(lmax: int) -> Alm:
    """Return (1 + x) / (1 + (z / _PLANE)^2) in Galactic coordinates, brightest towards the centre of the Galaxy.

    It has orders 0 and 1 alone, so that four pixels on each of many Gauss-Legendre rings hold all of it.
    """
    z = np.cos(ducc0.misc.GL_thetas(_RINGS))
    x = np.sqrt(1.0 - z**2)[:, None] * np.array([1.0, 0.0, -1.0, 0.0])
    rings = (1.0 + x) / (1.0 + (z[:, None] / _PLANE) ** 2)
    found = ducc0.sht.analysis_2d(map=rings[None], spin=0, lmax=lmax, mmax=1, geometry="GL")[0]
    whole = np.zeros(alm_.size(lmax), dtype=np.complex128)
    whole[: found.size] = found
    return whole


@lru_cache(maxsize=4)
def _on_model(galaxy_uk: float, width_deg: float, dipole_uk: tuple[float, ...], frame: str) -> NDArray[np.float64]:
    """Return what :func:`_smoothed` makes of the model of the Galaxy."""
    lmax = _lmax(width_deg)
    return _smoothed(rotate_alm(galaxy_uk * _plane_alm(lmax), lmax, "galactic", frame), width_deg, dipole_uk)


@once_per_content(4)
def _on_template(
    path: str, frequency_ghz: float | None, width_deg: float, dipole_uk: tuple[float, ...], frame: str
) -> NDArray[np.float64]:
    """Return what :func:`_smoothed` makes of a map of the Galaxy."""
    return _smoothed(template_alm(path, _lmax(width_deg), frame, True, frequency_ghz), width_deg, dipole_uk)


def _lmax(width_deg: float) -> int:
    """Return the degree at which nothing is left of a lobe."""
    sigma = np.deg2rad(width_deg) / np.sqrt(8.0 * np.log(2.0))
    return int(np.ceil(6.0 / sigma))


def _smoothed(galaxy: Alm, width_deg: float, dipole_uk: tuple[float, ...]) -> NDArray[np.float64]:
    """Return dipole and Galaxy, both in uK, as a lobe of unit response sees them, at its direction in their frame."""
    lmax = _lmax(width_deg)
    window = healpy.gauss_beam(np.deg2rad(width_deg), lmax)
    sky = alm_.multiply(galaxy + dipole_alm(dipole_uk, lmax), window, lmax)
    return np.asarray(healpix.synthesis(sky[None], _NSIDE, lmax)[0], dtype=np.float32)
