"""Effects by name: the built-in ones, each in a file of this package, and those of other packages."""

import difflib
import inspect
import pkgutil
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
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
        if kind.name in found:
            raise InputError(f"effect {kind.name} of {entry.value} has a name that is taken; rename it.")
        found[kind.name] = kind
    return MappingProxyType(found)


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
