"""What a model is asked, and what its simulations answer: candidates, evidence, and the tasks that measure it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.diagnosis.bipolar_scan import BipolarScan
from mcsim.diagnosis.matched_filters import MatchedFilter, matched_filter
from mcsim.diagnosis.summaries import Block, Element, blocks_of
from mcsim.diagnosis.wiener_filter import BEAM_ORDERS, Model, model_of, show, wiener_filter
from mcsim.errors import InputError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.systematics import Effect

Map = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """An effect that might be there: one of the library in one channel (None: in all), with fixed settings.

    Attributes
    ----------
    kind, channel, settings
        Effect, name of the channel, and parameters that are not fitted.
    basis
        Effects whose responses span it.
    """

    kind: type[Effect]
    channel: str | None
    settings: dict[str, Any]
    basis: tuple[Effect, ...]

    @property
    def label(self) -> str:
        """Name, channel and settings, for people."""
        settings = ", ".join(f"{key} = {value}" for key, value in self.settings.items())
        where = self.channel or "all"
        return f"{self.kind.name} ({where}{', ' + settings if settings else ''})"

    @property
    def drawn(self) -> bool:
        """Whether the responses that are measured of it are draws: not those of an effect that is only taken away."""
        return self.kind.draws and self.kind.sign >= 0

    def with_parameters(self, coordinates: NDArray[np.float64], precision: NDArray[np.float64]) -> Effect:
        """The effect nearest to fitted coordinates."""
        return replace(self.kind.nearest(coordinates, precision), **self.settings)

    def table(self, effect: Effect) -> config.Effect:
        """The effect as ``[[effect]]`` of a run."""
        return config.Effect(
            name=effect.name,
            channel=self.channel,
            parameters={"amplitude": effect.amplitude, **effect.parameters()},
        )


@dataclass(frozen=True)
class Analysis:
    """A believed survey, what might be wrong with it, and what to listen for.

    Attributes
    ----------
    model
        Of the survey.
    proposals
        In order; ``columns[i]`` are those of proposal i among all basis effects.
    blocks
        That make up the evidence, the scores of the proposals last.
    without
        Effects of the library that were left out.
    """

    model: Model
    proposals: tuple[Proposal, ...]
    blocks: tuple[Block, ...]
    without: tuple[str, ...] = ()

    @property
    def elements(self) -> tuple[Element, ...]:
        """Where every number of the evidence was heard."""
        return tuple(element for block in self.blocks for element in block.elements)

    @property
    def columns(self) -> tuple[tuple[int, ...], ...]:
        """Columns of every proposal in the matrix of templates."""
        edges = np.cumsum([0, *(len(proposal.basis) for proposal in self.proposals)])
        return tuple(tuple(range(int(a), int(b))) for a, b in pairwise(edges))

    def answer(self, maps: Sequence[Map], nthreads: int = 1, bipolar_scan: bool = False) -> NDArray[np.float64]:
        """Evidence of a set of maps, shape (entries,), and behind it the atlas, where it is asked for."""
        filtered = wiener_filter(self.model, maps, nthreads)
        found = [block.values(self.model, filtered) for block in self.blocks]
        return np.concatenate([*found, self.bipolar_scan.values(filtered)] if bipolar_scan else found)

    @cached_property
    def bipolar_scan(self) -> BipolarScan:
        """What else is measured, to say where."""
        return BipolarScan(self.model)


def analysis_of(run: config.RunConfig, without: Sequence[str] = (), nthreads: int = 1) -> Analysis:
    """What to ask of data that ``run`` claims to describe.

    Parameters
    ----------
    run
        What is believed, effects that are already modelled included.
    without
        Effects of the library that are not to be proposed.
    nthreads
        Threads for what is computed once.
    """
    model = model_of(survey(run, nthreads=nthreads, orders=BEAM_ORDERS))
    proposals = tuple(
        Proposal(kind, channel, dict(settings), tuple(replace(basis, **settings) for basis in kind.basis()))
        for name, kind in systematics.catalogue().items()
        if name not in without
        for channel in ([None] if kind.scope == "common" else [channel.name for channel in run.channels])
        for settings in kind.variants
        if _applies(model, kind, channel, settings)
    )
    return Analysis(model, proposals, (*blocks_of(model), *_matched_blocks(model, proposals)), tuple(without))


def _applies(model: Model, kind: type[Effect], channel: str | None, settings: Mapping[str, Any]) -> bool:
    """Whether an effect can be there at all: what it needs to know is known, and it changes something.

    Not proposed: effects on differencing, which a diagnosis cannot hear, on noise where none is believed, and on
    orientations that are a scan's already or that a circular beam does not show.
    """
    if kind.differencing is not Effect.differencing:
        return False
    owners = [c for c in model.survey.channels if channel in (None, c.name)]
    if kind.orientations is not Effect.orientations:
        specs = {spec.name: spec for spec in model.survey.config.channels}
        if not all(isinstance(specs[owner.name].scan, config.ScanParallelTransport) for owner in owners):
            return False  # the believed orientations are those of a scan already
        if not any(owner.beam.mmax for owner in owners):
            return False  # nor does a circular beam show any
    effect = replace(kind.basis()[0], **settings)
    try:
        for owner in owners:
            effect.gain(np.zeros(1), owner.site)
            effect.noise(owner.site)
            systematics.seen_through((effect,), owner.site)
            systematics.looked_at((effect,), np.zeros_like(model.dipole), replace(owner.site, lmax=model.lmax), 0, 0)
            effect.orientations(owner.maps[0].moments, owner.site)
    except InputError:
        return False
    quiet = all(m.noise_uk is None for owner in owners for m in owner.maps)
    return not (quiet and kind.noise is not Effect.noise)


def _matched_blocks(model: Model, proposals: Sequence[Proposal]) -> list[Block]:
    names = [channel.name for channel in model.survey.channels]
    blocks = []
    for proposal in proposals:
        where = None if proposal.channel is None else names.index(proposal.channel)
        for number, basis in enumerate(proposal.basis):
            score = matched_filter(model, basis, where)
            if score is not None:
                blocks.append(_matched_block(proposal, number, score, names))
    return blocks


def _matched_block(proposal: Proposal, number: int, score: MatchedFilter, names: Sequence[str]) -> Block:
    channels = tuple(names) if proposal.channel is None else (proposal.channel,)
    element = Element(f"score/{proposal.label}/{number}", "score", channels)
    return Block((element,), lambda model, filtered: np.array([score(model, filtered)]))


@dataclass(frozen=True)
class Job:
    """Simulations that one task makes, small enough to travel.

    Attributes
    ----------
    believed, simulated
        JSON of the runs that listen and that are simulated; they differ in effects, noise and seed.
    first, count
        Realizations.
    sample_by_sample
        By the referee, not by the default route.
    without
        Effects that are not proposed.
    atlas
        Measure it too.
    observed
        Coefficients of the sky that data show, shape (size,) of the model's lmax: the skies are then constrained by it.
    """

    fiducial: str
    simulated: str
    first: int
    count: int
    sample_by_sample: bool = False
    without: tuple[str, ...] = ()
    bipolar_scan: bool = False
    observed: NDArray[np.complex128] | None = None


def data_vectors(job: Job) -> NDArray[np.float64]:
    """Task: evidence of simulations, shape (count, entries), with the atlas behind it where it is asked for."""
    analysis = _questions(job.fiducial, job.without)
    shared = _survey(job.simulated)
    rows = []
    for realization in range(job.first, job.first + job.count):
        if job.sample_by_sample:
            maps = [map_uk for _, map_uk in sampled.maps(shared, realization)]
        else:
            sky = None
            if job.observed is not None:
                sky = _constrained(analysis.model, job.observed, shared.config.ensemble.seed, realization)
            maps = list(simulate.maps(shared, realization, sky=sky))
        rows.append(analysis.answer(maps, bipolar_scan=job.bipolar_scan))
    return np.stack(rows)


def _constrained(model: Model, observed: NDArray[np.complex128], seed: int, realization: int) -> NDArray[np.complex128]:
    """A sky that data might have been taken of: what they show, and what they do not show drawn (Hoffman & Ribak 1991).

    s + (s^_data - s^_drawn), where s^_drawn is what simulated data of the drawn sky s show. Their noise is a draw of
    its own: with that of the realization itself, sky and noise would be correlated, and every response too small by the
    filter of s^.
    """
    key = (hash(observed.tobytes()), seed, realization)
    if key not in _SKIES:
        if len(_SKIES) >= _KEPT:
            _SKIES.clear()
        run = model.survey.config
        drawn = replace(model.survey, config=replace(run, ensemble=replace(run.ensemble, seed=seed)))
        sky = simulate.draw_sky(drawn, realization)
        shown = show(model, list(simulate.maps(drawn, realization + _OTHER_NOISE, sky=sky)))
        _SKIES[key] = sky + alm_.resize(observed - shown, model.lmax, run.sky.lmax)
    return _SKIES[key]


_SKIES: dict[tuple[int, int, int], NDArray[np.complex128]] = {}
_KEPT = 32
_OTHER_NOISE = 1_000_000


@lru_cache(maxsize=2)
def _survey(simulated: str) -> Survey:
    """Jobs of the same run follow each other; a drift of the gain takes a pass over its pointing."""
    return survey(config.from_json(simulated))


@lru_cache(maxsize=1)
def _questions(fiducial: str, without: tuple[str, ...]) -> Analysis:
    return analysis_of(config.from_json(fiducial), without)
