"""Names of arrays by what they hold, shapes and units stand in docstrings; quotients, and arrays of texts."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Map = NDArray[np.float64]
Cl = NDArray[np.float64]
Alm = NDArray[np.complex128]


def divided(numerator: ArrayLike, denominator: ArrayLike, otherwise: float = 0.0) -> NDArray:
    """Return a quotient where its denominator is above zero, and ``otherwise`` elsewhere."""
    above, below = np.asarray(numerator), np.asarray(denominator)
    shape, dtype = np.broadcast_shapes(above.shape, below.shape), np.result_type(above, below, np.float64)
    return np.divide(above, below, out=np.full(shape, otherwise, dtype), where=below > 0)


def texts(words: Iterable[str]) -> NDArray[np.object_]:
    """Return texts as objects: Zarr 3 has no stable form for numpy's texts of fixed length."""
    return np.array(list(words), dtype=object)
