"""Files of moments: HEALPix tables in FITS, and the arrays of an object that a run was given in place of a file."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.scan.geometry import check_frame
from mcsim.instrument.scan.moments import Moments
from mcsim.instrument.scan.offsets import HIGHEST, exponents
from mcsim.sphere.checks import nside_of
from mcsim.sphere.header import first_table, opened, radians, stated_frame
from mcsim.sphere.map_files import PIXEL
from mcsim.sphere.rotation import FRAMES
from mcsim.support.folders import unreadable
from mcsim.support.npy import read_npz


def read_moments(
    path: str | Path, nside: int | None = None, smax: int | None = None, frame: str | None = None
) -> Moments:
    """Read moments from a HEALPix table with columns HITS, RE_s, IM_s[, DTHETA, DPHI], or from the .npz file of a run.

    The table is the first binary table of the FITS file; RE_s + i IM_s is the mean of e^{-i s psi}. Columns OFFSET_a_b
    are the means of DTHETA^a DPHI^b of single samples, of degree a + b = 2, 3 and 4, as far as there are any.

    ``nside``, ``smax`` and ``frame`` are what the file must have; None: any, and all orders that follow each other from
    s = 1. Where a file has no COORDSYS, ``frame`` is taken for it. InputError if the file cannot be read, is NESTED,
    lacks a column, has pixel numbers out of order, another nside or frame, negative hits, non-finite numbers, or a
    modulus above 1.
    """
    where = f"moments file {str(path)!r}"
    if frame is not None:
        check_frame(frame)
    found = _from_npz(path, where) if Path(path).suffix == ".npz" else _from_fits(path, where, smax, frame)
    check_moments(found, where)
    if nside not in (None, found.nside):
        raise InputError(f"{where} has nside {found.nside}, but the maps have nside {nside}; use moments of it.")
    if frame not in (None, found.frame):
        raise InputError(
            f"{where} is in {found.frame} coordinates, but the maps are {frame}; use moments of that frame."
        )
    if smax is not None and found.smax < smax:
        raise InputError(f"{where} ends at s = {found.smax}, but {smax} is needed; compute moments with smax={smax}.")
    return found if smax is None else replace(found, w=found.w[:smax])


def _from_npz(path: str | Path, where: str) -> Moments:
    arrays = read_npz(path)
    try:
        return Moments(int(arrays.pop("nside")), str(arrays.pop("frame")), **arrays)
    except (KeyError, TypeError) as error:
        raise InputError(f"{where} holds no moments ({error}); write it again.") from None


def _from_fits(path: str | Path, where: str, smax: int | None, frame: str | None) -> Moments:
    """Read a HEALPix table, up to ``smax`` if it is given; ``frame`` is its own if it states none."""
    columns, header = _read_table(path, where)
    if "HITS" not in columns:
        raise InputError(f"{where} has no column HITS; the columns are {', '.join(columns)}.")
    hits = columns["HITS"]
    nside = nside_of(hits.size, where)
    if header["NSIDE"] not in (None, nside):
        raise InputError(f"{where} says NSIDE = {header['NSIDE']} but has {hits.size} pixels; write it again.")
    if header["ORDERING"] is None:
        raise InputError(f"{where} has no ORDERING; write RING there if its pixels are so, or reorder it first.")
    if str(header["ORDERING"]).strip().upper() != "RING":
        raise InputError(f"{where} has ORDERING = {header['ORDERING']!r}, but it must be RING; reorder it first.")
    for name in set(PIXEL) & set(columns):
        if not np.array_equal(columns[name], np.arange(hits.size)):
            raise InputError(f"{where} has pixel numbers in {name} that do not count from 0; sort its rows by them.")
    stated = header["COORDSYS"] or frame
    if stated is None:
        raise InputError(f"{where} has no COORDSYS; write E, G or C there.")
    if smax is None:
        smax = 1
        while f"RE_{smax + 1}" in columns and f"IM_{smax + 1}" in columns:
            smax += 1
    needed = [f"{part}_{s}" for s in range(1, smax + 1) for part in ("RE", "IM")]
    for name in needed:
        if name not in columns:
            raise InputError(f"{where} has no column {name}, but moments up to s = {smax} are needed.")
    offsets = [name for name in ("DTHETA", "DPHI") if name in columns]
    if len(offsets) == 1:
        raise InputError(f"{where} has {offsets[0]} alone; give both DTHETA and DPHI or neither.")
    powers = _powers_in(columns, where)
    seen = hits > 0.0
    for name in ("HITS", *needed, *offsets, *powers):
        if name != "HITS":
            columns[name] = np.where(seen, columns[name], 0.0)
        bad = ~np.isfinite(columns[name])
        if bad.any():
            raise InputError(f"{where}: column {name} is not finite in {bad.sum()} pixels, first {np.argmax(bad)}.")
    orders = [columns[f"RE_{s}"] + 1j * columns[f"IM_{s}"] for s in range(1, smax + 1)]
    w = np.array(orders, dtype=np.complex128).reshape(smax, hits.size)
    more = np.stack([columns[name] for name in powers]) if powers else None
    dtheta, dphi = (columns.get(name) for name in ("DTHETA", "DPHI"))
    return Moments(nside, stated, hits, w, dtheta, dphi, more)


def check_moments(moments: Moments, where: str) -> None:
    """Raise InputError for values that the samples of no pixel have; ``where`` names them in messages."""
    hits, w = (array[..., : 1 if array.strides[-1] == 0 else None] for array in (moments.hits, moments.w))
    if not hits.min() >= 0.0:
        pixel = int(np.argmin(hits))  # that of a NaN, if there is one
        raise InputError(f"{where}: HITS is {hits[pixel]:g} in pixel {pixel}; give 0 where nothing was observed.")
    largest = np.max([np.abs(row).max() for row in w], initial=0.0)
    if not largest <= 1.0 + 1e-6:  # single precision may exceed 1 by 6e-8
        raise InputError(f"{where}: a moment has modulus {largest:g}, but means of e^(-i s psi) are <= 1.")
    offsets = [(row, 1) for row in (moments.dtheta, moments.dphi) if row is not None]
    if moments.offset_moments is not None:
        offsets += [(row, sum(ab)) for row, ab in zip(moments.offset_moments, exponents(HIGHEST), strict=False)]
    farthest = np.max([np.abs(row).max() ** (1.0 / degree) for row, degree in offsets], initial=0.0)
    if not farthest <= 2.0 * healpy.max_pixrad(moments.nside):
        raise InputError(
            f"{where}: samples lie {farthest:g} rad from their pixel's centre, but a pixel of nside {moments.nside} "
            f"reaches {healpy.max_pixrad(moments.nside):.3g}; give DTHETA and DPHI in radians, or their unit in TUNIT."
        )


def _named(order: int) -> dict[str, tuple[int, int]]:
    """Return the columns of the moments of offsets of degree 2 to ``order``, with their exponents."""
    return {f"OFFSET_{a}_{b}": (a, b) for a, b in exponents(order)}


def _powers_in(columns: dict[str, NDArray[np.float64]], where: str) -> dict[str, tuple[int, int]]:
    """Return the columns OFFSET_a_b of a table, up to the highest degree of which there is one."""
    found = [sum(powers) for name, powers in _named(HIGHEST).items() if name in columns]
    wanted = _named(max(found, default=1))
    lacking = [name for name in ("DTHETA", *wanted) if name not in columns] if wanted else []
    if lacking:
        raise InputError(f"{where} has columns OFFSET_a_b but not {lacking[0]}; give all up to the highest a + b.")
    return wanted


def _to_radians(name: str, unit: str) -> float:
    """Return the factor from the unit of a column to powers of radians: of OFFSET_a_b rad2, deg3, arcmin**4."""
    degree = sum(_named(HIGHEST).get(name, (1,)))
    base = re.fullmatch(rf"(.*?[a-z])\s*(?:\*\*|\^)?\s*\(?{degree}\)?", unit.strip().lower()) if degree > 1 else None
    return radians(unit if base is None else base[1]) ** degree


def _read_table(path: str | Path, where: str) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any]]:
    """Return columns (upper-case names, flattened, float64) and HEALPix keywords of a file's first binary table."""
    with unreadable(where, "a table of moments", "give a complete FITS table"), opened(Path(path)) as hdus:
        table = first_table(hdus)
        columns = {name.upper(): np.array(table.data[name], dtype=np.float64).ravel() for name in table.columns.names}
        for column in table.columns:
            if column.unit and column.name.upper() in ("DTHETA", "DPHI", *_named(HIGHEST)):
                columns[column.name.upper()] *= _to_radians(column.name.upper(), column.unit)
        header = {key: table.header.get(key) for key in ("NSIDE", "ORDERING")}
        header["COORDSYS"] = stated_frame(hdus, where)
    sizes = {array.size for array in columns.values()}
    if len(sizes) != 1:
        raise InputError(f"{where} has columns of different sizes {sorted(sizes)}; write it again.")
    return columns, header


def write_moments_fits(path: str | Path, moments: Moments) -> None:
    """Write moments as a HEALPix table that :func:`read_moments` reads, overwriting ``path``."""
    arrays = {"HITS": moments.hits}
    for s, w in enumerate(moments.w, start=1):
        arrays[f"RE_{s}"], arrays[f"IM_{s}"] = w.real, w.imag
    if moments.dtheta is not None and moments.dphi is not None:
        arrays["DTHETA"], arrays["DPHI"] = moments.dtheta, moments.dphi
    units = {"DTHETA": "rad", "DPHI": "rad"}
    if moments.offset_moments is not None:
        powers = _named(moments.offset_order)
        arrays |= dict(zip(powers, moments.offset_moments, strict=True))
        units |= {name: f"rad{sum(degree)}" for name, degree in powers.items()}
    table = fits.BinTableHDU.from_columns(
        [fits.Column(name=name, format="D", unit=units.get(name), array=array) for name, array in arrays.items()]
    )
    table.header.update(
        PIXTYPE="HEALPIX",
        ORDERING="RING",
        COORDSYS=FRAMES[moments.frame],
        NSIDE=moments.nside,
        FIRSTPIX=0,
        LASTPIX=moments.npix - 1,
        INDXSCHM="IMPLICIT",
        COMMENT="RE_s + i IM_s: mean of exp(-i s psi); psi from e_theta (south) towards e_phi (east)",
    )
    table.writeto(path, overwrite=True)
