"""Light of the Galaxy: a template of the user's, or a model that is drawn."""

import json
from functools import lru_cache
from pathlib import Path

import healpy
import numpy as np

from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, map_files
from mcsim.sphere.checks import check_complete
from mcsim.sphere.header import to_uk
from mcsim.sphere.rotation import rotate_alm
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.loading import once_per_content
from mcsim.systematics.base import Alm, Draw, Site
from mcsim.systematics.parametrization import Vector
from mcsim.systematics.product import multiplied

_SLOPE = -2.5
_PLANE = 0.15
_PROFILE_DEGREE = 128


def morphology(template: str, site: Site, draw: Draw) -> Alm:
    """Return coefficients of rms 1 over the full sky: those of a file, or (an empty name) of a draw of the model.

    Notes
    -----
    Drawn: p(b) (1 + g), p = 1 / (1 + (sin b / 0.15)^2), g a Gaussian field of C_l ~ l^-2.5, l > 0, and unit variance; a
    model of our own that is bright in the plane and patchy off it, no more.
    """
    if template:
        return _unit_rms(template_alm(template, site.lmax, site.frame), site.lmax)
    return _drawn(site.lmax, site.frame, json.dumps(draw("morphology").bit_generator.state))


@once_per_content(4)
def template_alm(path: str, lmax: int, frame: str, in_uk: bool = False, frequency_ghz: float | None = None) -> Alm:
    """Return the coefficients of a map, up to l = 2 nside, in ``frame``; its own frame is its header's, or galactic.

    They are in the unit of the file; ``in_uk``: in uK, by the unit that the header states, at a channel's frequency.
    """
    values, found, unit = map_files.read_map(Path(path))
    check_complete(values, path)
    if not np.any(values):
        raise InputError(f"{path} is zero in every pixel; give a complete template.")
    top = min(lmax, 2 * healpy.npix2nside(values.size))
    alm = healpix.analysis(values, top, iterations=3) * (to_uk(unit, Path(path), frequency_ghz) if in_uk else 1.0)
    return rotate_alm(alm_.resize(alm, top, lmax), lmax, found or "galactic", frame)


@lru_cache(maxsize=1)
def _drawn(lmax: int, frame: str, state: str) -> Alm:
    """Return coefficients of the model, rms 1, drawn by a generator in this state: the same for all channels."""
    rng = np.random.default_rng()
    rng.bit_generator.state = json.loads(state)
    ell = np.arange(1.0, lmax + 1)
    cl = np.append(0.0, ell**_SLOPE)
    cl /= np.sum((2.0 * ell + 1.0) * cl[1:]) / (4.0 * np.pi)
    patches = gaussian_alm(cl, rng)
    patches[0] += np.sqrt(4.0 * np.pi)

    def plane(x: Vector, y: Vector, z: Vector) -> Vector:
        return 1.0 / (1.0 + (z / _PLANE) ** 2)

    alm = rotate_alm(_unit_rms(multiplied(patches, lmax, plane, _PROFILE_DEGREE), lmax), lmax, "galactic", frame)
    alm.setflags(write=False)
    return alm


def _unit_rms(alm: Alm, lmax: int) -> Alm:
    power = np.abs(alm) ** 2
    total = 2.0 * power.sum() - power[: lmax + 1].sum()
    return alm / np.sqrt(total / (4.0 * np.pi))
