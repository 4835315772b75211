"""Load large modules quickly."""

import gc
import sys
from importlib import import_module
from types import ModuleType


def loaded(name: str) -> ModuleType:
    """Return a module; if it has to be imported, do so without garbage collection.

    An import makes hundreds of thousands of objects that stay, and the collector walks through all of them again and
    again: a fifth of the time that the runner takes to load. Afterwards they are exempt from collection. For processes
    of mcsim's own, its commands and its workers: what else a process has made is exempt as well.
    """
    if name in sys.modules:
        return sys.modules[name]
    collecting = gc.isenabled()
    gc.disable()
    try:
        module = import_module(name)
        gc.freeze()
    finally:
        if collecting:
            gc.enable()
    return module
