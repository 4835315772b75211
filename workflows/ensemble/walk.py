"""A walk through a stored ensemble with plain xarray: no mcsim is needed to read what mcsim wrote.

Nothing is loaded before it is asked for: arrays come chunk by chunk, as they are stored, through Dask's threads, so an
ensemble may be larger than the memory.

    python workflows/ensemble/walk.py quickstart.zarr
"""

import argparse
from pathlib import Path

import numpy as np
import xarray as xr


def finished(store: str | Path) -> xr.Dataset:
    """The realizations that are done; rows of the others hold NaN."""
    ensemble = xr.open_zarr(store)
    return ensemble.isel(realization=np.flatnonzero(ensemble["done"].values))


def choose(ensemble: xr.Dataset, L: int | None = None, M: int | None = None, d: int | None = None) -> xr.Dataset:
    """The modes of some L, M and d = l2 - l1. One mode by its name: ``ensemble.sel(mode="L2M0d0")``."""
    keep = xr.ones_like(ensemble["L"], dtype=bool)
    for name, value in (("L", L), ("M", M), ("d", d)):
        if value is not None:
            keep = keep & (ensemble[name] == value)
    return ensemble.isel(mode=np.flatnonzero(keep.values))


def mean_and_error(spectra: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """Mean over realizations, and its standard error, of real or complex spectra."""
    count = spectra.sizes["realization"]
    mean = spectra.mean("realization")
    variance = (abs(spectra - mean) ** 2).sum("realization", skipna=False) / (count - 1)
    return mean, np.sqrt(variance / count)


def binned(spectra: xr.DataArray, width: int) -> xr.DataArray:
    """l(l+1)/2pi times the spectra, averaged over bins of ``width`` degrees."""
    scaled = spectra * spectra["ell"] * (spectra["ell"] + 1) / (2 * np.pi)
    first = (spectra["ell"] // width * width).rename("bin_first")
    return scaled.groupby(first).mean(skipna=True)


def covariance(bins: xr.DataArray) -> xr.DataArray:
    """Covariance E (x - mean) conj(x - mean)^T of one realization between bins; only the bins themselves are loaded."""
    deviation = (bins - bins.mean("realization")).compute()
    other = deviation.conj().rename(bin_first="bin_first_2")
    return xr.dot(deviation, other, dim="realization") / (bins.sizes["realization"] - 1)


def main() -> None:
    """Walk through one store."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--width", type=int, default=50, help="of the bins in ell")
    chosen = parser.parse_args()

    ensemble = finished(chosen.store)
    print(ensemble)
    print(f"\nunit {ensemble.biposh.attrs['units']}, frame {ensemble.attrs['configuration']['map']['frame']}")

    quadrupole = choose(ensemble, L=2, d=0)
    print(f"modes with L = 2, d = 0: {', '.join(quadrupole['mode'].values)}")

    # What the beam adds, sky by sky: the same skies through the circular part of the beam are stored beside it.
    a20 = ensemble.sel(mode="L2M0d0").isel(pair=0)
    what, spectra = "A20", a20["biposh"]
    if "biposh_circular" in a20:
        what, spectra = "A20, paired difference", spectra - a20["biposh_circular"]
    bins = binned(spectra, chosen.width)
    mean, error = mean_and_error(bins)
    correlation = covariance(bins)
    scale = np.sqrt(np.diag(correlation).real)
    print(f"\nl(l+1)/2pi {what} ({bins.sizes['realization']} realizations), correlation with the next bin")
    for k, first in enumerate(bins["bin_first"].values):
        nxt = f"{correlation[k, k + 1].values.real / (scale[k] * scale[k + 1]):+.2f}" if k + 1 < len(scale) else ""
        print(f"l from {first:5d}: {complex(mean[k].values).real:12.5g} +- {float(error[k]):.2g} uK^2  {nxt}")


if __name__ == "__main__":
    main()
