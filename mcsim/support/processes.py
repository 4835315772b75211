"""Processes of this host."""

import os
from contextlib import suppress
from pathlib import Path


def alive(process: int) -> bool:
    """Return True if a process of this host has not ended."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    with suppress(OSError):  # a zombie: ended, but not yet waited for by its parent
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True
