"""Arrays and objects given in place of files: written to the cache under the hash of their content.

A run refers to files only, so that its text is all that workers, stores and resumption need. Here arrays and objects
become such files. The run's hash is over the contents of files, so equal arrays make equal runs.
"""

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mcsim.errors import InputError
from mcsim.support import folders

TEMPLATES = {"alm", "map", "mask", "path", "model", "window", "own_window", "templates"}
"""Keys that name files and may contain placeholders such as {channel}."""

FILES = TEMPLATES | {"spectrum", "pixel_window", "template"}
"""Keys that name files."""


@runtime_checkable
class Tabled(Protocol):
    """Object that a table of a run can represent: a beam, the moments of a scan, a scan model."""

    def as_table(self, folder: Path) -> dict[str, str]:
        """Write the object into an empty folder; return its table: the kind, and the name of the file."""


def in_files(value: Any, key: str = "") -> Any:
    """Return a table of a run with its arrays and objects replaced by paths of files.

    Parameters
    ----------
    value
        Table, list or value. An array under a key that names a file is written; another becomes a list.
    key
        Key of the value.

    Raises
    ------
    InputError
        For an array of objects or with a unit or mask, or if the cache cannot be written.
    """
    if isinstance(value, Mapping):
        return {name: in_files(item, name) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [in_files(item, key) for item in value]
    if isinstance(value, Tabled):
        table = table_of(value)
        return table.popitem()[1] if key in FILES else table
    if hasattr(value, "__array__") and np.ndim(value) > 0:
        return file_of(value, key) if key in FILES else np.asarray(value).tolist()
    return value


def table_of(given: Tabled) -> dict[str, str]:
    """Write an object to the cache; return the table that represents it in a run, the path last."""
    table: dict[str, str] = {}
    folder = _kept(lambda scratch: table.update(given.as_table(scratch)), type(given).__name__)
    key, name = table.popitem()
    return {**table, key: _literal(folder / name, key)}


def file_of(given: Any, key: str) -> str:
    """Write an array to the cache; return the path of its .npy file, named after the key."""
    if getattr(given, "unit", None) is not None or isinstance(given, np.ma.MaskedArray):
        own = "a mask of its own" if isinstance(given, np.ma.MaskedArray) else f"the unit {given.unit}"
        raise InputError(f"the array {key} has {own}; give plain numbers, temperatures in uK and spectra in uK^2.")
    array = np.asarray(given)
    if array.dtype.kind not in "biufc":
        raise InputError(f"the array {key} is of type {array.dtype}; give numbers.")
    folder = _kept(lambda scratch: np.save(scratch / f"{key}.npy", array), key)
    return _literal(folder / f"{key}.npy", key)


def _kept(write: Callable[[Path], Any], what: str) -> Path:
    """Return the cache folder with the output of ``write``, named by the hash of that output."""
    root = folders.default_cache_dir()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".given.", dir=root) as scratch:
            write(Path(scratch))
            digest = hashlib.sha256()
            for path in sorted(Path(scratch).iterdir()):
                digest.update(f"{path.name}\0{path.stat().st_size}\0".encode())
                with path.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())

            def move(folder: Path) -> None:
                for path in Path(scratch).iterdir():
                    shutil.move(path, folder / path.name)

            return folders.cached(f"given-{digest.hexdigest()}", move, root).absolute()
    except OSError as error:
        raise InputError(
            f"cache folder {str(root)!r} cannot take what is given as {what} ({error.strerror}); make room there, or "
            "set MCSIM_CACHE to one that can."
        ) from None


def _literal(path: Path, key: str) -> str:
    """Escape the braces of a folder's name: they are not placeholders."""
    return str(path).replace("{", "{{").replace("}", "}}") if key in TEMPLATES else str(path)
