"""Lazy opening of stored ensembles with xarray."""

import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from mcsim.bipolar import Mode
from mcsim.config.preparation import frame_of
from mcsim.ensemble import store
from mcsim.ensemble.layout import Layout
from mcsim.ensemble.lock import is_held
from mcsim.errors import InputError, RunError
from mcsim.support.folders import user_path

if TYPE_CHECKING:
    import xarray as xr

WAITS_S = (0.2, 1.0, 5.0)  #: before what a run replaces is looked for again


def open_ensemble(path: str | Path) -> "xr.Dataset":
    """Open the realizations of a store lazily.

    Parameters
    ----------
    path
        The store.

    Returns
    -------
    xarray.Dataset
        ``biposh``, ``cl``, their circular-beam controls, with kept maps ``observed_map`` (in stores of earlier versions
        ``map``), lazily; in memory ``done`` and the coordinates realization, pair, mode (with L, M, d, parity), ell.
        ``.sel(mode="L2M0d0")`` selects a spectrum, ``.where(ds.L == 2, drop=True)`` all of one L.

    Raises
    ------
    InputError
        If there is no store at ``path``.
    RunError
        If files of finished realizations are missing, which zarr would read as NaN, or the store is damaged.

    Examples
    --------
    >>> import mcsim
    >>> ensemble = mcsim.open_ensemble(mcsim.run("tiny", "tiny.zarr").store)
    >>> dict(ensemble.biposh.sel(mode="L2M0d0").sizes)
    {'realization': 32, 'pair': 1, 'ell': 33}
    """
    target = user_path(path)
    store.attributes(target)
    return _opened(target, None)


def open_summary(path: str | Path) -> "xr.Dataset":
    """Open the summary of a store: means, standard errors, standard deviations, binned spectra and covariances.

    Parameters
    ----------
    path
        The store.

    Returns
    -------
    xarray.Dataset
        ``biposh_mean``, ``_standard_error`` and ``_standard_deviation`` (of one realization), uK^2, shape (pair, mode,
        ell); ``cl_mean`` and so on (pair, ell); if the run is paired the same of ``biposh_circular``,
        ``biposh_difference``, ``cl_circular`` and ``cl_difference``. ``biposh_binned_mean`` and so on (pair, mode, bin)
        are means over a bin, ``bin_first`` to ``bin_last``, of the raw coefficients times ``bin_factor`` (mode, ell),
        which makes them l(l+1)/2pi A-hat, uK^2; ``biposh_binned_covariance`` (pair, mode, bin, bin_2) is that of one
        realization, uK^4. Errors and deviations of complex numbers are those of both parts together,
        sqrt(re^2 + im^2). A warning says that realizations are finished that it does not have.

    Raises
    ------
    InputError
        If there is no store at ``path``, or it has no summary yet.
    RunError
        If files of the summary are missing or damaged.

    Examples
    --------
    >>> import mcsim
    >>> summary = mcsim.open_summary(mcsim.run("tiny", "tiny.zarr").store)
    >>> spectra = summary.sel(mode="L2M0d0", pair="demo,demo", ell=slice(10, 30))
    >>> significance = abs(spectra.biposh_difference_mean) / spectra.biposh_difference_standard_error
    >>> bool((significance > 5.0).all())  # the beam makes a quadrupole
    True
    """
    target = user_path(path)
    store.attributes(target)
    if not (target / "summary").is_dir():
        raise InputError(
            f"{path} has no summary, because no run on it has ended yet; continue it with mcsim run --resume."
        )
    found = _opened(target, "summary")
    if (count := int(found["count"])) < store.size(target) and count < (finished := int(store.done(target).sum())):
        warnings.warn(
            f"the summary of {path} is of {count} realizations, and {finished} are finished since; mcsim run --resume "
            "makes it of all.",
            stacklevel=2,
        )
    return found


def _opened(path: Path, group: str | None) -> "xr.Dataset":
    """Open a group lazily, again where a run has just taken away what it replaces."""
    for wait_s in WAITS_S:
        try:
            return _found(path, group)
        except RunError:
            if not is_held(path):
                raise
            time.sleep(wait_s)
    return _found(path, group)


def _found(path: Path, group: str | None) -> "xr.Dataset":
    """Open a group lazily; load its coordinates and ``done``, by which xarray selects rows."""
    import xarray as xr  # here: workers start sooner without it

    store.check_whole(path, summary=group is not None)
    with store.faults_named(path):
        found = xr.open_zarr(path, group=group)
    read_in(found[[*({*found.coords, "done"} & {*found.variables})]], path)
    return found


def read_in(dataset: "xr.Dataset", path: str | Path) -> "xr.Dataset":
    """Read the values of what was opened lazily of the store at ``path``; RunError if its files are damaged."""
    with store.faults_named(Path(path)):
        return dataset.load()


def layout(path: Path, realizations: int) -> Layout:
    """Return the layout of an existing store, with another number of realizations."""
    with open_ensemble(path) as found:
        attrs = found.attrs["configuration"]
        kept = found.sizes.get("pixel")
        indices = zip(*(found[name].values.tolist() for name in ("L", "M", "d")), strict=True)
        return Layout(
            realizations,
            store.chunk(path),
            tuple(found["map_name"].values.tolist()) if kept else (),
            tuple(found["pair"].values.tolist()),
            tuple(Mode(*each) for each in indices),
            found.sizes["ell"] - 1,
            "biposh_circular" in found,
            kept,
            frame=frame_of(attrs),
            bin_width=attrs["biposh"]["summary_bin"],
            filtered="biposh_qml" in found,
        )
