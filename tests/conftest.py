"""Settings of the whole suite: the same hypothesis examples every time, and no windows."""

import os

from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# Compiling a numba kernel or a slow disk must not fail a test: no deadline. The examples are the same on every machine.
settings.register_profile("mcsim", derandomize=True, deadline=None, database=None)
settings.load_profile("mcsim")
