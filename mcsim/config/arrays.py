"""Arrays and objects given in place of files: written to the cache under the hash of their content.

A run refers to files only, so that its text is all that workers, stores and resumption need. Here arrays and objects
become such files. The run's hash is over the contents of files, so equal arrays make equal runs.
"""

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError, RunError
from mcsim.support import folders, resources
from mcsim.support.arrays import numbers
from mcsim.support.loading import once_per_content
from mcsim.support.npy import write_npy


class Rule(NamedTuple):
    """Rules of a key that names files: the kind of packaged name, the words and the placeholders that it may hold.

    What is not ``checked`` is no file that must exist, and no part of the run's hash.
    """

    packaged: str | None = None
    words: tuple[str, ...] = ()
    placeholders: tuple[str, ...] = ()
    checked: bool = True


RULES = {
    "sky.spectrum": Rule(packaged="data"),
    "sky.alm": Rule(placeholders=("realization",)),
    "sky.map": Rule(placeholders=("realization",)),
    "map.mask": Rule(placeholders=("channel", "split")),
    "map.pixel_window": Rule(words=("computed", "none")),
    "beam.path": Rule(placeholders=("channel",)),
    "beam_b.path": Rule(placeholders=("channel",)),
    "scan.path": Rule(placeholders=("channel", "split")),
    "scan.model": Rule(packaged="scan_models", placeholders=("channel", "split")),
    "channel.mask": Rule(placeholders=("channel", "split")),
    "noise.hits": Rule(placeholders=("channel", "split")),
    "noise.variance": Rule(placeholders=("channel", "split")),
    "noise.maps": Rule(placeholders=("channel",)),
    "noise.mask": Rule(placeholders=("channel",)),
    "noise.files": Rule(placeholders=("channel", "split", "realization")),
    "effect.template": Rule(),
    # The name of a packaged one stands for it in hashes of runs, as it always did.
    "effect orientation_averaging.model": Rule("scan_models", words=resources.names("scan_models")),
    "ensemble.maps": Rule(placeholders=("realization", "channel", "split"), checked=False),
    "preparation.mask": Rule(placeholders=("channel", "split")),
    "preparation.window": Rule(placeholders=("channel",)),
    "preparation.own_window": Rule(placeholders=("channel",)),
    "preparation.templates": Rule(placeholders=("channel",)),
}

_TEMPLATES = {path.split(".")[1] for path, rule in RULES.items() if rule.placeholders}
_FILES = {path.split(".")[1] for path in RULES}


@runtime_checkable
class Tabled(Protocol):
    """Object that a table of a run can represent: a beam, the moments of a scan, a scan model."""

    def as_table(self, folder: Path) -> dict[str, str]:
        """Write the object into an empty folder; return its table: the kind, and the name of the file."""


def in_files(value: Any, key: str = "") -> Any:
    """Return a table, list or value of a run with its arrays and objects replaced by paths of files.

    An array, or list of numbers, under a key that names a file is written; another becomes a list. An array of objects,
    or with a unit or mask, is refused.
    """
    if isinstance(value, Mapping):
        return {name: in_files(item, name) for name, item in value.items()}
    if isinstance(value, list | tuple) and key in _FILES and value and all(isinstance(v, Real) for v in value):
        return _file_of(numbers(value, f"the list {key}"), key)
    if isinstance(value, list | tuple):
        return [in_files(item, key) for item in value]
    if isinstance(value, Tabled):
        table = table_of(value)
        return table.popitem()[1] if key in _FILES else table
    if hasattr(value, "__array__") and np.ndim(value) > 0:
        array = numbers(value, f"the array {key}")
        return _file_of(array, key) if key in _FILES else array.tolist()
    return value


def table_of(given: Tabled) -> dict[str, str]:
    """Write an object to the cache; return the table that represents it in a run, the path last."""
    table: dict[str, str] = {}
    folder = kept(lambda scratch: table.update(given.as_table(scratch)), type(given).__name__)
    key, name = table.popitem()
    return {**table, key: _path(folder / name, key)}


def _file_of(array: NDArray, key: str) -> str:
    """Write an array to the cache; return the path of its .npy file, named after the key."""
    folder = kept(lambda scratch: write_npy(scratch / f"{key}.npy", array), key)
    return _path(folder / f"{key}.npy", key)


def kept(write: Callable[[Path], Any], what: str) -> Path:
    """Return the cache folder with the output of ``write``, named by the hash of that output."""
    root = folders.default_cache_dir()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=folders.scratch_prefix("given"), dir=root) as scratch:
            write(Path(scratch))
            contents = "\n".join(f"{sha256_of(path)} {path.name}" for path in sorted(Path(scratch).iterdir()))

            def move(folder: Path) -> None:
                for path in Path(scratch).iterdir():
                    shutil.move(path, folder / path.name)

            name = f"given-{hashlib.sha256(contents.encode()).hexdigest()}"
            return folders.cached(name, move).absolute()
    except OSError as error:
        kind, room = (RunError, "make room there, or ") if folders.is_full(error) else (InputError, "")
        raise kind(
            f"cache folder {str(root)!r} cannot take what is given as {what} ({folders.reason(error)}); {room}set "
            "MCSIM_CACHE to one that can."
        ) from None


@once_per_content(maxsize=256)
def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _path(path: Path, key: str) -> str:
    return literal(str(path)) if key in _TEMPLATES else str(path)


def literal(text: str) -> str:
    """Escape the braces of a folder's name: they are not placeholders."""
    return text.replace("{", "{{").replace("}", "}}")
