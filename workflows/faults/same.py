"""Whether two stores hold the same, bit for bit."""

from pathlib import Path

import numpy as np

from mcsim import open_summary
from mcsim.ensemble import store


def finished(path: Path) -> int:
    """Number of realizations that count as finished."""
    return int(store.done(path).sum()) if path.exists() else 0


def difference(path: Path, reference: Path) -> dict[str, int | bool]:
    """What a store lacks, counts twice, or has otherwise than the store of an undisturbed run."""
    rows = [store.read(each, 0, store.size(reference), maps=True) for each in (path, reference)]
    done = rows[0]["done"]
    differing = np.zeros(done.shape, dtype=bool)
    for name in rows[1]:
        bits = [np.ascontiguousarray(each[name]).view(np.uint8) for each in rows]
        differing |= (bits[0] != bits[1]).reshape(len(done), -1).any(axis=1)
    with open_summary(path) as found, open_summary(reference) as expected:
        return {
            "lost": int((~done).sum()),
            "doubled": max(int(found["count"]) - len(done), 0),
            "differing": int(differing.sum()),
            "same_summary": bool(found.identical(expected)),
        }
