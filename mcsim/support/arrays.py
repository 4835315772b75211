"""Names of arrays by what they hold, shapes and units stand in docstrings; arrays that users give; quotients; texts."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mcsim.errors import InputError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Map = NDArray[np.float64]
Maps = NDArray[np.float64]
Cl = NDArray[np.float64]
Alm = NDArray[np.complex128]
Rows = NDArray[np.int64]

COUNTED = ("l", "ell", "multipole", "m", "pixel", "pix", "ipix")
"""Names of labels, of xarray and pandas, that say an element's place."""


def divided(numerator: ArrayLike, denominator: ArrayLike, otherwise: float = 0.0) -> NDArray:
    """Return a quotient where its denominator is above zero, and ``otherwise`` elsewhere."""
    above, below = np.asarray(numerator), np.asarray(denominator)
    shape, dtype = np.broadcast_shapes(above.shape, below.shape), np.result_type(above, below, np.float64)
    return np.divide(above, below, out=np.full(shape, otherwise, dtype), where=below > 0)


def numbers(given: Any, name: str, masked: float | None = None) -> NDArray:
    """Return a list, or an array of numpy, pandas, xarray or Dask, as numbers; ``name`` names it in messages.

    Masked elements become ``masked``. InputError for what a conversion would drop in silence: a unit, masked elements
    without a value to take, labels that say another place than an element has; and for what is no array of numbers.
    """
    _check_places(given, name)
    unit = getattr(given, "unit", None) if hasattr(type(given), "to_value") else None
    if unit is None and hasattr(type(given), "magnitude"):
        unit = given.units
    if unit is not None and str(unit):
        raise InputError(f"{name} carries the unit {unit}; give plain numbers in the documented unit.")
    if isinstance(given, np.ma.MaskedArray):
        hidden = int(np.ma.count_masked(given))
        if hidden and masked is None:
            raise InputError(f"{name} has {hidden} masked elements; give plain numbers, all of them.")
        wide = np.result_type(given.dtype, np.float64)  # holds what stands for a masked element
        given = np.ma.filled(given.astype(wide), masked) if hidden else given.data
    try:
        found = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no array of numbers ({error}); give one.") from None
    if found.dtype.kind not in "biufc":
        raise InputError(f"{name} is of type {found.dtype}, shape {found.shape}; give an array of numbers.")
    return found


def _check_places(given: Any, name: str) -> None:
    """Raise InputError for an array of xarray or pandas whose labels of degree, order or pixel do not count from 0."""
    labels = dict(given.indexes) if hasattr(given, "indexes") else {}
    if hasattr(given, "iloc"):
        labels = {given.index.name: given.index}
    for key, places in labels.items():
        if key in COUNTED and not np.array_equal(places, np.arange(len(places))):
            raise InputError(
                f"{name} has {key} = {places[0]} to {places[-1]} in its labels, but elements count from 0, one by one; "
                "sort and fill it, or give plain numbers."
            )


def reals(given: Any, name: str, masked: float | None = None) -> NDArray[np.float64]:
    """Return :func:`numbers` in double precision; InputError also for complex ones, whose imaginary part would go."""
    found = numbers(given, name, masked)
    if np.iscomplexobj(found):
        raise InputError(f"{name} is complex ({found.dtype}); give real numbers.")
    return np.asarray(found, dtype=np.float64)


def texts(words: Iterable[str]) -> NDArray[np.object_]:
    """Return texts as objects: Zarr 3 has no stable form for numpy's texts of fixed length."""
    return np.array(list(words), dtype=object)
