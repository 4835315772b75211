"""Damaged files of every format that mcsim reads."""

import random
import shutil
import time
from pathlib import Path

from .damage import damage
from .judge import Outcome, judge
from .samples import readers, write_files


def fuzz(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Damaged files of every format, each read by what reads such files."""
    outcome = Outcome()
    end = time.monotonic() + seconds
    good = folder / "good"
    good.mkdir()
    write_files(good)
    calls = readers(folder)
    for path in good.iterdir():
        shutil.copy(path, folder)
    for name, call in calls.items():  # a fuzzer whose undamaged files fail proves nothing
        call()
        outcome.ends[f"whole {name.split('.')[-1]}"] += 1
    names = sorted(calls)
    for number in range(count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed}/{number}")
        name = names[number % len(names)]
        damage(folder / name, rng)
        judge(f"file {number} {name}", calls[name], outcome)
        shutil.copy(good / name, folder / name)
        if (folder / "made.zarr").exists():
            shutil.rmtree(folder / "made.zarr")
    return outcome
