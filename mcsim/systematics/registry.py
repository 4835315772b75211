"""Effects by name: the built-in ones, each in a file of this package, and those of other packages."""

import difflib
import inspect
import pkgutil
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from math import isfinite
from types import MappingProxyType
from typing import Any

from mcsim.errors import InputError
from mcsim.systematics import base
from mcsim.systematics.base import Effect

ENTRY_POINTS = "mcsim.effects"
"""Group of entry points under which a package names its effects."""

Library = Mapping[str, type[Effect]]
"""Effects by name."""


@cache
def catalogue() -> Library:
    """Return every effect by name, read-only: built in, then registered by other packages.

    Raises
    ------
    InputError
        If a registered effect cannot be loaded, is none, or bears a name that is taken.
    """
    found: dict[str, type[Effect]] = {}
    package = base.__name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(import_module(package).__path__):
        for _, kind in inspect.getmembers(import_module(f"{package}.{module.name}"), inspect.isclass):
            own = kind.__module__ == f"{package}.{module.name}"
            if own and issubclass(kind, Effect) and hasattr(kind, "name"):  # a base of several effects has none
                found[kind.name] = kind
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            kind = entry.load()
        except Exception as error:  # whatever a foreign package does when it is imported
            raise InputError(
                f"effect {entry.name} of {entry.value} cannot be loaded ({error}); mend or uninstall it."
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


def _flaw(kind: type[Effect]) -> str | None:
    """Say what keeps a class from being a whole effect; None: nothing."""
    own = {key for key, text in vars(kind).get("__annotations__", {}).items() if "ClassVar" not in str(text)}
    missing = own - {f.name for f in fields(kind)}
    if missing:
        return f"is no dataclass, so {', '.join(sorted(missing))} is no parameter of it: decorate it with @dataclass"
    for key in ("name", "unit", "cause", "signature"):
        if not isinstance(getattr(kind, key, None), str) or not getattr(kind, key):
            return f"has no {key}: it needs a text"
    if getattr(kind, "scope", None) not in ("channel", "common"):
        return 'has no scope: it needs "channel" or "common"'
    for key in ("step", "max_amplitude"):
        value = getattr(kind, key, None)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0.0:
            return f"has {key} = {value!r}: it needs a number above 0"
    if not isfinite(kind.step):
        return f"has step = {kind.step!r}: it needs a finite number"
    if kind.sign not in (-1, 0, 1):
        return f"has sign = {kind.sign!r}: it needs -1, 0 or 1"
    try:
        basis = kind.basis()
        sizes = {effect.coordinates().shape for effect in basis}
        for variant in kind.variants:
            base.build(kind, variant)
    except Exception as error:  # whatever a foreign class does
        return f"cannot be made ({type(error).__name__}: {error})"
    if not basis or sizes != {(len(basis),)}:
        return f"has a basis of {len(basis)} effects whose coordinates have other shapes: each needs ({len(basis)},)"
    return None


def get(name: str, library: Library | None = None) -> type[Effect]:
    """Return the effect called ``name``; InputError, with what comes close, if there is none.

    ``library``: default: :func:`catalogue`.
    """
    known = catalogue() if library is None else library
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose from {', '.join(sorted(known))}."
        raise InputError(f"there is no effect {name!r}; {hint}")
    return known[name]


def build(name: str, parameters: Mapping[str, Any], library: Library | None = None) -> Effect:
    """Return the effect called ``name`` with these parameters; those left out have their defaults."""
    return base.build(get(name, library), parameters)


def describe() -> list[dict[str, Any]]:
    """Describe every effect, with the defaults of its parameters."""
    return [
        {
            "name": kind.name,
            "scope": kind.scope,
            "unit": kind.unit,
            "parameters": {f.name: f.default for f in fields(kind)},
            "cause": kind.cause,
            "signature": kind.signature,
            "source": kind.source,
        }
        for kind in catalogue().values()
    ]
