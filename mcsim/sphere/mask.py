"""Masks: read from a file, brought to the frame and nside of the maps, apodised."""

from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mcsim.errors import InputError
from mcsim.sphere import map_files, rotation
from mcsim.sphere.checks import check_map, check_nside
from mcsim.support.loading import once_per_content

Mask = NDArray[np.float64]


def read_mask(
    path: Path, nside: int, frame: str = "ecliptic", mask_frame: str | None = None, apodisation_deg: float = 0.0
) -> Mask:
    """Read the weights of the pixels, shape (12 nside^2,) in RING order, from a HEALPix FITS file.

    ``path``: HEALPix map of weights between 0 and 1 (1 where the sky is used), of any nside; the header states the
    ordering. ``nside``, ``frame``: those of the maps. ``mask_frame``: frame of the mask; None: that of the file's
    COORDSYS, else that of the maps. ``apodisation_deg``: width of the soft edge (:func:`apodise`), >= 0. Raise
    InputError if the file is not a HEALPix map, its nside is not a power of two, a value is outside 0 ... 1, or its
    frame is not the given one.

    Notes
    -----
    Pixels of the value that the header calls BAD_DATA have weight 0. The nside is changed by
    ``healpy.ud_grade``, the frame pixel by pixel (:func:`mcsim.sphere.rotation.rotate_pixels`) at the finer of the two
    resolutions. The edge is apodised last: its width does not depend on the file's resolution.
    """
    check_nside(nside)
    mask, stated, _ = map_files.read_map(path, bad=0.0)
    found = healpy.get_nside(mask)
    if found & (found - 1):
        raise InputError(f"{path} has nside {found}, which is not a power of two; bring the mask to one that is.")
    if mask_frame is not None and stated not in (None, mask_frame):
        raise InputError(
            f"{path} says that it is in {stated} coordinates, map.mask_frame is {mask_frame}; correct one of them."
        )
    mask_frame = mask_frame or stated or frame
    wrong = np.flatnonzero(~((mask >= 0.0) & (mask <= 1.0)))
    if wrong.size:
        value = "UNSEEN" if mask[wrong[0]] == healpy.UNSEEN else f"{mask[wrong[0]]:.9g}"
        raise InputError(
            f"{path} has values outside 0 ... 1 ({wrong.size} pixels, first {wrong[0]}: {value}); a mask is a map of "
            "weights, 1 where the sky is used and 0 where it is not."
        )
    if found < nside:
        mask = healpy.ud_grade(mask, nside)
    if mask_frame != frame:
        mask = rotation.rotate_pixels(mask, mask_frame, frame)
    if found > nside:
        mask = healpy.ud_grade(mask, nside)
    return apodise(mask, np.deg2rad(apodisation_deg))


@once_per_content(32)
def kept_mask(path: Path, nside: int, frame: str, mask_frame: str | None = None, apodisation_deg: float = 0.0) -> Mask:
    """Read a mask (:func:`read_mask`) once for all surveys of a process; the weights cannot be written to."""
    mask = read_mask(path, nside, frame, mask_frame, apodisation_deg)
    mask.setflags(write=False)
    return mask


def apodise(mask: Mask, width: float) -> Mask:
    r"""Return the mask times a soft edge, which rises from 0 at its zeros to 1 at a distance ``width``.

    ``mask`` are weights in RING order, shape (npix,); the width of the edge is in radians, >= 0.

    Notes
    -----
    The edge is (1 - cos(pi d / width)) / 2 of the angle d from a pixel's centre to that of the nearest pixel of weight
    0. Its slope is continuous: the mask's power at l > 3 pi / width is at most 1/64 of a sharp edge's.
    """
    nside = check_map(mask, name="the mask")
    if not 0.0 <= width <= np.pi:
        raise InputError(f"the width of the soft edge is {width:g} rad, but it must lie between 0 and pi.")
    zeros = mask == 0.0
    if width == 0.0 or not zeros.any() or zeros.all():
        return mask
    used = np.flatnonzero(~zeros)
    nearest = cKDTree(_vectors(nside, _edge(zeros, nside)))
    chord, _ = nearest.query(_vectors(nside, used), distance_upper_bound=2.0 * np.sin(min(width, np.pi) / 2.0))
    # Beyond the bound the tree returns infinity.
    distance = 2.0 * np.arcsin(np.minimum(chord, 2.0) / 2.0)
    soft = mask.copy()
    soft[used] *= np.where(distance < width, 0.5 - 0.5 * np.cos(np.pi * np.minimum(distance / width, 1.0)), 1.0)
    return soft


def _edge(zeros: NDArray[np.bool_], nside: int) -> NDArray[np.int64]:
    """Return the pixels of weight 0 that have a neighbour of another weight: the nearest zero is one of them."""
    pixels = np.flatnonzero(zeros)
    neighbours = healpy.get_all_neighbours(nside, pixels)
    # If a pixel has only seven neighbours, the eighth is -1 and indexes the last pixel: at worst the edge has one
    # pixel too many.
    edge: NDArray[np.int64] = pixels[np.any(~zeros[neighbours], axis=0)]
    return edge


def _vectors(nside: int, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.stack(healpy.pix2vec(nside, pixels), axis=-1)
