"""Check of a store, and removal of damaged parts so that a run computes them again."""

import re
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcsim.config.identity import digest_of
from mcsim.ensemble import store
from mcsim.ensemble.layout import Layout, listed
from mcsim.ensemble.store import Damage
from mcsim.errors import RunError
from mcsim.support.folders import user_path
from mcsim.support.progress import reporting

THREADS = 4

LOOKING_S = 60.0  #: age from which a file beside a store is none of a run that is about to look for the lock


@dataclass(frozen=True)
class Verdict:
    """Result of reading every file of a store: ``finished`` of ``size`` realizations are intact.

    ``broken`` names the faults of parts other than realizations: metadata, coordinates, summary.
    """

    path: Path
    finished: int
    size: int
    damages: tuple[Damage, ...]
    broken: dict[str, str]

    @property
    def lost(self) -> tuple[int, ...]:
        """Realizations marked as finished that are damaged."""
        return tuple(r for damage in self.damages for r in damage.lost)

    @property
    def intact(self) -> bool:
        """Return True if everything marked as finished is undamaged."""
        return not self.lost and not self.broken

    def text(self) -> str:
        """Return the result as text."""
        if self.intact:
            return f"{self.path} is intact: {self.finished} of {self.size} realizations, each file read and checked."
        lines = [f"{self.path} is damaged."]
        lines += [f"  {listed(damage.lost)}: {damage.reason}" for damage in self.damages if damage.lost]
        lines += [f"  {name}: {reason}" for name, reason in self.broken.items()]
        repair = "computes the others again" if self.lost else "repairs this"
        lines.append(f"  {self.finished} of {self.size} realizations are whole; mcsim run --resume {repair}.")
        return "\n".join(lines)


def verify(path: str | Path, quiet: bool = True) -> Verdict:
    """Read every chunk of every array and check its checksum."""
    target = user_path(path)
    broken = broken_parts(target)
    if "done" in broken:
        return Verdict(target, 0, 0, (), broken)
    finished = 0
    damages: list[Damage] = []
    size, chunk = store.size(target), store.chunk(target)

    def examined(start: int) -> tuple[int, Damage | None]:
        """Return the number of intact realizations of a chunk, and its damage."""
        damage = store.examine(target, start, broken)
        try:
            done = int(store.done(target, start, start + chunk).sum())
        except RunError:
            return 0, damage
        return done - len(damage.lost if damage else ()), damage

    with reporting("verification", float(size), "realizations", quiet) as report, ThreadPoolExecutor(THREADS) as pool:
        starts = range(0, size, chunk)
        for start, (count, damage) in zip(starts, pool.map(examined, starts), strict=True):
            if damage is not None:
                damages.append(damage)
            finished += count
            report(float(min(start + chunk, size)), sum(len(d.lost) for d in damages))
    if not (damages or broken) and (counted := store.summarised(target)[0]) > finished:
        broken["done"] = f"the summary is of {counted} realizations, but {finished} are marked as finished"
    return Verdict(target, finished, size, tuple(damages), broken)


def mend(path: Path, layout: Layout, attributes: Mapping[str, Any], quiet: bool = True) -> Verdict:
    """Verify a store that no run writes to, and drop damaged parts, so that a run computes them again.

    Broken metadata and coordinates, or lost attributes of the store itself, are rebuilt from the ``layout`` and
    ``attributes`` of its configuration.
    """
    sweep(path)
    lost = {}
    if store.headless(path):
        store.restore_attributes(path, layout, {**attributes, **store.origin(path)})
        lost = {"zarr.json": "the attributes of the store could not be read"}
    broken = lost | broken_parts(path)
    if broken:
        store.restore(path, layout, {name: attributes[name] for name in ("science", "digest")})
    verdict = verify(path, quiet)
    for damage in verdict.damages:
        store.discard(path, damage)
    return replace(verdict, broken=broken | verdict.broken)


def sweep(path: Path) -> None:
    """Remove the remains of killed writers of a store that no run writes to: partial files and temporary folders."""
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)
    scratch = re.compile(rf"\.{re.escape(path.name)}\.[a-z0-9_]{{8}}")  # tempfile's names
    beside, inside = path.absolute().parent.iterdir(), path.glob(".*")
    for left in [entry for entry in (*beside, *inside) if scratch.fullmatch(entry.name)]:
        with suppress(FileNotFoundError):
            if left.is_file() and time.time() - left.stat().st_mtime > LOOKING_S:
                left.unlink()
        shutil.rmtree(left, ignore_errors=True)


def broken_parts(path: Path) -> dict[str, str]:
    """Return the faults of parts other than realizations, by name."""
    attributes = store.attributes(path)
    broken = store.broken_parts(path)
    if digest_of(attributes["science"]) != attributes.get("digest"):
        broken["attributes"] = "the configuration in them does not have the hash that they state"
    return broken
