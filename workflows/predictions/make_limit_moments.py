"""Write wmap-limit-moments.fits: moments s = 1 ... 3 of the WMAP-like scan in the limit of endless time, nside 256.

    python workflows/predictions/make_limit_moments.py

A year leaves structure of its own at the scale of the scan's lines; the limit depends on colatitude alone.
"""

from mcsim.instrument import scan

NSIDE, SMAX = 256, 3

model = scan.ScanModel.load("wmap")
scan.write_moments_fits("wmap-limit-moments.fits", scan.Moments.limit(model, NSIDE, SMAX))
