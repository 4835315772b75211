"""Identify code by its content, so that nothing in a cache is older than the code that made it."""

import hashlib
import inspect
import sys
import uuid
from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FunctionType


def package_digest(packages: Iterable[str], libraries: Iterable[str] = ()) -> str:
    """Return the SHA-256 of the source files of packages or modules, and of the versions of libraries."""
    files = [path for name in sorted(packages) for path in _files(name)]
    found = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    found += [f"{name} {version(name)}" for name in sorted(libraries)]
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


def class_digest(kind: type | FunctionType) -> str:
    """Return the SHA-256 of the packages of a user that define a function, or a class and its bases.

    Those of mcsim do not count. Code whose source cannot be read, typed at a prompt for instance, gets a new digest at
    every call.
    """
    found = [f"{kind.__module__}.{kind.__qualname__}"]
    for base in kind.__mro__ if isinstance(kind, type) else (kind,):
        top = base.__module__.partition(".")[0]
        if top == "mcsim" or (top in sys.stdlib_module_names and top != "__main__"):
            continue
        try:
            found.append(inspect.getsource(base) if top == "__main__" else package_digest([top]))
        except (ImportError, OSError, TypeError):
            found.append(uuid.uuid4().hex)
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


def _files(name: str) -> list[Path]:
    module = sys.modules[name] if name in sys.modules else import_module(name)
    if hasattr(module, "__path__"):
        return sorted(path for folder in module.__path__ for path in Path(folder).rglob("*.py"))
    if module.__file__ is None:
        raise OSError(f"{name} has no file")
    return [Path(module.__file__)]
