"""BipoSH coefficients of maps that another program makes: a hundred seeds, on two workers."""

import healpy
import numpy as np
import xarray as xr
from distributed import Client
from own_simulator import LMAX, HealpySurvey

import mcsim


def spectra(seed):
    """Return the coefficients of the pair of maps of one seed."""
    maps = HealpySurvey().simulate(seed)["V"]
    alms = [healpy.map2alm(maps[half], lmax=LMAX) for half in ("a", "b")]
    return mcsim.biposh(*alms, L_max=2)


def significance(ensemble):
    """Return the mean over its error of every coefficient, real and imaginary part apart."""
    parts = xr.concat([ensemble.biposh.real, ensemble.biposh.imag], dim="part")
    error = parts.std("realization", ddof=1) / np.sqrt(parts.sizes["realization"])
    return parts.mean("realization") / error.where(error > 0.0)


if __name__ == "__main__":
    with Client(n_workers=2, threads_per_worker=1) as client:
        ensemble = xr.concat(client.gather(client.map(spectra, range(100))), dim="realization")
    found = significance(ensemble.where(ensemble.L > 0, drop=True))
    largest = float(abs(found).max())
    print(f"the largest of {int(found.count())} numbers with L > 0 is {largest:.1f} standard errors")
