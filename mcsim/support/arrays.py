"""Names of arrays by what they hold; shapes and units stand in docstrings."""

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Map = NDArray[np.float64]
Cl = NDArray[np.float64]
Alm = NDArray[np.complex128]
