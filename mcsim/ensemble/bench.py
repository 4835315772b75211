"""Speed of mcsim on this machine, relative to the transforms that a realization needs."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from mcsim import config
from mcsim.ensemble import runner
from mcsim.instrument import scan
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import healpix, rng
from mcsim.sphere.sky import gaussian_alm


def bench(nside: int = 512, lmax: int = 1024, repeats: int = 5) -> Iterator[str]:
    """Measure transforms, a realization relative to them, workers and their memory, moments; yield lines of text.

    Transforms and realization are timed in ``repeats`` pairs; medians of the ratios are given.
    """
    _run(nside, lmax, 0.0, 1)  # refuses invalid sizes
    yield f"nside {nside}, lmax {lmax}, m_max 2, L_max 2, paired; one thread; medians of {repeats} interleaved pairs"
    yield from _realization(nside, lmax, repeats)
    yield from _workers(nside, lmax, 16 * repeats)
    yield _offsets(nside, lmax, repeats)
    yield _moments(nside)


def _realization(nside: int, lmax: int, repeats: int) -> Iterator[str]:
    alms = np.stack([gaussian_alm(np.ones(lmax + 1), rng.generator(0, 0, stage)) for stage in ("E", "B")])
    map_uk = np.random.default_rng(0).standard_normal(12 * nside**2)

    def transforms(scalars: int, analyses: int) -> None:
        for _ in range(scalars):
            healpix.synthesis(alms[:1], nside, lmax)
        healpix.synthesis(alms, nside, lmax, spin=2)
        for _ in range(analyses):
            healpix.analysis(map_uk, lmax)

    transforms(1, 1)
    yield (
        f"  spin-0 synthesis {_seconds(healpix.synthesis, alms[:1], nside, lmax):.3g} s, "
        f"spin-2 synthesis {_seconds(healpix.synthesis, alms, nside, lmax, 2):.3g} s, "
        f"analysis {_seconds(healpix.analysis, map_uk, lmax):.3g} s (ring weights: 1 adjoint synthesis)"
    )
    for label, sigma0_uk, scalars, analyses in (
        ("noise-free over spin-0 + spin-2 synthesis and 2 analyses", 0.0, 1, 2),
        ("noise-free over what it runs, a spin-2 synthesis and 1 analysis", 0.0, 0, 1),
        ("with noise over what it runs, spin-0 + spin-2 synthesis and 2 analyses", 10.0, 1, 2),
    ):
        shared = survey(_run(nside, lmax, sigma0_uk, 1))
        simulate.realize(shared, 0)
        bare, whole = np.array(
            [(_seconds(transforms, scalars, analyses), _seconds(simulate.realize, shared, r)) for r in range(repeats)]
        ).T
        yield f"  realization {label}: ratio {np.median(whole / bare):.2f}, {np.median(whole):.3g} s"


def _workers(nside: int, lmax: int, realizations: int) -> Iterator[str]:
    rates = []
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder, runner.local_client(workers) as client:
            warm = _run(nside, lmax, 0.0, 4 * workers)
            runner.run(warm, Path(folder) / "bench.zarr", workers=client)
            run = _run(nside, lmax, 0.0, 4 * workers + realizations)
            seconds = _seconds(runner.run, run, Path(folder) / "bench.zarr", workers=client)
            peak = max(client.run(_peak_bytes).values())
            rates.append(realizations / seconds)
        yield (
            f"  {workers} worker{'s' if workers > 1 else ''}: {rates[-1]:.3g} realizations/s "
            f"(start, store and summary included), peak memory of a worker {peak / 1e9:.2f} GB"
        )
    yield f"  2 workers over 1: {rates[1] / rates[0]:.2f}"


def _offsets(nside: int, lmax: int, repeats: int) -> str:
    """Return the time of a realization with powers of the samples' offsets over that with their mean alone."""
    draw, npix = np.random.default_rng(0), 12 * nside**2
    w = np.exp(1j * draw.uniform(0.0, 2.0 * np.pi, (2, npix)))
    offsets = draw.standard_normal((14, npix)) / nside
    moments = scan.Moments(nside, "ecliptic", np.ones(npix), w, offsets[0], offsets[1], offsets[2:] / nside)
    shared = survey(_run(nside, lmax, 0.0, 1))
    spread = []
    for order in (1, 2, 3, 4):
        own = tuple(replace(m, moments=moments.up_to_offsets(order)) for m in shared.channels[0].maps)
        spread.append(replace(shared, channels=(replace(shared.channels[0], maps=own),)))
        simulate.realize(spread[-1], 0)
    seconds = np.array([[_seconds(simulate.realize, one, r) for one in spread] for r in range(repeats)])
    ratios = ", ".join(f"{ratio:.2f}" for ratio in np.median(seconds[:, 1:] / seconds[:, :1], axis=0))
    return f"  realization with the samples' offsets up to power 2, 3 and 4 over one with their mean: ratio {ratios}"


def _moments(nside: int) -> str:
    model = scan.ScanModel.load("wmap")
    threads = min(2, os.cpu_count() or 1)
    part = (0.0, 0.05)
    scan.Moments.from_model(model, nside, 2, time_range=(0.0, 1e-5), nthreads=threads)
    seconds = _seconds(scan.Moments.from_model, model, nside, 2, time_range=part, nthreads=threads)
    samples = part[1] * sum(model.samples(line) for line in model.select())
    return f"  orientation moments, s <= 2: {samples / seconds / 1e6:.1f} million samples/s on {threads} threads"


def _peak_bytes() -> int:
    import resource

    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _run(nside: int, lmax: int, sigma0_uk: float, realizations: int) -> config.RunConfig:
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 13.9, "fwhm_minor_arcmin": 12.7, "m_max": 2}
    channel = {"name": "W1", "beam": beam, "scan": {"kind": "parallel_transport"}, "noise": {"sigma0_uk": sigma0_uk}}
    return config.load(
        {
            "schema": 1,
            "name": "bench",
            "sky": {"spectrum": "wmap7", "lmax": lmax},
            "map": {"nside": nside},
            "channel": [channel],
            "ensemble": {"realizations": realizations, "seed": 1},
            "compute": {"chunk": 1},
        }
    )


def _seconds(action: Callable[..., object], *args: object, **kwargs: object) -> float:
    start = time.perf_counter()
    action(*args, **kwargs)
    return time.perf_counter() - start
