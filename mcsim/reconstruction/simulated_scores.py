"""Scores of the grammar in maps of a model: of data, and of simulations of it."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from scipy.sparse import csr_matrix, diags

from mcsim import config
from mcsim.datavector.analysis import Analysis, Job, Kinds, analysis_for, simulated_maps
from mcsim.datavector.campaign import Ask, seeded
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import Model, wiener_filter
from mcsim.instrument.scan import MapGrid
from mcsim.instrument.scan.model import SECONDS_PER_DAY
from mcsim.reconstruction.forms import AddedToSamples
from mcsim.reconstruction.scores import ELONGATION, HARMONICS, MONTH, ORDERS, Scene, View, coarse
from mcsim.simulation.pixel_means import signal_of
from mcsim.simulation.tod import samples
from mcsim.support import folders
from mcsim.support.arrays import Map, Matrix, Vector, divided
from mcsim.support.code import package_digest
from mcsim.systematics import Pointing
from mcsim.systematics.spacecraft import axes

SIMULATIONS = 400
"""Of the model, for mean and covariance of the scores: as many realizations more, once for each model."""

SEED = 0x6D63 * 1_000 + 4  #: of these simulations; those of the data vector and of the controls have others

PER_TASK = 10

WAVES: dict[str, dict[str, Any]] = {
    **{f"spin {k}": {"wave": "spin", "harmonic": k} for k in range(1, ELONGATION + 1)},
    **{
        f"year {k}": {"wave": "year", "harmonic": k} for k in (*range(1, HARMONICS + 1), *range(MONTH[0], MONTH[1] + 1))
    },
    "trend": {"wave": "trend"},
    "Sun": {"wave": "Sun"},
}
"""What follows time, of two components each but for the trend, by name: class variables of a form."""

TAIL_DEG = 15.0  #: of the spin, after which the tail of a slow response has fallen by e
LAGS = {"-1/8": -0.125, "+1/8": 0.125, "-1/4": -0.25, "+1/4": 0.25, "1/2": 0.5}  #: turns of the spin after a sample
SAMPLES = 200_000  #: of a map, about, by which directions elsewhere are known

CODE = (
    *("config", "sphere", "instrument", "systematics", "simulation", "reconstruction.forms", "reconstruction.scores"),
    *(f"datavector.{name}" for name in ("analysis", "matched_filters", "wiener_filter")),
)
"""What scores of simulations are computed with."""


def scene_of(model: Model) -> Scene:
    """Return the maps of a model as the grammar needs them."""
    run = model.survey.config
    splits = run.map.splits or ("",)
    sites = [channel.site for channel in model.survey.channels]
    timed = run.map.split_by == "time" and all(site.pointing is not None for site in sites)
    pointed = [site.pointed("a wave").line for site in sites] if timed else []
    lines = tuple((line.boresight_angle_deg, line.azimuth_deg) for line in pointed)
    elsewhere = [directions(own, dict(zip(model.channels, lines, strict=True))) for own in lines]
    views = []
    for i, part in enumerate(model.parts):
        channel = model.survey.channels[part.channel]
        split = model.of(part.channel).index(i)
        waves: dict[str, tuple[Map, ...]] = {}
        for name, values in WAVES.items() if timed else ():
            acting = [_wave(*values.items(), component=c)(amplitude=1.0) for c in range(1 if name == "trend" else 2)]
            waves[name] = tuple(signal_of(one, channel.site, run.map.span(split)) for one in acting)
        kernel = channel.site.beam.blm[0, : model.lmax + 1].real
        measured = part.moments.w[: model.settings.beam_orders]
        moments = np.where(np.isfinite(measured), measured, 0.0)
        waves |= {f"orientation {s + 1}": (w.real, -w.imag) for s, w in enumerate(moments[:ORDERS])}
        grid = MapGrid(model.nside, model.frame, run.map.span(split))
        seen = _elsewhere(channel.site.pointed("elsewhere"), grid, elsewhere[part.channel]) if timed else {}
        response = model.response[part.channel]
        views.append(View(part.channel, split, moments, waves, seen, part.precision, response, kernel))
    return Scene(
        channels=model.channels,
        frequencies=tuple(channel.site.frequency_ghz for channel in model.survey.channels),
        splits=splits,
        frame=model.frame,
        nside=model.nside,
        lmax=model.lmax,
        dipole_uk=np.asarray(model.survey.channels[0].site.dipole_uk),
        cl=model.cl,
        sky_power=model.sky_power,
        split_orders=model.settings.split_beam_orders,
        views=tuple(views),
        elsewhere=tuple(elsewhere),
    )


def directions(own: tuple[float, float], lines: Mapping[str, tuple[float, float]]) -> dict[str, Matrix]:
    """Return unit vectors in the frame of a beam (its x and y, outward) with weights, shape (n, 4), by what is there.

    ``own`` and ``lines`` are boresight angle and azimuth, degrees: of the beam, and of other channels.
    """
    found = {f"line {name}": line for name, line in lines.items() if line != own}
    found |= {f"spin {name}": (own[0], own[1] + 360.0 * turns) for name, turns in LAGS.items()}
    taps = TAIL_DEG * -np.log(1.0 - (np.arange(16) + 0.5) / 16)
    outward, south, east = (one[:, 0] for one in axes(*np.deg2rad(own)[:, None]))
    frame = np.stack([east, -south, outward])

    def there(line: tuple[float, float], weight: float = 1.0) -> Vector:
        return np.append(frame @ axes(*np.deg2rad(line)[:, None])[0][:, 0], weight)

    seen = {name: there(line)[None] for name, line in found.items()}
    lag = [there((own[0], own[1] - one), 1.0 / len(taps)) for one in taps]
    return seen | {"opposite": np.array([[0.0, 0.0, -1.0, 1.0]]), "lag": np.array([*lag, [0.0, 0.0, 1.0, -1.0]])}


def _elsewhere(pointing: Pointing, grid: MapGrid, wanted: Mapping[str, Matrix]) -> dict[str, csr_matrix]:
    """Return the mean over the samples of every coarse pixel of what a map has in other directions."""
    period = pointing.model.duration_days * SECONDS_PER_DAY * np.ptp(grid.time_range) / SAMPLES
    model, line = pointing.model, pointing.line
    if period > model.period_of_samples(line):
        model, line = model.with_sampling(period), replace(line, sample_period_s=None)
    nside = coarse(grid.nside)
    total = {name: csr_matrix((12 * nside**2, 12 * nside**2)) for name in wanted}
    for chunk in samples(model, line, replace(grid, nside=nside)):
        outward, south, east = axes(chunk.theta, chunk.phi)
        x, y = (np.cos(a) * south + np.sin(a) * east for a in (chunk.psi, chunk.psi + 0.5 * np.pi))
        for name, (a, b, c, weight) in ((name, one) for name, rows in wanted.items() for one in rows):
            there = healpy.vec2pix(nside, *(a * x + b * y + c * outward))
            total[name] += csr_matrix((np.full(len(there), weight), (chunk.pixel, there)), total[name].shape)
    hits = total["opposite"].sum(axis=1).A1
    return {name: diags(divided(1.0, hits)) @ one for name, one in total.items()}


@lru_cache(maxsize=64)
def _wave(*values: tuple[str, Any], component: int) -> type[AddedToSamples]:
    """Return the effect with these class variables that adds one of its two components."""
    name = "_".join(["wave", *(str(value) for _, value in values), str(component)])
    own = {"__module__": __name__, "name": name, "coefficients": (1.0 - component, 0.0 + component), **dict(values)}
    return dataclass(frozen=True, kw_only=True)(type("Wave", (AddedToSamples,), own))


def scores_of_maps(model: Model, scene: Scene, maps: Sequence[Map]) -> Vector:
    """Return the scores of the grammar, shape (P,)."""
    filtered = wiener_filter(model, maps)
    return scene.values(filtered)


def scores(job: Job) -> Matrix:
    """Return the scores of the simulations of a job, shape (count, P): the task that a worker runs."""
    model, scene = analysis_for(job).model, scene_for(job)
    return np.stack([scores_of_maps(model, scene, maps) for maps in simulated_maps(job)])


def scene_for(job: Job) -> Scene:
    """Return the scene of the model of a job; the last one is kept."""
    return _scene(*job.definition)


@lru_cache(maxsize=1)
def _scene(fiducial: str, without: tuple[str, ...], settings: DiagnosisSettings, library: Kinds) -> Scene:
    job = Job(fiducial, fiducial, 0, 0, without=without, settings=settings, library=library)
    return scene_of(analysis_for(job).model)


def null_scores(analysis: Analysis, ask: Ask) -> Matrix:
    """Return the scores of simulations of the model, shape (SIMULATIONS, P), simulated or from the cache."""
    run = analysis.run
    science = config.science(run, *(("nuisance",) if run.nuisances else ()))
    identity = [science | {"ensemble": {}}, SIMULATIONS, package_digest(f"mcsim.{name}" for name in CODE)]
    identity.append(asdict(replace(analysis.settings, without=(), including=())))
    key = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:32]

    def fill(folder: Path) -> None:
        job = replace(analysis.job(seeded(run, SEED)), nuisances=bool(run.nuisances))
        starts = range(0, SIMULATIONS, PER_TASK)
        jobs = [replace(job, first=k, count=min(PER_TASK, SIMULATIONS - k)) for k in starts]
        np.save(folder / "scores.npy", np.concatenate(ask(jobs)))

    return np.asarray(np.load(folders.cached(f"diagnose/unlisted-{key}", fill) / "scores.npy"))
