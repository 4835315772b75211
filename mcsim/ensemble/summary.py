"""Summary of an ensemble: means, errors and binned spectra with their covariance."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import Mode
from mcsim.bipolar.modes import bin_factor
from mcsim.config.preparation import frame_of
from mcsim.ensemble.layout import Layout
from mcsim.stats import streaming
from mcsim.stats.streaming import Sums
from mcsim.stats.wishart import inverse_variance
from mcsim.support.arrays import divided

FACTOR = (
    "l(l+1)/2pi times sqrt(2 L + 1) / (sqrt((2 l1 + 1)(2 l2 + 1)) C^{L0}_{l1 0 l2 0}), Bennett's; of odd parity times "
    "(-1)^l2 ((2 l1 + 1)(2 l2 + 1))^(-1/4)"
)

if TYPE_CHECKING:
    import xarray as xr

QML, SCORE = "biposh_qml", "biposh_qml_score"
"""Start of the names of quadratic maximum-likelihood estimates, and of what is normalised to give them."""

REAL = "_real"  #: end of the names of real parts of bins, of which errors alone are told


@lru_cache(maxsize=2)
def _factors(modes: tuple[Mode, ...], lmax: int) -> NDArray[np.float64]:
    """Return the factors of all modes, shape (mode, lmax + 1)."""
    return np.stack([bin_factor(mode, lmax) for mode in modes])


def binned(layout: Layout, values: NDArray) -> NDArray:
    """Return the mean of factor * A over the existing coefficients of each bin, shape (..., mode, bin)."""
    scaled = _factors(layout.modes, layout.lmax) * values
    total, count = _sums(layout, scaled)
    return divided(total, count, np.nan)


def binned_covariance(layout: Layout, shifted: Sequence[NDArray]) -> NDArray:
    """Return the covariance of :func:`binned` between bins, shape (..., mode, bin, bin), NaN where one is empty.

    ``shifted`` are the variances of coefficients, and their covariances with those n = 1, 2, ... degrees above, up to
    the sign that the factors take out; each of shape (..., mode, lmax + 1).
    """
    size = np.abs(_factors(layout.modes, layout.lmax))
    place = np.arange(layout.lmax + 1) // layout.bin_width
    count = _sums(layout, size * shifted[0])[1]
    total = np.zeros(2 * count.shape[-1:] + count.shape[:-1])
    for n, covariance in enumerate(shifted):
        lower, upper = slice(None, layout.lmax + 1 - n), slice(n, None)
        products = np.nan_to_num(size[..., lower] * size[..., upper] * covariance[..., lower])
        np.add.at(total, (place[lower], place[upper]), np.moveaxis(products, -1, 0))
        if n:
            np.add.at(total, (place[upper], place[lower]), np.moveaxis(products, -1, 0))
    # Of maps without noise and odd L only round-off of either sign remains.
    each = np.arange(count.shape[-1])
    total[each, each] = np.maximum(total[each, each], 0.0)
    found = np.moveaxis(total, (0, 1), (-2, -1))
    return divided(found, count[..., :, None] * count[..., None, :], np.nan)


def _sums(layout: Layout, values: NDArray) -> tuple[NDArray, NDArray]:
    """Return the sums of the finite values of each bin, and how many there are, shape (..., bin)."""
    exists = np.isfinite(values)
    total = np.add.reduceat(np.where(exists, values, 0.0), layout.first_ells(), axis=-1)
    return total, np.add.reduceat(exists, layout.first_ells(), axis=-1, dtype=np.int64)


def reduce_rows(layout: Layout, rows: Mapping[str, NDArray]) -> Sums | None:
    """Reduce consecutive realizations, arrays as stored with ``done``, to statistics, by the tree of their indices.

    The index of the first row is a multiple of the smallest power of two not below the number of rows.
    """

    def node(row: int) -> Sums | None:
        if not rows["done"][row]:
            return None
        values = {name: array[row] for name, array in rows.items() if name != "done"}
        if layout.paired:
            for name in [name for name in ("biposh", "cl", QML, SCORE) if name in values]:
                values[f"{name}_difference"] = values[name] - values[f"{name}_circular"]
        wide = [name for name in values if name.startswith("biposh") and not name.startswith(QML)]
        bins = {f"{name}_binned": binned(layout, values[name]) for name in wide}
        parts = {f"{name}{REAL}": each.real for name, each in bins.items()}
        estimates = [name for name in values if name.startswith(QML) and not name.startswith(SCORE)]
        return streaming.leaf(values | bins | parts, covariance_of=(*bins, *estimates))

    return streaming.tree(node, len(rows["done"]))


def of_normalisation(layout: Layout, sums: Sums, probes: int, kind: str) -> NDArray[np.float64]:
    """Return the error of the mean of filtered estimates that all realizations share, (pair, mode, bin).

    It is that of the estimate of F by random probes, uK^2: zero without probes, or in stores that do not have the
    scores F alpha. ``kind``: "", "_circular" or "_difference".

    Notes
    -----
    The variances of numbers for one isotropic sky, the diagonal of F^-1, are those of the controls over realizations,
    or, without controls, of the estimates themselves. Plain means, and those of controls, hold the power of the sky and
    the mean field, so that this error of theirs is far larger than that of their difference.
    """
    found = np.zeros(sums.mean[f"{QML}{kind}"].shape)
    if not probes or f"{SCORE}{kind}" not in sums.mean:
        return found
    parts = np.where([mode.M > 0 for mode in layout.modes], 2, 1)[:, None]
    isotropic = f"{QML}_circular" if layout.paired else QML
    variances = streaming.standard_deviation(sums, isotropic) ** 2
    for row, label, numbers, score, variance in zip(
        found, layout.pairs, sums.mean[f"{QML}{kind}"], sums.mean[f"{SCORE}{kind}"], variances, strict=True
    ):
        x, _, y = label.partition(",")
        size = int(np.sum(parts * np.isfinite(numbers)))
        total = float(np.nansum((numbers * score.conj()).real))
        pairs = probes * (probes - 1) / (2.0 if x == y else 1.0)
        row[:] = np.sqrt(inverse_variance(variance, np.abs(numbers) ** 2, total, size, pairs))
    return found


def _errors_of_parts(
    layout: Layout, sums: Sums, name: str, error: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the errors of the means of real and imaginary parts of bins, whose squares add up to that of the modulus.

    Where sums do not have them, as those of predictions, the parts of a mode with M > 0 share it equally.
    """
    if not name.endswith("_binned"):
        return {}
    if f"{name}{REAL}" in sums.mean:
        real = streaming.standard_deviation(sums, f"{name}{REAL}") / np.sqrt(sums.count)
    else:
        share = [np.sqrt(0.5) if mode.M > 0 else float(mode.parity == "even") for mode in layout.modes]
        real = np.array(share)[:, None] * error
    return {"real": real, "imaginary": np.sqrt(np.maximum(error**2 - real**2, 0.0))}


_MEANING = {
    "": "",
    "_circular": " of the circular-beam control",
    "_difference": ", non-circular minus circular-beam control",
}


def dataset(layout: Layout, sums: Sums, attributes: Mapping[str, Any]) -> "xr.Dataset":
    """Return the summary as a dataset: ``{variable}_{mean, standard_error, standard_deviation}``, raw and binned.

    The provenance among the store's ``attributes`` is copied into the summary.

    Binned spectra are means over bins of ``bin_factor * A``; their covariance is that of single realizations, over the
    bins of one mode.
    """
    import xarray as xr  # here: workers start an eighth faster without it

    variables: dict[str, tuple[Sequence[str], NDArray, dict[str, str]]] = {}
    for name in [name for name in sums.mean if not (name.startswith(SCORE) or name.endswith(REAL))]:
        raw = name.removesuffix("_binned")
        kind = raw.removeprefix(QML).removeprefix("biposh").removeprefix("cl")
        last = "ell" if raw == name and not raw.startswith(QML) else "bin"
        dims = ("pair", last) if raw.startswith("cl") else ("pair", "mode", last)
        meaning = ("power spectrum" if raw.startswith("cl") else "BipoSH coefficients") + _MEANING[kind]
        if raw.startswith(QML):
            meaning = f"quadratic maximum-likelihood l(l+1)/2pi A, by bin, {meaning}"
        elif raw != name:
            meaning = f"l(l+1)/2pi A, mean over the bin, {meaning}"
        deviation = streaming.standard_deviation(sums, name)
        both = "" if raw.startswith("cl") else " of a complex number, sqrt(re^2 + im^2)"
        error, of_mean = deviation / np.sqrt(sums.count), f"standard error of the mean{both}"
        if raw.startswith(QML):
            error = np.hypot(error, of_normalisation(layout, sums, attributes.get("probes", 0), kind))
            of_mean += ", that of the normalisation by random probes included"
        for suffix, array, text in (
            ("mean", sums.mean[name], "mean"),
            ("standard_error", error, of_mean),
            ("standard_deviation", deviation, f"standard deviation of one realization{both}"),
        ):
            variables[f"{name}_{suffix}"] = (dims, array, {"units": "uK^2", "long_name": f"{meaning}: {text}"})
        for part, array in _errors_of_parts(layout, sums, name, error).items():
            text = f"{meaning}: standard error of the mean of its {part} part"
            variables[f"{name}_standard_error_{part[:4]}"] = (dims, array, {"units": "uK^2", "long_name": text})
        if name in sums.comoment:
            text = f"{meaning}: covariance of one realization between bins"
            array = streaming.covariance(sums, name)
            variables[f"{name}_covariance"] = ((*dims, "bin_2"), array, {"units": "uK^4", "long_name": text})
    own = {"units": "1", "long_name": f"factor from raw coefficients to binned ones: {FACTOR}"}
    variables["bin_factor"] = (("mode", "ell"), _factors(layout.modes, layout.lmax).copy(), own)
    variables["count"] = ((), np.array(sums.count), {"units": "1", "long_name": "number of realizations"})
    coordinates = {k: v for k, v in layout.coordinates().items() if k not in ("realization", "map_name")}
    for name, dim, values, text in (
        ("bin", "bin", layout.middles(), "middle of the bin in ell"),
        ("bin_2", "bin_2", layout.middles(), "the other bin of a covariance"),
        ("bin_first", "bin", layout.first_ells(), "first ell of the bin"),
        ("bin_last", "bin", layout.last_ells(), "last ell of the bin"),
    ):
        coordinates[name] = (dim, values, {"units": "1", "long_name": text})
    origin = {name: attributes[name] for name in ("digest", "conventions", "packages")}
    run = {"name": attributes["configuration"]["name"], "frame": frame_of(attributes["configuration"])}
    normalisation = "Hajian-Souradeep; binned: see bin_factor"
    return xr.Dataset(variables, coordinates, {**run, **origin, "normalisation": normalisation})
