"""Readers of numpy's .npy and .npz files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError


def read_npy(path: str | Path, kind: str = "biufc", ndims: tuple[int, ...] = (1,)) -> NDArray:
    """Read a .npy file, of the allowed ``dtype.kind`` letters (by default any numbers) and numbers of dimensions."""
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # libraries raise errors of any type for a broken file
        raise InputError(f"{path} cannot be read as an array of numpy ({error}); write it with numpy.save.") from error
    if array.ndim not in ndims or array.dtype.kind not in kind:
        kinds = {"c": "complex numbers", "biufc": "numbers"}
        wanted = f"{kinds.get(kind, 'real numbers')} in {' or '.join(map(str, ndims))} dimensions"
        raise InputError(f"{path} holds {array.dtype} of shape {array.shape}; give {wanted}.")
    return array


def read_npz(path: str | Path) -> dict[str, NDArray]:
    """Read all arrays of a .npz file; raise InputError if it cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)
    except Exception as error:  # libraries raise errors of any type for a broken file
        raise InputError(f"{path} cannot be read as arrays of numpy ({error}); write it again.") from error
