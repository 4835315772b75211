"""What a store holds, in words, and its summary in other formats."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from astropy.table import Table

from mcsim.ensemble import store
from mcsim.errors import InputError


def describe(path: str | Path) -> str:
    """Text about a store: configuration, progress, size, and the most significant spectra."""
    target = Path(path)
    attributes = store.attributes(target)
    done = store.done(target)
    files = [file for file in target.rglob("*") if file.is_file()]
    with store.open_ensemble(target) as ensemble:
        sizes = dict(ensemble.sizes)
        pairs = [str(pair) for pair in ensemble["pair"].values]
        paired = "biposh_circular" in ensemble
    run = attributes["configuration"]
    lines = [
        f"{target}: {run['name']}, {int(done.sum())} of {done.size} realizations finished",
        f"  maps      {_grid(run['map'])}, {run['map']['frame']} frame, lmax {sizes['ell'] - 1}",
        f"  seed      {run['ensemble']['seed']}",
        f"  pairs     {'; '.join(pairs)}",
        f"  modes     {sizes['mode']}, L <= {run['biposh']['L_max']}{', with circular twins' if paired else ''}",
        f"  size      {sum(file.stat().st_size for file in files) / 1e6:.1f} MB in {len(files)} files",
        f"  digest    {attributes['digest']}",
        f"  made with {', '.join(f'{name} {number}' for name, number in attributes['packages'].items())}",
    ]
    if (target / "summary").is_dir():
        with store.open_summary(target) as summary:
            strongest = _strongest(summary, paired)
            lines += ["  strongest binned spectra (mean over error):", *strongest] if strongest else []
    return "\n".join(lines)


def _grid(section: dict[str, Any]) -> str:
    return "rings without pixels" if section.get("grid") == "gl" else f"nside {section['nside']}"


def _strongest(summary: xr.Dataset, paired: bool, count: int = 5) -> list[str]:
    name = "biposh_difference_binned" if paired else "biposh_binned"
    mean = summary[f"{name}_mean"].where(summary["L"] > 0)
    error = summary[f"{name}_standard_error"]
    z = (abs(mean) / error.where(error > 0)).fillna(0.0)
    strongest = z.max("bin").stack(spectrum=("pair", "mode"))
    order = np.argsort(-strongest.values)[:count]
    found = []
    for index in order[strongest.values[order] > 0]:
        pair, mode = strongest["spectrum"].values[index]
        place = int(z.sel(pair=pair, mode=mode).argmax("bin"))
        value = complex(mean.sel(pair=pair, mode=mode)[place].values)
        at = f"l = {int(summary['bin_first'][place])}-{int(summary['bin_last'][place])}"
        found.append(f"    {pair}  {mode:8s} {at:14s} {value:.4g} uK^2, {float(strongest[index]):.1f} sigma")
    return found


def export(path: str | Path, output: str | Path) -> None:
    """Write the summary of a store as NetCDF (``.nc``) or its binned spectra as an ECSV table (``.ecsv``).

    Raises
    ------
    InputError
        For another ending, or an output that cannot be written.
    """
    target = Path(output)
    with store.open_summary(path) as stored:
        summary = stored.load()
        try:
            if target.suffix == ".nc":
                _real(summary).to_netcdf(target, engine="scipy")
            elif target.suffix == ".ecsv":
                table(summary).write(target, format="ascii.ecsv", overwrite=True)
            else:
                raise InputError(
                    f"{target} ends in {target.suffix or 'nothing'}; choose .nc (NetCDF) or .ecsv (table)."
                )
        except OSError as error:
            raise InputError(f"{target} cannot be written ({error.strerror or error}); choose another file.") from error


def _real(summary: xr.Dataset) -> xr.Dataset:
    """Complex variables as pairs ``_re``, ``_im``, which NetCDF can hold."""
    parts = {}
    for name, variable in summary.data_vars.items():
        if np.iscomplexobj(variable):
            parts[f"{name}_re"], parts[f"{name}_im"] = variable.real, variable.imag
            parts[f"{name}_re"].attrs, parts[f"{name}_im"].attrs = variable.attrs, variable.attrs
        else:
            parts[str(name)] = variable.astype("int32") if variable.dtype == np.int64 else variable
    # NetCDF has no nested attributes: they go in as text.
    attributes = {name: value if isinstance(value, str) else json.dumps(value) for name, value in summary.attrs.items()}
    real = xr.Dataset(parts, attrs=attributes)
    for name, coordinate in real.coords.items():
        if coordinate.dtype == np.int64:
            real = real.assign_coords({name: coordinate.astype("int32")})
        elif coordinate.dtype.kind in "OT":
            real = real.assign_coords(
                {name: (coordinate.dims, np.array([str(label) for label in coordinate.values]), coordinate.attrs)}
            )
    return real


def table(summary: xr.Dataset) -> Table:
    """Binned spectra as a table: pair, L, M, d, ell_min, ell_max, value, value_imag, error, in uK^2.

    ``value`` and ``value_imag`` are real and imaginary part of the plain mean, ``error`` its standard error; for paired
    ensembles those of the difference to the circular twin follow. Units, scaling and normalisation are in the header.
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
    result.meta |= {name: summary.attrs[name] for name in ("name", "frame", "digest") if name in summary.attrs}
    if "count" in summary:
        result.meta["realizations"] = int(summary["count"])
    result.meta["scaling"] = "l(l+1)/2pi A, mean over ell_min <= l2 <= ell_max"
    result.meta["normalisation"] = (
        "Bennett (WMAP) for even parity; Hajian-Souradeep times (-1)^l2 ((2 l1 + 1)(2 l2 + 1))^(-1/4) for odd parity"
    )
    return result
