"""HEALPix tables in the layouts of published maps."""

import healpy
import numpy as np
from astropy.io import fits


def table(path, columns, units=(), pixels=None, **keywords):
    """Write maps in RING order as a table, NESTED if ORDERING says so; ``pixels``: these alone, with their indices."""
    npix = len(next(iter(columns.values())))
    nside = healpy.npix2nside(npix)
    order = healpy.nest2ring(nside, np.arange(npix)) if keywords.get("ORDERING") == "NESTED" else np.arange(npix)
    written = np.arange(npix) if pixels is None else np.asarray(pixels)
    made = [] if pixels is None else [fits.Column("PIXEL", "J", array=written)]
    units = dict(units)
    made += [fits.Column(name, "D", array=map_[order][written], unit=units.get(name)) for name, map_ in columns.items()]
    hdu = fits.BinTableHDU.from_columns(made)
    hdu.header.update({"PIXTYPE": "HEALPIX", "NSIDE": nside, "ORDERING": "RING", **keywords})
    hdu.header["INDXSCHM"] = "IMPLICIT" if pixels is None else "EXPLICIT"
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    return str(path)
