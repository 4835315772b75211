"""One run at a time writes to a store."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mcsim.errors import InputError


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the store for one run: a file ``{path}.lock`` beside it names host and process.

    Raises
    ------
    InputError
        If another run holds it. The lock of a process of this host that is gone is taken over.
    """
    lock = path.with_name(f"{path.name}.lock")
    while True:
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            with lock.open("x") as stream:
                stream.write(f"{socket.gethostname()} {os.getpid()}")
            break
        except FileExistsError:
            _take_over(lock, path)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{lock} cannot be written ({reason}); choose a writable folder with -o.") from error
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)


def _take_over(lock: Path, path: Path) -> None:
    """Remove the lock of a dead process, or refuse."""
    try:
        host, process = lock.read_text().split()
    except FileNotFoundError:
        return
    except ValueError:
        host, process = "an unknown host", "0"
    if host == socket.gethostname() and not _alive(int(process)):
        lock.unlink(missing_ok=True)
        return
    raise InputError(
        f"Another run writes to {path} (process {process} on {host}); wait for it, or remove {lock} if it is gone."
    )


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
