"""Binned spectra as tables: for the terminal, to ECSV and from ECSV."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from astropy.table import Table

from mcsim.errors import InputError

NEGLIGIBLE = 1e-6
"""Fraction of its error below which a predicted value counts as zero."""

ROWS = 40
"""Number of bins of a prediction that are shown."""


class Bin(NamedTuple):
    """One binned value, uK^2, with its error."""

    pair: str
    mode: str
    first: int
    last: int
    value: complex
    error: float


def strongest(summary: xr.Dataset, kind: str, count: int) -> list[Bin]:
    """Return the most significant bin of each of the ``count`` most significant spectra with L > 0.

    ``kind``: "" for the plain mean, "_difference" for that to the circular-beam control.
    """
    mean = summary[f"biposh{kind}_binned_mean"].where(summary["L"] > 0)
    error = summary[f"biposh{kind}_binned_standard_error"]
    z = (abs(mean) / error.where(error > 0)).fillna(0.0)
    best = z.max("bin").stack(spectrum=("pair", "mode"))
    order = np.argsort(-best.values)[:count]
    found = []
    for pair, mode in best["spectrum"].values[order[best.values[order] > 0]]:
        place = int(z.sel(pair=pair, mode=mode).argmax("bin"))
        found.append(_bins(summary, kind, pair, mode)[place])
    return found


def _bins(summary: xr.Dataset, kind: str, pair: str, mode: str) -> list[Bin]:
    one = summary.sel(pair=pair, mode=mode)
    columns = ("bin_first", "bin_last", f"biposh{kind}_binned_mean", f"biposh{kind}_binned_standard_error")
    rows = zip(*(one[name].values for name in columns), strict=True)
    return [Bin(str(pair), str(mode), int(a), int(b), complex(value), float(e)) for a, b, value, e in rows]


def lines(rows: list[Bin]) -> list[str]:
    """Return the rows as lines for a terminal."""
    return [
        f"    {row.pair}  {row.mode:8s} {f'l = {row.first}-{row.last}':14s} {row.value:.4g} uK^2, "
        f"{abs(row.value) / row.error:.1f} sigma"
        for row in rows
    ]


def table(summary: xr.Dataset) -> Table:
    """Return binned spectra as a table: pair, L, M, d, ell_min, ell_max, value, value_imag, error, in uK^2.

    ``value`` and ``value_imag`` are the real and imaginary part of the plain mean, ``error`` its standard error. For
    paired ensembles those of the difference to the circular-beam control follow. The header has units, scaling and
    normalisation.
    """
    kinds = [kind for kind in ("", "_difference") if f"biposh{kind}_binned_mean" in summary]
    rows = []
    for pair in summary["pair"].values:
        for mode in summary["mode"].values:
            one = summary.sel(pair=pair, mode=mode)
            columns = []
            for kind in kinds:
                mean = one[f"biposh{kind}_binned_mean"].values
                columns += [mean.real, mean.imag, one[f"biposh{kind}_binned_standard_error"].values]
            label = (str(pair), int(one["L"]), int(one["M"]), int(one["d"]))
            bounds = zip(one["bin_first"].values, one["bin_last"].values, *columns, strict=True)
            rows += [(*label, int(a), int(b), *values) for a, b, *values in bounds if np.isfinite(values[0])]
    measured = [f"{name}{kind}" for kind in kinds for name in ("value", "value_imag", "error")]
    result = Table(rows=rows, names=["pair", "L", "M", "d", "ell_min", "ell_max", *measured])
    for name in measured:
        result[name].unit = "uK2"
    origin = ("name", "frame", "digest", "prediction")
    result.meta |= {name: summary.attrs[name] for name in origin if name in summary.attrs}
    if "count" in summary:
        result.meta["realizations"] = int(summary["count"])
    result.meta["scaling"] = "l(l+1)/2pi A, mean over ell_min <= l2 <= ell_max"
    result.meta["normalisation"] = (
        "Bennett (WMAP) for even parity; Hajian-Souradeep times (-1)^l2 ((2 l1 + 1)(2 l2 + 1))^(-1/4) for odd parity"
    )
    return result


def describe_prediction(prediction: xr.Dataset, count: int = 8) -> str:
    """Return a text on a prediction: its order, its strongest binned spectra, and its signal to noise if present.

    ``count`` is the number of modes whose signal to noise is given.
    """
    attrs = prediction.attrs
    text = [f"{attrs['name']}: {attrs['prediction']}, f_sky = {attrs['f_sky']:.3g}, {attrs['frame']} frame"]
    text += _predicted(prediction)
    if "signal_to_noise" not in prediction:
        return "\n".join(text)
    total = float(prediction["signal_to_noise_total"])
    text.append(f"  signal to noise of one sky, all maps and modes jointly: {total:.4g}")
    if np.isinf(total):
        text.append("  (maps without noise see the same sky through different beams: nothing hides the beams)")
    each = prediction["signal_to_noise"].stack(spectrum=("pair", "mode")).fillna(0.0)
    strongest = float(each.max())
    for index in np.argsort(-each.values)[:count]:
        if each[index] <= 1e-6 * strongest:
            break
        pair, mode = each["spectrum"].values[index]
        bins = prediction["signal_to_noise_binned"].sel(pair=pair, mode=mode)
        place = int(bins.fillna(0.0).argmax("bin"))
        at = f"l = {int(bins['bin_first'][place])}-{int(bins['bin_last'][place])}"
        text.append(f"    {pair}  {mode:8s} {float(each[index]):8.3g}, most of it at {at} ({float(bins[place]):.3g})")
    return "\n".join(text)


def _predicted(prediction: xr.Dataset) -> list[str]:
    """Return lines for the bins of the strongest spectra, whole spectra if there is room."""
    text = ["  binned means in uK^2, errors of the mean of an isotropic ensemble:"]
    text.append(f"    {'pair':<16} {'mode':<9} {'l':<11} {'value':>22} {'error':>10}")
    best = strongest(prediction, "", count=prediction.sizes["mode"] * prediction.sizes["pair"])
    best = [row for row in best if abs(row.value) > NEGLIGIBLE * row.error]
    shown = max(1, ROWS // prediction.sizes["bin"])
    for spectrum in best[:shown]:
        for row in _bins(prediction, "", spectrum.pair, spectrum.mode):
            if np.isfinite(row.value):
                bounds = f"{row.first}-{row.last}"
                value = row.value if row.value.imag else row.value.real
                text.append(f"    {row.pair:<16} {row.mode:<9} {bounds:<11} {value:>22.4g} {row.error:>10.3g}")
    if not best:
        return ["  no spectrum with L > 0 differs from zero"]
    if len(best) > shown:
        text.append(f"    and {len(best) - shown} weaker spectra: write all with -o FILE.ecsv")
    return text


def write_prediction(prediction: xr.Dataset, output: str | Path) -> None:
    """Write a prediction as a Zarr group (``.zarr``), or its binned spectra as an ECSV table (``.ecsv``).

    Raises
    ------
    InputError
        For another file extension, an existing Zarr group, or an output that cannot be written.
    """
    target = Path(output)
    try:
        if target.suffix == ".zarr":
            if target.exists():
                raise InputError(f"{target} exists already; choose another output, or delete it.")
            with warnings.catch_warnings():
                # Zarr warns that its consolidated metadata and strings are not yet standard.
                warnings.simplefilter("ignore", category=UserWarning)
                prediction.to_zarr(target, zarr_format=3, consolidated=True)
        elif target.suffix == ".ecsv":
            table(prediction).write(target, format="ascii.ecsv", overwrite=True)
        else:
            raise InputError(f"{target} ends in {target.suffix or 'nothing'}; choose .zarr or .ecsv (table).")
    except OSError as error:
        raise InputError(f"{target} cannot be written ({error.strerror or error}); choose another file.") from error


def read_prediction(path: str | Path) -> xr.Dataset:
    """Read the binned spectra that :func:`write_prediction` wrote.

    Returns
    -------
    xarray.Dataset
        ``biposh{, _difference}_binned_{mean, standard_error}`` with the coordinates of a summary; the attribute
        ``prediction`` states the method. A Zarr group gives all predicted variables.

    Raises
    ------
    InputError
        For a file that is not a prediction.
    """
    source = Path(path)
    if not source.exists():
        raise InputError(f"{source} does not exist; give what mcsim predict -o wrote, or a configuration.")
    try:
        found = xr.open_zarr(source) if source.is_dir() else _from_table(source)
        if "biposh_binned_mean" not in found:
            raise KeyError("biposh_binned_mean")
        found = found.load()
    except Exception as error:  # libraries raise errors of any type for a foreign file
        raise InputError(
            f"{source} cannot be read as a prediction ({type(error).__name__}: {' '.join(str(error).split())}); give "
            "what mcsim predict -o wrote."
        ) from error
    return found.assign_attrs(prediction=found.attrs.get("prediction", f"from {source.name}"))


def _from_table(path: Path) -> xr.Dataset:
    from mcsim.bipolar import Mode  # the numerics, which load slowly

    rows = Table.read(path, format="ascii.ecsv")
    attributes = {key: str(value) for key, value in rows.meta.items()}
    frame = rows.to_pandas()
    every = [Mode(*key) for key in zip(frame.L, frame.M, frame.d, strict=True)]
    modes = {mode.name: mode for mode in every}
    frame["mode"] = [mode.name for mode in every]
    frame["bin"] = (frame.ell_min + frame.ell_max) / 2.0
    bounds = frame.groupby("bin")[["ell_min", "ell_max"]].first()
    each = frame.set_index(["pair", "mode", "bin"]).to_xarray()
    spectra = {}
    for kind in ("", "_difference"):
        if f"value{kind}" in each:
            spectra[f"biposh{kind}_binned_mean"] = each[f"value{kind}"] + 1j * each[f"value_imag{kind}"]
            spectra[f"biposh{kind}_binned_standard_error"] = each[f"error{kind}"]
    labels = [modes[str(name)] for name in each["mode"].values]
    coordinates: dict[str, tuple[str, object]] = {
        "bin_first": ("bin", bounds["ell_min"].to_numpy()),
        "bin_last": ("bin", bounds["ell_max"].to_numpy()),
        **{name: ("mode", [getattr(mode, name) for mode in labels]) for name in ("L", "M", "d", "parity")},
    }
    return xr.Dataset(spectra, attrs=attributes).assign_coords(coordinates)
