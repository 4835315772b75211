"""Skies that users give, as files of a_lm or of maps, refused in one sentence where they cannot be used."""

import warnings
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from mcsim import config
from mcsim.errors import InputError
from mcsim.sphere import alm as alm_
from mcsim.sphere import header, healpix, map_files
from mcsim.sphere.checks import UNSEEN_BELOW
from mcsim.support.arrays import Alm
from mcsim.support.npy import read_npy

LARGEST_UK = 1e7  #: of a user's sky: 10 K, more than the Galaxy has in any band of a CMB survey

SMALLEST_UK, SMALL_UK = 0.01, 1.0
"""Of the largest value of a user's sky that is not zero: a CMB sky in K has 5e-4, in mK 0.5, and in uK more than 1."""


def given(run: config.RunConfig, realization: int) -> Alm | None:
    """Return the sky of a realization that a run reads from files, a_lm up to the sky's lmax, uK; None: it draws it."""
    sky, frame = run.sky, run.map.frame
    channels = {channel.frequency_ghz for channel in run.channels}
    frequency = channels.pop() if len(channels) == 1 else None
    if sky.alm is not None:
        return read_alm(config.sky_path(sky.alm, realization), sky.lmax, frame, frequency_ghz=frequency)
    if sky.map is None:
        return None
    return read_map(config.sky_path(sky.map, realization), sky.lmax, frame, frequency_ghz=frequency)


def read_alm(path: Path, lmax: int, frame: str, frequency_ghz: float | None = None) -> Alm:
    """Read the coefficients of a sky up to ``lmax``, uK, from a file of ``healpy.write_alm`` or ``numpy.save``.

    ``frequency_ghz`` is as in :func:`read_map`. InputError if the file cannot be read, ends below ``lmax``, states
    another frame or a unit that cannot be converted, or has values that are not finite or of no sky in uK.
    """
    if path.suffix == ".npy":
        given = read_npy(path, "c")
        mmax, keywords = healpy.Alm.getlmax(given.size), fits.Header()
    else:
        given, mmax, keywords = header.read_coefficients(path, "a_lm")
    alm = given.astype(np.complex128)
    found = healpy.Alm.getlmax(alm.size, mmax)
    if mmax != found or found < lmax:
        raise InputError(f"{path} holds a_lm up to l = {found}, m = {mmax}; the sky needs both up to {lmax}.")
    if not np.all(np.isfinite(alm)):
        raise InputError(f"{path} holds a_lm that are not finite; repair the file.")
    alm_.check_order(alm, found, str(path))
    stated = header.frame_named(keywords.get("COORDSYS"), str(path))
    if stated not in (None, frame):
        raise InputError(f"{path} is in {stated} coordinates, the run's maps in {frame}; rotate the sky first.")
    factor = header.to_uk(str(keywords.get("TUNIT2", "")), path, frequency_ghz)
    alm = alm if factor == 1.0 else factor * alm
    _check_size(path, alm, keywords.get("TUNIT2"))
    return alm_.resize(alm, found, lmax)


def read_map(path: Path, lmax: int, frame: str, frequency_ghz: float | None = None) -> Alm:
    """Read a HEALPix map of the whole sky and return its coefficients up to ``lmax`` <= 3 nside - 1, uK.

    ``frame`` is the run's, and the file's where it states one; ``frequency_ghz`` is what the run's channels have in
    common: antenna temperature and brightness need it. InputError if the file cannot be used so.
    """
    map_uk, stated = map_files.read_uk_and_unit(path, frame, frequency_ghz)
    nside = healpy.npix2nside(map_uk.size)
    if nside & (nside - 1):
        raise InputError(f"{path} has nside {nside}, which is not a power of two; bring the sky to one that is.")
    if not np.all(np.isfinite(map_uk)) or np.any(map_uk < UNSEEN_BELOW):
        raise InputError(f"{path} has pixels that are not finite or unseen; a sky must be complete.")
    if lmax > 3 * nside - 1:
        raise InputError(f"{path} has nside {nside}, good to l = {3 * nside - 1}; the sky's lmax {lmax} is above it.")
    _check_size(path, map_uk, stated)
    return healpix.analysis(map_uk, lmax, iterations=3)


def _check_size(path: Path, sky: NDArray[np.generic], unit: str | None) -> None:
    """Refuse what a flipped bit or another unit makes of a sky, and warn of a file that may be in mK."""
    largest = float(np.max(np.abs(sky)))
    if largest > LARGEST_UK:
        raise InputError(f"{path} holds {largest:.3g} uK, more than any sky ({LARGEST_UK:g} uK); correct its unit.")
    if 0.0 < largest < SMALLEST_UK:
        raise InputError(
            f"{path} holds at most {largest:.3g} uK, less than any sky ({SMALLEST_UK:g} uK); is it in K? Say the unit "
            "in its header (TUNIT), or give it in uK."
        )
    if not unit and path.suffix != ".npy" and 0.0 < largest < SMALL_UK:
        warnings.warn(
            f"{path} holds at most {largest:.3g} uK, less than a sky of the CMB; if it is in mK, say so in its header "
            "(TUNIT), or give it in uK.",
            stacklevel=4,
        )
