"""An analysis: model, candidate effects and data vector; and the task that simulates data vectors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.diagnosis.bipolar_scan import BipolarScan
from mcsim.diagnosis.candidate import Candidate, numbered
from mcsim.diagnosis.matched_filters import MatchedFilter, matched_filter
from mcsim.diagnosis.residual_maps import coarse_residuals
from mcsim.diagnosis.settings import DiagnosisSettings
from mcsim.diagnosis.summaries import Block, Element, blocks_of
from mcsim.diagnosis.wiener_filter import Model, model_of, shared_sky, wiener_filter
from mcsim.errors import InputError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere import alm as alm_
from mcsim.systematics import Effect, Library

Map = NDArray[np.float64]

_OTHER_NOISE = 1_000_000


@dataclass(frozen=True)
class Analysis:
    """Define what is measured and which effects may be there.

    Attributes
    ----------
    model
        Fiducial survey.
    candidates
        Effects that may be there.
    blocks
        Of which the data vector consists, the matched filters of the candidates last.
    without
        Effects of the library that are left out.
    """

    model: Model
    candidates: tuple[Candidate, ...]
    blocks: tuple[Block, ...]
    without: tuple[str, ...] = ()

    @property
    def settings(self) -> DiagnosisSettings:
        """Return the settings of the model."""
        return self.model.settings

    @property
    def elements(self) -> tuple[Element, ...]:
        """Return the descriptions of the elements of the data vector."""
        return tuple(element for block in self.blocks for element in block.elements)

    def data_vector(self, maps: Sequence[Map], nthreads: int = 1, bipolar_scan: bool = False) -> NDArray[np.float64]:
        """Return the data vector, shape (p,), and on request the bipolar scan and coarse residuals behind it."""
        filtered = wiener_filter(self.model, maps, nthreads)
        found = [block.values(self.model, filtered) for block in self.blocks]
        if bipolar_scan:
            found += [self.bipolar_scan.values(filtered), coarse_residuals(self.model, filtered).ravel()]
        return np.concatenate(found)

    @cached_property
    def bipolar_scan(self) -> BipolarScan:
        """Return the scan that localises a departure from the model."""
        return BipolarScan(self.model)


def analysis_of(
    run: config.RunConfig,
    without: Sequence[str] = (),
    nthreads: int = 1,
    settings: DiagnosisSettings | None = None,
) -> Analysis:
    """Define the analysis of data that ``run`` claims to describe.

    Parameters
    ----------
    run
        Fiducial model, with the effects that are modelled already.
    without
        Effects of the library that are no candidates.
    nthreads
        Threads for what is computed once.
    settings
        Default: those of :class:`DiagnosisSettings`.
    """
    settings = settings or DiagnosisSettings()
    model = model_of(survey(run, nthreads=nthreads, orders=settings.beam_orders), settings)
    candidates = numbered(
        [
            Candidate(effect, channel, tuple(range(len(effect.parametrization.basis()))), dict(fixed))
            for name, effect in systematics.catalogue().items()
            if name not in without
            for channel in ([None] if effect.scope == "common" else [channel.name for channel in run.channels])
            for fixed in effect.variants
            if _applies(model, effect, channel, fixed)
        ]
    )
    return Analysis(model, candidates, (*blocks_of(model), *_matched_blocks(model, candidates)), tuple(without))


def _applies(model: Model, kind: type[Effect], channel: str | None, settings: Mapping[str, Any]) -> bool:
    """Return True if an effect can be there: what it depends on is known, and it changes something.

    Left out are effects on differencing, which a diagnosis does not take, on noise if there is none, and on
    orientations that are a scan's already or that a circular beam does not show.
    """
    if kind.differencing is not Effect.differencing:
        return False
    owners = [c for c in model.survey.channels if channel in (None, c.name)]
    if kind.orientations is not Effect.orientations:
        specs = {spec.name: spec for spec in model.survey.config.channels}
        if not all(isinstance(specs[owner.name].scan, config.ScanParallelTransport) for owner in owners):
            return False
        if not any(owner.beam.mmax for owner in owners):
            return False
    effect = systematics.basis_of(kind, settings)[0]
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


def _matched_blocks(model: Model, candidates: Sequence[Candidate]) -> list[Block]:
    names = [channel.name for channel in model.survey.channels]
    blocks = []
    for candidate in candidates:
        where = None if candidate.channel is None else names.index(candidate.channel)
        for number, basis in enumerate(candidate.basis):
            found = matched_filter(model, basis, where)
            if found is not None:
                blocks.append(_matched_block(candidate, number, found, names))
    return blocks


def _matched_block(candidate: Candidate, number: int, matched: MatchedFilter, names: Sequence[str]) -> Block:
    channels = tuple(names) if candidate.channel is None else (candidate.channel,)
    element = Element(
        f"score/{candidate.label}/{number}",
        "score",
        channels,
        kind="matched",
        component=f"component {number + 1}" if len(candidate.columns) > 1 else None,
        effect=candidate.title,
    )
    return Block((element,), lambda model, filtered: np.array([matched(model, filtered)]))


@dataclass(frozen=True)
class Job:
    """Describe the simulations of one task, small enough to send.

    Attributes
    ----------
    fiducial, simulated
        JSON of the runs that filter and that are simulated; they differ in effects, noise and seed.
    first, count
        Realizations.
    sample_by_sample
        Simulate with the time-ordered reference, not with the default route.
    without
        Effects that are no candidates.
    bipolar_scan
        Measure the bipolar scan and the coarse residual maps as well.
    observed
        Filtered sky of the data, coefficients up to the model's lmax: the skies are then constrained by it.
    settings
        Of the analysis.
    """

    fiducial: str
    simulated: str
    first: int
    count: int
    sample_by_sample: bool = False
    without: tuple[str, ...] = ()
    bipolar_scan: bool = False
    observed: NDArray[np.complex128] | None = None
    settings: DiagnosisSettings = field(default_factory=DiagnosisSettings)


def data_vectors(job: Job, library: Library | None = None) -> NDArray[np.float64]:
    """Return the data vectors of simulations, shape (count, p), with bipolar scan and coarse residuals if asked for.

    This is the task that a worker runs. ``library``: effects that the simulated run may name; default: the catalogue.
    """
    analysis = _analysis(job.fiducial, job.without, job.settings)
    shared = _survey(job.simulated) if library is None else survey(config.from_json(job.simulated), library=library)
    rows = []
    for realization in range(job.first, job.first + job.count):
        if job.sample_by_sample:
            maps = [map_uk for _, map_uk in sampled.maps(shared, realization)]
        else:
            sky = None
            if job.observed is not None:
                model = (job.fiducial, job.without, job.settings)
                sky = _constrained_sky(*model, job.observed.tobytes(), shared.config.ensemble.seed, realization)
            maps = list(simulate.maps(shared, realization, sky=sky))
        rows.append(analysis.data_vector(maps, bipolar_scan=job.bipolar_scan))
    return np.stack(rows)


@lru_cache(maxsize=32)
def _constrained_sky(
    fiducial: str, without: tuple[str, ...], settings: DiagnosisSettings, observed: bytes, seed: int, realization: int
) -> NDArray[np.complex128]:
    """Return a constrained realization: a sky s + (s^_data - s^_drawn), with s^_drawn filtered from maps of s.

    Notes
    -----
    Hoffman & Ribak, ApJ 380, L5 (1991). The noise of these maps is independent of that of the realization itself:
    otherwise sky and noise would be correlated, and every response too small by the filter of s^.
    """
    model = _analysis(fiducial, without, settings).model
    run = model.survey.config
    drawn = replace(model.survey, config=replace(run, ensemble=replace(run.ensemble, seed=seed)))
    sky = simulate.draw_sky(drawn, realization)
    filtered = shared_sky(model, list(simulate.maps(drawn, realization + _OTHER_NOISE, sky=sky)))
    return np.asarray(
        sky + alm_.resize(np.frombuffer(observed, dtype=np.complex128) - filtered, model.lmax, run.sky.lmax)
    )


@lru_cache(maxsize=2)
def _survey(simulated: str) -> Survey:
    """Keep the last surveys: jobs of a run follow each other, and a gain drift takes a pass over the pointing."""
    return survey(config.from_json(simulated))


@lru_cache(maxsize=1)
def _analysis(fiducial: str, without: tuple[str, ...], settings: DiagnosisSettings) -> Analysis:
    return analysis_of(config.from_json(fiducial), without, settings=settings)
