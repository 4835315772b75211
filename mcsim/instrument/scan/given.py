"""Moments that a run names by file: a FITS table, or the arrays of an object that was given in its place."""

from dataclasses import replace
from pathlib import Path

from mcsim.errors import InputError
from mcsim.instrument.scan.moments import Moments, read_moments_fits
from mcsim.support.npy import read_npz


def read_moments(
    path: str | Path, nside: int | None = None, smax: int | None = None, frame: str | None = None
) -> Moments:
    """Read moments from FITS (:func:`read_moments_fits`), or from the .npz file of :meth:`Moments.as_table`.

    Parameters
    ----------
    path
        The file.
    nside, frame
        Resolution and frame that it must have; None: any.
    smax
        Largest s to read, which the file must have; None: all.

    Raises
    ------
    InputError
        If the file cannot be read, or lacks what is asked for.
    """
    if Path(path).suffix != ".npz":
        return read_moments_fits(path, nside, smax, frame)
    arrays = read_npz(path)
    try:
        found = Moments(int(arrays.pop("nside")), str(arrays.pop("frame")), **arrays)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} holds no moments ({error}); write it again.") from None
    for name, own, wanted in (("nside", found.nside, nside), ("frame", found.frame, frame)):
        if wanted is not None and own != wanted:
            raise InputError(f"the moments have {name} {own!r}, the maps {wanted!r}; use moments of the maps' {name}.")
    if smax is not None and found.smax < smax:
        raise InputError(f"the moments end at s = {found.smax}, but {smax} is needed; compute them with smax={smax}.")
    return found if smax is None else replace(found, w=found.w[:smax])
