"""Write wmap-limit-moments.fits: moments s = 1 ... 3 of the WMAP-like scan in the limit of endless time, nside 256.

    python workflows/predictions/make_limit_moments.py

A year leaves structure of its own at the scale of the scan's lines; the limit depends on colatitude alone.
"""

import healpy
import numpy as np

from mcsim import resources, scan

NSIDE, SMAX = 256, 3

model = scan.load_model(resources.scan_model("wmap"))
theta, _ = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
rings, ring = np.unique(theta, return_inverse=True)
density, w = scan.limit_moments(model, rings, SMAX)
moments = scan.Moments(NSIDE, "ecliptic", density[ring] / density[ring].mean(), w[:, ring])
scan.write_moments_fits("wmap-limit-moments.fits", moments)
