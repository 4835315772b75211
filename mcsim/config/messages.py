"""Messages of failed checks of the schema: one sentence with file, key, value, limit, remedy."""

import difflib
import functools
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
from pydantic import ValidationError
from pydantic_core import ArgsKwargs, ErrorDetails

from mcsim.config import beams, noise, preparation, schema
from mcsim.errors import InputError

# Table -> its class. The kind of a beam or scan, which pydantic puts into the location, selects one of several.
_TABLES: dict[tuple[str, ...], type] = {
    (): schema.RunConfig,
    ("sky",): schema.Sky,
    ("map",): schema.Map,
    ("channel",): schema.Channel,
    ("biposh",): schema.Biposh,
    ("ensemble",): schema.Ensemble,
    ("compute",): schema.Compute,
    ("effect",): schema.Effect,
    ("nuisance",): schema.Nuisance,
    **{("preparation", step.kind): step for step in preparation.STEPS},
    **{
        ("channel", key, kind): table
        for key, tables in (
            ("beam", beams.BEAMS),
            ("beam_b", beams.BEAMS),
            ("scan", schema.SCANS),
            ("noise", noise.NOISES),
        )
        for kind, table in tables.items()
    },
}
_TOML_NAMES = {"schema_version": "schema", "channels": "channel", "effects": "effect", "nuisances": "nuisance"}
_REPEATED = {key: f"[[{key}]]" for key in ("channel", "effect", "preparation", "nuisance")}

_EXPECTED = {
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number of fewer digits",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text in quotes",
    "string_unicode": "text in UTF-8",
    "bool_type": "true or false",
    "tuple_type": "a list in [ ]",
    "dataclass_type": "a table of keys",
    "dict_type": "a table of keys",
    "union_tag_not_found": "a table with a kind",
}
_BOUNDS = {
    "greater_than": ("gt", "is too small", "above"),
    "greater_than_equal": ("ge", "is too small", "at least"),
    "less_than": ("lt", "is too large", "below"),
    "less_than_equal": ("le", "is too large", "at most"),
}

_FILE = "_file"  #: attribute of a run that was read from a file, beside its fields

_TYPES = ("float", "int", "str", "bool")


def sentence(error: ValidationError, plain: Any, where: str) -> str:
    """Return one sentence on the first error; unknown keys come first because they explain missing ones."""
    first = _first(error)
    key, tables = _locate(first["loc"], plain)
    return f"{where}: {_text(first, key, tables)}."


def _first(error: ValidationError) -> ErrorDetails:
    details = error.errors(include_url=False)
    telling = ("unexpected_keyword_argument", "unexpected_positional_argument")
    return next((item for item in details if item["type"] in telling), details[0])


def read_from(run: schema.RunConfig, file: str) -> schema.RunConfig:
    """Return a run that remembers its file for :func:`standing`: it is no part of the run, and no copy has it."""
    object.__setattr__(run, _FILE, file)
    return run


@contextmanager
def standing(run: schema.RunConfig, key: str) -> Iterator[None]:
    """Say where it stands in the run what an InputError is about: file, if it was read from one, and key.

    What has been said within is not said again.
    """
    try:
        yield
    except InputError as error:
        if error.stands_in is not None:
            raise
        file = getattr(run, _FILE, None)
        said = type(error)(f"{key}: {error}" if file is None else f"{file}: {key}: {error}")
        said.stands_in = key
        raise said from error


def _text(item: ErrorDetails, key: str, tables: tuple[str, ...]) -> str:
    kind, context = item["type"], item.get("ctx", {})
    stated = f"{key} = {shown(item['input'])}" if key else "the configuration"
    if kind == "unexpected_keyword_argument":
        known = [_TOML_NAMES.get(field.name, field.name) for field in fields(_TABLES[tables])]
        hint = _closest(str(item["loc"][-1]), known, headers=not tables)
        return f"the key {key} is unknown{hint}; remove it or correct it to one of {', '.join(known)}"
    if kind == "unexpected_positional_argument":
        return f"{key or 'a run'} is given {shown(item['input'])} without its key; name every value by its key"
    if kind == "missing":
        return f"the key {key} is missing; add it"
    if kind == "value_error":
        reason = str(context["error"])
        if isinstance(item["input"], dict | schema.RunConfig | ArgsKwargs):
            return f"{key}: {reason}" if key else reason
        return f"{stated} {reason}"
    if key == "schema":
        return f"{stated} is not supported; this version of mcsim reads schema = 1"
    if kind in _BOUNDS:
        name, what, limit = _BOUNDS[kind]
        bound = context[name]
        return f"{stated} {what}; give {limit} {f'{bound:g}' if isinstance(bound, float) else bound}"
    if kind == "too_short":
        return f"{key} is empty; give at least one"
    if kind == "literal_error":
        known = _quoted(context["expected"])
        return f"{stated} is unknown{_closest(str(item['input']), known)}; use one of {', '.join(known)}"
    if kind == "union_tag_invalid":
        tag, known = str(context["tag"]), _quoted(context["expected_tags"])
        return f"{key}.kind = {shown(tag)} is unknown{_closest(tag, known)}; use one of {', '.join(known)}"
    if kind == "union_tag_not_found" and isinstance(item["input"], dict):
        return f"the key {key}.kind is missing; add it"
    if key in _REPEATED and kind == "tuple_type" and isinstance(item["input"], dict):
        return f"{stated} is a single table; write its header as {_REPEATED[key]}, once for each"
    if kind == "dataclass_type" and isinstance(item["input"], list) and "." not in key:
        return f"{stated} is a list of tables; there is one alone: write its header as [{key}]"
    if kind in _EXPECTED:
        return f"{stated} has the wrong type or value; give {_EXPECTED[kind]}"
    return f"{stated} cannot be used ({item['msg'].rstrip('.')}); correct it"


def label(table: Any, number: int) -> str:
    """Return the name of a channel in a key, or its number if the name is unreadable."""
    name = table.get("name") if isinstance(table, dict) else None
    return name if isinstance(name, str) and name.isprintable() else str(number)


def shown(value: Any) -> str:
    """Return a value as TOML writes it, cut to a readable length."""
    try:
        text = json.dumps(value.item() if isinstance(value, np.generic) else value, default=str)
    except (ValueError, TypeError):
        text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _quoted(text: str) -> list[str]:
    """Return the quoted words: pydantic lists expected values as 'a', 'b' or 'c'."""
    return text.split("'")[1::2]


def _closest(word: str, known: Iterable[str], headers: bool = False) -> str:
    """Return a question for the nearest word; ``headers``: tables that repeat have theirs."""
    names = list(known)
    same = [name for name in names if name.lower() == word.lower()]  # L_max for l_max, not lmax
    match = same or difflib.get_close_matches(word, names, n=1)
    meant = [_REPEATED.get(name, name) if headers else name for name in match]
    return f" (did you mean {meant[0]}?)" if meant else ""


def _locate(loc: tuple[int | str, ...], plain: Any) -> tuple[str, tuple[str, ...]]:
    """Return the dotted key, with the names of channels, and the table that contains it."""
    key, here = "", plain
    tag_passed = False
    for part in loc:
        if isinstance(part, int):
            here = here[part] if isinstance(here, list) and part < len(here) else None
            key += f"[{label(here, part)}]"
            continue
        # A table of noise may leave out that it is white.
        if isinstance(here, dict) and here.get("kind", "white") == part and not tag_passed:
            tag_passed = True
            continue
        if part in _TYPES and not (isinstance(here, dict) and part in here):
            continue  # one of those that a value may have
        if part == "parameters" and loc[0] == "effect":  # they stand beside its name
            here = here.get(part) if isinstance(here, dict) else None
            continue
        readable = part if part.isprintable() else shown(part)
        key = f"{key}.{readable}" if key else readable
        here = here.get(part) if isinstance(here, dict) else None
    tables = tuple(str(part) for part in loc[:-1] if not isinstance(part, int))
    return key, ("channel", "noise", *tables[3:]) if tables[:2] == ("channel", "split_noise") else tables


def _in_words(table: type, path: tuple[str, ...]) -> None:
    """Let a table that is built in Python, or replaced there, be refused in the words that one of a file is."""
    made = vars(table)["__init__"]
    start = path[: max(len(path) - 1, 1)]

    @functools.wraps(made)
    def init(self: Any, *args: Any, **given: Any) -> None:
        try:
            made(self, *args, **given)
        except ValidationError as error:
            first = _first(error)
            parts = (part for part in first["loc"] if isinstance(part, str) and part not in _TYPES)
            key = ".".join([*start, *parts])
            raise InputError(f"{_text(first, key, path)}.") from None

    type.__setattr__(table, "__init__", init)


for _table, _path in {table: path for path, table in reversed(_TABLES.items())}.items():
    _in_words(_table, _path)
