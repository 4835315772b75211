"""Lock of a store: one run at a time writes to it."""

import fcntl
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

from mcsim.errors import InputError

_held: set[Path] = set()
"""Absolute paths of the locks that this process holds."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the store for one run: a file ``{path}.lock`` beside it names host and process.

    Raises
    ------
    InputError
        If another run holds it. The lock of a dead process of this host is taken over.
    """
    lock = path.absolute().with_name(f"{path.name}.lock")
    while True:
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            _make(lock, path)
            break
        except FileExistsError:
            _take_over(lock, path)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{lock} cannot be written ({reason}); choose a writable folder with -o.") from error
    _held.add(lock)
    try:
        yield
    finally:
        _held.discard(lock)
        with suppress(OSError):  # if the disk has become read-only, the next run takes the lock over
            lock.unlink()


def _make(lock: Path, path: Path) -> None:
    """Make the lock and its contents in one step, so that a killed process leaves a readable lock."""
    descriptor, scratch = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "w") as stream:
            stream.write(f"{socket.gethostname()} {os.getpid()}")
        os.link(scratch, lock)
    finally:
        os.unlink(scratch)


def _take_over(lock: Path, path: Path) -> None:
    """Remove the lock of a dead process; raise InputError for that of a live one."""
    with suppress(FileNotFoundError), lock.open() as stream:
        try:
            host, number = stream.read().split()
            process = int(number)
        except ValueError:
            host, process = "an unknown host", 0
        dead = lock not in _held if process == os.getpid() else not _alive(process)
        if host == socket.gethostname() and dead:
            # If several processes find a dead lock, one removes it, and none removes a newer lock.
            fcntl.flock(stream, fcntl.LOCK_EX)
            if os.fstat(stream.fileno()).st_ino == lock.stat().st_ino:
                lock.unlink()
            return
        _refuse(lock, path, host, process)


def _refuse(lock: Path, path: Path, host: str, process: int) -> NoReturn:
    raise InputError(
        f"Another run writes to {path} (process {process} on {host}); wait for it, or remove {lock} if it is gone."
    )


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    with suppress(OSError):  # a zombie: ended, but not yet waited for by its parent
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True
