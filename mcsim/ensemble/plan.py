"""Plan of a run: its realizations, chunks, attributes and cost."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mcsim import config
from mcsim.bipolar import Mode, estimate, estimator, modes
from mcsim.bipolar.dataset import CONVENTION, NORMALISATION
from mcsim.config.preparation import frame_of
from mcsim.ensemble import opening, store, summary
from mcsim.ensemble.layout import Layout
from mcsim.errors import InputError
from mcsim.simulation import differencing
from mcsim.simulation.channels import check_effects, load_beam
from mcsim.simulation.preparation import preparation
from mcsim.simulation.survey import Survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng, spectra
from mcsim.sphere.sky import gaussian_alm

CHUNKS = 128
CHUNK_BYTES = 1 << 26

CONVENTIONS = {
    "temperature": "uK_CMB",
    "alm": "healpy m-major order, analysis divided by the pixel window",
    "psi": "rotation of the beam about its axis, from e_theta (south) towards e_phi (east)",
    "beam": "b_lm of the beam at the pole, b_l0 = sqrt((2l+1)/4pi) B_l, B_0 = 1; x axis = spin axis x boresight",
    "biposh": CONVENTION,
    "normalisation": NORMALISATION,
    "weights": "maps times weights of unit mean square, spectra over the mean product of the two weights",
}
_PACKAGES = ("mcsim", "numpy", "healpy", "ducc0", "numba", "scipy", "dask", "distributed", "zarr", "xarray")


def wanted(run: config.RunConfig, part: slice | None) -> range:
    """Return the realizations to compute: all, or a slice ``A:B`` of them.

    Raises
    ------
    InputError
        If the slice is empty or reaches beyond the ensemble.
    """
    total = run.ensemble.realizations
    if part is None:
        return range(total)
    start, stop = part.start or 0, total if part.stop is None else part.stop
    if not 0 <= start < stop <= total:
        raise InputError(
            f"The slice {start}:{stop} of realizations is not within 0:{total} (ensemble.realizations); choose A < B."
        )
    return range(start, stop)


def default_store(run: config.RunConfig, part: slice | None) -> Path:
    """Return ``{name}.zarr`` in the working folder, or ``{name}.{A}-{B}.zarr`` for a slice of an ensemble."""
    if part is None:
        return Path(f"{run.name}.zarr")
    realizations = wanted(run, part)
    return Path(f"{run.name}.{realizations.start}-{realizations.stop}.zarr")


def exists(path: Path) -> bool:
    """Return True if ``path`` exists; raise InputError for an invalid name."""
    try:
        return path.exists()
    except OSError as error:
        raise InputError(
            f"{str(path)[:60]}... cannot be a store ({error.strerror}); give a shorter path with -o."
        ) from error


def layout(survey: Survey) -> Layout:
    """Return the layout of a new store."""
    run = survey.config
    bare = Layout(
        run.ensemble.realizations,
        1,
        survey.map_names,
        survey.pair_names,
        survey.estimator.modes,
        survey.lmax,
        run.ensemble.paired,
        12 * survey.nside**2 if run.ensemble.keep_maps else None,
        frame=survey.frame,
    )
    return _chunked(bare, run.compute.chunk)


def _chunked(bare: Layout, chunk: int | None) -> Layout:
    """Return the layout with a chunk size: about 128 chunks, unless a chunk would exceed 64 MiB.

    The tree of sums needs a power of two.
    """
    if chunk is not None:
        while chunk // 2 >= bare.realizations:
            chunk //= 2
    else:
        chunk = 1
        while chunk * CHUNKS < bare.realizations and 2 * chunk * bare.realization_bytes() <= CHUNK_BYTES:
            chunk *= 2
    return replace(bare, chunk=chunk)


def recipe(survey: Survey) -> summary.Recipe:
    """Return the recipe of the summary."""
    run = survey.config
    return summary.Recipe(
        survey.pair_names, survey.estimator.modes, survey.lmax, run.biposh.summary_bin, run.ensemble.paired
    )


def attributes(run: config.RunConfig) -> dict[str, Any]:
    """Return the attributes of a store: configuration (what defines the result), hash, conventions, versions."""
    resolved = config.resolved(run)
    del resolved["compute"]
    return {
        "configuration": resolved,
        "science": config.science(run),
        "digest": config.digest(run),
        "conventions": CONVENTIONS,
        "side_b": differencing.sides(run),
        "packages": {name: version(name) for name in _PACKAGES},
    }


def check_same(path: Path, run: config.RunConfig) -> None:
    """Raise InputError unless a store has this configuration and its variables.

    Raises
    ------
    InputError
        With the keys that differ.
    """
    found = store.attributes(path)
    changes = _changes(found, attributes(run))
    if changes:
        raise InputError(
            f"{path} was made with another configuration ({'; '.join(changes)}); "
            "choose another store with -o, or restore the values."
        )


def check_mergeable(path: Path, first: Mapping[str, Any], other: Path, second: Mapping[str, Any]) -> None:
    """Raise InputError if stores have different configurations."""
    changes = _changes(first, second)
    if changes:
        raise InputError(f"{other} and {path} differ ({'; '.join(changes)}); merge slices of one configuration.")


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the differences that keep two stores from being one ensemble: science, kept maps, mcsim's version."""
    changes = [change for change in config.differences(old["science"], new["science"]) if not _of_summary(change)]
    for key, before, after in (
        ("ensemble.keep_maps", *(a["configuration"]["ensemble"]["keep_maps"] for a in (old, new))),
        ("version of mcsim", *(a["packages"]["mcsim"] for a in (old, new))),
    ):
        if before != after:
            changes.append(f"{key}: {before} -> {after}")
    return changes


def _of_summary(change: str) -> bool:
    """Return True for a difference of the summary alone, whose bins earlier versions counted as science."""
    return change.startswith("biposh.summary_bin: ")


def stored(path: Path, realizations: int) -> tuple[Layout, summary.Recipe]:
    """Return the layout and recipe of an existing store, with another number of realizations."""
    with opening.open_ensemble(path) as found:
        attrs = found.attrs["configuration"]
        pairs = tuple(str(pair) for pair in found["pair"].values)
        kept = found.sizes.get("pixel")
        maps = tuple(str(name) for name in found["map_name"].values) if kept else ()
        lmax, paired = found.sizes["ell"] - 1, "biposh_circular" in found
        stored_modes = tuple(
            Mode(int(L), int(M), int(d)) for L, M, d in zip(found["L"], found["M"], found["d"], strict=True)
        )
    layout = Layout(
        realizations, store.chunk(path), maps, pairs, stored_modes, lmax, paired, kept, frame=frame_of(attrs)
    )
    return layout, summary.Recipe(pairs, stored_modes, lmax, attrs["biposh"]["summary_bin"], paired)


def describe(source: str | Path, part: slice | None = None, workers: int | None = None) -> str:
    """Return a text on the cost of a run: realizations, tasks, memory, disk, files and time."""
    run = config.load(source)
    check_effects(run)
    planned = cost(run, wanted(run, part))
    count = workers or run.compute.workers
    hours = planned.realizations * planned.seconds_per_realization / 3600.0
    return "\n".join(
        [
            f"{run.name}: {planned.realizations} realizations in {planned.tasks} tasks",
            f"  memory  {planned.worker_bytes / 1e9:.2f} GB per worker, {count} workers",
            f"  disk    {planned.store_bytes / 1e6:.1f} MB in about {planned.files} files",
            *([f"  prepare {planned.preparation}"] if planned.preparation else []),
            f"  time    {planned.seconds_per_realization:.3g} s per realization and core, {hours:.3g} core-hours,"
            f" {60.0 * hours / count:.3g} minutes with {count} workers on as many idle cores",
        ]
    )


@dataclass(frozen=True)
class Cost:
    """Cost of a run: realizations, tasks, worker memory, disk, files and processor time; of preparing, in words."""

    realizations: int
    tasks: int
    worker_bytes: float
    store_bytes: float
    files: int
    seconds_per_realization: float
    preparation: str = ""


def cost(run: config.RunConfig, realizations: range) -> Cost:
    """Estimate the cost of a run from its sizes, its beams, and one timed transform."""
    if run.sky.spectrum is not None:
        spectra.load(run.sky.spectrum, run.sky.lmax)
    mmax = [load_beam(channel, run.sky.lmax).mmax for channel in run.channels]
    lmax = config.analysis_lmax(run)
    # A grid of rings costs about as much as HEALPix with as many rings.
    nside = run.map.resolution or 1 + 3 * run.sky.lmax // 10
    names = config.map_names(run)
    both = run.biposh.pairs == "all"
    pairs = len(names) * (len(names) + 1) // 2 if both else len(names)
    found = modes(run.biposh.L_max, both and len(names) > 1)
    npix, kept = 12 * nside**2, 12 * config.prepared_grid(run)[0] ** 2
    bare = Layout(
        run.ensemble.realizations, 1, names, ("",) * pairs, found, lmax, run.ensemble.paired,
        kept if run.ensemble.keep_maps else None,
    )  # fmt: skip
    planned = _chunked(bare, run.compute.chunk)
    splits = len(run.map.splits) or 1
    transform, estimation = _timed(nside, run.sky.lmax, lmax, run.biposh.L_max)
    transforms = sum(1.0 + 2.0 * m + splits * (2.0 + 4.0 * run.biposh.iterations) for m in mmax)
    if run.map.grid == "gl":
        transforms = sum(2.0 * m for m in mmax)
    extra = splits * (1 + run.ensemble.paired) * sum(_transforms(run, channel) for channel in run.channels)
    estimates = pairs * (2 if run.ensemble.paired else 1)
    largest = max(mmax)
    memory = 3e8 + 8.0 * npix * (6 + 2 * largest) + 16.0 * alm_.size(run.sky.lmax) * (6 + len(names) * 2)
    memory += planned.chunk * planned.realization_bytes() + (40.0 * npix if run.preparation else 0.0)
    grid = f"nside {nside} to {config.prepared_grid(run)[0]}"
    words = f"{extra:g} further transforms per realization and {40e-9 * npix:.2g} GB per worker, {grid}"
    return Cost(
        len(realizations),
        -(-len(realizations) // planned.chunk),
        memory,
        float(planned.realization_bytes()) * len(realizations),
        planned.files(),
        transform * (transforms + extra) + estimation * estimates + differencing.seconds(run),
        words if run.preparation else "",
    )


def _transforms(run: config.RunConfig, channel: config.Channel) -> int:
    """Return the number of transforms that prepare a map of a channel."""
    steps = preparation(run, channel, run.map.splits[0] if run.map.splits else None)
    return 0 if steps is None else sum(step.transforms for step in steps.steps)


def _timed(nside: int, lmax_sky: int, lmax: int, L_max: int) -> tuple[float, float]:
    """Return the seconds of one spin-0 synthesis and of one estimate of all coefficients, on one thread."""
    alm = gaussian_alm(np.ones(lmax_sky + 1), rng.generator(0, 0, "timing"))
    tables, cut = estimator(L_max, lmax), alm_.resize(alm, lmax_sky, lmax)
    estimate(estimator(L_max, min(lmax, L_max + 2)), alm_.resize(alm, lmax_sky, min(lmax, L_max + 2)))  # compiles it
    start = time.perf_counter()
    healpix.synthesis(alm[None], nside, lmax_sky)
    middle = time.perf_counter()
    estimate(tables, cut)
    return middle - start, time.perf_counter() - middle
