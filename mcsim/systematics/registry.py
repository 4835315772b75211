"""Effects by name: the built-in ones, in files of this package, and those of other packages."""

import difflib
import inspect
import os
import pkgutil
import re
import sys
from collections import UserDict
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import cache_from_source
from math import inf, isfinite
from numbers import Real
from pathlib import Path
from sys import float_info
from types import MappingProxyType, ModuleType
from typing import Any

from mcsim.errors import InputError
from mcsim.systematics import base
from mcsim.systematics.base import Bound, Effect, acts_through
from mcsim.systematics.hooks import HOOKS
from mcsim.systematics.parametrization import Parametrization

ENTRY_POINTS = "mcsim.effects"  #: group of entry points under which a package names its effects
Library = Mapping[str, type[Effect]]  #: effects by name
LARGEST = 1e12  #: of a parameter, in absolute value: far from where squares and products of maps overflow
_EFFECTS = "mcsim_effects"  #: attribute of a module that holds the content of its file when it was run, and its effects


@cache
def catalogue() -> Library:
    """Return every effect by name, read-only: built in, in the order of their names, then those of other packages.

    Raise InputError if a registered effect cannot be loaded, is none, or bears a name that is taken.
    """
    found: dict[str, type[Effect]] = {}
    package = base.__name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(import_module(package).__path__):
        for _, kind in inspect.getmembers(import_module(f"{package}.{module.name}"), inspect.isclass):
            own = kind.__module__ == f"{package}.{module.name}"
            if own and issubclass(kind, Effect) and hasattr(kind, "name"):  # a base of several effects has none
                found[kind.name] = kind
    found = dict(sorted(found.items()))
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            kind = entry.load()
        except (Exception, SystemExit) as error:  # whatever a foreign package does when it is imported
            raise InputError(
                f"effect {entry.name} of {entry.value} cannot be loaded ({_said(error)}); mend or uninstall it."
            ) from error
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"effect {entry.name} of {entry.value} is no class derived from mcsim.systematics.Effect.")
        flaw = _flaw(kind)
        if flaw is not None:
            raise InputError(f"effect {entry.name} of {entry.value} {flaw}; mend or uninstall it.")
        if kind.name in found:
            raise InputError(f"effect {kind.name} of {entry.value} has a name that is taken; rename it.")
        found[kind.name] = kind
    return MappingProxyType(found)


def checked(library: Library) -> Library:
    """Return a library as it was given; raise InputError if one of its effects is none, or bears another name."""
    if not isinstance(library, Mapping) or not library:
        raise InputError(f"library = {library!r} has no effects by name; give some of mcsim.effects().")
    for name, kind in library.items():
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"effect {name} of the library is {kind!r}; give a class derived from mcsim.Effect.")
        flaw = _flaw(kind)
        if flaw is None and kind.name != name:
            flaw = f"calls itself {kind.name}"
        if flaw is not None:
            raise InputError(f"effect {name} of the library {flaw}; mend or leave it out.")
    return library


def _flaw(kind: type[Effect]) -> str | None:
    """Say what keeps a class from being a whole effect; None: nothing."""
    own = {key for key, text in vars(kind).get("__annotations__", {}).items() if "ClassVar" not in str(text)}
    missing = own - {f.name for f in fields(kind)}
    if missing:
        return f"is no dataclass, so {', '.join(sorted(missing))} is no parameter of it: decorate it with @dataclass"
    for key in ("name", "unit", "cause", "signature"):
        if not isinstance(getattr(kind, key, None), str) or not getattr(kind, key):
            return f"has no {key}: it needs a text"
    if re.fullmatch(r"\w[\w-]*", kind.name) is None:  # what is told apart from a channel, a width or a file
        return f"has name = {kind.name!r}: it needs letters, digits, _ and - alone, - not as the first"
    if getattr(kind, "scope", None) not in ("channel", "common"):
        return 'has no scope: it needs "channel" or "common"'
    fit: Any = kind.parametrization
    step = getattr(kind, "step", None)
    if not isinstance(fit, Parametrization):
        return f"has parametrization = {fit!r}: it needs a mcsim.systematics.Parametrization"
    for key, value, largest in (("step", step, float_info.max), ("max_amplitude", fit.max_amplitude, inf)):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= largest:
            return f"has {key} = {value!r}: it needs a number above 0"
    rank: Any = kind.rank
    if isinstance(rank, bool) or not isinstance(rank, Real) or not isfinite(rank):
        return f"has rank = {rank!r}: it needs a number"
    if taken := sorted(f.name for f in fields(kind) if callable(getattr(Effect, f.name, None))):
        return f"has the parameter {taken[0]}, which is a method of every effect: it needs another name"
    bounds: Any = kind.bounds
    if not isinstance(bounds, tuple | list):
        return f"has bounds = {bounds!r}: it needs a tuple of mcsim.systematics.Bound"
    bounded = {f.name for f in fields(kind) if isinstance(f.default, int | float)}
    for one in bounds:
        if not isinstance(one, Bound) or one.parameter not in bounded or not one.low < one.high:
            return f"has the bound {one!r}: it needs a mcsim.systematics.Bound of a parameter, a number, low < high"
    if fit.sign not in (-1, 0, 1):
        return f"has sign = {fit.sign!r}: it needs -1, 0 or 1"
    try:
        basis = basis_of(kind)
        sizes = {fit.coordinates(effect).shape for effect in basis}
        for variant in kind.variants:
            build(kind, variant)
        kind.format_amplitude(kind.step)
    except Exception as error:  # whatever a foreign class does
        return f"cannot be made ({type(error).__name__}: {error})"
    if not basis or sizes != {(len(basis),)}:
        return f"has a basis of {len(basis)} effects whose coordinates have other shapes: each needs ({len(basis)},)"
    if not acts_through(kind, *HOOKS):
        return f"does nothing: it needs one of {', '.join(HOOKS)}"
    return None


def get(name: str, library: Library | None = None) -> type[Effect]:
    """Return the effect called ``name``; InputError, with what comes close, if there is none.

    A name that ends in .py is the path of a file that defines the effect. ``library``: default: :func:`catalogue`.
    """
    if name.endswith(".py"):
        return of_file(name)
    known = catalogue() if library is None else library
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.7)  # at 0.6 "nonsense" is noise_knee
        hint = f"did you mean {near[0]}?" if near else f"choose from {', '.join(sorted(known))}."
        raise InputError(f"there is no effect {name!r}; {hint}")
    return known[name]


def called(name: str) -> str:
    """Return the name of an effect that is given by its name or by the path of a file."""
    return of_file(name).name if name.endswith(".py") else name


def of_file(path: str) -> type[Effect]:
    """Return the effect that a Python file defines; InputError if it cannot be run, or defines none or several."""
    found = in_file(path)
    if len(found) != 1:
        raise InputError(f"{path} defines {len(found)} effects; let it define one class derived from mcsim.Effect.")
    (kind,) = found
    if catalogue().get(kind.name, kind) is not kind:
        raise InputError(f"{path} defines {kind.name}, which is an effect of the library; give it another name.")
    return kind


def in_file(path: str) -> tuple[type[Effect], ...]:
    """Return the effects that a Python file defines; InputError if it cannot be run, or an effect is not whole.

    The file becomes a module by its stem, and its folder is on the path of this process and those that it starts:
    workers can then load the effects as well. A file that has another content than before is run again.
    """
    file = Path(path).absolute()
    if not file.is_file():
        raise InputError(f"{path} is no file; name a Python file that defines a class derived from mcsim.Effect.")
    if "." in file.stem:
        raise InputError(f"{path} has a dot before that of .py, as no module has it in its name; rename it.")
    content = file.read_bytes()
    before = sys.modules.get(file.stem)
    if before is not None and _path_of(before) == file:
        kept: tuple[bytes, tuple[type[Effect], ...]] = getattr(before, _EFFECTS, (content, ()))
        if kept[0] == content and kept[1]:
            return kept[1]
        if kept[0] != content:
            del sys.modules[file.stem]
            Path(cache_from_source(file)).unlink(missing_ok=True)  # it would serve a file of the same second and size
    folder = str(file.parent)
    sys.path.insert(0, folder)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (folder, os.environ.get("PYTHONPATH"))))
    try:
        module = import_module(file.stem)
    except (Exception, SystemExit) as error:  # whatever a foreign file does when it is run
        raise InputError(f"{path} cannot be run ({_said(error)}); mend it.") from error
    if _path_of(module) != file:
        raise InputError(f"{path} has the name of another module, {_path_of(module)}; rename it.")
    setattr(module, _EFFECTS, (content, ()))  # of a file that is refused below: once mended, it is run again
    found = tuple(
        kind
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if kind.__module__ == module.__name__ and issubclass(kind, Effect)
    )
    for kind in found:
        if (flaw := _flaw(kind)) is not None:
            raise InputError(f"the effect {kind.__name__} of {path} {flaw}; mend it.")
    setattr(module, _EFFECTS, (content, found))
    return found


def _said(error: BaseException) -> str:
    """Return what an error says: that which ends a program has a number at most."""
    return f"{type(error).__name__}: {error}" if isinstance(error, SystemExit) else str(error)


def _path_of(module: ModuleType) -> Path:
    return Path(str(getattr(module, "__file__", None))).absolute()  # what is built in has none


def build(kind: str | type[Effect], parameters: Mapping[str, Any], beside: tuple[str, ...] = ()) -> Effect:
    """Build an effect, or the one of that name, from a table of parameters; those left out have their defaults.

    ``beside``: keys that stand beside them in such a table. Raise InputError for an unknown name, a parameter that the
    effect does not have, or a value that is no finite number where one is needed.
    """
    kind = get(kind) if isinstance(kind, str) else kind
    known = [f.name for f in fields(kind)]
    values: dict[str, Any] = {}
    for key, value in parameters.items():
        if key not in known:
            near = difflib.get_close_matches(key, (*beside, *known), n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise InputError(
                f"effect {kind.name} has no parameter {key!r}{hint}; it has {', '.join((*beside, *known))}."
            )
        values[key] = _checked(f"effect {kind.name}: {key}", value, getattr(kind(), key))
    return kind(**values)


def _checked(what: str, value: Any, default: Any) -> Any:
    """Return a value of the type of the default."""
    shown = list(value) if isinstance(value, tuple) else value  # as TOML has it
    if isinstance(default, str):
        if isinstance(value, str):
            return value
        raise InputError(f"{what} = {shown!r} must be a text.")
    if isinstance(default, tuple):
        if isinstance(value, list | tuple) and (not default or len(value) == len(default)):
            return tuple(float(_checked(what, item, 0.0)) for item in value)
        size = f"{len(default)} numbers" if default else "numbers"
        raise InputError(f"{what} = {shown!r} must be a list of {size}.")
    if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
        raise InputError(f"{what} = {shown!r} must be a finite number.")
    number = float(value)
    if abs(number) > LARGEST:
        raise InputError(f"{what} = {value!r} is larger than anything of a survey ({LARGEST:g}); correct its unit.")
    if what.endswith(": lat_deg") and abs(number) > 90.0:
        raise InputError(f"{what} = {value!r} is no latitude; give -90 to 90, and the longitude as lon_deg.")
    return number


def basis_of(
    kind: type[Effect], settings: Mapping[str, Any] | None = None, fit: Parametrization | None = None
) -> tuple[Effect, ...]:
    """Return the effects, of amplitude ``step``, whose responses span those of all parameters but the ``settings``.

    ``fit``: default: the parametrization of the effect.
    """
    return tuple(
        kind(**{"amplitude": kind.step, **parameters, **(settings or {})})
        for parameters in (kind.parametrization if fit is None else fit).basis()
    )


class Effects(UserDict[str, type[Effect]]):
    """Effects by name, printed one a line with scope, unit and cause."""

    def __repr__(self) -> str:
        """Return a line for each effect."""
        width = max(map(len, self), default=0)
        return "\n".join(
            f"{name:<{width}}  {kind.scope}, {kind.unit}: {kind.cause}" for name, kind in sorted(self.items())
        )

    def _ipython_key_completions_(self) -> list[Any]:
        return sorted(self)


def effects() -> Effects:
    """Return the library of effects: what a run can add and a diagnosis can find.

    Returns
    -------
    mapping
        Name -> class derived from :class:`mcsim.Effect`; printing it lists scope, unit of the amplitude and cause. It
        is a copy: changing it changes no run. Other packages add effects under the entry points ``mcsim.effects``.

    Raises
    ------
    InputError
        If an effect of another package cannot be loaded, is none, or has a name that is taken.

    Examples
    --------
    >>> import mcsim
    >>> library = mcsim.effects()
    >>> "beam_ellipticity" in library
    True
    >>> library["beam_ellipticity"](amplitude=0.05, angle_deg=30.0)
    BeamEllipticity(amplitude=0.05, angle_deg=30.0)
    >>> library["beam_ellipticity"].unit
    'major/minor - 1'
    """
    return Effects(catalogue())
