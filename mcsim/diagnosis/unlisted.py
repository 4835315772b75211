"""After an unknown gap: simulate the scores of the grammar, search them, and say what is missing."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import healpy
import numpy as np

from mcsim import config
from mcsim.diagnosis.analysis import Analysis, Job, Kinds, analysis_for, simulated_maps
from mcsim.diagnosis.campaign import Ask, constrained_jobs, seeded
from mcsim.diagnosis.matched_filters import normalised_difference
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.validation import Halves
from mcsim.diagnosis.wiener_filter import Model, wiener_filter
from mcsim.reconstruction import words
from mcsim.reconstruction.forms import AddedToSamples
from mcsim.reconstruction.grammar import Structure, structures
from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.result import NSIDE, Reconstructed
from mcsim.reconstruction.scores import Scene, View
from mcsim.reconstruction.search import Search
from mcsim.simulation.pixel_means import signal_of
from mcsim.stats.excess import HeldOut
from mcsim.stats.gaussian import Fit
from mcsim.support import folders
from mcsim.support.arrays import Map, Matrix, Vector
from mcsim.support.code import package_digest

SIMULATIONS = 400
"""Of the model, for mean and covariance of the scores: as many realizations more, once for each model."""

SEED = 0x6D63 * 1_000 + 4
"""Of these simulations; those of the data vector and of the controls have others."""

PER_TASK = 10

WAVES = {"spin 1": ("spin", 1), "spin 2": ("spin", 2), "year": ("year", 1)}
"""Waves in time by name: of what, and which harmonic."""

ALTERNATIVES = 3
"""Structures that are told beside the best at most."""

SKIES = 4
"""Skies, constrained by the data, on which a reconstructed effect is simulated."""

FREE = 5
"""Coordinates of a pattern on the sky whose responses are simulated one by one, at most."""

FEW = 0.1
"""Share of the largest rms below which a map does not have an effect."""

CODE = (
    *("config", "sphere", "instrument", "systematics", "simulation", "reconstruction.forms", "reconstruction.scores"),
    *(f"diagnosis.{name}" for name in ("analysis", "matched_filters", "wiener_filter")),
)
"""What scores of simulations are computed with."""


def scene_of(model: Model) -> Scene:
    """Return the maps of a model as the grammar needs them."""
    run = model.survey.config
    splits = run.map.splits or ("",)
    timed = run.map.split_by == "time" and all(c.site.pointing is not None for c in model.survey.channels)
    views = []
    for i, part in enumerate(model.parts):
        channel = model.survey.channels[part.channel]
        split = model.of(part.channel).index(i)
        waves: dict[str, tuple[Map, Map]] = {}
        if timed:
            span = run.map.span(split)
            for name, (wave, harmonic) in WAVES.items():
                pair = [signal_of(_wave(wave, harmonic, c)(amplitude=1.0), channel.site, span) for c in (0, 1)]
                seen = part.precision > 0
                waves[name] = (np.where(seen, pair[0], 0.0), np.where(seen, pair[1], 0.0))
        kernel = channel.site.beam.blm[0, : model.lmax + 1].real
        moments = np.where(np.isfinite(part.moments.w), part.moments.w, 0.0)
        views.append(View(part.channel, split, moments, waves, model.response[part.channel], kernel))
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
        timed=timed,
    )


@lru_cache(maxsize=16)
def _wave(of: str, order: int, component: int) -> type[AddedToSamples]:
    """Return the effect that adds the cosine (component 0) or sine of a wave."""

    class Wave(AddedToSamples):
        name = f"wave_{of}_{order}_{component}"
        wave, harmonic, coefficients = of, order, (1.0 - component, 0.0 + component)

    return Wave


def scores_of_maps(model: Model, scene: Scene, maps: Sequence[Map]) -> Vector:
    """Return the scores of the grammar, shape (P,)."""
    filtered = wiener_filter(model, maps)
    channels = range(len(model.channels))
    return scene.values(filtered, [normalised_difference(model, filtered, model.of(c)) for c in channels])


def scores(job: Job) -> Matrix:
    """Return the scores of the simulations of a job, shape (count, P): the task that a worker runs."""
    model, scene = analysis_for(job).model, _scene(*job.definition)
    return np.stack([scores_of_maps(model, scene, maps) for maps in simulated_maps(job)])


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


def reconstructed(result: DiagnosisResult, data: ObservedMaps, ask: Ask) -> DiagnosisResult:
    """Return the result with what is missing in the words of the grammar; ``ask`` simulates with :func:`scores`."""
    analysis = data.context.analysis
    scene = _scene(*analysis.job(analysis.run).definition)
    search = Search(structures(scene), null_scores(analysis, ask))
    found, reduction = structures_of(data, scene, search)
    return replace(result, unlisted=found, unlisted_held_out=reduction)


def structures_of(data: ObservedMaps, scene: Scene, search: Search) -> tuple[tuple[Reconstructed, ...], HeldOut | None]:
    """Return the structures that are found in maps, and how far they reduce the excess on held-out data."""
    analysis = data.context.analysis
    x = scores_of_maps(analysis.model, scene, data.data)
    made = Reconstruction(data, scene, search, x)
    found = search.run(x, made)
    if not found:
        return (), None
    chosen = [search.grammar[one.structure] for one in found]
    fits, plugins, _ = made.fitted([one.structure for one in found])
    rows = []
    for one, structure, (theta, covariance), effect in zip(found, chosen, fits, plugins, strict=True):
        size, where, picture = (None, "", np.zeros(0)) if effect is None else made.picture(structure, effect)
        says = words.says(structure, theta, scene)
        others = [search.grammar[k] for k in one.alternatives[:ALTERNATIVES]]
        told = (words.says(other, search.fit([other], x)[0][0], scene) for other in others)
        rows.append(
            Reconstructed(
                *structure.says,
                says,
                one.pvalue,
                one.delta_chi2,
                structure.size,
                size,
                1.0 / np.sqrt(one.delta_chi2),
                words.cause(structure, dict(analysis.library)),
                tuple(told),
                words.profile(structure, theta, covariance, scene),
                tuple(map(float, picture)),
                where,
                None if effect is None else effect.name,
                None if effect is None else effect.source(f"{says[:1].upper()}{says[1:]}."),
            )
        )
    return tuple(rows), made.reduction(chosen, plugins)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Simulated skies: the maps of the first, and mean scores, shape (P,), and data vectors, shape (p,), of all."""

    maps: list[Map]
    scores: Vector
    x: Vector


Fitted = tuple[list[tuple[Vector, Matrix]], list[Plugin | None], Vector]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Simulate reconstructed effects, to find their size and to measure what they remove."""

    data: ObservedMaps
    scene: Scene
    search: Search
    x: Vector
    _fitted: dict[tuple[int, ...], Fitted] = field(default_factory=dict, repr=False)
    _trial: dict[int, Matrix] = field(default_factory=dict, repr=False)
    _kept: dict[int, Vector] = field(default_factory=dict, repr=False)

    def simulated(self, effects: Sequence[Plugin], amplitudes: Sequence[float] = ()) -> Simulated:
        """Return maps, scores and data vectors of skies that the data constrain, with effects at amplitudes."""
        analysis = self.data.context.analysis
        kinds = {one.name: one.kind() for one in effects}
        given = amplitudes or [1.0] * len(effects)
        tables = [
            config.Effect(
                name=one.name,
                channel=None if kinds[one.name].scope == "common" else one.channel,
                parameters={"amplitude": float(amplitude)},
            )
            for one, amplitude in zip(effects, given, strict=True)
        ]
        (job,) = constrained_jobs(analysis, tables, self.data.observed_sky, range(SKIES))
        maps = list(simulated_maps(job, {**dict(analysis.library), **kinds}))
        scores_ = [scores_of_maps(analysis.model, self.scene, one) for one in maps]
        return Simulated(maps[0], np.mean(scores_, axis=0), np.mean([analysis.data_vector(m) for m in maps], axis=0))

    @cached_property
    def before(self) -> Simulated:
        """Return the same without effects."""
        return self.simulated([])

    def fitted(self, chosen: Sequence[int]) -> Fitted:
        """Return coordinates and covariance of structures, their effects at amplitudes that fit, and what these leave.

        Coordinates of the last are fitted to what those before it leave, the amplitudes of all to simulated scores.
        """
        if not chosen:
            return [], [], self.x
        if (key := tuple(chosen)) not in self._fitted:
            fits, plugins, rest = self.fitted(chosen[:-1])
            structure = self.search.grammar[chosen[-1]]
            ((theta, covariance),) = self.search.fit([structure], rest)
            fit = self._kept.get(chosen[-1], theta), covariance
            made = plugin(f"unlisted_{len(chosen)}", structure, fit[0], self.scene)
            self._fitted[key] = ([*fits, fit], *self._calibrated(chosen, [*plugins, made]))
        return self._fitted[key]

    def responses(self, members: Sequence[int], rest: Vector) -> list[Matrix]:
        """Return what the effects of structures, fitted to scores, make of all scores; their mean where there is none.

        A pattern of few coordinates acts on few modes of this sky: each of them has its own response. Shape (k, P).
        """
        found = self.search.mean_responses(members, rest)
        self._trial.clear()
        for row, k in enumerate(members):
            structure = self.search.grammar[k]
            ((theta, _),) = self.search.fit([structure], rest)
            each = theta[None]
            if _by_coordinate(structure):
                each = float(np.linalg.norm(theta)) * np.eye(structure.size)
            self._trial[k] = each
            effects = [plugin("unlisted", structure, one, self.scene) for one in each]
            if None not in effects:
                rows = [self.simulated([one]).scores for one in effects if one is not None]
                found[row] = np.stack(rows) - self.before.scores
        return found

    def keep(self, member: int, amplitudes: Vector) -> None:
        """Keep the coordinates that these amplitudes of the responses mean."""
        self._kept[member] = amplitudes @ self._trial[member]

    def left(self, chosen: list[int]) -> Vector:
        """Return the scores without what the effects of structures make of them on this sky."""
        _, plugins, rest = self.fitted(chosen)
        return self.search.regressed(chosen, self.x) if None in plugins else rest

    def _calibrated(
        self, chosen: Sequence[int], plugins: Sequence[Plugin | None]
    ) -> tuple[list[Plugin | None], Vector]:
        """Return effects with the amplitudes at which their simulated scores fit best, and what these leave."""
        acting = [k for k, one in enumerate(plugins) if one is not None]
        if not acting:
            return list(plugins), self.x
        responses = np.stack([self.simulated([one]).scores for one in plugins if one is not None]) - self.before.scores
        structures_ = [self.search.grammar[chosen[k]] for k in acting]
        factors = self.search.amplitudes(structures_, self.x, responses)
        scaled = dict(zip(acting, factors, strict=True))
        found = [None if one is None else one.scaled(float(scaled[k])) for k, one in enumerate(plugins)]
        return found, self.x - factors @ responses

    def picture(self, structure: Structure, effect: Plugin) -> tuple[float, str, Map]:
        """Return the rms of what an effect adds, uK, the name of the map that has most of it, and this coarse map."""
        model, after = self.data.context.analysis.model, self.simulated([effect])
        changes = []
        for part, one, before in zip(model.parts, after.maps, self.before.maps, strict=True):
            seen = part.precision > 0
            change = np.where(seen, one - before, np.nan)
            if structure.stage == "noise":  # the same numbers are drawn with another variance
                factor = effect.kind()(amplitude=1.0).noise(model.survey.channels[part.channel].site)
                assert factor is not None
                extra = np.where(seen, (factor - 1.0) / np.where(seen, part.precision, 1.0), np.nan)
                change = np.sign(extra) * np.sqrt(np.abs(extra))
            changes.append(change)
        sizes = np.array([np.sqrt(np.nanmean(one**2)) for one in changes])
        most = int(np.argmax(sizes))
        acting = sizes > FEW * sizes[most]
        shown = np.where(np.isfinite(changes[most]), changes[most], healpy.UNSEEN)
        coarse = healpy.ud_grade(shown, min(NSIDE, model.nside))
        return float(np.sqrt(np.mean(sizes[acting] ** 2))), model.parts[most].name, coarse

    def reduction(self, chosen: Sequence[Structure], plugins: Sequence[Plugin | None]) -> HeldOut | None:
        """Return how far effects that are fitted to one half of the data reduce the excess of the other half.

        A structure that is measured map by map is fitted to those of the first fold alone; of others, and of patterns
        that act on few modes, the shape is that of all data. The amplitudes are those that fit the elements of the
        first fold of the data vector.
        """
        acting = [(w, one) for w, one in zip(chosen, plugins, strict=True) if one is not None]
        if not acting:
            return None
        context, settings = self.data.context, self.data.context.settings
        splits = [view.split for view in self.scene.views]
        first = []
        for structure, effect in acting:
            if structure.views and len(self.scene.splits) > 1 and not _by_coordinate(structure):
                half = structure.within(0, splits)
                if not len(half.weights):
                    return None
                (theta, _), = self.search.fit([half], self.x)  # fmt: skip
                again = plugin(effect.name, structure, theta, self.scene)
                assert again is not None
                first.append(again)
            else:
                first.append(effect)
        matrix, told = self.data.halves()
        halves = Halves.of(context.ensemble.remix(matrix), matrix @ self.data.x)
        if halves is None:
            return None
        t = np.stack([matrix @ (self.simulated([one]).x - self.before.x) for one in first], axis=1)
        whole = context.null.expected_snr(t.sum(axis=1))
        if halves.expected_snr(t.sum(axis=1)) < settings.half_snr_share * whole:
            return None

        def respond(frozen: Fit) -> Vector:
            change: Vector = matrix @ (self.simulated(first, list(frozen.amplitudes)).x - self.before.x)
            return change

        return halves.reduction(t, respond, (), told)


def _by_coordinate(structure: Structure) -> bool:
    """Return True for a pattern of few coordinates that multiplies the sky."""
    return structure.frame == "sky" and bool(structure.acts_on) and structure.size <= FREE
