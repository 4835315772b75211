"""Lock of a store: one run at a time writes to it.

The package filelock does not replace this module: on file systems that cannot exchange two names, such as NFS, its
lock of a dead process stays for ever.
"""

import fcntl
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TextIO

from mcsim.ensemble.store import refuse_unwritable
from mcsim.errors import InputError, RunError
from mcsim.support.processes import alive


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold the store for one run, or raise InputError: a file ``{path}.lock`` beside it names host and process.

    The lock of a dead process of this host is taken over; yield True then, for it may have left more behind.
    """
    lock, inherited = _lock_of(path), False
    with ExitStack() as stack:
        with refuse_unwritable(path):
            lock.parent.mkdir(parents=True, exist_ok=True)
            # A link makes the lock and its contents in one step, so that a killed process leaves a readable lock.
            descriptor, scratch = tempfile.mkstemp(prefix=f".{path.name}.", dir=lock.parent)
            try:
                with os.fdopen(descriptor, "wb", buffering=0) as stream:
                    stream.write(holder().encode())
                held = stack.enter_context(Path(scratch).open())
                with suppress(OSError):  # the kernel's lock tells other runs of this process; some disks have none
                    fcntl.flock(held, fcntl.LOCK_EX)
                while not _linked(scratch, lock):
                    _remove_if_dead(lock, path)
                    inherited = True
            finally:
                os.unlink(scratch)
        try:
            yield inherited
        finally:
            with suppress(OSError):  # if the disk has become read-only, the next run takes the lock over
                lock.unlink()


def holder() -> str:
    """Return what the lock of a store that this process holds says: host and process."""
    return f"{socket.gethostname()} {os.getpid()}"


def is_held(path: Path) -> bool:
    """Return True if a run writes to a store, for all that this host knows."""
    try:
        host, _, number = _lock_of(path).read_text().partition(" ")
    except OSError:
        return False
    return host != socket.gethostname() or not number.isdecimal() or alive(int(number))


def check_held(path: Path, by: str) -> None:
    """Raise RunError on a worker that does not see the lock of the driver (:func:`holder`): its disk is another one."""
    lock = _lock_of(path)
    for wait_s in (0.0, 1.0, 2.0):
        time.sleep(wait_s)
        with suppress(OSError):
            os.listdir(lock.parent)  # a network disk then looks for new files
            if lock.read_text() == by:
                return
    raise RunError(
        f"A worker on {socket.gethostname()} does not see the driver's store {path}; choose with -o a folder that "
        "driver and workers share."
    )


def _lock_of(path: Path) -> Path:
    return path.absolute().with_name(f"{path.name}.lock")


def _linked(scratch: str, lock: Path) -> bool:
    try:
        os.link(scratch, lock)
    except FileExistsError:
        return False
    return True


def _taken(stream: TextIO, own: bool) -> bool:
    """Take the kernel's lock of a file that no live process holds; False if another run of this process has it."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | (fcntl.LOCK_NB if own else 0))
    except BlockingIOError:
        return False
    except OSError:  # a disk without such locks
        return not own
    return True


def _remove_if_dead(lock: Path, path: Path) -> None:
    """Remove the lock of a dead process; raise InputError for that of a live one."""
    with suppress(FileNotFoundError), lock.open() as stream:
        host, _, number = stream.read().partition(" ")
        process = int(number) if number.isdecimal() else 0
        own = process == os.getpid()
        if host == socket.gethostname() and process and (own or not alive(process)) and _taken(stream, own):
            # If several processes find a dead lock, one removes it, and none removes a newer lock.
            if os.fstat(stream.fileno()).st_ino == lock.stat().st_ino:
                lock.unlink()
            return
        who = f"process {process} on {host}" if process else "process 0 on an unknown host"
        raise InputError(f"Another run writes to {path} ({who}); wait for it, or remove {lock} if it is gone.")
