"""What simulations of a model have taught: the scatter of its evidence, and how that responds to every proposal."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.analysis import Analysis, Job, Proposal
from mcsim.diagnosis.summaries import Element
from mcsim.stats.gaussian import SimulatedGaussian, null

Vector = NDArray[np.float64]
Ask = Callable[[Sequence[Job]], list[NDArray[np.float64]]]
"""From jobs to their answers, in order; in this process or on a cluster."""

PER_ENTRY = 10
"""Simulations for every number of the evidence that is not the twin of others."""

SOME = 3
"""Simulations for every number, after which it is known which are twins."""

MODES = 1 << 14
"""Degrees squared, times skies, that a response is the mean of: noise is less than 3e-3 of its F then."""

FEWEST_SKIES = 3
"""Skies that the response of a channel is the mean of, at both signs of a step, at least."""

TYPICAL_SKIES = 6
"""The same for changes of the sky that are held to their mean response."""

COMMON_SKIES = 12
"""The same for changes of the sky whose response in a single sky is largely random."""

NOISY_SKIES = 24
"""The same where the change itself is random, or has one sign."""

CONSTRAINED_SKIES = 8
"""Skies that agree with the observed one, on which what was found is simulated."""

SCATTER_SKIES = 24
"""The same where the scatter of an effect that draws is wanted."""

PIECE = 4
"""Of those, in a task."""

TIME_ORDERED_SKIES = 6
"""Skies seen sample by sample, that the default route is compared with."""

ATLAS = 300
"""Simulations with an atlas."""

COLLINEAR = 1e-4
"""Directions of the evidence whose variance is this fraction of the largest say nothing new: scores of near twins."""

CHUNK = 10

# Streams: the same seed is never used for two purposes, nor for the data of a run that counts from seed 0.
_COVARIANCE, _RESPONSE = (0x6D63 * 1_000 + stream for stream in (1, 2))


@dataclass(frozen=True)
class Knowledge:
    """What a model's simulations say, all that a diagnosis needs besides the data.

    Attributes
    ----------
    simulations
        Evidence of the model, shape (N, p).
    offset
        Mean of the referee's evidence less that of the default route for the same skies, shape (p,).
    templates
        Response to every basis effect per unit of its coordinate, shape (p, K).
    curvature
        Half its second derivative, shape (p, K).
    template_error
        Standard error of the templates, shape (p, K).
    reference
        Evidence of the model for the skies of the responses, shape (NOISY_SKIES, p).
    atlas
        Atlas of the first simulations, shape (n, numbers).
    entries
        Where every number was heard.
    """

    simulations: NDArray[np.float64]
    offset: Vector
    templates: NDArray[np.float64]
    curvature: NDArray[np.float64]
    template_error: NDArray[np.float64]
    reference: NDArray[np.float64]
    bipolar_scan: NDArray[np.float64]
    elements: tuple[Element, ...]

    def null(self, where: Sequence[int] | NDArray[np.int64] | None = None) -> SimulatedGaussian:
        """Null of all entries, or of some."""
        rows = slice(None) if where is None else np.asarray(where)
        return null(self.simulations[:, rows], self.offset[rows], COLLINEAR)

    def save(self, path: Path) -> None:
        """Write to a new Zarr store."""
        dataset = xr.Dataset(
            {
                "simulations": (("simulation", "entry"), self.simulations, {"long_name": "evidence of the model"}),
                "offset": ("entry", self.offset, {"long_name": "referee less default route"}),
                "templates": (("entry", "column"), self.templates, {"long_name": "response per unit coordinate"}),
                "curvature": (("entry", "column"), self.curvature, {"long_name": "half the second derivative"}),
                "template_error": (("entry", "column"), self.template_error, {"long_name": "standard error"}),
                "reference": (("sky", "entry"), self.reference, {"long_name": "evidence of the responses' skies"}),
                "bipolar_scan": (("drawn", "number"), self.bipolar_scan, {"long_name": "atlas of the model"}),
            },
            attrs={"entries": json.dumps([asdict(element) for element in self.elements])},
        )
        dataset.to_zarr(path, mode="w", consolidated=False)

    @classmethod
    def load(cls, path: Path) -> "Knowledge":
        """Read what :meth:`save` wrote."""
        with xr.open_zarr(path, consolidated=False) as dataset:
            arrays = {str(name): np.asarray(values) for name, values in dataset.data_vars.items()}
            elements = tuple(_entry(row) for row in json.loads(dataset.attrs["entries"]))
        return cls(**arrays, elements=elements)


def _entry(row: Mapping[str, Any]) -> Element:
    ell = row["ell"]
    return Element(**{**row, "channels": tuple(row["channels"]), "ell": None if ell is None else tuple(ell)})


@dataclass(frozen=True)
class Plan:
    """Jobs by what they are for, in order; the answer of each is an array (count, p)."""

    jobs: tuple[Job, ...]
    purposes: tuple[tuple[Any, ...], ...]


def plan(run: config.RunConfig, analysis: Analysis, simulations: int | None = None, time_ordered: bool = True) -> Plan:
    """All simulations that :func:`learned` is made of.

    Parameters
    ----------
    run
        What is believed.
    asked
        Of that run.
    simulations
        For the scatter; default: PER_ENTRY for every number of the evidence, of which :func:`answered` leaves some out.
    referee
        Compare with the sample-by-sample route where every channel's pointing is known.
    """
    fiducial = config.to_json(run)
    wanted = PER_ENTRY * len(analysis.elements) if simulations is None else simulations
    jobs, purposes = [], []

    def add(
        purpose: tuple[Any, ...], simulated: config.RunConfig, first: int, count: int, samples: bool = False
    ) -> None:
        bipolar_scan = purpose[0] == "null" and first < ATLAS
        jobs.append(Job(fiducial, config.to_json(simulated), first, count, samples, analysis.without, bipolar_scan))
        purposes.append(purpose)

    base = seeded(run, _RESPONSE)
    if time_ordered and all(c.site.pointing is not None for c in analysis.model.survey.channels):
        quiet = replace(base, channels=tuple(replace(c, noise=config.Noise()) for c in base.channels))
        for sky in range(TIME_ORDERED_SKIES):
            add(("referee", sky), quiet, sky, 1, True)
            add(("default", sky), quiet, sky, 1)
    for first in range(0, wanted, CHUNK):
        add(("null", first), seeded(run, _COVARIANCE), first, min(CHUNK, wanted - first))
    for first in range(0, NOISY_SKIES, CHUNK):
        add(("reference", first), base, first, min(CHUNK, NOISY_SKIES - first))
    for number, column, sign, effect in _basis(analysis):
        count = skies(analysis.proposals[number], analysis.model.lmax)
        add(("response", column, sign), with_effects(base, [analysis.proposals[number].table(effect)]), 0, count)
    return Plan(tuple(jobs), tuple(purposes))


def answered(plan: Plan, size: int, ask: Ask) -> tuple[Plan, list[NDArray[np.float64]]]:
    """What of a plan is needed, and the answers.

    Of ``size`` numbers some are twins; the first simulations tell how many are independent, and ten for each of those
    are enough.
    """
    first = [k for k, job in enumerate(plan.jobs) if plan.purposes[k][0] == "null" and job.first < SOME * size]
    answers = dict(zip(first, ask([plan.jobs[k] for k in first]), strict=True))
    drawn = np.concatenate([answer[:, :size] for answer in answers.values()])
    enough = PER_ENTRY * null(drawn, floor=COLLINEAR).dimension
    rest = [
        k
        for k, job in enumerate(plan.jobs)
        if k not in answers and (plan.purposes[k][0] != "null" or job.first < enough)
    ]
    answers |= zip(rest, ask([plan.jobs[k] for k in rest]), strict=True)
    kept = sorted(answers)
    needed = Plan(tuple(plan.jobs[k] for k in kept), tuple(plan.purposes[k] for k in kept))
    return needed, [answers[k] for k in kept]


def learned(analysis: Analysis, plan: Plan, answers: Sequence[NDArray[np.float64]]) -> Knowledge:
    """Put the answers to the jobs of a plan together."""
    by_purpose = dict(zip(plan.purposes, answers, strict=True))

    size = len(analysis.elements)

    def stacked(kind: str) -> NDArray[np.float64]:
        rows = [by_purpose[purpose][:, :size] for purpose in plan.purposes if purpose[0] == kind]
        return np.concatenate(rows) if rows else np.zeros((0, size))

    reference = stacked("reference")
    columns = sum(len(proposal.basis) for proposal in analysis.proposals)
    shape = (size, columns)
    templates, curvature, error = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for number, column, sign, effect in _basis(analysis):
        other = by_purpose.get(("response", column, -sign))
        if sign < 0 and other is not None:
            continue  # done with the other sign
        here = by_purpose["response", column, sign]
        step = effect.coordinates()[analysis.columns[number].index(column)]
        same = reference[: len(here)]
        if other is None:
            each = (here - same) / step
        else:
            each = (here - other) / (2.0 * step)
            curvature[:, column] = np.mean(here + other - 2.0 * same, axis=0) / (2.0 * step**2)
        templates[:, column] = each.mean(axis=0)
        error[:, column] = each.std(axis=0, ddof=1) / np.sqrt(len(each))
    time_ordered, default = stacked("referee"), stacked("default")
    offset = np.mean(time_ordered - default, axis=0) if len(time_ordered) else np.zeros(size)
    bipolar_scan = [answer[:, size:] for job, answer in zip(plan.jobs, answers, strict=True) if job.bipolar_scan]
    return Knowledge(
        stacked("null"), offset, templates, curvature, error, reference, np.concatenate(bipolar_scan), analysis.elements
    )


def after_jobs(
    run: config.RunConfig, analysis: Analysis, found: Sequence[config.Effect], skies: int = NOISY_SKIES
) -> list[Job]:
    """Simulations of the model with effects at frozen amplitudes, over the skies of the responses."""
    fiducial = config.to_json(run)
    simulated = config.to_json(with_effects(seeded(run, _RESPONSE), found))
    half = -(-skies // 2)
    return [Job(fiducial, simulated, first, min(half, skies - first), False, analysis.without) for first in (0, half)]


def constrained_jobs(
    run: config.RunConfig,
    analysis: Analysis,
    found: Sequence[config.Effect],
    observed: NDArray[np.complex128],
    first: int = 0,
    last: int = CONSTRAINED_SKIES,
) -> list[Job]:
    """Simulations of the model with effects at frozen amplitudes, over skies that agree with an observed one."""
    fiducial = config.to_json(run)
    simulated = config.to_json(with_effects(seeded(run, _RESPONSE), found))
    return [
        Job(fiducial, simulated, start, min(PIECE, last - start), False, analysis.without, False, observed)
        for start in range(first, last, PIECE)
    ]


def _basis(analysis: Analysis) -> Iterator[tuple[int, int, int, Any]]:
    """Proposal, column, sign and effect of every response that is simulated."""
    for number, (proposal, columns) in enumerate(zip(analysis.proposals, analysis.columns, strict=True)):
        for column, effect in zip(columns, proposal.basis, strict=True):
            for sign in (1, -1):
                if proposal.kind.sign in (0, sign):
                    yield number, column, sign, effect.scaled(sign)


def skies(proposal: Proposal, lmax: int) -> int:
    """Number of skies that the response to a proposal is the mean of."""
    if proposal.drawn:
        return NOISY_SKIES
    fewest = FEWEST_SKIES
    if proposal.channel is None:
        fewest = TYPICAL_SKIES if proposal.kind.mean_response else COMMON_SKIES
    return min(max(fewest, -(-MODES // lmax**2)), NOISY_SKIES)


def with_effects(run: config.RunConfig, found: Sequence[config.Effect]) -> config.RunConfig:
    """The run with further effects."""
    return replace(run, effects=(*run.effects, *found))


def seeded(run: config.RunConfig, seed: int) -> config.RunConfig:
    """The run with another seed."""
    return replace(run, ensemble=replace(run.ensemble, seed=seed))
