"""Planck's FEBeCoP spectra at 30 GHz as a table of measured BipoSH coefficients that ``mcsim diagnose`` reads.

    python workflows/diagnosis/febecop/make_table.py -o febecop.ecsv [--skies 50]

MCSIM_DATA names a folder with biposh_reference/AL2Ms_febecop_030.txt.gz, which workflows/planck/febecop.py describes:
Re A^{2M}_{l,l+D} of the mean of 50 CMB maps, row 3 M + D, columns l = 2...2048, uK^2, l(l+1)/2pi times the Bennett
normalisation, galactic frame. Bins of 25 multipoles from 150 to 399, as there. There are no imaginary parts and no
errors; --skies is the number of skies that the table claims to be the mean of.
"""

import argparse
import os
from pathlib import Path

import numpy as np
from astropy.table import Table

FIRST, LAST, WIDTH = 150, 399, 25


def main() -> None:
    """Bin and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--skies", type=int, default=50)
    arguments = parser.parse_args()
    if "MCSIM_DATA" not in os.environ:
        parser.error("set MCSIM_DATA to the folder described above")
    file = np.loadtxt(Path(os.environ["MCSIM_DATA"]) / "biposh_reference" / "AL2Ms_febecop_030.txt.gz")
    rows = []
    for M in (0, 1, 2):
        for d in (0, 2):
            spectrum = np.full(file.shape[1] + 2 + d, np.nan)
            spectrum[2 + d :] = file[3 * M + d]  # at l2 = l + d
            for low in range(FIRST, LAST + 1, WIDTH):
                high = low + WIDTH - 1
                rows.append((2, M, d, low, high, float(np.mean(spectrum[low : high + 1]))))
    table = Table(rows=rows, names=["L", "M", "d", "ell_min", "ell_max", "value"])
    table["value"].unit = "uK2"
    table.meta = {
        "normalisation": "Bennett",
        "scaling": "l(l+1)/2pi",
        "frame": "galactic",
        "realizations": arguments.skies,
    }
    table.write(arguments.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
