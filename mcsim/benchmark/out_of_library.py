"""Load effects that no library has from a Python file."""

import importlib.util
import inspect
import sys
from functools import lru_cache
from pathlib import Path

from mcsim import systematics
from mcsim.errors import InputError
from mcsim.systematics import Effect, Library


@lru_cache(maxsize=4)
def load(path: str) -> dict[str, type[Effect]]:
    """Load the effects that a Python file defines, by name.

    Raises
    ------
    InputError
        If the file cannot be run, or defines no effect, or one whose name the library has.
    """
    spec = importlib.util.spec_from_file_location(f"mcsim_out_of_library_{Path(path).stem}", path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise InputError(f"{path} is no Python file with effects; name one that defines classes of mcsim.Effect.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a foreign file does when it is run
        raise InputError(f"{path} cannot be run ({error}); mend it.") from error
    found = {
        kind.name: kind
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, Effect) and kind.__module__ == spec.name
    }
    taken = sorted(set(found) & set(systematics.catalogue()))
    if not found or taken:
        wrong = f"{taken[0]}, which the library has" if taken else "no effect"
        raise InputError(f"{path} defines {wrong}; let it define effects of its own.")
    return found


def library_with(path: str | None) -> Library | None:
    """Return the catalogue with the effects of a file; None, the catalogue itself, without a file."""
    return None if path is None else {**systematics.catalogue(), **load(path)}
