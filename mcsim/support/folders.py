"""Folders that appear complete or not at all, and the cache that all processes share."""

import ctypes
import errno
import json
import os
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from glob import escape
from pathlib import Path
from typing import Any
from uuid import uuid4
from zlib import crc32

from mcsim.errors import InputError, RunError
from mcsim.support.processes import alive

CONTENT = ".content.json"  #: file of a cached folder with the names of all others, sizes in bytes and CRC-32


def user_path(given: Any) -> Path:
    """Return a path that a user gives, with ~ for the home; InputError for what is no path."""
    try:
        return Path(given).expanduser()
    except (TypeError, RuntimeError) as error:  # RuntimeError: no such home is known
        shown = repr(given) if len(repr(given)) <= 60 else f"a {type(given).__name__}"
        raise InputError(f"{shown} is no path of a file or folder ({error}); give one.") from None


def real_path(path: Path) -> Path:
    """Return what a symbolic link leads to, and any other path as it is.

    What is renamed to a link takes no place, and what is made beside one may be on another disk.
    """
    return Path(os.path.realpath(path)) if os.path.islink(path) else path


def scratch_prefix(name: str) -> str:
    """Return how the name of a scratch folder begins: if this process is killed, :func:`appearing` deletes it later."""
    return f".{name}.{socket.gethostname()}.{os.getpid()}."


@contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """Yield a scratch folder beside ``path``; rename it to ``path`` at the end, delete it if the block fails.

    If another process was faster, its folder stays. What killed processes of this host have left there is deleted.
    InputError for a file in the place of a folder.
    """
    path = real_path(path)
    not_a_file(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = _scratch(path)
    try:
        yield scratch
        scratch.chmod(0o755)  # a temporary folder is readable by its owner alone
        try:
            scratch.rename(path)
        except OSError:
            if not path.is_dir():
                raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def replacing(folder: Path, last: str, *former: str) -> Iterator[Path]:
    """Yield a scratch folder; at the end all that it holds takes the place of what has these names in ``folder``.

    If the block fails, what is there stays. Otherwise all of it, and ``former``, goes before anything new comes, with
    ``last`` first: a process that is killed leaves files of one call alone, and ``last`` only beside all others.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scratch = _scratch(folder / last)
    try:
        yield scratch
        names = sorted({path.name for path in scratch.iterdir()} | {*former}, key=lambda name: name != last)
        for name in names:
            remove(real_path(folder / name))
        for name in reversed(names):
            if (scratch / name).exists():
                shutil.move(scratch / name, real_path(folder / name))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def remove(path: Path) -> None:
    """Delete a file, or a folder at once and not file by file, if it is there."""
    if path.is_dir():
        shutil.rmtree(path.rename(_scratch(path)))
    else:
        path.unlink(missing_ok=True)


def _scratch(path: Path) -> Path:
    """Make a scratch folder beside ``path``; delete those that killed processes of this host have left there."""
    host = f".{socket.gethostname()}."
    for left in path.parent.glob(f".*{escape(host)}*.*"):
        number = left.name.rpartition(host)[2].partition(".")[0]
        if number.isdecimal() and not alive(int(number)):
            shutil.rmtree(left, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=scratch_prefix(path.name), dir=path.parent))


def not_a_file(path: Path) -> None:
    """Raise InputError if a file stands where a folder is to be, or one of those that it is in."""
    for one in (path, *path.parents):
        if one.exists():
            if not one.is_dir():
                raise InputError(f"{one} is a file, where a folder is needed; move it away.")
            return


def not_filled(folder: Path) -> None:
    """Raise InputError unless a folder is empty, or is not there yet."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is not a new folder, and nothing is written over; choose another folder with -o.")


def outside_stores(path: Path, filled: bool = False) -> None:
    """Raise InputError for a path within a Zarr store, which would no longer be what it was.

    ``filled``: for a folder that is filled, and so may not be a store itself.
    """
    real = Path(os.path.realpath(path))
    for one in (real, *real.parents) if filled else real.parents:
        if _is_store(one):
            where = "is a store" if one == real else f"is within the store {one}"
            raise InputError(f"{path} {where}, and nothing is written into one; choose a place outside it.")


def _is_store(folder: Path) -> bool:
    """Return True for a Zarr array, or a group with arrays; a group of groups alone may have further ones."""
    if not (folder / "zarr.json").is_file():
        return False
    return any(_is_array(one) for one in (folder / "zarr.json", *folder.glob("*/zarr.json")))


def _is_array(metadata: Path) -> bool:
    try:
        return bool(json.loads(metadata.read_bytes())["node_type"] == "array")
    except (ValueError, KeyError, TypeError, OSError):
        return True  # of a damaged store


def is_full(error: BaseException | None) -> bool:
    """Return True for an error of a disk, or a quota, that is full: the input is not to blame."""
    return isinstance(error, OSError) and (error.errno in (errno.ENOSPC, errno.EDQUOT) or _FULL in str(error))


_FULL = " requested and "  #: numpy wrote less than that, and raises no number; nor does astropy, which adds to it


def reason(error: OSError) -> str:
    """Return why the file system refuses."""
    return error.strerror or (os.strerror(errno.ENOSPC) if is_full(error) else str(error))


@contextmanager
def unwritable(name: str | Path, remedy: str) -> Iterator[None]:
    """Turn the file system's refusal to write into an InputError, and a full disk into a RunError."""
    try:
        yield
    except OSError as error:
        if is_full(error):
            raise RunError(f"{name} cannot be written ({reason(error)}); make room there and try again.") from error
        raise InputError(f"{name} cannot be written ({reason(error)}); {remedy}.") from error


@contextmanager
def filling(folder: Path) -> Iterator[None]:
    """Make a folder for what a command has computed; name it in a RunError where its disk is full or fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        why = reason(error)
        raise RunError(f"{folder} cannot be written ({why}); make room there, and run the command again.") from error


@contextmanager
def unreadable(name: str | Path, what: str, remedy: str) -> Iterator[None]:
    """Turn whatever a library raises for a broken file into an InputError; a lack of memory is none of the file."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # of any type
        raise InputError(f"{name} cannot be read as {what} ({error}); {remedy}.") from error


def read_json(path: Path, remedy: str) -> Any:
    """Read a JSON file; InputError with the remedy if it is missing or malformed."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); {remedy}.") from error


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that appears complete or not at all."""
    path = real_path(path)
    with _written_beside(path, content) as scratch:
        os.replace(scratch, path)


def exchanged(one: Path, other: Path) -> bool:
    """Give two files or folders each other's names in one step; False where kernel or disk cannot."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)  # of Linux
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename is not None and rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


def write_once(path: Path, text: str) -> None:
    """Write a file that appears complete or not at all, unless it is there: of several writers one, and it alone."""
    with _written_beside(path, text) as scratch, suppress(FileExistsError):
        os.link(scratch, path)


@contextmanager
def _written_beside(path: Path, content: str | bytes) -> Iterator[Path]:
    """Yield a file with this content beside ``path``; delete it if it is still there at the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        scratch.write_bytes(content.encode() if isinstance(content, str) else content)
        yield scratch
    finally:
        scratch.unlink(missing_ok=True)


def writable(folder: Path) -> None:
    """Raise InputError if a folder cannot be made or written into; a folder that is made for the test is removed.

    A folder that is a Zarr store, or within one, is refused as well.
    """
    outside_stores(folder, filled=True)
    with unwritable(folder, "choose another folder"):
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    with suppress(OSError):  # another process may have begun to use it
        for path in made:
            path.rmdir()


def default_cache_dir() -> Path:
    """Return $MCSIM_CACHE, or $XDG_CACHE_HOME/mcsim, or ~/.cache/mcsim."""
    if own := os.environ.get("MCSIM_CACHE"):
        return user_path(own)
    if xdg := os.environ.get("XDG_CACHE_HOME"):
        return Path(xdg) / "mcsim"
    return Path.home() / ".cache" / "mcsim"


def cached(name: str, fill: Callable[[Path], None]) -> Path:
    """Return a folder of the cache (:func:`default_cache_dir`); if it is not whole, ``fill`` an empty one.

    The name of the folder identifies everything that its content depends on. Some clusters delete files of a scratch
    disk one by one as they grow old, a computer that stops leaves empty ones, and disks change bits: such a folder is
    made again. A process reads each file once for that, 0.6 s for 1 GB in memory.
    """
    root = default_cache_dir()
    folder = root / name
    if not _is_whole(folder):
        try:
            not_a_file(folder)
        except InputError as error:
            why, _, _ = str(error).partition(";")
            raise InputError(
                f"cache folder {str(root)!r} cannot be written ({why}); move it away, or set MCSIM_CACHE to another."
            ) from None
        try:
            with appearing(folder) as scratch:
                fill(scratch)
                (scratch / CONTENT).write_text(json.dumps(_contents(scratch)))
                if (place := real_path(folder)).is_dir() and not _is_whole(place):
                    with suppress(FileNotFoundError):  # another process removes it, too
                        shutil.rmtree(place)
        except OSError as error:
            if error.errno is None and not is_full(error):  # from a connection or a timeout, not from a file
                raise
            kind, room = (RunError, "make room there, or ") if is_full(error) else (InputError, "")
            raise kind(
                f"cache folder {str(root)!r} cannot be written ({reason(error)}); {room}set "
                "MCSIM_CACHE to one that can."
            ) from None
    return folder


def is_cached(name: str) -> bool:
    """Return True if :func:`cached` would find this folder whole."""
    return _is_whole(default_cache_dir() / name)


def _contents(folder: Path) -> dict[str, tuple[int, int]]:
    """Return the sizes of all files in a folder, in bytes, and their CRC-32, by their paths in it."""
    return {str(path.relative_to(folder)): _content(path) for path in folder.rglob("*") if path.is_file()}


def _content(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, _crc32(path, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=4096)
def _crc32(path: Path, size: int, changed_ns: int) -> int:
    """Return the CRC-32 of a file; ``size`` and ``changed_ns`` say of which state of it."""
    found = 0
    with path.open("rb") as stream:
        while piece := stream.read(1 << 20):
            found = crc32(piece, found)
    return found


def _is_whole(folder: Path) -> bool:
    """Return True if a folder of the cache has all the files that it was made with; earlier versions kept sizes."""
    try:
        made = json.loads((folder / CONTENT).read_bytes())
        contents = ((kept, _content(folder / name)) for name, kept in made.items())
        return all(kept in (found[0], [*found]) for kept, found in contents)
    except (OSError, ValueError):
        return False
