"""An analysis: model, candidate effects and data vector; and the task that simulates data vectors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from mcsim import config, systematics
from mcsim.datavector import slices as slices_
from mcsim.datavector.bipolar_scan import BipolarScan, coarse_residuals
from mcsim.datavector.candidate import Candidate, numbered
from mcsim.datavector.filter_model import Model, model_of
from mcsim.datavector.hindrance import hindrance
from mcsim.datavector.map_checks import check_differ, checked_map
from mcsim.datavector.matched_filters import differencing_filters, matched_filter
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.datavector.summaries import Block, Element, blocks_of, of_map
from mcsim.datavector.untouched_maps import UntouchedMaps, without_effects
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.ensemble.external_maps import Source
from mcsim.errors import InputError, RunError
from mcsim.simulation import differencing, sampled, simulate
from mcsim.simulation.nuisance import DisturbedSurvey, Nuisance, check_nuisances, nuisances_of
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import rotation
from mcsim.support.arrays import Alm, Cl, Map, Vector
from mcsim.systematics import Effect, Library, acts_through

Kinds = tuple[tuple[str, type[Effect]], ...]  #: effects of a library by name, as they are sent to workers

_OTHER_NOISE = 1_000_000
_EPSILON = 1e-5  #: of the interpolation of samples: errors of a few nK, in maps whose noise is hundreds of times larger


@dataclass(frozen=True)
class Analysis:
    """Define what is measured and which effects may be there."""

    model: Model  # fiducial survey
    candidates: tuple[Candidate, ...]  # effects that may be there
    blocks: tuple[Block, ...]  # of which the data vector consists, the matched filters of the candidates last
    without: tuple[str, ...] = ()  # effects of the library that are left out
    library: Kinds = field(default_factory=lambda: kinds_of(None))  # effects that are known
    of_maps: bool = True  # False: the data vector is a table of spectra
    source: Source | None = None  # external simulations in place of those of the run

    @property
    def run(self) -> config.RunConfig:
        """Return the configuration of the fiducial survey."""
        return self.model.survey.config

    @property
    def settings(self) -> DiagnosisSettings:
        """Return the settings of the model."""
        return self.model.settings

    @property
    def elements(self) -> tuple[Element, ...]:
        """Return the descriptions of the elements of the data vector."""
        return tuple(element for block in self.blocks for element in block.elements)

    @property
    def slices(self) -> tuple[Element, ...]:
        """Return the descriptions of the numbers beside the data vector; none for measured spectra."""
        return slices_.elements_of(self.model) if self.of_maps else ()

    @property
    def acting(self) -> set[type[Effect]]:
        """Return the effects and nuisances that the run names."""
        named = [*(one.name for one in self.run.effects), *(one.effect for one in self.run.nuisances)]
        return {systematics.get(name, dict(self.library)) for name in named}

    @cached_property
    def nuisances(self) -> tuple[Nuisance, ...]:
        """Return the nuisances of the run."""
        return nuisances_of(self.run, dict(self.library))

    @cached_property
    def bipolar_scan(self) -> BipolarScan:
        """Return the scan that localises a departure from the model."""
        return BipolarScan(self.model)

    def data_vector(self, maps: Sequence[Map], bipolar_scan: bool = False, slices: bool = False) -> Vector:
        """Return the data vector, shape (p,), and on request what follows it.

        These are the numbers beside it, and bipolar scan and coarse residuals, in this order.
        """
        filtered = wiener_filter(self.model, maps)
        found = [np.atleast_1d(block.values(filtered)) for block in self.blocks]
        if slices:
            found.append(slices_.values_of(self.model, filtered))
        if bipolar_scan:
            found += [self.bipolar_scan.values(filtered), coarse_residuals(self.model, filtered).ravel()]
        return np.concatenate(found)

    def source_of(self, found: Sequence[config.Effect], given_sky: bool = False) -> Source | None:
        """Return the external simulator if it can add these effects, to a given sky on request; else None."""
        source = self.source
        if source is None or not source.effects or not {effect.name for effect in found} <= set(source.effects):
            return None
        return source if source.takes_sky or not given_sky else None

    @cached_property
    def content(self) -> str:
        """Return the hash of the run and of its files, those of its nuisances among them."""
        return config.digest(self.run, "nuisance")

    def job(self, simulated: config.RunConfig) -> "Job":
        """Return a job of no realization yet that simulates a run and analyses it."""
        fiducial, own = config.to_json(self.run), config.to_json(simulated)
        known = Job(fiducial, own, 0, 0, without=self.without, settings=self.settings, library=self.library)
        return replace(known, content=self.content)


def analysis_of(
    run: config.RunConfig,
    without: Sequence[str] = (),
    nthreads: int = 1,
    settings: DiagnosisSettings | None = None,
    library: Library | None = None,
    source: Source | None = None,
) -> Analysis:
    """Define the analysis of data that ``run``, with the effects that are modelled already, claims to describe.

    Effects of the library (default: built-in and registered ones), which the run may name as well, are candidates
    where they apply, but those called in ``without``, and those that are proposed on request alone and neither called
    in ``settings.including`` nor nuisances of the run. ``nthreads`` compute what is computed once. ``source``:
    simulates in place of mcsim.
    """
    settings = settings or DiagnosisSettings()
    if run.nuisances:
        settings = settings.without_shrinkage()
    known = kinds_of(library, run)
    check_nuisances(run, dict(known))
    if source is not None and run.nuisances:
        raise InputError(
            f"nuisances are drawn by mcsim's simulations, but these are of {source.label}; draw them there, and leave "
            "[[nuisance]] out."
        )
    declared = _declared(run)
    model = model_of(survey(run, nthreads=nthreads, orders=settings.beam_orders, library=dict(known)), settings)
    proposed = [
        (name, effect)
        for name, effect in known
        if name not in without and (effect.proposed or name in (*settings.including, *declared))
    ]
    candidates = numbered(list(_candidates(model, proposed)))
    blocks = (*blocks_of(model), *_matched_blocks(model, candidates))
    for name in () if source is None else source.effects:
        systematics.get(name, dict(known))
    return Analysis(model, candidates, blocks, tuple(without), known, source=source)


def on_request(analysis: Analysis) -> tuple[Candidate, ...]:
    """Return what would be a candidate if it were asked for, with columns behind those of the candidates."""
    model, listed = analysis.model, {candidate.name for candidate in analysis.candidates}
    others = [
        (name, effect)
        for name, effect in analysis.library
        if not effect.proposed and name not in listed and name not in analysis.without
    ]
    return numbered([*analysis.candidates, *_candidates(model, others)])[len(analysis.candidates) :]


def _candidates(model: Model, kinds: Sequence[tuple[str, type[Effect]]]) -> Iterator[Candidate]:
    """Yield the effects of some kinds wherever they apply."""
    run = model.survey.config
    frequencies = [c.site.frequency_ghz if c.site.foregrounds else None for c in model.survey.channels]
    declared = _declared(run)
    for name, effect in kinds:
        # A nuisance is fitted in the coordinates of its prior.
        fit = effect.parametrization if name in declared else effect.parametrization.seen_at(frequencies)
        for channel in (None,) if effect.scope == "common" else model.channels:
            for fixed in effect.variants_in(run.map.splits):
                if hindrance(model, effect, channel, fixed) is None:
                    columns = tuple(range(len(fit.basis())))
                    yield Candidate(effect, channel, columns, dict(fixed), step=_step(model, effect, channel), fit=fit)


def kinds_of(library: Library | None, run: config.RunConfig | None = None) -> Kinds:
    """Return the effects of a library (None: built-in and registered ones), and those of a run's nuisances."""
    known = dict(systematics.catalogue() if library is None else library)
    declared = () if run is None else nuisances_of(run, known)
    return tuple((known | {one.effect.name: one.effect for one in declared}).items())


def _declared(run: config.RunConfig) -> set[str]:
    """Return the names of the effects that are nuisances of a run."""
    return {systematics.called(one.effect) for one in run.nuisances}


def check_asked(analysis: Analysis, names: Sequence[str]) -> None:
    """Raise InputError for an effect that is asked for and is no candidate, with the reason."""
    missing = sorted(set(names) - {candidate.name for candidate in analysis.candidates})
    for name in missing:
        kind = dict(analysis.library)[name]
        places = (None,) if kind.scope == "common" else analysis.model.channels
        variants = kind.variants_in(analysis.run.map.splits)
        reasons = [hindrance(analysis.model, kind, place, dict(fixed)) for place in places for fixed in variants]
        why = next((reason for reason in reasons if reason is not None), "what is measured does not show it")
        raise InputError(f"effect {name} is asked for, but cannot be found in this model: {why}; leave it out.")


def _step(model: Model, kind: type[Effect], channel: str | None) -> float | None:
    """Return the amplitude at which responses are measured if it depends on the model: iterations of map-making."""
    if not acts_through(kind, "differencing") or kind(amplitude=kind.step).differencing(0.0, 0)[1] == 0:
        return None
    (owner,) = (c for c in model.survey.making.channels if c.name == channel)
    return float(differencing.iterations_to_spare(owner, simulate.draw_sky(model.survey, 0)))


def _matched_blocks(model: Model, candidates: Sequence[Candidate]) -> Iterator[Block]:
    for candidate in candidates:
        channels = model.channels if candidate.channel is None else (candidate.channel,)
        where = None if candidate.channel is None else model.channels.index(candidate.channel)
        if acts_through(candidate.effect, "differencing"):
            yield from _blocks_by_map(model, candidate)
            continue
        for number, basis in enumerate(candidate.basis):
            found = matched_filter(model, basis, where)
            if found is not None:
                component = f"component {number + 1}" if len(candidate.columns) > 1 else None
                name, words = f"score/{candidate.label}/{number}", candidate.title
                alike = Element(name, "score", channels, kind="matched", effect=words, candidate=candidate.name)
                yield Block((replace(alike, component=component),), found)


def _blocks_by_map(model: Model, candidate: Candidate) -> Iterator[Block]:
    """Yield the matched filters of an effect on differencing, one for each map: nothing else of a map shows it."""
    assert candidate.channel is not None
    where = model.channels.index(candidate.channel)
    filters = differencing_filters(model, candidate.basis[0], where)
    for part, found in zip(model.of(where), filters, strict=bool(filters)):
        alike = replace(of_map(model, part), kind="matched", frame=None)
        own = replace(alike, name=f"score/{candidate.label}/{alike.name}", component=alike.split)
        yield Block((replace(own, effect=candidate.title, candidate=candidate.name),), found)


@dataclass(frozen=True)
class Job:
    """Describe the simulations of one task, small enough to send."""

    fiducial: str  # JSON of the run that filters; it differs from the simulated one in effects, noise and seed
    simulated: str  # JSON
    first: int  # realization
    count: int
    sample_by_sample: bool = False  # simulate with the time-ordered reference, not with the default route
    without: tuple[str, ...] = ()  # effects that are no candidates
    bipolar_scan: bool = False  # measure the bipolar scan and the coarse residual maps as well
    slices: bool = False  # measure the numbers beside the data vector as well
    observed: Alm | None = None  # filtered sky of the data, which then constrains the skies
    spread: Cl | None = None  # of skies about the observed one, over that without effects, by degree: (lmax + 1,)
    negative: bool = False  # turn the sign of these skies
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)
    library: Kinds = field(default_factory=lambda: kinds_of(None))
    source: Source | None = None  # simulates in place of mcsim
    nuisances: bool = False  # draw those of the run
    chosen: tuple[str, ...] = ()  # kinds of structures that scores are wanted of besides those of the grammar
    content: str = ""  # hash of the run that filters and of its files: what a process keeps of another one is older

    @property
    def definition(self) -> tuple[str, tuple[str, ...], DiagnosisSettings, Kinds, str]:
        """Return what the analysis follows from."""
        return self.fiducial, self.without, self.settings, self.library, self.content

    @property
    def given(self) -> bytes:
        """Return what tells the skies that data constrain from those of other data; b"" without data."""
        spread = b"" if self.spread is None else self.spread.tobytes()
        return b"" if self.observed is None else bytes([self.negative]) + self.observed.tobytes() + spread


def data_vectors(job: Job, library: Library | None = None) -> Vector:
    """Return the data vectors of simulations, shape (count, p), and behind them what else the job asks for.

    This is the task that a worker runs. ``library``: effects that the simulated run may name; default: the job's.
    """
    analysis = analysis_for(job)
    return np.stack([analysis.data_vector(maps, job.bipolar_scan, job.slices) for maps in simulated_maps(job, library)])


def analysis_for(job: Job) -> Analysis:
    """Return the analysis that a job is for; the last one is kept."""
    return _analysis(*job.definition)


def simulated_maps(job: Job, library: Library | None = None) -> Iterator[list[Map]]:
    """Yield the maps of every realization of a job; ``library`` as for :func:`data_vectors`."""
    for realization, shared in surveys(job, library):
        if job.sample_by_sample:
            yield [map_uk for _, map_uk in sampled.maps(shared, realization, epsilon=_EPSILON)]
            continue
        sky = None
        if job.observed is not None:
            seed, _ = _seed_and_added(job.simulated, job.fiducial)
            sky = _constrained_sky(job.definition, job.observed, seed, realization, job.spread)
            sky = -sky if job.negative else sky
        if job.source is not None:
            yield external_maps(job, realization, sky)
        elif job.nuisances:
            yield list(simulate.maps(shared, realization, sky=sky))
        else:
            which = (
                without_effects(job.simulated),
                job.library if library is None else kinds_of(library),
                hash(job.given),
                job.content,
            )
            yield _untouched().maps(shared, realization, sky, which)


@lru_cache(maxsize=1)
def _untouched() -> UntouchedMaps:
    return UntouchedMaps()


def external_maps(job: Job, realization: int, sky: Alm | None = None) -> list[Map]:
    """Return the maps of one realization that an external simulator makes; InputError if no such survey makes them."""
    assert job.source is not None
    seed, added = _seed_and_added(job.simulated, job.fiducial)
    model, where = _analysis(*job.definition).model, job.source.words(seed, realization)
    names = [f"the map {part.name} of {where}" for part in model.parts]
    given = zip(model.parts, job.source.maps(seed, realization, added, sky), names, strict=True)
    maps = [checked_map(model, part, map_uk, name) for part, map_uk, name in given]
    check_differ(model, maps, names)
    return maps


@lru_cache(maxsize=2)
def _seed_and_added(simulated: str, fiducial: str) -> tuple[int, tuple[config.Effect, ...]]:
    """Return the seed of a run, and its effects beyond those of the fiducial one."""
    run = config.from_json(simulated)
    return run.ensemble.seed, run.effects[len(config.from_json(fiducial).effects) :]


def surveys(job: Job, library: Library | None = None) -> Iterator[tuple[int, Survey]]:
    """Yield every realization of a job with its survey: the same for all, but for the nuisances that each draws."""
    kinds = job.library if library is None else kinds_of(library)
    known = job.simulated, kinds, job.fiducial, job.content
    disturbed = _disturbed(*known) if job.nuisances else None
    for realization in range(job.first, job.first + job.count):
        yield realization, _survey(*known) if disturbed is None else disturbed.at(realization)


@lru_cache(maxsize=1)
def _disturbed(simulated: str, kinds: Kinds, fiducial: str, content: str) -> DisturbedSurvey:
    check_files(fiducial, content)
    return DisturbedSurvey.of(config.from_json(simulated), dict(kinds))


def _constrained_sky(
    definition: tuple[Any, ...], observed: Alm, seed: int, realization: int, spread: Cl | None = None
) -> Alm:
    """Return a constrained realization: a sky s + (s^_data - s^_drawn), with s^_drawn filtered from maps of s.

    Notes
    -----
    Hoffman & Ribak, ApJ 380, L5 (1991). ``spread`` multiplies each degree of s - s^_drawn: where effects of the data
    hide or show more of the sky, it is known worse or better than from the maps that s^_drawn is filtered from.
    """
    model, drawn = _analysis(*definition).model, _drawn_sky(definition, seed, realization)
    if spread is not None:
        lmax = model.survey.config.sky.lmax
        drawn = alm_.multiply(drawn, np.append(spread, np.ones(lmax - model.lmax)), lmax)
    return np.asarray(drawn + _as_made(model, observed))


@lru_cache(maxsize=48)  # as many as are drawn for the scatter of a stochastic effect, again and again
def _drawn_sky(definition: tuple[Any, ...], seed: int, realization: int) -> Alm:
    """Return a sky of the model without what is filtered from maps of it.

    The noise of these maps is independent of that of the realization itself: otherwise sky and noise would be
    correlated, and every response too small by the filter of s^.
    """
    model = _analysis(*definition).model
    run = model.survey.config
    drawn = replace(model.survey, config=replace(run, ensemble=replace(run.ensemble, seed=seed)))
    sky = simulate.draw_sky(drawn, realization)
    filtered = shared_sky(model, list(simulate.maps(drawn, realization + _OTHER_NOISE, sky=sky)))
    return np.asarray(sky - _as_made(model, filtered))


def _as_made(model: Model, filtered: Alm) -> Alm:
    """Return a filtered sky, of prepared maps, in the frame and up to the degree in which maps are made."""
    run = model.survey.config
    turned = rotation.rotate_alm(filtered, model.lmax, model.frame, run.map.frame)
    return alm_.resize(turned, model.lmax, run.sky.lmax)


@lru_cache(maxsize=2)
def _survey(simulated: str, kinds: Kinds, fiducial: str, content: str) -> Survey:
    """Keep the last surveys: jobs of a run follow each other, and a gain drift takes a pass over the pointing."""
    check_files(fiducial, content)
    return survey(config.from_json(simulated), library=dict(kinds))


@lru_cache(maxsize=1)
def _analysis(
    fiducial: str, without: tuple[str, ...], settings: DiagnosisSettings, kinds: Kinds, content: str
) -> Analysis:
    check_files(fiducial, content)
    return analysis_of(config.from_json(fiducial), without, settings=settings, library=dict(kinds))


def check_files(run: str, content: str) -> None:
    """Raise RunError if the files of a run (JSON) are not those of ``content``, as of an analysis; "": not known."""
    if content and config.digest(config.from_json(run), "nuisance") != content:
        raise RunError(
            "The files that the run names have changed since it was read, or a worker sees others; let workers share "
            "them, leave them as they are, and run the same command again."
        )
