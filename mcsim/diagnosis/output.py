"""The folder of a verdict: of which data it is, and what a diagnosis does not write over."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.result import DiagnosisResult
from mcsim.errors import InputError
from mcsim.support.folders import user_path

DIGEST = "SHA-256 of the data"  #: key of the provenance of a result


def digest(arrays: Iterable[NDArray[np.float64]]) -> str:
    """Return a hash of maps, or of the values of a table."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return found.hexdigest()


def check_outside(folder: Path, data: Any) -> None:
    """Raise InputError for an output that is the folder of the data, or has the report of a comparison."""
    if (folder / "compare.json").is_file():
        raise InputError(
            f"{folder} holds the report.html of a comparison (compare.json), which would be replaced; choose another "
            "folder with -o."
        )
    if not isinstance(data, str | Path) or not folder.is_dir():
        return
    if (maps := user_path(data)).is_dir() and folder.samefile(maps):
        raise InputError(
            f"{folder} is the folder of the data, among which a verdict would be written; choose another folder with "
            "-o."
        )


def check_replaced(folder: Path, case: str, of: str) -> None:
    """Raise InputError for an output with the verdict of another case, or of data with another digest than ``of``.

    Results of earlier versions have no digest. What cannot be read is no verdict.
    """
    try:
        former = DiagnosisResult.open(folder)
    except InputError:
        return
    if former.case != case:
        raise InputError(
            f"{folder} holds the verdict of case {former.case}, and this is case {case}; choose another folder with "
            "-o, or delete that one."
        )
    if former.provenance.get(DIGEST, of) != of:
        raise InputError(
            f"{folder} holds the verdict of case {case} on other data; choose another folder with -o, or delete that "
            "one."
        )
