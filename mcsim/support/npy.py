"""Readers of numpy's .npy and .npz files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.support.folders import unreadable


def read_npy(path: str | Path, kind: str = "biufc", ndims: tuple[int, ...] = (1,)) -> NDArray:
    """Read a .npy file, of the allowed ``dtype.kind`` letters (by default any numbers) and numbers of dimensions."""
    with unreadable(path, "an array of numpy", "write it with numpy.save"):
        array = np.load(path, allow_pickle=False)
    if array.ndim not in ndims or array.dtype.kind not in kind:
        kinds = {"c": "complex numbers", "biufc": "numbers"}
        plural = "" if ndims == (1,) else "s"
        wanted = f"{kinds.get(kind, 'real numbers')} in {' or '.join(map(str, ndims))} dimension{plural}"
        raise InputError(f"{path} holds {array.dtype} of shape {array.shape}; give {wanted}.")
    return array


def read_npz(path: str | Path) -> dict[str, NDArray]:
    """Read all arrays of a .npz file; raise InputError if it cannot be read."""
    with unreadable(path, "arrays of numpy", "write it again"), np.load(path, allow_pickle=False) as archive:
        return dict(archive)
