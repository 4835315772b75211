"""Load large modules quickly, and files once for as long as they stay as they are."""

import gc
import os
import sys
from collections.abc import Callable
from functools import lru_cache, wraps
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

Read = TypeVar("Read", bound=Callable[..., Any])


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


def once_per_content(maxsize: int) -> Callable[[Read], Read]:
    """Return a decorator that keeps the last results of a reader of a file, its first argument, until that is changed.

    A file counts as changed if its size or its time of writing is another.
    """

    def decorated(read: Read) -> Read:
        kept = lru_cache(maxsize=maxsize)(lambda written, *given: read(*given))

        @wraps(read)
        def found(path: str | Path, *given: Any) -> Any:
            try:
                now = os.stat(path)
            except OSError:
                return read(path, *given)  # which says what is missing
            return kept((now.st_mtime_ns, now.st_size), path, *given)

        return found  # type: ignore[return-value]

    return decorated
