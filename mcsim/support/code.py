"""Identify code by its content, so that nothing in a cache is older than the code that made it."""

import ast
import dataclasses
import hashlib
import inspect
import pickle
import sys
import uuid
from collections.abc import Iterable
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any


@cache
def version(library: str) -> str:
    """Return the version of an installed library; its metadata are parsed once."""
    return metadata.version(library)


def package_digest(packages: Iterable[str], libraries: Iterable[str] = ()) -> str:
    """Return the SHA-256 of the source files of packages or modules, and of the versions of libraries.

    Files are read once: they may change afterwards, but the code that is loaded does not.
    """
    return _package_digest(tuple(sorted(packages)), tuple(sorted(libraries)))


@cache
def _package_digest(packages: tuple[str, ...], libraries: tuple[str, ...]) -> str:
    files = [path for name in packages for path in _files(name)]
    return _digest(files, *(f"{name} {version(name)}" for name in libraries))


def class_digest(kind: type | FunctionType) -> str:
    """Return the SHA-256 of the packages of a user that define a function, or a class and its bases.

    Of a module in no package, what it imports from its own folder counts as well; of a script or notebook the source,
    and what it uses of the rest. Files are read when code is first seen, as it is loaded then; values that functions
    hold count as they are. Those of mcsim do not count. Code whose source cannot be read, typed at a prompt for
    instance, gets a new digest at every call.
    """
    found = [f"{kind.__module__}.{kind.__qualname__}"]
    for base in kind.__mro__ if isinstance(kind, type) else (kind,):
        top = base.__module__.partition(".")[0]
        if top == "mcsim" or (top in sys.stdlib_module_names and top != "__main__"):
            continue
        try:
            found += _of_script(base, []) if top == "__main__" else [_of_file(base), *_held(base, [])]
        except (AttributeError, ImportError, OSError, pickle.PicklingError, SyntaxError, TypeError):
            found.append(uuid.uuid4().hex)
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


@cache
def _of_file(kind: type | FunctionType) -> str:
    return _digest(_with_imports(_files(kind.__module__.partition(".")[0])))


def _of_script(kind: type | FunctionType, met: list[Any]) -> list[str]:
    """Return the source of what a script or notebook defines, and of what it uses that is defined there, too."""
    met.append(kind)
    return [inspect.getsource(kind), *_held(kind, met)]


def _held(kind: type | FunctionType, met: list[Any]) -> list[str]:
    """Return the values that the functions of a class, or a function, hold from around them."""
    own = [getattr(one, "__func__", getattr(one, "fget", getattr(one, "func", one))) for one in vars(kind).values()]
    own = [inspect.unwrap(one) if callable(one) else one for one in own]
    functions = [one for one in ([kind] if isinstance(kind, FunctionType) else own) if isinstance(one, FunctionType)]
    found = []
    for function in functions:
        if function.__code__.co_filename not in ("<string>", dataclasses.__file__):  # made from its fields
            used = inspect.getclosurevars(function)
            there = used.globals if function.__module__ == "__main__" else {}
            for name, value in sorted({**used.nonlocals, **there}.items()):
                found += [name, *_of_value(value, met)]
    return found


def _of_value(value: Any, met: list[Any]) -> list[str]:
    if isinstance(value, type | FunctionType):
        if value.__module__ != "__main__" or value in met:
            return [f"{value.__module__}.{value.__qualname__}"]
        return _of_script(value, met)
    return [value.__name__] if isinstance(value, ModuleType) else [hashlib.sha256(pickle.dumps(value)).hexdigest()]


def _digest(files: Iterable[Path], *more: str) -> str:
    found = [*(hashlib.sha256(path.read_bytes()).hexdigest() for path in files), *more]
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


def _with_imports(files: list[Path]) -> list[Path]:
    """Return the files of a package; of a single module also those that it imports, directly or not, from its folder.

    A package of that folder counts as a whole.
    """
    folder, found, waiting = files[0].parent, set[Path](), list(files)
    if len(files) > 1 or files[0].name == "__init__.py" or folder.name == "site-packages":
        return files
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        for node in ast.walk(ast.parse(path.read_bytes())):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for top in {name.partition(".")[0] for name in names}:
                waiting += [one for one in (folder / f"{top}.py",) if one.is_file()]
                waiting += (folder / top).rglob("*.py")
    return sorted(found)


def _files(name: str) -> list[Path]:
    module = sys.modules[name] if name in sys.modules else import_module(name)
    if hasattr(module, "__path__"):
        return sorted(path for folder in module.__path__ for path in Path(folder).rglob("*.py"))
    if module.__file__ is None:
        raise OSError(f"{name} has no file")
    return [Path(module.__file__)]
