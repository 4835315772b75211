"""Layout of an ensemble store: dimensions, variables, coordinates, chunks and sizes."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mcsim.support.arrays import texts

if TYPE_CHECKING:  # stored ensembles open without the numerics, which load slowly
    from mcsim.bipolar import Mode


@dataclass(frozen=True)
class Layout:
    """Layout of a store: realizations, realizations per task, maps, pairs, modes, degrees, width of the bins in ell."""

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
    bin_width: int = 50
    filtered: bool = False

    def variables(self) -> dict[str, tuple[tuple[str, ...], str, str, str]]:
        """Return dimensions, type, unit and long name of every array over realizations."""
        coefficients = "BipoSH coefficient A^{LM}_{l2-d,l2} at ell = l2"
        spectra = {
            "biposh": (("pair", "mode", "ell"), "complex128", "uK^2", coefficients),
            "cl": (("pair", "ell"), "float64", "uK^2", "power spectrum C_l with beam and noise"),
        }
        if self.filtered:
            text = "quadratic maximum-likelihood l(l+1)/2pi A^{LM}, by bin"
            spectra["biposh_qml"] = (("pair", "mode", "bin"), "complex128", "uK^2", text)
            text = "derivative of the log-likelihood by biposh_qml, before the mean field is taken off"
            spectra["biposh_qml_score"] = (("pair", "mode", "bin"), "complex128", "uK^-2", text)
        found = dict(spectra)
        if self.paired:
            for name, (dims, dtype, unit, text) in spectra.items():
                found[f"{name}_circular"] = (dims, dtype, unit, f"{text} of the circular-beam control")
        if self.kept_npix is not None:
            found[self.kept_name] = (("map_name", "pixel"), "float32", "uK", "simulated map, HEALPix RING")
        return found

    def coordinates(self) -> dict[str, tuple[str, NDArray, dict[str, str]]]:
        """Return dimension, values and attributes of every coordinate; labels are arrays of objects."""
        numbers = {
            "realization": ("realization", range(self.realizations), "index of the realization"),
            "ell": ("ell", range(self.lmax + 1), "degree l2"),
            "L": ("mode", [mode.L for mode in self.modes], "bipolar degree"),
            "M": ("mode", [mode.M for mode in self.modes], "bipolar order"),
            "d": ("mode", [mode.d for mode in self.modes], "l2 - l1"),
        }
        labels = {
            "pair": ("pair", self.pairs, "ordered pair of maps X,Y: l1 is of X, l2 of Y"),
            "mode": ("mode", [mode.name for mode in self.modes], "BipoSH mode"),
            "parity": ("mode", [mode.parity for mode in self.modes], "parity of l1 + l2 + L"),
        }
        if self.kept_npix is not None:
            labels["map_name"] = ("map_name", self.maps, "map")
        bins = {"bin": ("bin", self.middles(), {"units": "1", "long_name": "middle of the bin in ell"})}
        return (
            {
                name: (dim, np.array(values), {"units": "1", "long_name": text})
                for name, (dim, values, text) in numbers.items()
            }
            | (bins if self.filtered else {})
            | {name: (dim, texts(values), {"long_name": text}) for name, (dim, values, text) in labels.items()}
        )

    def first_ells(self) -> NDArray[np.int64]:
        """Return the first ell of every bin."""
        return np.arange(0, self.lmax + 1, self.bin_width)

    def last_ells(self) -> NDArray[np.int64]:
        """Return the last ell of every bin."""
        return np.append(self.first_ells()[1:] - 1, self.lmax)

    def middles(self) -> NDArray[np.float64]:
        """Return the middle of every bin in ell."""
        return np.asarray((self.first_ells() + self.last_ells()) / 2.0)

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
            "bin": len(self.first_ells()),
            "map_name": len(self.maps),
            "pixel": self.kept_npix or 0,
        }

    def realization_bytes(self) -> int:
        """Return the uncompressed size of one realization in bytes."""
        sizes = self.sizes()
        shapes = [(np.dtype(dtype), [sizes[dim] for dim in dims]) for dims, dtype, _, _ in self.variables().values()]
        return sum(dtype.itemsize * math.prod(shape) for dtype, shape in shapes)

    def statistics_bytes(self) -> int:
        """Return the size of the statistics of any number of realizations in bytes, as a summary is made of them."""
        sizes = self.sizes()
        spectra, bins = sizes["pair"] * sizes["mode"], sizes["bin"]
        # A mean, a sum of squares, and of binned spectra their products: of maps, controls and differences.
        raw = (16 + 8) * spectra * sizes["ell"] + (8 + 8) * sizes["pair"] * sizes["ell"]
        binned = ((1 + self.filtered) * (16 + 8 + 16 * bins) + 8 + 8) * spectra * bins  # with real parts of bins
        return (1 + 2 * self.paired) * (raw + binned)

    def files(self) -> int:
        """Return the number of files of the finished store, coordinates and metadata included."""
        chunks = -(-self.realizations // self.chunk)
        # Coordinates and about 32 variables of the summary have metadata and one chunk each.
        return (len(self.variables()) + 1) * (chunks + 1) + 100


def listed(numbers: Iterable[int]) -> str:
    """Return realization numbers as text: ``realizations 3, 7-9``."""
    every = np.unique(np.fromiter(numbers, int))
    runs = np.split(every, np.flatnonzero(np.diff(every) > 1) + 1)
    found = [f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
    shown = ", ".join(found[:8]) + (f" and {len(found) - 8} more ranges" if len(found) > 8 else "")
    return f"{'realization' if len(every) == 1 else 'realizations'} {shown}"
