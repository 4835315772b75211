"""What a dataset must say of its variables."""

import xarray as xr


def undescribed(dataset: xr.Dataset) -> list[str]:
    """Return the variables and coordinates without a long name or, of numbers, a unit; texts have no unit."""
    found = []
    for name, variable in dataset.variables.items():
        wanted = {"long_name"} | ({"units"} if variable.dtype.kind in "biufc" else set())
        found += [f"{name}: {key}" for key in sorted(wanted - {key for key, value in variable.attrs.items() if value})]
    return found
