"""A run as TOML, for people."""

import json
from collections.abc import Mapping
from typing import Any


def text(plain: Mapping[str, Any]) -> str:
    """TOML of a run as :func:`mcsim.config.to_dict` gives it; what is None is left out."""
    lines: list[str] = []
    tables: list[str] = []
    for key, value in plain.items():
        if isinstance(value, Mapping):
            tables += ["", f"[{key}]", *_pairs(value)]
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            for item in value:
                tables += ["", f"[[{key}]]", *_pairs(item)]
        elif value is not None and value != []:
            lines.append(f"{key} = {_value(value)}")
    return "\n".join([*lines, *tables]) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_value(value)}" for key, value in table.items() if value is not None]


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(_pairs(value)) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    # TOML writes text, numbers and truth values as JSON does.
    return json.dumps(value)
