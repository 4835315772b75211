"""Names of arrays by what they hold, shapes and units stand in docstrings; and arrays of texts."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Map = NDArray[np.float64]
Cl = NDArray[np.float64]
Alm = NDArray[np.complex128]


def texts(words: Iterable[str]) -> NDArray[np.object_]:
    """Return texts as objects: Zarr 3 has no stable form for numpy's texts of fixed length."""
    return np.array(list(words), dtype=object)
