"""Effects that no library has: classes of a file of the challenger's, lent to the simulator while data are made."""

import importlib.util
import inspect
import sys
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path

from mcsim import systematics
from mcsim.errors import InputError
from mcsim.systematics import Effect


@lru_cache(maxsize=4)
def load(path: str) -> dict[str, type[Effect]]:
    """Effects that a Python file defines, by name.

    Raises
    ------
    InputError
        A file that cannot be run, defines no effect, or one whose name the library has.
    """
    spec = importlib.util.spec_from_file_location(f"mcsim_inventions_{Path(path).stem}", path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise InputError(f"{path} is no Python file with inventions; name one that defines classes of mcsim.Effect.")
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


def introduced(path: str | None) -> AbstractContextManager[None]:
    """Let runs be simulated with the inventions of a file; no diagnosis may be prepared meanwhile."""
    return systematics.lent({} if path is None else load(path))
