"""Summary of an ensemble: means, errors and binned spectra with their covariance."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim.bipolar import Mode, bennett_factor
from mcsim.config.preparation import frame_of
from mcsim.ensemble.layout import Layout
from mcsim.stats import streaming
from mcsim.stats.streaming import Sums


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


@lru_cache(maxsize=2)
def _factors(modes: tuple[Mode, ...], lmax: int) -> NDArray[np.float64]:
    """Return the factors of all modes, shape (mode, lmax + 1)."""
    return np.stack([bin_factor(mode, lmax) for mode in modes])


def first_ells(layout: Layout) -> NDArray[np.int64]:
    """Return the first ell of every bin of the summary."""
    return np.arange(0, layout.lmax + 1, layout.bin_width)


def binned(layout: Layout, values: NDArray, power: int = 1) -> NDArray:
    """Return the mean of factor * A over the existing coefficients of each bin, shape (..., mode, bin).

    With ``power`` 2 the values are variances of coefficients, independent from ell to ell; return that of the mean.
    """
    scaled = _factors(layout.modes, layout.lmax) ** power * values
    exists = np.isfinite(scaled)
    total = np.add.reduceat(np.where(exists, scaled, 0.0), first_ells(layout), axis=-1)
    count = np.add.reduceat(exists, first_ells(layout), axis=-1, dtype=np.int64)
    return np.divide(total, count**power, out=np.full_like(total, np.nan), where=count > 0)


def reduce_rows(layout: Layout, rows: Mapping[str, NDArray], first: int) -> Sums | None:
    """Reduce consecutive realizations, arrays as stored with ``done``, to statistics, by the tree of their indices.

    ``first``, the index of the first row, is a multiple of the smallest power of two not below the number of rows.
    """

    def node(row: int) -> Sums | None:
        if not rows["done"][row]:
            return None
        values = {name: array[row] for name, array in rows.items() if name != "done"}
        if layout.paired:
            for name in ("biposh", "cl"):
                values[f"{name}_difference"] = values[name] - values[f"{name}_circular"]
        bins = {f"{name}_binned": binned(layout, values[name]) for name in values if name.startswith("biposh")}
        return streaming.leaf(values | bins, covariance_of=tuple(bins))

    return streaming.tree(node, len(rows["done"]))


_MEANING = {
    "": "",
    "_circular": " of the circular-beam control",
    "_difference": ", non-circular minus circular-beam control",
}


def dataset(layout: Layout, sums: Sums, attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return the summary as a dataset: ``{variable}_{mean, standard_error, standard_deviation}``, raw and binned.

    The provenance among the store's ``attributes`` is copied into the summary.

    Binned spectra are means over bins of ``bin_factor * A``; their covariance is that of single realizations, over the
    bins of one mode.
    """
    variables: dict[str, tuple[Sequence[str], NDArray, dict[str, str]]] = {}
    for name in sums.mean:
        raw = name.removesuffix("_binned")
        kind = raw.removeprefix("biposh").removeprefix("cl")
        last = "ell" if raw == name else "bin"
        dims = ("pair", last) if raw.startswith("cl") else ("pair", "mode", last)
        meaning = ("power spectrum" if raw.startswith("cl") else "BipoSH coefficients") + _MEANING[kind]
        if raw != name:
            meaning = f"l(l+1)/2pi A, mean over the bin, {meaning}"
        deviation = streaming.standard_deviation(sums, name)
        for suffix, array, text in (
            ("mean", sums.mean[name], "mean"),
            ("standard_error", deviation / np.sqrt(sums.count), "standard error of the mean"),
            ("standard_deviation", deviation, "standard deviation of one realization"),
        ):
            variables[f"{name}_{suffix}"] = (dims, array, {"units": "uK^2", "long_name": f"{meaning}: {text}"})
        if name in sums.comoment:
            text = f"{meaning}: covariance of one realization between bins"
            array = streaming.covariance(sums, name)
            variables[f"{name}_covariance"] = ((*dims, "bin_2"), array, {"units": "uK^4", "long_name": text})
    own = {"units": "1", "long_name": "factor from raw coefficients to binned ones"}
    variables["bin_factor"] = (("mode", "ell"), _factors(layout.modes, layout.lmax).copy(), own)
    variables["count"] = ((), np.array(sums.count), {"units": "1", "long_name": "number of realizations"})
    first = first_ells(layout)
    final = np.append(first[1:] - 1, layout.lmax)
    coordinates = {k: v for k, v in layout.coordinates().items() if k not in ("realization", "map_name")}
    for name, dim, values, text in (
        ("bin", "bin", (first + final) / 2.0, "middle of the bin in ell"),
        ("bin_2", "bin_2", (first + final) / 2.0, "the other bin of a covariance"),
        ("bin_first", "bin", first, "first ell of the bin"),
        ("bin_last", "bin", final, "last ell of the bin"),
    ):
        coordinates[name] = (dim, values, {"units": "1", "long_name": text})
    origin = {name: attributes[name] for name in ("digest", "conventions", "packages")}
    run = {"name": attributes["configuration"]["name"], "frame": frame_of(attributes["configuration"])}
    normalisation = "Hajian-Souradeep; binned: see bin_factor"
    return xr.Dataset(variables, coordinates, {**run, **origin, "normalisation": normalisation})
