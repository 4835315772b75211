"""Galactic light that the cleaning left."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import healpy
import numpy as np

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.checks import check_complete
from mcsim.sphere.rotation import rotate_alm
from mcsim.sphere.sky import gaussian_alm
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Parametrization, Vector
from mcsim.systematics.product import multiplied

REFERENCE_GHZ = 94.0
_SLOPE = -2.5
_PLANE = 0.15
_PROFILE_DEGREE = 128


@dataclass(frozen=True, kw_only=True)
class ForegroundResidual(Effect):
    """A signal fixed to the sky, strongest in the Galactic plane, growing as a power of frequency.

    Attributes
    ----------
    amplitude
        Root mean square over the full sky at 94 GHz, uK; negative where the cleaning took too much.
    spectral_index
        The signal grows as (nu / 94 GHz)^index, in thermodynamic temperature; 2 is near that of dust.
    template
        Path of a HEALPix map to be used up to l = 2 nside, brought to rms 1; its frame is what its header says, or
        galactic. Left out, every realization draws its own.

    Notes
    -----
    Drawn: p(b) (1 + g), p = 1 / (1 + (sin b / 0.15)^2), g a Gaussian field of C_l ~ l^-2.5, l > 0, and unit variance,
    scaled to rms 1 over the full sky; a model of our own that is bright in the plane and patchy off it, no more.
    """

    name = "foreground_residual"
    scope = "common"
    unit = "uK rms at 94 GHz"
    title = "residual foreground"
    wording = Wording("{} rms at 94 GHz", " µK")
    cause = "Synchrotron, free-free or dust emission that the templates of the cleaning do not follow."
    signature = (
        "Additive and fixed to the sky, along the Galactic plane, different from channel to channel in size alone."
    )
    source = "Bennett et al. 2013, ApJS 208, 20, Sec. 5 (residuals of cleaned bands); the morphology is a model"
    step = 5.0
    bounds = (
        Bound("amplitude", -500.0, 500.0, "a prior of this library: less than the foreground itself"),
        Bound("spectral_index", -4.0, 4.0, "from synchrotron to dust; fixed in a fit"),
    )
    parametrization = Parametrization(stochastic=True, matched_filter=False)

    spectral_index: float = 2.0
    template: str = ""

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the residual."""
        scale = self.amplitude * (site.frequency(self.name) / REFERENCE_GHZ) ** self.spectral_index
        if self.template:
            return sky + scale * _of_file(self.template, site.lmax, site.frame)
        drawn = _drawn(site.lmax, draw("morphology"))
        return sky + scale * rotate_alm(drawn, site.lmax, "galactic", site.frame)


def _drawn(lmax: int, rng: np.random.Generator) -> Alm:
    """Coefficients of the model in the galactic frame, rms 1."""
    ell = np.arange(1.0, lmax + 1)
    cl = np.append(0.0, ell**_SLOPE)
    cl /= np.sum((2.0 * ell + 1.0) * cl[1:]) / (4.0 * np.pi)
    patches = gaussian_alm(cl, rng)
    patches[0] += np.sqrt(4.0 * np.pi)

    def plane(x: Vector, y: Vector, z: Vector) -> Vector:
        return 1.0 / (1.0 + (z / _PLANE) ** 2)

    return _unit_rms(multiplied(patches, lmax, plane, _PROFILE_DEGREE), lmax)


def _unit_rms(alm: Alm, lmax: int) -> Alm:
    power = np.abs(alm) ** 2
    total = 2.0 * power.sum() - power[: lmax + 1].sum()
    return alm / np.sqrt(total / (4.0 * np.pi))


@lru_cache(maxsize=4)
def _of_file(path: str, lmax: int, frame: str) -> Alm:
    """Coefficients of a template in ``frame``, rms 1."""
    values, found, _ = healpix.read_map(Path(path))
    check_complete(values, path)
    if not np.any(values):
        raise InputError(f"{path} is zero in every pixel; give a complete template.")
    top = min(lmax, 2 * healpy.npix2nside(values.size))
    alm = healpix.analysis(values, top, iterations=3)
    turned = rotate_alm(alm_.resize(alm, top, lmax), lmax, found or "galactic", frame)
    return _unit_rms(turned, lmax)
