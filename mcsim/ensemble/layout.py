"""Layout of an ensemble store: dimensions, variables, chunks and sizes."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # stored ensembles open without the numerics, which load slowly
    from mcsim.bipolar import Mode


@dataclass(frozen=True)
class Layout:
    """Layout of a store: realizations, realizations per task, maps, pairs, modes, degrees."""

    realizations: int
    chunk: int
    maps: tuple[str, ...]
    pairs: tuple[str, ...]
    modes: "tuple[Mode, ...]"
    lmax: int
    paired: bool
    kept_npix: int | None
    kept_name: str = "observed_map"
    frame: str = ""

    def variables(self) -> dict[str, tuple[tuple[str, ...], str, str, str]]:
        """Return dimensions, type, unit and long name of every array over realizations."""
        spectra = {
            "biposh": (
                ("pair", "mode", "ell"),
                "complex128",
                "uK^2",
                "BipoSH coefficient A^{LM}_{l2-d,l2} at ell = l2",
            ),
            "cl": (("pair", "ell"), "float64", "uK^2", "power spectrum C_l"),
        }
        found = dict(spectra)
        if self.paired:
            for name, (dims, dtype, unit, text) in spectra.items():
                found[f"{name}_circular"] = (dims, dtype, unit, f"{text} of the circular-beam control")
        if self.kept_npix is not None:
            found[self.kept_name] = (("map_name", "pixel"), "float32", "uK", "simulated map, HEALPix RING")
        return found

    def kept_attributes(self) -> dict[str, str | int | float]:
        """Return the attributes of kept maps besides unit and long name."""
        nside = math.isqrt((self.kept_npix or 0) // 12)
        return {"nside": nside, "frame": self.frame, "ordering": "RING", "unseen": -1.6375e30}

    def sizes(self) -> dict[str, int]:
        """Return the length of every dimension."""
        return {
            "realization": self.realizations,
            "pair": len(self.pairs),
            "mode": len(self.modes),
            "ell": self.lmax + 1,
            "map_name": len(self.maps),
            "pixel": self.kept_npix or 0,
        }

    def realization_bytes(self) -> int:
        """Return the uncompressed size of one realization in bytes."""
        sizes = self.sizes()
        return sum(
            int(np.prod([sizes[dim] for dim in dims])) * np.dtype(dtype).itemsize
            for dims, dtype, _, _ in self.variables().values()
        )

    def files(self) -> int:
        """Return the number of files of the finished store, coordinates and metadata included."""
        chunks = -(-self.realizations // self.chunk)
        # Coordinates and about 32 variables of the summary have metadata and one chunk each.
        return (len(self.variables()) + 1) * (chunks + 1) + 100


def listed(numbers: Iterable[int]) -> str:
    """Return realization numbers as text: ``realizations 3, 7-9``."""
    ranges: list[list[int]] = []
    for number in sorted(int(n) for n in numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    found = [f"{a}" if a == b else f"{a}-{b}" for a, b in ranges]
    shown = ", ".join(found[:8]) + (f" and {len(found) - 8} more ranges" if len(found) > 8 else "")
    return f"{'realization' if len(ranges) == 1 and ranges[0][0] == ranges[0][1] else 'realizations'} {shown}"
