"""Scores of the grammar in maps of a model: of data, and of simulations of it."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags

from mcsim import config
from mcsim.datavector.analysis import Analysis, Job, Kinds, analysis_for, simulated_maps
from mcsim.datavector.campaign import Ask, in_tasks, seeded
from mcsim.datavector.filter_model import Model, sky_variance
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import FilteredMaps, wiener_filter
from mcsim.instrument.scan import MapGrid
from mcsim.instrument.scan.model import SECONDS_PER_DAY
from mcsim.reconstruction import sources
from mcsim.reconstruction.choices import Choice, angle_apart, frequency_apart
from mcsim.reconstruction.forms import AddedToSamples
from mcsim.reconstruction.grammar import structures
from mcsim.reconstruction.periods import SHORTEST_S, SPANS, TimeLine
from mcsim.reconstruction.scores import (
    ELONGATION,
    HARMONICS,
    MONTH,
    MOVED,
    MOVING,
    ORDERS,
    PERIODIC,
    SUN,
    Scene,
    View,
    coarse,
)
from mcsim.reconstruction.search import LEVEL, Search, evidence
from mcsim.reconstruction.structure import Structure
from mcsim.simulation import simulate
from mcsim.simulation.pixel_means import Part, signal_of
from mcsim.simulation.tod import Samples, every_ring, samples
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, rotation
from mcsim.support import folders
from mcsim.support.arrays import Map, Matrix, Vector, divided
from mcsim.support.code import LIBRARIES, class_digest, package_digest
from mcsim.support.npy import write_npy
from mcsim.systematics import Pointing
from mcsim.systematics.spacecraft import axes, heading, spin_phase

SIMULATIONS = 400
"""Of the model, for mean and covariance of the scores: as many realizations more, once for each model, and once for
all choices of one data set."""

SPREAD = 40  #: simulations by which the variance of the scores of sources is known

SEED = 0x6D63 * 1_000 + 4  #: of these simulations; those of the data vector and of the controls have others

SUBTRACTED = 0.03  #: scatter of the score of a coordinate over the largest, up to which maps do not have it


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
VISITS = 2_000_000  #: of a map, about, by which it is known when each pixel is observed

CODE = (
    *("config", "sphere", "instrument", "systematics", "bipolar", "simulation"),
    *(f"reconstruction.{name}" for name in ("choices", "forms", "periods", "scores", "simulated_scores", "sources")),
    "reconstruction.sky_changes",
    *(f"datavector.{name}" for name in ("analysis", "filter_model", "matched_filters", "parts", "pixel_noise")),
    *("datavector.shared_sky", "datavector.untouched_maps", "datavector.wiener_filter"),
)
"""What scores of simulations are computed with."""


@dataclass(frozen=True)
class Observing:
    """When and where a map is observed: its share of the survey on a grid, and of that every n-th ring from one on."""

    grid: MapGrid
    rings: tuple[int, int] | None = None

    def thinned(self, pointing: Pointing, most: int, angles: bool = True) -> Iterator[Samples]:
        """Yield ``most`` samples of the map, about, or as many as there are."""
        model, line, grid = pointing.model, pointing.line, self.grid
        whole = most * (1 if self.rings is None else self.rings[0])
        period = model.duration_days * SECONDS_PER_DAY * np.ptp(grid.time_range) / whole
        if period > model.period_of_samples(line):
            model, line = model.with_sampling(period), replace(line, sample_period_s=None)
        stream = samples(model, line, grid, angles=angles)
        return stream if self.rings is None else every_ring(model.spin_period_s, *self.rings)(stream)


def scene_of(model: Model) -> Scene:
    """Return the maps of a model as the grammar needs them."""
    run = model.survey.config
    splits = run.map.splits or ("",)
    sites = [channel.site for channel in model.survey.channels]
    pointed = all(site.pointing is not None for site in sites)
    timed, scan_frame = run.map.split_by != "sets" and pointed, "ecliptic" if pointed else model.frame
    known = [site.pointed("a wave").line for site in sites] if timed else []
    lines = tuple((line.boresight_angle_deg, line.azimuth_deg) for line in known)
    elsewhere = [directions(own, dict(zip(model.channels, lines, strict=True))) for own in lines]
    turn = rotation.between_meridians(model.nside, model.frame, scan_frame)
    views = []
    for i, part in enumerate(model.parts):
        channel = model.survey.channels[part.channel]
        split = model.of(part.channel).index(i)
        named = WAVES.items() if timed else ()
        waves = {name: _waves(model, i, values) for name, values in named}
        kernel = channel.site.beam.blm[0, : model.lmax + 1].real
        measured = part.moments.w[: model.settings.beam_orders]
        moments = np.where(np.isfinite(measured), measured, 0.0)
        scanned = [np.exp(1j * s * turn) * w for s, w in enumerate(moments[:ORDERS], start=1)]
        waves |= {f"orientation {s}": (w.real, -w.imag) for s, w in enumerate(scanned, start=1)}
        own = Observing(MapGrid(model.nside, model.frame, run.map.span(split)), run.map.rings(split))
        whole = replace(own, rings=None)  # as orientation moments are
        seen = _elsewhere(channel.site.pointed("elsewhere"), whole, elsewhere[part.channel]) if timed else {}
        response = model.response[part.channel]
        moving = _moving(channel.site.pointed("a beam"), own) if timed else {}
        views.append(View(part.channel, split, moments, waves, moving, seen, {}, {}, part.precision, response, kernel))
    scene = Scene(
        channels=model.channels,
        frequencies=tuple(channel.site.frequency_ghz for channel in model.survey.channels),
        splits=splits,
        foregrounds=tuple(channel.site.foregrounds for channel in model.survey.channels),
        frame=model.frame,
        scan_frame=scan_frame,
        nside=model.nside,
        lmax=model.lmax,
        dipole_uk=np.asarray(model.survey.channels[0].site.dipole_uk),
        cl=model.cl,
        split_orders=model.settings.split_beam_orders,
        views=tuple(views),
        elsewhere=tuple(elsewhere),
        by_rings=run.map.split_by == "rings",
        time_lines=tuple(_time_line(model, channel) for channel in range(len(model.channels))) if timed else (),
    )
    other = replace(model.survey, config=seeded(run, SEED))
    skies = (list(simulate.maps(other, SIMULATIONS + k)) for k in range(SPREAD))
    return scene.with_spreads([filtered(model, maps) for maps in skies])


def with_chosen(model: Model, scene: Scene, kinds: Sequence[str]) -> Scene:
    """Return a scene that has waves of periods, or compact sources, besides: kinds of structures."""
    views, chosen = [], [Choice(kind, 0.0) for kind in kinds]
    for i, view in enumerate(scene.views):
        periods, spots = dict(view.periods), dict(view.sources)
        for one in chosen:
            if one.family == "period":
                periods[one.kind] = _waves(model, i, {"wave": "period", "period_s": one.numbers[0]})
            else:
                seen = alm_.multiply(sources.at(one.numbers, model.lmax), view.response, model.lmax)
                spots[one.kind] = healpix.synthesis(seen[None], model.nside, model.lmax)[0]
        views.append(replace(view, periods=periods, sources=spots))
    return replace(scene, views=tuple(views))


def _waves(model: Model, i: int, values: Mapping[str, Any]) -> tuple[Map, ...]:
    """Return the means of cosine and sine of a wave, or of a trend, over the samples of every pixel of a map."""
    channel, split = model.parts[i].channel, model.of(model.parts[i].channel).index(i)
    site, part = model.survey.channels[channel].site, Part.of(model.survey.config, split)
    components = range(1 if values["wave"] == "trend" else 2)
    return tuple(signal_of(_wave(*values.items(), component=c)(amplitude=1.0), site, part) for c in components)


def _time_line(model: Model, channel: int) -> TimeLine:
    """Return when the maps of a channel are observed."""
    members, site, run = model.of(channel), model.survey.channels[channel].site, model.survey.config
    pointing = site.pointed("a time line")
    period = pointing.model.period_of_samples(pointing.line)
    span_s = max(SHORTEST_S / SPANS, period)
    shape = int(np.ceil(pointing.model.duration_days * SECONDS_PER_DAY / span_s)), 12 * model.nside**2
    visits, weights = [], dict[str, list[Map]]({on: [] for on in PERIODIC})
    sky = sky_variance(model.cl * model.sky_power, model.response[channel])
    dipole = site.dipole_uk @ healpix.centres(model.nside)
    squares: tuple[float | Map, ...] = 1.0, dipole**2 + sky
    for split, i in enumerate(members):
        own = Observing(MapGrid(model.nside, model.frame, run.map.span(split)), run.map.rings(split))
        total = csr_matrix(shape)
        for chunk in own.thinned(pointing, VISITS, angles=False):
            spans = np.minimum((chunk.time_s / span_s).astype(int), shape[0] - 1)
            total += csr_matrix((np.ones(len(spans)), (spans, chunk.pixel)), shape)
        visits.append(total @ diags(divided(1.0, total.sum(axis=0).A1)))
        for on, square in zip(PERIODIC, squares, strict=True):
            weights[on].append(model.parts[i].precision * square)
    return TimeLine.of(tuple(visits), span_s, weights)


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


def _elsewhere(pointing: Pointing, observed: Observing, wanted: Mapping[str, Matrix]) -> dict[str, csr_matrix]:
    """Return the mean over the samples of every coarse pixel of what a map has in other directions."""
    nside = coarse(observed.grid.nside)
    of_coarse = replace(observed, grid=replace(observed.grid, nside=nside))
    total = {name: csr_matrix((12 * nside**2, 12 * nside**2)) for name in wanted}
    for chunk in of_coarse.thinned(pointing, SAMPLES):
        outward, south, east = axes(chunk.theta, chunk.phi)
        x, y = (np.cos(a) * south + np.sin(a) * east for a in (chunk.psi, chunk.psi + 0.5 * np.pi))
        for name, (a, b, c, weight) in ((name, one) for name, rows in wanted.items() for one in rows):
            there = healpy.vec2pix(nside, *(a * x + b * y + c * outward))
            total[name] += csr_matrix((np.full(len(there), weight), (chunk.pixel, there)), total[name].shape)
    hits = total["opposite"].sum(axis=1).A1
    return {name: diags(divided(1.0, hits)) @ one for name, one in total.items()}


def _moving(pointing: Pointing, observed: Observing) -> dict[tuple[str, int], NDArray[np.complex128]]:
    """Return :attr:`View.moving` of a map."""
    grid = observed.grid
    followed = [(wave, s) for wave in MOVING for s in range(1, MOVED + 1)]
    total = {one: np.zeros((2, grid.npix), dtype=np.complex128) for one in (*followed, (SUN, 1))}
    hits = np.zeros(grid.npix)
    for chunk in observed.thinned(pointing, VISITS):
        year = 2.0 * np.pi * chunk.time_s / pointing.model.orbit_period_s
        phases = {"year": year, "spin": spin_phase(pointing, chunk.time_s)}
        hits += np.bincount(chunk.pixel, minlength=grid.npix)
        for wave, s in followed:
            name, harmonic = wave.split()
            for row, function in zip(total[wave, s], (np.cos, np.sin), strict=True):
                value = function(int(harmonic) * phases[name]) * np.exp(-1j * s * chunk.psi)
                row.real += np.bincount(chunk.pixel, value.real, grid.npix)
                row.imag += np.bincount(chunk.pixel, value.imag, grid.npix)
        _, south, east = axes(chunk.theta, chunk.phi)
        for row, turn in zip(total[SUN, 1], (0.0, 0.5 * np.pi), strict=True):
            velocity = heading(pointing.model, chunk.time_s, grid.frame, turn)
            row.real += np.bincount(chunk.pixel, np.sum(velocity * south, axis=0), grid.npix)
            row.imag -= np.bincount(chunk.pixel, np.sum(velocity * east, axis=0), grid.npix)
    return {key: both * divided(1.0, hits) for key, both in total.items()}


@lru_cache(maxsize=64)
def _wave(*values: tuple[str, Any], component: int) -> type[AddedToSamples]:
    """Return the effect with these class variables that adds one of its two components."""
    name = "_".join(["wave", *(str(value) for _, value in values), str(component)])
    own = {"__module__": __name__, "name": name, "coefficients": (1.0 - component, 0.0 + component), **dict(values)}
    return dataclass(frozen=True, kw_only=True)(type("Wave", (AddedToSamples,), own))


def scores_of_maps(model: Model, scene: Scene, maps: Sequence[Map]) -> Vector:
    """Return the scores of the grammar, shape (P,)."""
    return scene.values(filtered(model, maps))


def filtered(model: Model, maps: Sequence[Map]) -> FilteredMaps:
    """Return filtered maps, by the noise of every pixel and the offsets of its samples, if that is known.

    Only then is the scatter of scores, by which structures are fitted, their response to what they measure.
    """
    return wiener_filter(model.exact, maps)


def scores(job: Job) -> Matrix:
    """Return the scores of the simulations of a job, shape (count, P): the task that a worker runs.

    Behind them stand the falls of chi^2 of peaks; if the job names kinds, the scores of these alone are returned.
    """
    model, scene = analysis_for(job).model, scene_for(job)
    each = (filtered(model, maps) for maps in simulated_maps(job))
    if job.chosen:
        return np.stack([scene.chosen_values(one) for one in each])
    return np.stack([np.append(scene.values(one), [peak.fall for peak in scene.peaks(one)]) for one in each])


def scene_for(job: Job) -> Scene:
    """Return the scene of the model of a job, with the kinds that it names; the last one of a model is kept."""
    return with_chosen(analysis_for(job).model, _scene(*job.definition), job.chosen)


@lru_cache(maxsize=1)
def _scene(fiducial: str, without: tuple[str, ...], settings: DiagnosisSettings, library: Kinds, content: str) -> Scene:
    job = Job(fiducial, fiducial, 0, 0, content=content, without=without, settings=settings, library=library)
    return scene_of(analysis_for(job).model.exact)


def search_of(analysis: Analysis, scene: Scene, ask: Ask) -> Search:
    """Return the search of the maps of a model."""
    null, count = null_scores(analysis, ask), len(scene.keys)
    scores_, exact = null[:, :count], analysis.model.exact_known
    return Search(_seen(scene, scores_), scores_, _charged(scene, null[:, count:]), exact)


def _seen(scene: Scene, simulations: Matrix) -> tuple[Structure, ...]:
    """Return the structures, those that are added without coordinates that were subtracted from the maps.

    These are monopole and dipole, or the constant of a function of time: their scores hardly scatter.
    """
    found = list(structures(scene))
    for place, one in enumerate(found):
        spread = one.of(simulations).std(axis=0)
        kept = spread >= SUBTRACTED * spread.max()
        if one.stage == "added" and one.kind != "power" and not kept.all():
            found[place] = replace(one, mix=(np.eye(len(one.rows)) if one.mix is None else one.mix)[kept])
    return tuple(found)


def _charged(scene: Scene, falls: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the evidences of peaks from their falls of chi^2, shape (..., peaks), all of each continuum charged."""
    sizes, tried = np.transpose(scene.continua)
    return evidence(falls, sizes) - np.log(tried)


def with_peaks(analysis: Analysis, scene: Scene, search: Search, maps: Sequence[Map], ask: Ask) -> tuple[Scene, Search]:
    """Return scene and search with the choices that are significant by themselves, the most evident first, if any.

    Periods are the same if they are so over the survey within half a cycle, and sources if a beam hardly tells them.
    """
    found = scene.peaks(filtered(analysis.model, maps))
    evidences = _charged(scene, np.array([one.fall for one in found]))
    chosen = list[Choice]()
    for k in np.argsort(-evidences):
        new = not any(_same(scene, found[k], one) for one in chosen)
        if new and search.pvalue(evidences[k]) <= LEVEL:
            chosen.append(found[k])
    if not chosen:
        return scene, search
    kinds = tuple(one.kind for one in chosen)
    more = with_chosen(analysis.model, scene, kinds)
    simulations = np.concatenate([search.simulations, null_scores(analysis, ask, kinds)], axis=1)
    return more, replace(search, grammar=_seen(more, simulations), simulations=simulations)


def _same(scene: Scene, one: Choice, other: Choice) -> bool:
    """Return True for two choices that are one."""
    if one.family != other.family:
        return False
    if one.family == "period":
        return frequency_apart(one, other) * scene.time_lines[0].duration_s <= 0.5
    return angle_apart(one, other) * scene.lmax <= np.pi


def null_scores(analysis: Analysis, ask: Ask, chosen: tuple[str, ...] = ()) -> Matrix:
    """Return :func:`scores` of SIMULATIONS simulations of the model, simulated or from the cache.

    They draw the nuisances of which maps cannot be rid.
    """
    pairs = zip(analysis.run.nuisances, analysis.nuisances, strict=True)
    run = replace(analysis.run, nuisances=tuple(table for table, one in pairs if not one.subtractable))
    science = config.science(run, *(("nuisance",) if run.nuisances else ()))
    identity = [
        science | {"ensemble": {}},
        SIMULATIONS,
        chosen,
        package_digest((f"mcsim.{name}" for name in CODE), LIBRARIES),
        asdict(replace(analysis.settings, without=(), including=())),
        sorted(map(class_digest, analysis.acting)),
    ]
    key = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[:32]

    def fill(folder: Path) -> None:
        job = replace(analysis.job(seeded(run, SEED)), nuisances=bool(run.nuisances), chosen=chosen)
        write_npy(folder / "scores.npy", np.concatenate(ask(in_tasks(job, range(SIMULATIONS)))))

    return np.asarray(np.load(folders.cached(f"diagnose/unlisted-{key}", fill) / "scores.npy"))
