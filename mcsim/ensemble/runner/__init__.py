"""Runs on Dask: one task per chunk of realizations, which writes to the store, and a tree of sums.

This is the only package that uses dask. The graph stays small: tasks carry the configuration as text, and each worker
loads beams and moments once.
"""

from mcsim.ensemble.runner.batch import Result, run
from mcsim.ensemble.runner.cluster import Workers, check_workers, completed, connected, load_ahead, local_client
from mcsim.ensemble.runner.slices import merge

__all__ = ["Result", "Workers", "check_workers", "completed", "connected", "load_ahead", "local_client", "merge", "run"]
