"""The WMAP 7-year V and W maps and Planck's CMB map at nside 32 as data for a diagnosis.

    python workflows/diagnosis/wmap7-maps/prepare.py FOLDER

Reads $MCSIM_DATA/wmap_maps/wmap_band_iqumap_r9_7yr_{V,W}_v4_udgraded32.fits (from the tests of healpy; originals:
https://lambda.gsfc.nasa.gov/product/wmap/dr4/maps_band_r9_iqu_7yr_get.html), whose headers give no unit: it is mK.
Planck's map is $MCSIM_DATA/planck/planck_cmb_inpainted_nside64_uK.fits, in uK (input/cmb_data.txt of
https://github.com/jamshidi3d/cmb_anomaly_detection; original: https://pla.esac.esa.int), averaged to nside 32.
Monopole and dipole outside the mask, which the WMAP maps keep from their calibration, are taken off.
"""

import argparse
import os
from pathlib import Path

import healpy
import numpy as np


def main() -> None:
    """Write FOLDER/V.fits, FOLDER/W.fits and FOLDER/CMB.fits in uK."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    source = Path(os.environ["MCSIM_DATA"]) / "wmap_maps"
    planck = Path(os.environ["MCSIM_DATA"]) / "planck" / "planck_cmb_inpainted_nside64_uK.fits"
    mask = healpy.read_map(source / "wmap_temperature_analysis_mask_r9_7yr_v4_udgraded32.fits") > 0.5
    folder.mkdir(parents=True, exist_ok=True)
    bands = {
        band: 1e3 * healpy.read_map(source / f"wmap_band_iqumap_r9_7yr_{band}_v4_udgraded32.fits") for band in "VW"
    }
    bands["CMB"] = healpy.ud_grade(healpy.read_map(planck, dtype=np.float64), 32)
    for band, map_uk in bands.items():
        monopole, dipole = healpy.fit_dipole(np.where(mask, map_uk, healpy.UNSEEN))
        x, y, z = healpy.pix2vec(32, np.arange(map_uk.size))
        map_uk -= monopole + dipole[0] * x + dipole[1] * y + dipole[2] * z
        path = folder / f"{band}.fits"
        healpy.write_map(path, map_uk, coord="G", column_units="uK", dtype=np.float64, overwrite=True)
        print(f"wrote {path}: took off {monopole:.1f} uK and a dipole of {np.linalg.norm(dipole):.1f} uK")


if __name__ == "__main__":
    main()
