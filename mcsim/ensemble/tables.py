"""Binned spectra as tables: the most significant ones, to files and from files."""

import json
import os
import warnings
from pathlib import Path
from statistics import NormalDist
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import xarray as xr
from astropy.io.fits.verify import VerifyWarning
from astropy.table import Table

from mcsim.ensemble.datasets import write_dataset
from mcsim.errors import InputError
from mcsim.support.folders import unreadable, unwritable, user_path, writable

ENDINGS = (".zarr", ".nc", ".ecsv")  #: of files of summaries and predictions: Zarr, NetCDF, a table of bins
TABLES = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits"}  #: astropy's formats of tables by ending

DEFINITION = {
    "scaling": "l(l+1)/2pi A, mean over ell_min <= l2 <= ell_max",
    "normalisation": "Bennett (WMAP) for even parity; Hajian-Souradeep times (-1)^l2 ((2 l1 + 1)(2 l2 + 1))^(-1/4) for "
    "odd parity",
}
"""What the header of a table of binned spectra says of its numbers."""


def spectra(summary: xr.Dataset, kind: str) -> pd.DataFrame:
    """Return the bins of all spectra with L > 0: pair, mode, bin_first, bin_last, value and error in uK^2, sigma.

    ``kind``: "" for the plain mean, "_difference" for that to the circular-beam control. ``sigma`` is |value| / error;
    of a mean of realizations (``count``) the normal deviate that is as improbable without a mean.
    """
    names = {f"biposh{kind}_binned_mean": "value", f"biposh{kind}_binned_standard_error": "error"}
    chosen = summary[list(names)].isel(mode=np.flatnonzero(summary["L"] > 0)).rename(names)
    rows = chosen.to_dataframe(dim_order=["pair", "mode", "bin"]).reset_index()
    ratio = (rows["value"].abs() / rows["error"].where(rows["error"] > 0)).fillna(0.0)
    if "count" in summary:
        from mcsim.stats.look_elsewhere import deviates_of_means  # the numerics, which load slowly

        return rows.assign(sigma=deviates_of_means(ratio.to_numpy(), rows["M"].to_numpy() > 0, int(summary["count"])))
    return rows.assign(sigma=ratio)


def strongest(summary: xr.Dataset, kind: str) -> pd.DataFrame:
    """Return the most significant bin of each spectrum that differs from zero, the most significant first."""
    rows = spectra(summary, kind)
    best = rows.loc[rows.groupby(["pair", "mode"])["sigma"].idxmax()]
    return best[best["sigma"] > 0.0].sort_values("sigma", ascending=False, kind="stable")


def detected(summary: xr.Dataset, kind: str, pair: str, level: float = 1e-3) -> list[str]:
    """Return the modes of a pair with a bin that is significant at a level for all bins, the strongest first."""
    rows = spectra(summary, kind)
    needed = -NormalDist().inv_cdf(0.5 * level / max(int((rows["sigma"] > 0.0).sum()), 1))
    best = strongest(summary, kind)
    return best[(best["pair"] == pair) & (best["sigma"] > needed)]["mode"].to_list()


def table(summary: xr.Dataset) -> Table:
    """Return binned spectra as a table: pair, L, M, d, ell_min, ell_max, value, value_imag, error and so on, in uK^2.

    ``value`` and ``value_imag`` are the real and imaginary part of the plain mean, ``error`` its standard error, and
    ``error_real`` and ``error_imag`` those of the parts, whose squares add up to its own. For
    paired ensembles those of the difference to the circular-beam control follow. The header has units, scaling and
    normalisation.
    """
    columns: dict[str, xr.DataArray] = {}
    for kind in ("", "_difference"):
        if f"biposh{kind}_binned_mean" in summary:
            mean = summary[f"biposh{kind}_binned_mean"]
            columns |= {f"value{kind}": mean.real, f"value_imag{kind}": mean.imag}
            columns[f"error{kind}"] = summary[f"biposh{kind}_binned_standard_error"]
            for part in ("real", "imag"):
                if (name := f"biposh{kind}_binned_standard_error_{part}") in summary:
                    columns[f"error_{part}{kind}"] = summary[name]
    rows = xr.Dataset(columns).to_dataframe(dim_order=["pair", "mode", "bin"]).reset_index()
    rows = rows[np.isfinite(rows["value"])].rename(columns={"bin_first": "ell_min", "bin_last": "ell_max"})
    result = Table({"pair": rows["pair"].to_numpy(dtype=str)})
    for name in ("L", "M", "d", "ell_min", "ell_max", *columns):
        result[name] = rows[name].to_numpy()
    for name in columns:
        result[name].unit = "uK2"
    origin = ("name", "frame", "digest", "prediction")
    result.meta |= {name: summary.attrs[name] for name in origin if name in summary.attrs}
    if "count" in summary:
        result.meta["realizations"] = int(summary["count"])
    if "biposh_qml_mean" in summary:
        result.meta["filter"] = "inverse_covariance"
    if "ell" in summary.sizes:
        result.meta["lmax"] = summary.sizes["ell"] - 1
    result.meta |= DEFINITION
    return result


def check_output(output: str | Path) -> None:
    """Raise InputError unless :func:`write` can write a file of this name, and knows the kind that it asks for."""
    ending = Path(output).suffix
    if ending not in (*ENDINGS, *TABLES):
        raise InputError(
            f"{output} ends in {ending or 'nothing'}; choose .zarr, .nc (NetCDF), or .ecsv, .fits or .csv (table of "
            "bins; mcsim reads .ecsv again)."
        )
    target = user_path(output)
    if target.exists():
        raise InputError(f"{target} exists already; choose another output, or delete it.")
    writable(target.absolute().parent)


def write(summary: xr.Dataset, output: str | Path) -> None:
    """Write a summary or a prediction as Zarr (``.zarr``) or NetCDF (``.nc``), or its binned spectra as a table.

    A table is ``.ecsv``, ``.fits``, or ``.csv``, which has no header of units and normalisation. What is named
    ``output`` is complete, or is not there.
    """
    check_output(output)
    target = user_path(output)
    with unwritable(target, "choose another file"):
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
            scratch = Path(folder) / target.name
            _write(summary, scratch)
            os.replace(scratch, target)


def _write(summary: xr.Dataset, target: Path) -> None:
    if target.suffix == ".zarr":
        write_dataset(summary, target)
    elif target.suffix == ".nc":
        _for_netcdf(summary).to_netcdf(target, engine="scipy")
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category=VerifyWarning)  # names in the header are longer than eight letters
            table(summary).write(target, format=TABLES[target.suffix])


def _for_netcdf(summary: xr.Dataset) -> xr.Dataset:
    """Return what NetCDF can hold: complex variables in pairs ``_re``, ``_im``, short integers, nested attributes."""
    parts: dict[str, xr.DataArray] = {}
    for name, variable in summary.data_vars.items():
        if np.iscomplexobj(variable):
            parts |= {f"{name}_re": variable.real.assign_attrs(variable.attrs)}
            parts |= {f"{name}_im": variable.imag.assign_attrs(variable.attrs)}
        else:
            parts[str(name)] = variable
    attributes = {name: value if isinstance(value, str) else json.dumps(value) for name, value in summary.attrs.items()}
    result = xr.Dataset(parts, attrs=attributes)
    for name, old in list(result.variables.items()):
        if old.dtype == np.int64:
            result[name] = old.dims, old.values.astype("int32"), old.attrs
        elif old.dtype.kind in "OT":
            result[name] = old.dims, np.array(old.values.tolist()), old.attrs
    return result


def read_prediction(path: str | Path) -> xr.Dataset:
    """Read a prediction that :func:`write` wrote: of a table ``biposh{, _difference}_binned_{mean, standard_error}``.

    The coordinates are those of a summary; the attribute ``prediction`` states the method.
    """
    source = user_path(path)
    if not source.exists():
        raise InputError(f"{source} does not exist; give what mcsim predict -o wrote, or a configuration.")
    with unreadable(source, "a prediction", "give what mcsim predict -o wrote"):
        if source.is_dir():
            found = xr.open_zarr(source).load()
        else:
            found = _from_netcdf(source) if source.suffix == ".nc" else _from_table(source)
        if "biposh_binned_mean" not in found:
            raise KeyError("biposh_binned_mean")
    if "prediction" not in found.attrs and ("count" in found or "realizations" in found.attrs):
        raise InputError(f"{source} is the summary of a Monte Carlo, no prediction; give what mcsim predict -o wrote.")
    return found.assign_attrs(prediction=found.attrs.get("prediction", f"from {source.name}"))


def _from_netcdf(path: Path) -> xr.Dataset:
    """Read what :func:`_for_netcdf` made, with complex variables in one piece."""
    with xr.open_dataset(path, engine="scipy") as parts:
        found = parts.load()
    for name in [str(name)[:-3] for name in found.data_vars if str(name).endswith("_re")]:
        joined = found[f"{name}_re"] + 1j * found[f"{name}_im"]
        found = found.drop_vars([f"{name}_re", f"{name}_im"]).assign({name: joined})
    return found


def _from_table(path: Path) -> xr.Dataset:
    from mcsim.bipolar import Mode  # the numerics, which load slowly

    table = Table.read(path, format="ascii.ecsv")
    stated = DEFINITION | {"unit": "uK2"}
    found = {key: str(table.meta.get(key)) for key in DEFINITION} | {"unit": str(table["value"].unit)}
    for key in (one for one in stated if found[one] != stated[one]):
        raise InputError(
            f"{path} has {key} = {found[key]!r}, where a prediction has {stated[key]!r}; give what mcsim predict -o "
            "wrote."
        )
    rows = table.to_pandas().rename(columns={"ell_min": "bin_first", "ell_max": "bin_last"})
    modes = [Mode(*key) for key in zip(rows["L"], rows["M"], rows["d"], strict=True)]
    rows = rows.assign(mode=[mode.name for mode in modes], parity=[mode.parity for mode in modes])
    rows["bin"] = (rows["bin_first"] + rows["bin_last"]) / 2.0
    for kind in ("", "_difference"):
        if f"value{kind}" in rows:
            rows[f"biposh{kind}_binned_mean"] = rows[f"value{kind}"] + 1j * rows[f"value_imag{kind}"]
            rows[f"biposh{kind}_binned_standard_error"] = rows[f"error{kind}"]
    each = rows.set_index(["pair", "mode", "bin"]).to_xarray()
    spectra = each[[name for name in each.data_vars if str(name).startswith("biposh")]]
    for dim, names in (("mode", ["L", "M", "d", "parity"]), ("bin", ["bin_first", "bin_last"])):
        own = rows.groupby(dim)[names].first()
        spectra = spectra.assign_coords({name: (dim, own[name].tolist()) for name in names})
    return spectra.assign_attrs({key: str(value) for key, value in table.meta.items()})
