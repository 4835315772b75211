"""Types of single values in a run, and their checks.

A failed check raises ValueError whose text follows ``key = value``; :mod:`mcsim.config.messages` completes the
sentence.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationInfo

from mcsim.config import arrays

NSIDE_MAX = 8192
LMAX_MAX = 32768

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, validate_by_name=True, validate_by_alias=True)


def power_of_two(value: int) -> int:
    """Return the value if it is a power of two."""
    if value < 1 or value & (value - 1):
        above = 1 << max(value, 1).bit_length()
        raise ValueError(f"is not a power of two; use {max(above // 2, 1)} or {above}")
    return value


def _label(value: str) -> str:
    """Return a name of a channel or split if it can be part of a file name and of a pair's label."""
    if not value.strip() or value != value.strip() or any(c in "/\\:,{}" or not c.isprintable() for c in value):
        raise ValueError(
            "is not a usable name: it needs printable characters, no blanks at its ends and none of / \\ : , { }; "
            "rename it"
        )
    return value


def unique(values: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names if none is given twice."""
    twice = [value for value in values if values.count(value) > 1]
    if twice:
        raise ValueError(f"names {twice[0]!r} twice; give every one its own name")
    return values


def _not_empty(value: str) -> str:
    if not value.strip():
        raise ValueError("is empty; give a name or a path")
    return value


def _in_file(value: Any, info: ValidationInfo) -> Any:
    """Replace an array or an object by the path of a file."""
    return arrays.in_files(value, info.field_name or "")


def _listed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | tuple) else (value,)


Label = Annotated[str, AfterValidator(_label)]
PathText = Annotated[str, BeforeValidator(_in_file), AfterValidator(_not_empty)]
Nside = Annotated[int, Field(ge=1, le=NSIDE_MAX), AfterValidator(power_of_two)]
Degree = Annotated[int, Field(ge=2, le=LMAX_MAX)]
BeamOrder = Annotated[int, Field(ge=0, le=LMAX_MAX)] | None
Fwhm = Annotated[float, Field(gt=0.0, le=10800.0)]
Frame = Literal["ecliptic", "galactic", "equatorial"]
Width = Annotated[float, Field(gt=0.0)]
Widths = Annotated[
    tuple[Width, ...], Field(min_length=1), BeforeValidator(_listed, json_schema_input_type=float | list[float])
]
"""Prior standard deviations, or the only one."""
