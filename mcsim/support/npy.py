"""Numpy's .npy and .npz files: readers, and a writer that says why it fails."""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.support.folders import unreadable


def write_npy(path: Path, array: NDArray) -> None:
    """Write an array as :func:`numpy.save` does, bit for bit; OSError with its number where that fails.

    Of a full disk numpy.save says no more than "20700 requested and 17392 written", without the number of the error.
    """
    path.unlink(missing_ok=True)  # another process may have the old file mapped to its memory
    with path.open("wb") as stream:
        np.save(SimpleNamespace(write=stream.write), array, allow_pickle=False)


def make_room(path: Path, size: int) -> None:
    """Make a file of so many bytes, of zeros; OSError where the disk has no room.

    Who writes into a file that is mapped to memory, and has no room, is ended by a signal (SIGBUS).
    """
    with path.open("wb") as stream:
        stream.truncate(size)
        if size and hasattr(os, "posix_fallocate"):  # macOS lacks it
            os.posix_fallocate(stream.fileno(), 0, size)


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
