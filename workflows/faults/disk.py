"""Disks that fill up or become read-only in the middle of a run, and stores that are then continued. As root, on Linux.

    python workflows/faults/disk.py

The disks are file systems in memory, made for this and sized in pages: every run but the last of a store ends on a disk
that has no room for some share of what it would write.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from nodes import CONFIGURATION
from same import difference, finished

SHARES = (0.02, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9, 0.97)


@dataclass
class Ending:
    """How a run ended, and what the next one made of its store."""

    case: str
    exit_code: int
    sentences: int
    said: str
    stored: int
    left_behind: bool
    computed_by_resume: int
    exit_code_of_resume: int
    lost: int
    doubled: int
    differing: int
    same_summary: bool

    def sound(self, realizations: int) -> bool:
        """One sentence; nothing of what was stored is computed again; the result is that of an undisturbed run."""
        whole = (self.exit_code_of_resume, self.lost, self.doubled, self.differing, self.same_summary)
        again = self.computed_by_resume + self.stored - realizations
        return self.sentences == 1 and not self.left_behind and whole == (0, 0, 0, 0, True) and again == 0


def mount(*words: str) -> bool:
    """Whether a call of mount went well."""
    return subprocess.run(["mount", *words], capture_output=True, check=False).returncode == 0


@contextmanager
def disk(folder: Path) -> Iterator[Path]:
    """A disk of 1 GB of its own."""
    place = folder / "disk"
    place.mkdir()
    if not mount("-t", "tmpfs", "-o", "size=1g", "mcsim", str(place)):
        raise SystemExit("This user may not mount a disk; be root.")
    try:
        yield place
    finally:
        subprocess.run(["umount", place], check=True)
        place.rmdir()


def used(place: Path) -> int:
    """Bytes on a disk, in whole pages."""
    found = os.statvfs(place)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def start(config: Path, store: Path, *options: str) -> subprocess.Popen[str]:
    """``mcsim run``."""
    command = [sys.executable, "-m", "mcsim.cli", "run", str(config), "-o", str(store), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def judge(case: str, process: subprocess.Popen[str], place: Path, config: Path, reference: Path) -> Ending:
    """See a run end, give its disk room, continue it, and compare."""
    store = place / "run.zarr"
    _, err = process.communicate()
    said = [line for line in err.splitlines() if line.startswith("mcsim: ")]
    stored = finished(store)
    # The log cannot be taken back, and on a read-only disk nothing can.
    names = {entry.name for entry in place.iterdir()} - {"run.zarr", "run.zarr.log", "ballast"}
    left_behind = bool(names) and os.access(place, os.W_OK)
    mount("-o", "remount,rw,size=1g", str(place))
    again = start(config, store, *(["--resume"] if store.exists() else []))
    again.communicate()
    log = (place / "run.zarr.log").read_text().splitlines()
    new = next(int(line.split(" stored, ")[1].split()[0]) for line in reversed(log) if " stored, " in line)
    alone = len(said) + ("Traceback" in err)
    text = said[-1].replace(str(store), "STORE") if said else err[-300:]
    return Ending(
        case,
        process.returncode,
        alone,
        text,
        stored,
        left_behind,
        new,
        again.returncode,
        **difference(store, reference),
    )


def full(share: float, needed: int, folder: Path, config: Path, reference: Path) -> Ending:
    """A disk with room for a share of the store."""
    with disk(folder) as place:
        mount("-o", f"remount,size={max(4096, int(share * needed))}", str(place))
        return judge(f"room for {share:.0%}", start(config, place / "run.zarr"), place, config, reference)


def read_only(at: float, realizations: int, folder: Path, config: Path, reference: Path) -> Ending:
    """A disk that becomes read-only when a share of the realizations is stored."""
    with disk(folder) as place:
        process = start(config, place / "run.zarr")
        while process.poll() is None and finished(place / "run.zarr") < at * realizations:
            time.sleep(0.02)
        while process.poll() is None and not mount("-o", "remount,ro", str(place)):
            pass  # not while a file is being written
        return judge(f"read-only at {at:.0%}", process, place, config, reference)


def main() -> int:
    """All cases; exit code 1 if one is not sound."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--realizations", type=int, default=200)
    parser.add_argument("--output", type=Path, help="write the endings as JSON")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mcsim-disk-") as name:
        folder = Path(name)
        config, reference = folder / "run.toml", folder / "reference.zarr"
        config.write_text(CONFIGURATION.format(realizations=chosen.realizations))
        start(config, reference).communicate()
        with disk(folder) as place:
            start(config, place / "run.zarr").communicate()
            needed = used(place)
        cases = [lambda share=share: full(share, needed, folder, config, reference) for share in SHARES]
        cases += [lambda at=at: read_only(at, chosen.realizations, folder, config, reference) for at in (0.0, 0.3, 0.8)]
        endings = []
        for case in cases:
            endings.append(case())
            print(json.dumps(asdict(endings[-1])), flush=True)
    if chosen.output:
        chosen.output.write_text(json.dumps([asdict(ending) for ending in endings], indent=1) + "\n")
    return int(not all(ending.sound(chosen.realizations) for ending in endings))


if __name__ == "__main__":
    sys.exit(main())
