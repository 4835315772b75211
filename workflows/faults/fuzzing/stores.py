"""Stores with one damaged file."""

import random
import shutil
import time
from pathlib import Path

import numpy as np

from mcsim import config
from mcsim.ensemble import describe, plan, repair, store
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

from .damage import damaged_bytes
from .judge import Outcome, judge
from .samples import base


def make_store(path: Path) -> None:
    """A finished store of four realizations, written without a cluster."""
    run = config.load(base() | {"ensemble": {"realizations": 4, "seed": 3}})
    shared = survey(run)
    store.create(path, plan.layout(shared), plan.attributes(run))
    values = [simulate.realize(shared, r) for r in range(4)]
    rows = {name: np.stack([v[name] for v in values]) for name in values[0]}
    for r in range(4):
        store.write(path, r, {name: array[r : r + 1] for name, array in rows.items()}, np.array([True]))


def fuzz(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Stores with one damaged file: described, verified, opened and repaired, or refused in a sentence."""
    outcome = Outcome()
    end = time.monotonic() + seconds
    good, path = folder / "good.zarr", folder / "store.zarr"
    make_store(good)
    run = config.load(base() | {"ensemble": {"realizations": 4, "seed": 3}})
    shared = survey(run)
    expected = store.read(good, 0, 4)
    for number in range(count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed}/{number}")
        shutil.copytree(good, path)
        file = rng.choice(sorted(p for p in path.rglob("*") if p.is_file()))
        before = file.read_bytes()
        file.write_bytes(damaged_bytes(before, rng))
        name = f"store {number} {file.relative_to(path)}"
        judge(f"{name} described", lambda: describe.describe(path), outcome)
        judge(f"{name} verified", lambda: repair.verify(path).text(), outcome)

        def mended() -> None:
            plan.check_same(path, run)
            repair.mend(path, plan.layout(shared), plan.attributes(run))
            rows = store.read(path, 0, store.size(path))
            for key, values in rows.items():
                if key != "done" and not np.array_equal(
                    values[rows["done"]], expected[key][rows["done"]], equal_nan=True
                ):
                    raise AssertionError(f"{key} is silently wrong")

        judge(f"{name} mended", mended, outcome)
        shutil.rmtree(path)
    return outcome
