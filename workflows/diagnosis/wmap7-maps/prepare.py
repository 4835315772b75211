"""The WMAP 7-year V and W maps at nside 32 as data for a diagnosis.

    python workflows/diagnosis/wmap7-maps/prepare.py FOLDER

Reads $MCSIM_DATA/wmap_maps/wmap_band_iqumap_r9_7yr_{V,W}_v4_udgraded32.fits (from the tests of healpy; originals:
https://lambda.gsfc.nasa.gov/product/wmap/dr4/maps_band_r9_iqu_7yr_get.html), whose headers give no unit: it is mK.
Monopole and dipole outside the mask, which the maps keep from their calibration, are taken off.
"""

import argparse
import os
from pathlib import Path

import healpy
import numpy as np


def main() -> None:
    """Write FOLDER/V.fits and FOLDER/W.fits in uK."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    source = Path(os.environ["MCSIM_DATA"]) / "wmap_maps"
    mask = healpy.read_map(source / "wmap_temperature_analysis_mask_r9_7yr_v4_udgraded32.fits") > 0.5
    folder.mkdir(parents=True, exist_ok=True)
    for band in "VW":
        map_uk = 1e3 * healpy.read_map(source / f"wmap_band_iqumap_r9_7yr_{band}_v4_udgraded32.fits")
        monopole, dipole = healpy.fit_dipole(np.where(mask, map_uk, healpy.UNSEEN))
        x, y, z = healpy.pix2vec(32, np.arange(map_uk.size))
        map_uk -= monopole + dipole[0] * x + dipole[1] * y + dipole[2] * z
        path = folder / f"{band}.fits"
        healpy.write_map(path, map_uk, coord="G", column_units="uK", dtype=np.float64, overwrite=True)
        print(f"wrote {path}: took off {monopole:.1f} uK and a dipole of {np.linalg.norm(dipole):.1f} uK")


if __name__ == "__main__":
    main()
