"""The batch: one Dask task per chunk of realizations, results from worker to store, a tree of sums to the summary.

The only package that touches dask. Nothing large is in the graph: tasks carry the configuration as text and load beams
and moments on the worker, once.
"""

from mcsim.ensemble.runner.batch import Result, run
from mcsim.ensemble.runner.cluster import completed, local_client
from mcsim.ensemble.runner.slices import merge

__all__ = ["Result", "completed", "local_client", "merge", "run"]
