"""Skies that users give, as files of a_lm or of maps, refused in one sentence where they cannot be used."""

import warnings
from functools import cache
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

UNLIKE = 30.0  #: between the largest coefficients of skies of one run from which on one is in another unit: mK are 1000

SMALLEST_UK, SMALL_UK = 0.01, 1.0
"""Of the largest value of a user's sky that is not zero: a CMB sky in K has 5e-4, in mK 0.5, and in uK more than 1."""


def given(run: config.RunConfig, realization: int) -> Alm | None:
    """Return the sky of a realization that a run reads from files, a_lm up to the sky's lmax, uK; None: it draws it.

    InputError if the file cannot be used, or is in another unit than that of realization 0, as far as sizes say.
    """
    template = run.sky.map if run.sky.alm is None else run.sky.alm
    if template is None:
        return None
    channels = {channel.frequency_ghz for channel in run.channels}
    frequency = channels.pop() if len(channels) == 1 else None
    of_maps, grid = run.sky.alm is None, (run.sky.lmax, run.map.frame, frequency)
    path, first = (config.sky_path(template, r) for r in (realization, 0))
    found, unit = (_map_and_unit if of_maps else _alm_and_unit)(path, *grid)
    if path != first and not unit and path.suffix != ".npy" and first.is_file():
        size, usual = float(np.abs(found).max()), _size(first, first.stat().st_mtime_ns, of_maps, *grid)
        if size * usual > 0.0 and not 1.0 / UNLIKE < size / usual < UNLIKE:
            raise InputError(
                f"{path} has a_lm of up to {size:.3g} uK, {first} of up to {usual:.3g} uK; is one of them in another "
                "unit? Say it in its header (TUNIT), or give both in uK."
            )
    return found


@cache
def _size(path: Path, time_ns: int, of_maps: bool, lmax: int, frame: str, frequency_ghz: float | None) -> float:
    """Return the largest coefficient of a sky that was written at some time, in absolute value, uK."""
    return float(np.abs((_map_and_unit if of_maps else _alm_and_unit)(path, lmax, frame, frequency_ghz)[0]).max())


def read_alm(path: Path, lmax: int, frame: str, frequency_ghz: float | None = None) -> Alm:
    """Read the coefficients of a sky up to ``lmax``, uK, from a file of ``healpy.write_alm`` or ``numpy.save``.

    ``frequency_ghz`` is as in :func:`read_map`. InputError if the file cannot be read, ends below ``lmax``, states
    another frame or a unit that cannot be converted, or has values that are not finite or of no sky in uK.
    """
    return _alm_and_unit(path, lmax, frame, frequency_ghz)[0]


def _alm_and_unit(path: Path, lmax: int, frame: str, frequency_ghz: float | None) -> tuple[Alm, str | None]:
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
    unit = keywords.get("TUNIT2")
    _check_size(path, alm, unit)
    return alm_.resize(alm, found, lmax), unit


def read_map(path: Path, lmax: int, frame: str, frequency_ghz: float | None = None) -> Alm:
    """Read a HEALPix map of the whole sky and return its coefficients up to ``lmax`` <= 3 nside - 1, uK.

    ``frame`` is the run's, and the file's where it states one; ``frequency_ghz`` is what the run's channels have in
    common: antenna temperature and brightness need it. InputError if the file cannot be used so.
    """
    return _map_and_unit(path, lmax, frame, frequency_ghz)[0]


def _map_and_unit(path: Path, lmax: int, frame: str, frequency_ghz: float | None) -> tuple[Alm, str | None]:
    map_uk, stated = map_files.read_uk_and_unit(path, frame, frequency_ghz)
    nside = healpy.npix2nside(map_uk.size)
    if nside & (nside - 1):
        raise InputError(f"{path} has nside {nside}, which is not a power of two; bring the sky to one that is.")
    if not np.all(np.isfinite(map_uk)) or np.any(map_uk < UNSEEN_BELOW):
        raise InputError(f"{path} has pixels that are not finite or unseen; a sky must be complete.")
    if lmax > 3 * nside - 1:
        raise InputError(f"{path} has nside {nside}, good to l = {3 * nside - 1}; the sky's lmax {lmax} is above it.")
    _check_size(path, map_uk, stated)
    return healpix.analysis(map_uk, lmax, iterations=3), stated


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
