"""Plan of a run: its realizations, chunks, attributes and cost."""

import os
import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mcsim import config
from mcsim.bipolar import Mode, estimate, estimator, modes
from mcsim.bipolar.modes import CONVENTION, NORMALISATION
from mcsim.ensemble import repair, store
from mcsim.ensemble.layout import Layout, listed
from mcsim.errors import InputError, RunError
from mcsim.instrument.scan import read_moments
from mcsim.instrument.scan.accumulate import SECONDS_PER_SAMPLE
from mcsim.simulation import differencing, noise, offsets, power, skies
from mcsim.simulation import survey as survey_
from mcsim.simulation.channels import check_beams, check_effects, check_scans, load_beam, refuse_external, scan_model
from mcsim.simulation.filtering import Bands, probes_of
from mcsim.simulation.preparation import preparation
from mcsim.simulation.survey import Survey
from mcsim.simulation.timestream import LEVEL_DRAWS
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rng, spectra
from mcsim.sphere.mask import read_mask
from mcsim.sphere.sky import gaussian_alm
from mcsim.support.code import version
from mcsim.support.folders import real_path, user_path
from mcsim.support.numbers import duration
from mcsim.support.progress import reporting

SOLUTION, NEAR = 100.0, 0.7
"""Transforms that a solution of the inverse covariance takes, about, and the share of them with a near one known."""

BASE, COMMAND = 3e8, 4.2e8
"""Memory in bytes of a worker and of the process that drives it without what they calculate, about."""

SUMMING = 8
"""Statistics that each of them holds besides those of the tree of sums: results on their way, and copies of them."""

DRAWING = 24
"""Fisher matrices of a pair that are held at once, about, while they are estimated from random maps by two threads."""

CHUNKS = 128
CHUNK_BYTES = 1 << 26

CONVENTIONS = {
    "temperature": "uK_CMB",
    "alm": "healpy m-major order, analysis divided by the pixel window",
    "psi": "rotation of the beam about its axis, from e_theta (south) towards e_phi (east)",
    "beam": "b_lm of the beam at the pole, b_l0 = sqrt((2l+1)/4pi) B_l, B_0 = 1; x axis = spin axis x boresight",
    "sample": "T(n, psi) = sum_s e^{-i s psi} S_s(n), S_s = sum_lm k_l a_lm b_ls sY_lm(n), k_l = sqrt(4pi/(2l+1)), "
    "b_{l,-s} = (-1)^s conj(b_ls); hit average: w_s = <e^{-i s psi}> in place of e^{-i s psi}",
    "biposh": CONVENTION,
    "modes": "M >= 0, both parities of l1 + l2 + L; one map: 0 <= d <= L but d = 0 of odd L; a pair: -L <= d <= L",
    "normalisation": NORMALISATION,
    "weights": "maps times weights of unit mean square, spectra over the mean product of the two weights",
}
_NUMERIC = ("numpy", "healpy", "ducc0", "numba", "scipy")  #: packages that a realization's bits depend on
_PACKAGES = ("mcsim", "numpy", "healpy", "ducc0", "numba", "scipy", "dask", "distributed", "zarr", "xarray")


def wanted(run: config.RunConfig, part: slice | None) -> range:
    """Return the realizations to compute: all, or a slice ``A:B`` of them, which must lie within the ensemble."""
    total = run.ensemble.realizations
    if part is None:
        return range(total)
    ends = [end for end in (part.start, part.stop) if end is not None] if isinstance(part, slice) else [None]
    if not all(isinstance(end, int | np.integer) for end in ends) or part.step not in (None, 1):
        raise InputError(f"realizations = {part!r} is no slice of consecutive ones; give slice(A, B).")
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


def target(run: config.RunConfig, part: slice | None, path: str | Path | None) -> Path:
    """Return the store of a run; of one behind a link, lock, log and scratch files belong beside the store itself."""
    return real_path(user_path(path) if path is not None else default_store(run, part))


def check_store(path: Path, run: config.RunConfig, resume: bool) -> bool:
    """Return True if a run goes on with a store at ``path``, False if it starts one; InputError if it can do neither.

    ``resume``: a store is required, and its attributes may be lost.
    """
    if not exists(path):
        if resume:
            raise InputError(f"There is no store {path} to resume; leave out --resume to start it.")
        return False
    (check_summarised if resume and store.headless(path) else check_same)(path, run)
    return True


def finished(path: Path, run: config.RunConfig, realizations: range) -> bool:
    """Return True if a store of this configuration has all these realizations and their summary."""
    done, (count, bins) = store.done(path), store.summarised(path)
    binned = bins == list(range(0, config.analysis_lmax(run) + 1, run.biposh.summary_bin))
    return realizations.stop <= len(done) and bool(done[realizations].all()) and count == done.sum() and binned


def layout(survey: Survey) -> Layout:
    """Return the layout of a new store."""
    return _layout(survey.config, survey.pair_names, survey.estimator.modes)


def _layout(run: config.RunConfig, pairs: tuple[str, ...], modes: tuple[Mode, ...]) -> Layout:
    """Return a layout of about 128 chunks, unless one would exceed 64 MiB; the tree of sums needs a power of two."""
    lmax, paired = config.analysis_lmax(run), run.ensemble.paired
    nside, frame = config.prepared_grid(run)
    kept_npix = 12 * nside**2 if run.ensemble.keep_maps else None
    more: dict[str, Any] = {"frame": frame, "bin_width": run.biposh.summary_bin, "filtered": run.biposh.filtered}
    bare = Layout(run.ensemble.realizations, 1, config.map_names(run), pairs, modes, lmax, paired, kept_npix, **more)
    chunk = run.compute.chunk or 1
    if run.compute.chunk is not None:
        while chunk // 2 >= bare.realizations:
            chunk //= 2
    else:
        while chunk * CHUNKS < bare.realizations and 2 * chunk * bare.realization_bytes() <= CHUNK_BYTES:
            chunk *= 2
    return replace(bare, chunk=chunk)


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
    """Raise InputError, with the keys that differ, unless a store has this configuration and its variables."""
    if changes := _changes(store.attributes(path), attributes(run)):
        check_effects(run)  # a file of effects that is broken is another configuration too, and says more
        raise InputError(
            f"{path} was made with another configuration ({'; '.join(changes)}); "
            "choose another store with -o, or restore the values."
        )


def check_summarised(path: Path, run: config.RunConfig) -> None:
    """Raise InputError unless a store whose attributes are lost is of this configuration, as its summary says."""
    theirs, own = store.origin(path), attributes(run)
    kept = (store.keeps_maps(path), run.ensemble.keep_maps)
    for key, before, after in (
        ("hash", theirs["digest"], own["digest"]),
        ("ensemble.keep_maps", *kept),
        ("version of mcsim", *(a["packages"]["mcsim"] for a in (theirs, own))),
    ):
        if before != after:
            raise InputError(
                f"{path} has lost its attributes, and its summary is of another configuration ({key}: {before} -> "
                f"{after}); give the one that it was made with."
            )


def mixed(path: Path, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the attributes of a store say of realizations of other packages that join it, and warn of these.

    ``other_packages``: the versions beside those in ``packages``, by name; nothing if there are none.
    """
    known = {name: [*versions] for name, versions in old.get("other_packages", {}).items()}
    joining = {name: [own] for name, own in new["packages"].items()}
    for name, versions in new.get("other_packages", {}).items():
        joining[name] = [*joining[name], *versions]
    others = {}
    for name in _NUMERIC:
        each = [one for one in (*known.get(name, ()), *joining[name]) if one != old["packages"][name]]
        if each:
            others[name] = list(dict.fromkeys(each))
    if others == known:
        return {}
    told = ", ".join(f"{name} {' and '.join(own)} beside {old['packages'][name]}" for name, own in others.items())
    warnings.warn(f"{path} has realizations of different packages ({told}): their last bits may differ.", stacklevel=3)
    return {"other_packages": others}


def check_mergeable(path: Path, first: Mapping[str, Any], other: Path, second: Mapping[str, Any]) -> None:
    """Raise InputError if stores have different configurations."""
    if changes := _changes(first, second):
        raise InputError(f"{other} and {path} differ ({'; '.join(changes)}); merge slices of one configuration.")


def _changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the differences that keep two stores from being one ensemble: science, kept maps, mcsim's version."""
    changes = config.differences(old["science"], new["science"])
    # The bins of the summary, which earlier versions counted as science, may differ.
    changes = [change for change in changes if not change.startswith("biposh.summary_bin: ")]
    # Those of filtered maps count, under a name of their own.
    changes = [change.replace("biposh.bin: ", "biposh.summary_bin: ") for change in changes]
    for key, before, after in (
        ("ensemble.keep_maps", *(a["configuration"]["ensemble"]["keep_maps"] for a in (old, new))),
        ("version of mcsim", *(a["packages"]["mcsim"] for a in (old, new))),
    ):
        if before != after:
            changes.append(f"{key}: {before} -> {after}")
    return changes


@dataclass(frozen=True)
class Cost:
    """Cost of a run: layout of its store, memory of a worker in bytes, processor time of a realization in seconds.

    ``parts``: what a part of the run adds, or what is known of its noise, in words.
    """

    layout: Layout
    memory: float
    each_s: float
    parts: tuple[tuple[str, str], ...]
    once_s: float = 0.0  #: processor time of what all realizations share
    driver: float = COMMAND  #: memory of the process that drives the workers, in bytes

    def lines(self, number: int, workers: int) -> list[str]:
        """Return lines on memory, parts and time for a number of realizations."""
        total_s, plural = number * self.each_s + self.once_s, "s" if workers > 1 else ""
        return [
            f"  memory  {self.memory / 1e9:.2f} GB per worker, {workers} worker{plural}; about "
            f"{self.driver / 1e9:.1f} GB of the command itself",
            *(f"  {part:<7} {words}" for part, words in self.parts),
            f"  time    {duration(self.each_s)} per realization and core, {duration(total_s)} of processor time,"
            f" {duration(total_s / workers)} with {workers} worker{plural} on as many idle cores",
        ]


def describe(
    source: str | Path,
    part: slice | None = None,
    workers: int | None = None,
    path: str | Path | None = None,
    resume: bool = False,
) -> str:
    """Return a text on the cost of a run: realizations, tasks, memory, disk, files and time.

    Of a store that is there, at ``path`` or where the run would make it, what it holds is said, and the cost of the
    rest; with ``resume`` each of its files is read first. What the run would refuse is refused.
    """
    run = config.load(source)
    refuse_external(run)
    realizations = wanted(run, part)
    place = target(run, part, path)
    there = check_store(place, run, resume)
    if path is not None:
        store.check_writable(place)
    config.check_skies(run, realizations)
    check_beams(run)
    check_scans(run)
    check_effects(run)
    _check_files(run)
    _check_preparation(run)
    found = with_scans(cost(run), run)
    missing, held, chunk = list(realizations), list[str](), found.layout.chunk
    if there:
        missing, held = _missing(place, run, realizations, resume)
        with suppress(RunError):  # of one whose parts are made anew
            chunk = store.chunk(place)
    tasks = len({r // chunk for r in missing})
    first = f"{run.name}: {len(missing)} realizations in {tasks} tasks"
    if not missing:
        return "\n".join([first, *held])
    memory, *rest = found.lines(len(missing), workers or run.compute.workers)
    disk = float(found.layout.realization_bytes()) * len(missing)
    return "\n".join(
        [first, *held, memory, f"  disk    {disk / 1e6:.1f} MB in about {found.layout.files()} files", *rest]
    )


def _missing(path: Path, run: config.RunConfig, realizations: range, resume: bool) -> tuple[list[int], list[str]]:
    """Return the realizations that a run on a store there would compute, and lines on what the store holds."""
    if store.headless(path):
        words = "has lost its attributes; they are made again first, and what else is damaged is not known before"
        return list(realizations), [f"  store   {path} {words}"]
    verdict = repair.verify(path) if resume else None
    lines = [] if verdict is None else [f"  damaged {name}, made again ({why})" for name, why in verdict.broken.items()]
    if verdict is not None and "done" in verdict.broken:
        words = "does not say which realizations it holds; that is repaired first, and fewer may have to be computed"
        return list(realizations), [f"  store   {path} {words}", *lines]
    done, lost = store.done(path), () if verdict is None else verdict.lost
    if lost:
        lines.insert(0, f"  damaged {listed(lost)}, computed again")
    missing = [r for r in realizations if r >= len(done) or not done[r] or r in lost]
    words = f"{path} holds {len(realizations) - len(missing)} of {len(realizations)}"
    if finished(path, run, realizations):
        if verdict is None:
            store.check_whole(path)
        words += "" if lines else ", and their summary: nothing is left to do"
    elif not missing:
        words += "; their summary is made anew"
    return missing, [f"  store   {words}", *lines]


def _check_files(run: config.RunConfig) -> None:
    """Raise InputError, as the run itself would, for masks, moments or a first sky that cannot be used."""
    skies.given(run, 0)
    nside, frame = config.prepared_grid(run)
    for m in run.each_map:
        channel, mask = m.channel, m.channel.mask or run.map.mask
        if mask is not None:
            weight = read_mask(config.channel_path(mask, channel.name, m.split), nside, frame, run.map.mask_frame)
            if not weight.any():
                raise InputError(f"the mask of map {m.name} leaves no pixel; widen it.")
        if isinstance(channel.scan, config.ScanMoments):
            path = config.channel_path(channel.scan.path, channel.name, m.split)
            read_moments(path, run.map.resolution, load_beam(channel, run.sky.lmax).mmax, run.map.frame)


def _check_preparation(run: config.RunConfig) -> None:
    """Raise InputError, as the run itself would, for steps that cannot be applied to what the scans observe."""
    if run.preparation:
        with reporting("orientation moments", 1.0, "") as report:
            power.check(survey_.survey(run, os.cpu_count() or 1, report))


def cost(run: config.RunConfig) -> Cost:
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
    planned = _layout(run, ("",) * pairs, modes(run.biposh.L_max, both and len(names) > 1))
    splits = len(run.map.splits) or 1
    transform, estimation = _timed(nside, run.sky.lmax, lmax, run.biposh.L_max)
    transforms = sum(1.0 + 2.0 * m + splits * (2.0 + 4.0 * run.biposh.iterations) for m in mmax)
    if run.map.grid == "gl":
        transforms = sum(2.0 * m for m in mmax)
    memory, driver = _memory(run, planned, nside, max(mmax)), COMMAND + SUMMING * planned.statistics_bytes()
    parts = []
    if run.preparation:
        steps = [preparation(run, *one) for one in run.each_map]
        extra = (1 + run.ensemble.paired) * sum(each.transforms for each in steps if each is not None)
        transforms, memory = transforms + extra, memory + 480.0 * nside**2
        grid = f"nside {nside} to {config.prepared_grid(run)[0]}"
        words = f"{extra:g} further transforms per realization and {480e-9 * nside**2:.2g} GB per worker, {grid}"
        if not run.biposh.filtered:  # the filter knows what was subtracted and masked
            parts.append(("prepare", words))
    order = run.map.offset_order or 0
    if order > 1:
        spread = [channel for channel in run.channels if not isinstance(channel.scan, config.ScanParallelTransport)]
        extra = len(spread) * offsets.transforms(order)
        transforms += extra
        words = f"{extra} further transforms per realization for powers of the samples' offsets up to {order}"
        parts.append(("offsets", words))
    if run.biposh.filtered:
        solutions = len(names) * (1.0 + NEAR * run.ensemble.paired)
        transforms += SOLUTION * solutions
        autos = [True] * len(names) + [False] * (pairs - len(names))
        bands = {auto: Bands(planned.modes, lmax, run.biposh.summary_bin, auto) for auto in autos}
        probes = probes_of([*bands.values()], run.biposh.probes)
        once_s = probes * (SOLUTION * len(names) * transform + pairs * probes * estimation)
        matrices = [8.0 * bands[auto].size ** 2 for auto in autos]
        memory += 2.0 * (sum(matrices) + max(matrices))
        driver = max(driver, COMMAND + sum(matrices) + 2.0 * max(matrices))
        words = (
            f"about {SOLUTION * solutions:.0f} further transforms per realization; once, {probes} random maps of each "
            f"map, {duration(once_s)} of processor time and {1e-9 * DRAWING * max(matrices):.2g} GB more of the "
            "command (none if the noise is uniform on the full sky, and nothing was fitted and subtracted)"
        )
        parts.append(("filter", words))
    parts += [("noise", line) for line in noise.in_words(run)]
    estimates = pairs * (2 if run.ensemble.paired else 1)
    each_s = transform * transforms + estimation * estimates + differencing.seconds(run) + noise.seconds(run)
    return Cost(planned, memory, each_s, tuple(parts), driver=driver)


def _memory(run: config.RunConfig, planned: Layout, nside: int, mmax: int) -> float:
    """Return the memory of a worker in bytes: maps, a chunk as computed and as written, and the tree of sums."""
    splits, order = len(run.map.each_split), max(run.map.offset_order or 1, 1)
    # Channels that share a scan share its moments: hits, offsets with the products of higher orders, and w_s.
    scans = {
        repr(one.scan) if isinstance(one.scan, config.ScanHitAveraged) else one.name
        for one in run.channels
        if not isinstance(one.scan, config.ScanParallelTransport)
    }
    maps = 3 * len(planned.maps) + len(scans) * splits * (2 * mmax + (order + 1) * (order + 2) // 2)
    maps += 6 + 2 * mmax + (4 + splits if order > 1 else 0)
    alms = 6 + 2 * len(planned.maps)
    leaves = max(planned.chunk, planned.realizations / 16)
    sums = planned.statistics_bytes() * (np.ceil(np.log2(leaves)) + SUMMING)
    values = 2.0 * planned.chunk * planned.realization_bytes() + sums
    return float(BASE + 96.0 * nside**2 * maps + 16.0 * alm_.size(run.sky.lmax) * alms + values)


def with_scans(found: Cost, run: config.RunConfig) -> Cost:
    """Return a cost with the passes over the samples of scan models that come before the first realization."""
    passes: dict[str, tuple[float, float]] = {}  # by what the cache keeps: samples, processor seconds
    for spec, split in run.each_map if run.map.grid == "healpix" else ():
        if isinstance(chosen := spec.scan, config.ScanHitAveraged | config.ScanDifferencing):
            model = scan_model(spec, chosen, split)
            low, high = run.map.span(run.map.each_split.index(split))
            pair = chosen.pair if isinstance(chosen, config.ScanDifferencing) else None
            lines = model.select() if pair is None else model.pair(pair)
            number = (high - low) * sum(map(model.samples, lines))
            each_s = SECONDS_PER_SAMPLE if pair is None else differencing.SECONDS_OF_PAIRS
            passes[repr((model, lines, low, high))] = number, number * each_s
    samples, once_s = (sum(column) for column in zip((0.0, 0.0), *passes.values(), strict=True))
    once_s += (1.0 + LEVEL_DRAWS) * noise.seconds(run)
    words = f"{samples:.3g} samples, once, {duration(once_s)} of processor time (none if the cache has what they give)"
    return replace(found, once_s=once_s, parts=(("scan", words), *found.parts)) if samples else found


def _timed(nside: int, lmax_sky: int, lmax: int, L_max: int) -> tuple[float, float]:
    """Return the processor seconds of one spin-0 synthesis and of one estimate of all coefficients, on one thread."""
    alm = gaussian_alm(np.ones(lmax_sky + 1), rng.generator(0, 0, "timing"))
    tables, cut = estimator(L_max, lmax), alm_.resize(alm, lmax_sky, lmax)
    estimate(estimator(L_max, min(lmax, L_max + 2)), alm_.resize(alm, lmax_sky, min(lmax, L_max + 2)))  # compiles it
    start = time.thread_time()
    healpix.synthesis(alm[None], nside, lmax_sky)
    middle = time.thread_time()
    estimate(tables, cut)
    return middle - start, time.thread_time() - middle
