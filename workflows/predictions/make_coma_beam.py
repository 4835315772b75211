"""Write coma-beam.fits: a Gaussian of 40' times 1 + k (u^3 - 3u) along 30 degrees, an odd-m beam of known origin.

python workflows/predictions/make_coma_beam.py
"""

import numpy as np
from astropy.io import fits

FWHM_ARCMIN, K, ANGLE_DEG, PIXEL_DEG, HALF = 40.0, 0.08, 30.0, 0.04, 80

sigma = FWHM_ARCMIN / 60 / np.sqrt(8 * np.log(2))
y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1] * PIXEL_DEG
u = (x * np.cos(np.deg2rad(ANGLE_DEG)) + y * np.sin(np.deg2rad(ANGLE_DEG))) / sigma
beam = np.exp(-(x**2 + y**2) / (2 * sigma**2)) * (1 + K * (u**3 - 3 * u))
header = fits.Header({"CDELT1": PIXEL_DEG, "CDELT2": PIXEL_DEG, "CUNIT1": "deg", "CUNIT2": "deg"})
fits.PrimaryHDU(beam.astype(np.float32), header).writeto("coma-beam.fits", overwrite=True)
