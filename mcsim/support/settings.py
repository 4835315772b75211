"""Checks of the settings that users change by name."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, TypeVar, get_args

import numpy as np

from mcsim.errors import InputError

Kind = TypeVar("Kind")


def settings_of(given: Kind | None, kind: type[Kind]) -> Kind:
    """Return settings as they are given, or the default ones for None; InputError for anything else."""
    if given is None:
        return kind()
    if not isinstance(given, kind):
        raise InputError(f"settings are a {type(given).__name__}; give mcsim.{kind.__name__}(name=value).")
    return given


def check_settings(settings: Any, shares: Iterable[str] = (), least: Mapping[str, float] | None = None) -> None:
    """Raise InputError unless the fields of a dataclass are of the kind of their defaults, and numbers not negative.

    Those named in ``shares`` lie between 0 and 1, and what is in ``least`` is no less than that. An ``int | None`` is
    whole. Items of a tuple of numbers are such numbers, and there are some. Numbers of numpy become those of Python,
    by which results are known.
    """
    bounded, least = set(shares), least or {}
    for field in fields(settings):
        value, default = getattr(settings, field.name), field.default
        if value is default:
            continue
        if value is not (plain := _plain(value)):
            object.__setattr__(settings, field.name, value := plain)
        if default is None and int in get_args(field.type):
            default = 1
        if isinstance(default, tuple) and (isinstance(value, str) or not isinstance(value, tuple | list)):
            raise InputError(f"{field.name} = {value!r} is no tuple; give one, such as ({value!r},).")
        named = get_args(field.type)[:1] == (str,) and isinstance(value, Iterable)
        if named and (odd := [one for one in value if not isinstance(one, str)]):
            raise InputError(f"{field.name} = {value!r} has {odd[0]!r}, which is no name; give names, in quotes.")
        if isinstance(default, tuple) and default and not isinstance(default[0], str):
            _check_items(field.name, value, default[0], least.get(field.name, 0))
        if isinstance(default, bool) and not isinstance(value, bool):
            raise InputError(f"{field.name} = {value!r} is neither True nor False; give one of them.")
        if isinstance(default, int | float) and not isinstance(default, bool):
            smallest, largest = least.get(field.name, 0), 1.0 if field.name in bounded else math.inf
            if not _is_like(value, default, smallest, largest):
                kind = "a whole number" if isinstance(default, int) else "a number"
                limit = "from 0 to 1" if largest == 1.0 else f"of {smallest} or more"
                raise InputError(f"{field.name} = {value!r} is out of range; give {kind} {limit}.")


def _plain(value: Any) -> Any:
    """Return a value, or the items of a tuple or list, without scalars of numpy."""
    if isinstance(value, tuple | list) and any(isinstance(one, np.generic) for one in value):
        return type(value)(_plain(one) for one in value)
    return value.item() if isinstance(value, np.generic) else value


def _check_items(name: str, values: Iterable[Any], default: float, smallest: float) -> None:
    """Raise InputError unless there are values, each a number like the default one and no less than the smallest."""
    kind, found = "whole numbers" if isinstance(default, int) else "numbers", list(values)
    if not found or not all(_is_like(one, default, smallest) for one in found):
        raise InputError(f"{name} = {values!r} does not do; give {kind} of {smallest} or more.")


def _is_like(value: Any, default: float, smallest: float, largest: float = math.inf) -> bool:
    """Return True for a number within bounds, both included, that is whole if the default one is."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not smallest <= value <= largest:
        return False
    return not isinstance(default, int) or float(value).is_integer()
