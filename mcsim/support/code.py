"""Identify code by its content, so that nothing in a cache is older than the code that made it."""

import ast
import copyreg
import dataclasses
import dis
import hashlib
import inspect
import pickle
import sys
import textwrap
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import cloudpickle
import numpy as np

LIBRARIES = ("ducc0", "healpy", "numpy", "scipy")  #: what maps, and numbers of them, are computed with

UNSENDABLE = (TypeError, pickle.PicklingError)  #: raised by what cannot be sent to a worker


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


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a Python file, and of what it imports from its own folder, directly or not."""
    try:
        files = _with_imports([path])
    except (SyntaxError, ValueError):  # who runs it will say so
        files = [path]
    own = hashlib.sha256(path.read_bytes()).hexdigest()
    return own if files == [path] else _digest(files)


def class_digest(kind: type | FunctionType) -> str:
    """Return the SHA-256 of the packages of a user that define a function, or a class and its bases.

    Of a module in no package, what it imports from its own folder counts as well; of a script or notebook the source,
    and what it uses of the rest. Files are read when code is first seen, as it is loaded then; values that functions
    hold count as they are. Those of mcsim and of installed libraries do not count. Code of a prompt or notebook without
    source is known by what it is compiled to; what can be told in no way gets a new digest at every call.
    """
    return _hash(_of_code(kind, []))


def value_digest(value: Any) -> str:
    """Return the SHA-256 of what a value holds and of the code that defines it, the same in every process.

    Code counts as in :func:`class_digest`.
    """
    return _hash(_of_value(value, []))


def _hash(found: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


def _of_code(kind: type | FunctionType, met: list[Any]) -> list[str]:
    """Return what tells code from other code; what has been ``met`` counts by its name."""
    found = [f"{kind.__module__}.{kind.__qualname__}"]
    for base in kind.__mro__ if isinstance(kind, type) else (kind,):
        top = base.__module__.partition(".")[0]
        if any(base is one for one in met) or top == "mcsim" or (top in sys.stdlib_module_names and top != "__main__"):
            continue
        met.append(base)
        try:
            found += _of_script(base, met) if top == "__main__" else [_of_file(base), *_held(base, met)]
        except (AttributeError, ImportError, OSError, SyntaxError, *UNSENDABLE):
            found.append(uuid.uuid4().hex)
    return found


@cache
def _of_file(kind: type | FunctionType) -> str:
    return _digest(_with_imports(_files(kind.__module__.partition(".")[0])))


def _of_script(kind: type | FunctionType, met: list[Any]) -> list[str]:
    """Return the source of what a script or notebook defines, and of what it uses that is defined there, too.

    What has no source, as code at a prompt, is known by what it is compiled to.
    """
    try:
        source, imported = [inspect.getsource(kind)], set[str]()
    except (OSError, TypeError):  # TypeError: of a class in a notebook
        parts = [one for _, value in _values(kind) for one in _parts(value)]
        codes = [one.__code__ for one in parts if isinstance(one, FunctionType)]
        source = [text for code in codes for text in _of_code_object(code)]
        imported = {name for code in codes for name in _imported_by(code)}
    else:
        with suppress(SyntaxError):  # of a function without a name within a statement
            imported = _imported(ast.parse(textwrap.dedent(source[0])))
    modules = [import_module(name) for name in sorted(imported) if name in sys.modules or find_spec(name) is not None]
    return [*source, *(text for one in modules for text in _of_value(one, met)), *_held(kind, met)]


def _held(kind: type | FunctionType, met: list[Any]) -> list[str]:
    """Return the values that a class, its functions, or a function hold from around them."""
    found = list[str]()
    for name, value in _values(kind):
        for one in _parts(value):
            if isinstance(one, FunctionType):
                found += _of_function(one, met)
            elif not (name.startswith("__") or name == "_abc_impl"):  # those are made with the class
                with suppress(*UNSENDABLE):
                    found += [name, *_of_value(one, met)]
    return found


def _values(kind: type | FunctionType) -> list[tuple[str, Any]]:
    """Return what a class holds, by name; of a function itself."""
    if isinstance(kind, FunctionType):
        return [("", kind)]
    own = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    made = [(one.name, one.default_factory) for one in own if callable(one.default_factory)]
    return [*sorted(vars(kind).items()), *made]


def _parts(value: Any) -> list[Any]:
    """Return the functions of what stands for them in a class; of a function wrapped by no function the inner one."""
    if isinstance(value, property):
        return [one for one in (value.fget, value.fset) if one is not None]
    if isinstance(value, staticmethod | classmethod):
        return _parts(value.__func__)
    if isinstance(value, cached_property):
        return [value.func]
    wrapped = callable(value) and not isinstance(value, FunctionType | type) and hasattr(value, "__wrapped__")
    return [value.__wrapped__] if wrapped else [value]


def _of_function(function: FunctionType, met: list[Any]) -> list[str]:
    """Return the values that a function holds, and the code of one that wraps another; what it wraps is one of them."""
    if function.__code__.co_filename == dataclasses.__file__:  # the same for every class
        return []
    found = _of_code_object(function.__code__) if hasattr(function, "__wrapped__") else []
    for own_part in (function.__defaults__, function.__kwdefaults__, vars(function)):
        found += _of_value(own_part, met)
    for name, value in sorted(_around(function).items()):
        found += [name, *_of_value(value, met)]
    return found


def _around(function: FunctionType) -> dict[str, Any]:
    """Return what a function, and functions within it, use of those around it, and of a script or notebook."""
    there = function.__globals__ if function.__globals__.get("__name__") == "__main__" else {}
    found = {name: there[name] for code in _codes(function.__code__) for name in code.co_names if name in there}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # it is empty
            found[name] = cell.cell_contents
    return found


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield code and the code of all functions within it, comprehensions among them."""
    yield code
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _codes(one)


def _imported_by(code: CodeType) -> set[str]:
    """Return the packages and modules that code imports by their whole names."""
    steps = (step for one in _codes(code) for step in dis.get_instructions(one))
    return {str(step.argval).partition(".")[0] for step in steps if step.opname == "IMPORT_NAME" and step.argval}


def _of_code_object(code: CodeType) -> list[str]:
    """Return what code does, wherever it stands."""
    found = []
    for one in _codes(code):
        names = (one.co_names, one.co_varnames, one.co_freevars, one.co_cellvars)
        counts = (one.co_argcount, one.co_posonlyargcount, one.co_kwonlyargcount, one.co_flags)
        plain = [c for c in one.co_consts if not isinstance(c, CodeType)]
        constants = [repr(sorted(map(repr, c)) if isinstance(c, frozenset) else c) for c in plain]
        found += [one.co_code.hex(), one.co_exceptiontable.hex(), repr((names, counts)), *constants]
    return found


def _of_value(value: Any, met: list[Any]) -> list[str]:
    """Return what tells a value from others, in an order that is the same in every process."""
    name = f"{type(value).__module__}.{type(value).__qualname__}"
    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        return [name, repr(value)]
    if isinstance(value, type | FunctionType):
        known = value.__module__ == "__main__" or _is_of_user(value.__module__)
        return _of_code(value, met) if known else [f"{value.__module__}.{value.__qualname__}"]
    if isinstance(value, ModuleType):
        found = _is_of_user(value.__name__)
        return [value.__name__, _of_module(_One(value.__spec__), value.__name__)] if found else [value.__name__]
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return [f"{name} {value.dtype} {value.shape}", hashlib.sha256(value.tobytes()).hexdigest()]
    if any(value is one for one in met):
        return [name]
    met.append(value)
    if isinstance(value, set | frozenset):
        return [name, *sorted(_hash(_of_value(one, [*met])) for one in value)]
    if isinstance(value, dict):
        parts = [part for item in value.items() for part in item]
    elif isinstance(value, list | tuple):
        parts = list(value)
    else:
        parts = [list(part) if isinstance(part, Iterator) else part for part in _reduced(value)]
    return [f"{name} of {len(parts)}", *(text for part in parts for text in _of_value(part, met))]


def _reduced(value: Any) -> Iterable[Any]:
    """Return what an object is made from when it is sent to a worker."""
    try:
        found = copyreg.dispatch_table.get(type(value), lambda one: one.__reduce_ex__(4))(value)
    except TypeError:  # what cloudpickle alone can send
        found = cloudpickle.dumps(value)
    if isinstance(found, str):  # it is sent by name, as a function with a cache is
        return (
            found,
            type(value),
            getattr(value, "__wrapped__", None),
            sys.modules.get(str(getattr(value, "__module__", ""))),
        )
    return found if isinstance(found, tuple) else (found,)


@dataclass(frozen=True, eq=False)
class _One:
    """An object that is equal to itself alone: that of a module that is loaded again is another one."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _One) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


@cache
def _of_module(spec: _One, name: str) -> str:
    return _digest(_with_imports(_files(name.partition(".")[0])))


def _is_of_user(name: str) -> bool:
    """Return True for a module that is neither mcsim's, nor Python's, nor that of an installed library."""
    top = name.partition(".")[0]
    if top in ("mcsim", "__main__") or top in sys.stdlib_module_names or top not in sys.modules:
        return False
    folders = [*getattr(sys.modules[top], "__path__", ()), getattr(sys.modules[top], "__file__", None) or ""]
    return any(folders) and not any({"site-packages", "dist-packages"} & set(Path(one).parts) for one in folders)


def _digest(files: Iterable[Path], *more: str) -> str:
    return _hash([*(hashlib.sha256(path.read_bytes()).hexdigest() for path in files), *more])


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
        for top in _imported(ast.parse(path.read_bytes())):
            waiting += [one for one in (folder / f"{top}.py",) if one.is_file()]
            waiting += (folder / top).rglob("*.py")
    return sorted(found)


def _imported(tree: ast.AST) -> set[str]:
    """Return the packages and modules that code imports by their whole names."""
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


def _files(name: str) -> list[Path]:
    module = sys.modules[name] if name in sys.modules else import_module(name)
    if hasattr(module, "__path__"):
        return sorted(path for folder in module.__path__ for path in Path(folder).rglob("*.py"))
    if module.__file__ is None:
        raise OSError(f"{name} has no file")
    return [Path(module.__file__)]
