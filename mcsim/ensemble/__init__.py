"""Ensembles of realizations: planned, run on Dask, stored as Zarr, summarised, repaired, predicted."""
