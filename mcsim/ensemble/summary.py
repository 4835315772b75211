"""Summary of an ensemble: means, errors and binned spectra with their covariance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim.bipolar import Mode, bennett_factor
from mcsim.config.preparation import frame_of
from mcsim.stats import streaming
from mcsim.stats.streaming import Sums


@dataclass(frozen=True)
class Recipe:
    """Definition of a summary: the labels of the spectra and the width of their bins in ell."""

    pairs: tuple[str, ...]
    modes: tuple[Mode, ...]
    lmax: int
    bin_width: int
    paired: bool

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """First ell of every bin, and lmax + 1."""
        return np.append(np.arange(0, self.lmax + 1, self.bin_width), self.lmax + 1)

    @cached_property
    def factor(self) -> NDArray[np.float64]:
        """Factor from the raw to the binned coefficients, shape (mode, lmax + 1); see :func:`bin_factor`."""
        return np.stack([bin_factor(mode, self.lmax) for mode in self.modes])

    def binned(self, biposh: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the mean of factor * A over the existing coefficients of each bin, shape (..., mode, bin)."""
        scaled = self.factor * biposh
        exists = np.isfinite(scaled)
        total = np.add.reduceat(np.where(exists, scaled, 0.0), self.edges[:-1], axis=-1)
        count = np.add.reduceat(exists, self.edges[:-1], axis=-1, dtype=np.int64)
        return np.divide(total, count, out=np.full(total.shape, np.nan + 0j), where=count > 0)


def bin_factor(mode: Mode, lmax: int) -> NDArray[np.float64]:
    """Return the factor that makes A^{LM}_{l1 l2} smooth in ell = l2, shape (lmax + 1,).

    It is l(l+1)/2pi times the Bennett factor for even parity. For odd parity, which has no such factor, it is
    l(l+1)/2pi times (-1)^l ((2 l1 + 1)(2 l2 + 1))^{-1/4}, which removes the same alternation of sign and growth with l.
    """
    ell = np.arange(lmax + 1, dtype=float)
    spectrum = ell * (ell + 1.0) / (2.0 * np.pi)
    if mode.parity == "even":
        return spectrum * bennett_factor(mode, lmax)
    other = np.maximum(ell - mode.d, 0.0)
    return spectrum * np.where(ell % 2 == 0, 1.0, -1.0) * ((2.0 * other + 1.0) * (2.0 * ell + 1.0)) ** -0.25


def reduce_rows(recipe: Recipe, rows: Mapping[str, NDArray], first: int) -> Sums | None:
    """Reduce consecutive realizations to statistics, by the tree of their indices.

    Parameters
    ----------
    recipe
        Definition of the summary.
    rows
        Arrays over realizations as stored, with ``done``.
    first
        Index of the first row; a multiple of the smallest power of two that is not below the number of rows.
    """

    def node(row: int) -> Sums | None:
        if not rows["done"][row]:
            return None
        values = {name: array[row] for name, array in rows.items() if name != "done"}
        if recipe.paired:
            for name in ("biposh", "cl"):
                values[f"{name}_difference"] = values[name] - values[f"{name}_circular"]
        binned = {f"{name}_binned": recipe.binned(values[name]) for name in values if name.startswith("biposh")}
        return streaming.leaf(values | binned, covariance_of=tuple(binned))

    return streaming.tree(node, len(rows["done"]))


_MEANING = {
    "biposh": "BipoSH coefficients",
    "biposh_circular": "BipoSH coefficients of the circular-beam control",
    "biposh_difference": "BipoSH coefficients, non-circular minus circular-beam control",
    "cl": "power spectrum",
    "cl_circular": "power spectrum of the circular-beam control",
    "cl_difference": "power spectrum, non-circular minus circular-beam control",
}


def dataset(recipe: Recipe, sums: Sums, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return the summary as a dataset: ``{variable}_{mean, standard_error, standard_deviation}``, raw and binned.

    The provenance among the store's ``attributes`` is copied into the summary.

    Binned spectra are means over bins of ``bin_factor * A``; their covariance is that of single realizations, over the
    bins of one mode.
    """
    variables: dict[str, tuple[Sequence[str], NDArray, dict[str, str]]] = {}
    for name in sums.mean:
        raw = name.removesuffix("_binned")
        last = "ell" if raw == name else "bin"
        dims = ("pair", last) if raw.startswith("cl") else ("pair", "mode", last)
        scale = "l(l+1)/2pi A, mean over the bin, " if raw != name else ""
        deviation = streaming.standard_deviation(sums, name)
        for suffix, array, text in (
            ("mean", sums.mean[name], "mean"),
            ("standard_error", deviation / np.sqrt(sums.count), "standard error of the mean"),
            ("standard_deviation", deviation, "standard deviation of one realization"),
        ):
            variables[f"{name}_{suffix}"] = (dims, array, _units(f"{scale}{_MEANING[raw]}: {text}"))
        if name in sums.comoment:
            text = f"{scale}{_MEANING[raw]}: covariance of one realization between bins"
            array = streaming.covariance(sums, name)
            variables[f"{name}_covariance"] = ((*dims, "bin_2"), array, _units(text, "uK^4"))
    variables["bin_factor"] = (
        ("mode", "ell"),
        recipe.factor,
        {"units": "1", "long_name": "factor from raw coefficients to binned ones"},
    )
    variables["count"] = ((), np.array(sums.count), {"units": "1", "long_name": "number of realizations"})
    first, stop = recipe.edges[:-1], recipe.edges[1:]
    coordinates = {
        "pair": ("pair", np.array(recipe.pairs, dtype=object), {"long_name": "ordered pair of maps"}),
        "mode": ("mode", np.array([m.name for m in recipe.modes], dtype=object), {"long_name": "BipoSH mode"}),
        "ell": ("ell", np.arange(recipe.lmax + 1), {"units": "1", "long_name": "degree l2"}),
        "bin": ("bin", (first + stop - 1) / 2.0, {"units": "1", "long_name": "middle of the bin in ell"}),
        "bin_2": ("bin_2", (first + stop - 1) / 2.0, {"units": "1", "long_name": "the other bin of a covariance"}),
        "bin_first": ("bin", first, {"units": "1", "long_name": "first ell of the bin"}),
        "bin_last": ("bin", stop - 1, {"units": "1", "long_name": "last ell of the bin"}),
        "parity": ("mode", np.array([m.parity for m in recipe.modes], dtype=object), {"long_name": "of l1 + l2 + L"}),
        **{
            name: ("mode", np.array([getattr(m, name) for m in recipe.modes]), {"units": "1", "long_name": text})
            for name, text in (("L", "bipolar degree"), ("M", "bipolar order"), ("d", "l2 - l1"))
        },
    }
    origin = {name: attributes[name] for name in ("digest", "conventions", "packages")}
    run = {"name": attributes["configuration"]["name"], "frame": frame_of(attributes["configuration"])}
    normalisation = "Hajian-Souradeep; binned: see bin_factor"
    return xr.Dataset(variables, coordinates, {**run, **origin, "normalisation": normalisation})


def _units(text: str, unit: str = "uK^2") -> dict[str, str]:
    return {"units": unit, "long_name": text}
