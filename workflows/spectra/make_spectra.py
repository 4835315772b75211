"""Make the packaged C_l tables with CAMB: ``pip install "mcsim[spectra]"``, then ``python make_spectra.py FOLDER``.

Parameters
----------
wmap7
    Maximum-likelihood flat LCDM of WMAP-7 alone (LCDM + SZ + lensing), D. Larson et al. 2011, arXiv:1001.4635. WMAP-7
    was analysed with RECFAST 1.4.2, so its recombination is used: RECFAST 1.5 lowers C_l by 2 % at l = 2000.
planck2018
    Best fit of Planck TT,TE,EE+lowE+lensing (Plik), Planck Collaboration VI 2020, arXiv:1807.06209, Table 1.

Notes
-----
Lensed scalar TT in uK^2, without an SZ template. Over the tables that the two collaborations distribute: wmap7 is
within 0.9 % for l = 2..2000 (mean ratio 0.9967, scatter 0.0009 above l = 10), planck2018 within 0.3 % for l =
2..3700. The constant 0.33 % of wmap7 is the rounding of the published amplitude and optical depth; the published
values are kept.
"""

import argparse
from pathlib import Path
from typing import Any

import camb
import numpy as np

LMAX = 4096

PARAMETERS: dict[str, dict[str, Any]] = {
    "wmap7": {
        "reference": "WMAP-7 maximum likelihood, Larson et al. 2011, arXiv:1001.4635; RECFAST 1.4.2; linear lensing",
        "cosmology": {
            "ombh2": 0.02270,
            "omch2": 0.1107,
            "H0": 100.0 * float(np.sqrt((0.02270 + 0.1107) / (1.0 - 0.738))),
            "tau": 0.086,
            "ns": 0.969,
            "As": 2.38e-9,
            "pivot_scalar": 0.002,
            "mnu": 0.0,
            "nnu": 3.04,
            "YHe": 0.24,
            "TCMB": 2.725,
        },
    },
    "planck2018": {
        "reference": "Planck 2018 TT,TE,EE+lowE+lensing best fit, arXiv:1807.06209; lensing with halofit",
        "cosmology": {
            "ombh2": 0.022383,
            "omch2": 0.12011,
            "H0": 67.32,
            "tau": 0.0543,
            "ns": 0.96605,
            "As": 2.1005e-9,
            "pivot_scalar": 0.05,
            "mnu": 0.06,
            "nnu": 3.046,
            "TCMB": 2.7255,
        },
    },
}


def spectrum(name: str) -> np.ndarray:
    """Lensed scalar C_l in uK^2 for l = 0..LMAX."""
    # Lensing mixes degrees: the unlensed spectra go beyond the table, or its end is several per cent low.
    cosmology = camb.set_params(**PARAMETERS[name]["cosmology"], lmax=LMAX + 2000, lens_potential_accuracy=4)
    if name == "wmap7":
        cosmology.NonLinear = "NonLinear_none"
        cosmology.Recomb.RECFAST_fudge = 1.14
        cosmology.Recomb.RECFAST_Hswitch = False
    results = camb.get_results(cosmology)
    return results.get_lensed_scalar_cls(lmax=LMAX, CMB_unit="muK", raw_cl=True)[:, 0]


def main() -> None:
    """Write one table per set of parameters into the folder given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    for name, description in PARAMETERS.items():
        cosmology = ", ".join(f"{key}={value:.6g}" for key, value in description["cosmology"].items())
        header = [
            f"{name}: lensed scalar temperature power spectrum, CAMB {camb.__version__}",
            description["reference"],
            cosmology,
            "columns: ell, C_ell [uK^2]",
        ]
        cl = spectrum(name)
        rows = np.column_stack([np.arange(2, LMAX + 1), cl[2:]])
        np.savetxt(folder / f"{name}.txt", rows, fmt=["%d", "%.7e"], header="\n".join(header))


if __name__ == "__main__":
    main()
