"""Text about a store, and export of its summary to other formats."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mcsim.ensemble import opening, store
from mcsim.ensemble.tables import lines, strongest, table
from mcsim.errors import InputError


def describe(path: str | Path) -> str:
    """Return a text about a store: configuration, progress, size, and the most significant spectra."""
    target = Path(path)
    attributes = store.attributes(target)
    done = store.done(target)
    files = [file for file in target.rglob("*") if file.is_file()]
    with opening.open_ensemble(target) as ensemble:
        sizes = dict(ensemble.sizes)
        pairs = [str(pair) for pair in ensemble["pair"].values]
        paired = "biposh_circular" in ensemble
    run, controls = attributes["configuration"], ", with circular-beam controls" if paired else ""
    found = [
        f"{target}: {run['name']}, {int(done.sum())} of {done.size} realizations finished",
        f"  maps      {_grid(run['map'])}, {run['map']['frame']} frame, lmax {sizes['ell'] - 1}",
        f"  seed      {run['ensemble']['seed']}",
        f"  pairs     {'; '.join(pairs)}",
        f"  modes     {sizes['mode']}, L <= {run['biposh']['L_max']}{controls}",
        f"  size      {sum(file.stat().st_size for file in files) / 1e6:.1f} MB in {len(files)} files",
        f"  digest    {attributes['digest']}",
        f"  made with {', '.join(f'{name} {number}' for name, number in attributes['packages'].items())}",
    ]
    if (target / "summary").is_dir():
        with opening.open_summary(target) as summary:
            rows = strongest(summary, "_difference" if paired else "", count=5)
            found += ["  strongest binned spectra (mean over error):", *lines(rows)] if rows else []
    return "\n".join(found)


def _grid(section: dict[str, Any]) -> str:
    return "rings without pixels" if section.get("grid") == "gl" else f"nside {section['nside']}"


def export(path: str | Path, output: str | Path) -> None:
    """Write the summary of a store as NetCDF (``.nc``) or its binned spectra as an ECSV table (``.ecsv``).

    Raises
    ------
    InputError
        For another file extension, or an output that cannot be written.
    """
    target = Path(output)
    with opening.open_summary(path) as stored:
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
    """Split complex variables into pairs ``_re``, ``_im``, which NetCDF can hold."""
    parts = {}
    for name, variable in summary.data_vars.items():
        if np.iscomplexobj(variable):
            parts[f"{name}_re"], parts[f"{name}_im"] = variable.real, variable.imag
            parts[f"{name}_re"].attrs, parts[f"{name}_im"].attrs = variable.attrs, variable.attrs
        else:
            parts[str(name)] = variable.astype("int32") if variable.dtype == np.int64 else variable
    # NetCDF has no nested attributes: they are stored as text.
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
