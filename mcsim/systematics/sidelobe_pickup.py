"""Light that comes in far from the line of sight."""

from dataclasses import dataclass, replace
from functools import lru_cache

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotation_matrix
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Bound, Effect, Site, Wording
from mcsim.systematics.galaxy import template_alm
from mcsim.systematics.parametrization import Vector
from mcsim.systematics.spacecraft import axes

NARROWEST_DEG = 3.0
_NSIDE = 512
_PLANE = 0.05


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
        Path of a HEALPix map of the Galaxy in uK, in place of the model; its frame is what its header says, or
        galactic.

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
        seen = _smoothed(replace(self, amplitude=1.0), tuple(map(float, site.dipole_uk)), site.frame)
        outward, south, east = axes(theta, phi)
        away, towards = np.deg2rad(self.angle_deg), psi + np.deg2rad(self.towards_deg)
        centre = np.cos(away) * outward + np.sin(away) * (np.cos(towards) * south + np.sin(towards) * east)
        return np.asarray(self.amplitude * seen[healpy.vec2pix(_NSIDE, *centre)])


@lru_cache(maxsize=4)
def _smoothed(lobe: SidelobePickup, dipole_uk: tuple[float, ...], frame: str) -> NDArray[np.float64]:
    """Return dipole and Galaxy as a lobe of unit response sees them, uK, at its direction in ``frame``."""
    sigma = np.deg2rad(lobe.width_deg) / np.sqrt(8.0 * np.log(2.0))
    lmax = int(np.ceil(6.0 / sigma))
    if lobe.template:
        galaxy = template_alm(lobe.template, lmax, frame)
    else:
        x, _, z = rotation_matrix(frame, "galactic") @ np.stack(healpy.pix2vec(_NSIDE, np.arange(12 * _NSIDE**2)))
        galaxy = healpix.analysis(lobe.galaxy_uk * (1.0 + x) / (1.0 + (z / _PLANE) ** 2), lmax)
    ell = np.arange(lmax + 1.0)
    window = np.exp(-0.5 * ell * (ell + 1.0) * sigma**2)
    sky = alm_.multiply(galaxy + dipole_alm(dipole_uk, lmax), window, lmax)
    return np.asarray(healpix.synthesis(sky[None], _NSIDE, lmax)[0], dtype=np.float32)
