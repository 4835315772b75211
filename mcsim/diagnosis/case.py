"""One case: maps against a model and what its simulations have taught; verdict and all that it rests on."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.attribute import Attribution
from mcsim.diagnosis.candidate import Candidate, columns_of
from mcsim.diagnosis.closest import Closest
from mcsim.diagnosis.data import exchanges
from mcsim.diagnosis.evidence import Questions
from mcsim.diagnosis.exhibits import exhibits
from mcsim.diagnosis.knowledge import CONSTRAINED_SKIES, Ask, Knowledge
from mcsim.diagnosis.listen import show
from mcsim.diagnosis.refine import (
    Refined,
    Respond,
    heard_in,
    on_this_sky,
    quiet_templates,
    refine,
    scatter_of,
    tables_at,
)
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.scattered import scattered
from mcsim.diagnosis.shrink import Prediction, Shrink, achieved, carried, excess, predicted
from mcsim.diagnosis.verdict import detectable_of, sentence, verdict_of
from mcsim.diagnosis.where import Place, places
from mcsim.errors import InputError
from mcsim.stats.gaussian import Null, bases, fit
from mcsim.stats.look_elsewhere import Calibration, calibrate, gap

Vector = NDArray[np.float64]

ALPHA = 0.05
"""Probability below which there is a gap."""

EXCHANGED = 0.01
"""Probability above which maps in another order are said to fit the model."""

OPENED = 3.0
"""Standard deviations below zero, or below what was forecast, from which on a shrink speaks against what was added."""

HEARD = 0.2
"""Share of an effect's strength that either half of the evidence must hear for a shrink to be measured."""


@dataclass(frozen=True)
class Court:
    """What every case of a model is judged with.

    Attributes
    ----------
    run, asked, known
        What is believed, what is asked of it, what its simulations answered.
    null
        Of the whole evidence.
    candidates, calibration
        Of the proposals.
    """

    run: config.RunConfig
    asked: Questions
    known: Knowledge
    null: Null
    candidates: tuple[Candidate, ...]
    calibration: Calibration


@dataclass(frozen=True)
class Diagnosis:
    """Whether, where, which, how far: a verdict and the evidence that it rests on.

    Attributes
    ----------
    verdict
        As written to ``verdict.json``.
    evidence
        What was measured and what simulations say of it; dimensions entry, column, place.
    attribution
        Candidates, explanations and their fits.
    """

    verdict: dict[str, Any]
    evidence: xr.Dataset
    attribution: Attribution

    @property
    def sentence(self) -> str:
        """The verdict for a busy person."""
        return sentence(self.verdict)

    def save(self, folder: str | Path) -> None:
        """Write ``verdict.json`` and ``evidence.zarr`` into a folder, made where it does not exist."""
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        (target / "verdict.json").write_text(json.dumps(self.verdict, indent=1, allow_nan=False) + "\n")
        # Text as objects: for numpy's fixed-length text Zarr 3 has no stable form.
        texts = {
            name: values.astype(object) for name, values in self.evidence.variables.items() if values.dtype.kind == "U"
        }
        self.evidence.assign(texts).to_zarr(target / "evidence.zarr", mode="w", consolidated=False)


def court(run: config.RunConfig, asked: Questions, known: Knowledge) -> Court:
    """Make ready for the cases of a model."""
    null = known.null()
    scatter = scatter_of(known, asked)
    candidates = tuple(
        Candidate(
            proposal.kind.name,
            proposal.channel,
            columns,
            settings=proposal.settings,
            unit=proposal.kind.unit,
            # What an effect draws at random is not known even where the sky is.
            shape_error=min(float(own), 1.0) if proposal.drawn else None,
            positive=proposal.kind.side != 0,
            most=proposal.kind.most,
        )
        for proposal, columns, own in zip(asked.proposals, asked.columns, scatter, strict=True)
    )
    groups = bases(null, quiet_templates(known), [candidate.columns for candidate in candidates])
    return Court(run, asked, known, null, candidates, calibrate(null, groups))


def judge(court: Court, case: str, maps: Sequence[NDArray[np.float64]], ask: Ask) -> Diagnosis:
    """Judge a set of maps.

    Parameters
    ----------
    court
        Of the model.
    case
        Name of the case.
    maps
        In the order of the model's.
    ask
        Runs further simulations, with effects at the amplitudes that are found.
    """
    asked, known = court.asked, court.known
    answer = asked.answer(maps, atlas=True)
    x, numbers = answer[: len(asked.entries)], answer[len(asked.entries) :]

    respond = Responses(court.run, asked, known, show(asked.model, maps), ask)
    t = quiet_templates(known)
    groups = bases(court.null, t, [candidate.columns for candidate in court.candidates])
    if gap(court.null, x, groups, court.calibration).probability <= ALPHA:
        t = on_this_sky(known, asked, t, respond)
    refined = refine(known, court.null, x, t, court.candidates, asked.proposals, court.calibration, respond)
    found = refined.attribution
    exchanged = list(_exchanged(court, maps, found))
    notes = exchanged.copy()
    if exchanged:
        # An order of the maps in which the model fits says more than any effect.
        found = found.unexplained()
    shrink = None
    if found.explanations:
        found = _with_errors(court, refined, found, respond)
        found, shrink = confirmed(court, found, shrink_of(court, x, refined, respond), notes)
    where = _where(court, x, numbers)
    able = detectable_of(court.null, refined.templates, court.candidates, asked.proposals)
    heard = None if exchanged else heard_of(court, x, refined, found, respond)
    verdict = verdict_of(case, found, court.candidates, asked.proposals, where, shrink, able, notes, heard)
    shown = exhibits(asked.model, maps, known.simulations, court.null, found, court.candidates, asked.proposals)
    told = dataset(court, x, replace(refined, attribution=found), where, verdict)
    evidence = told.merge(shown, combine_attrs="no_conflicts")
    return Diagnosis(verdict, evidence, found)


def confirmed(
    court: Court, found: Attribution, shrink: tuple[Prediction, Shrink, str] | None, notes: list[str]
) -> tuple[Attribution, tuple[Prediction, Shrink, str] | None]:
    """Attribution and shrink, where they hold once the set that fits best is simulated.

    What opens the gap, or closes less than half of what it was forecast to close, both beyond error, is not what is
    there, and is not named. Half of the data that shows no gap beyond its own error measures no share of it.
    """
    if shrink is None:
        return found, None
    before, fraction, expected = shrink[1].before, shrink[1].fraction, shrink[0].fraction
    opened = fraction.value * before.value + OPENED * fraction.sigma * abs(before.value) < 0.0
    short = expected.value - fraction.value > OPENED * np.hypot(expected.sigma, fraction.sigma)
    if opened or (short and before.value > 0.0 and fraction.value < 0.5 * min(expected.value, 1.0)):
        best = " and ".join(court.asked.proposals[member].label for member in found.explanations[0].members)
        does = f"opens the gap of the other from {before.value:.3g} to {shrink[1].after.value:.3g}"
        if shrink[1].after.value < before.value:
            does = f"takes {fraction.value:.0%} of the other's gap, where {expected.value:.0%} were forecast"
        notes.append(f"What fits best, {best}, is not named: simulated with its amplitude from one half, it {does}.")
        return found.unexplained(), None
    if before.value < before.sigma:
        notes.append(
            f"No shrink is given: the half that would measure it shows no gap by itself ({before.value:.2g} +- "
            f"{before.sigma:.2g})."
        )
        return found, None
    return found, shrink


def _with_errors(court: Court, refined: Refined, found: Attribution, respond: Responses) -> Attribution:
    """The attribution, the best set with the errors that its amplitudes have where its effects act.

    Of effects that draw the scatter is known already: it has widened the null that they were fitted with.
    """
    best = found.explanations[0]
    if any(refined.candidates[member].scatter is not None for member in best.members):
        return found
    try:
        acting = tables_at(court.candidates, court.asked.proposals, best.members, best.fit)
        before, after = respond.pair(acting)
    except InputError:
        return found  # between what was fitted and what can be
    t = refined.templates[:, columns_of(court.candidates, best.members)]
    own = replace(best, fit=scattered(court.null, t, best.fit, before, after))
    return replace(found, explanations=(own, *found.explanations[1:]))


def heard_of(court: Court, x: Vector, refined: Refined, found: Attribution, respond: Respond) -> Closest | None:
    """What of the library is heard in a gap that it does not explain."""
    if found.verdict != "unknown" or refined.heard is not None:
        return refined.heard
    rest = court.asked.proposals, court.calibration, respond
    return heard_in(court.null, x, refined.templates, refined.candidates, *rest)


def shrink_of(court: Court, x: Vector, refined: Refined, respond: Respond) -> tuple[Prediction, Shrink, str] | None:
    """Fit one half of the evidence, freeze, add to the simulator, and look at the other half.

    The best explanation is fitted to the entries of fold 0 alone; the ensemble is simulated again with its effects; the
    gap of the entries of fold 1, whose noise is independent, is measured against both ensembles, the second one
    scattered by what draws. None where one half hardly hears the effect: without splits the halves are degrees and
    pixels, which say little of beams and pointing.
    """
    folds = np.array([-1 if entry.fold is None else entry.fold for entry in court.asked.entries])
    used, fresh = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
    if not len(used) or not len(fresh):
        return None
    members = refined.attribution.explanations[0].members
    columns = columns_of(court.candidates, members)
    change = refined.templates[:, columns] @ refined.attribution.explanations[0].fit.amplitudes
    heard = min(court.known.null(rows).length(change[rows]) for rows in (used, fresh))
    if heard < HEARD * court.null.length(change):
        return None
    chosen = np.array(columns)
    scatters = [one for one in (refined.candidates[member].scatter for member in members) if one is not None]
    learning, before = court.known.null(used), court.known.null(fresh)
    frozen = fit(learning.widened(*(one[used] for one in scatters)), x[used], refined.templates[np.ix_(used, chosen)])
    try:
        acting = tables_at(court.candidates, court.asked.proposals, members, frozen)
        mean = before.mean + respond(acting, CONSTRAINED_SKIES).mean(axis=0)[fresh]
    except InputError:
        return None  # half of the evidence asks for an amplitude that the effect cannot have
    after = replace(before, mean=mean).widened(*(one[fresh] for one in scatters))
    here = refined.templates[np.ix_(fresh, chosen)]
    if scatters:
        response = refined.templates[:, chosen] @ frozen.amplitudes
        squares = _squares(before, response, scatters, fresh), _squares(learning, response, scatters, used)
        noise = fit(learning, x[used], refined.templates[np.ix_(used, chosen)]).covariance
        expected = carried(before, after, x[fresh], here, noise, excess(learning, x[used]), *squares)
    else:
        expected = predicted(before, x[fresh], here, frozen.amplitudes, frozen.covariance)
    return expected, achieved(before, after, x[fresh]), _fresh_words(court)


def _squares(null: Null, response: Vector, scatters: Sequence[NDArray[np.float64]], rows: NDArray[np.int64]) -> Vector:
    """White squares of the draws of a response."""
    deviations = reduce(np.add, [np.sqrt(scatter.shape[1]) * scatter for scatter in scatters])
    return np.array([null.length(draw) ** 2 for draw in (response + deviations.T)[:, rows]])


def _fresh_words(court: Court) -> str:
    splits = court.run.map.splits
    if len(splits) < 2:
        return "odd degrees, alternate pixels"
    return f"{' and '.join(splits[1::2])} (frozen on {' and '.join(splits[::2])})"


def _exchanged(court: Court, maps: Sequence[NDArray[np.float64]], found: Attribution) -> list[str]:
    """Orders of the maps in which the model fits, where it does not as they are and no single effect explains it."""
    if found.gap.omnibus > EXCHANGED or (found.explanations and len(found.explanations[0].members) == 1):
        return []  # as they are the maps fit as well, or one effect says what is wrong
    names = [part.name for part in court.asked.model.parts]
    notes = []
    for order in exchanges(names):
        p = court.null.probability(court.asked.answer([maps[i] for i in order]))
        if p > EXCHANGED:
            moved = [f"{names[i]} as {name}" for name, i in zip(names, order, strict=True) if names[i] != name]
            notes.append(f"The model fits (p = {p:.2g}) with maps exchanged: {', '.join(moved)}.")
    return notes


def _where(court: Court, x: Vector, numbers: Vector) -> list[Place]:
    """Places in the atlas, and in what of the evidence is matched to no effect."""
    own = [i for i, entry in enumerate(court.asked.entries) if entry.statistic != "score"]
    count = len(court.known.atlas)
    drawn = np.concatenate([court.known.atlas, court.known.simulations[:count][:, own]], axis=1)
    shifted = x[own] - court.known.offset[own]
    entries = (*court.asked.atlas.entries, *(court.asked.entries[i] for i in own))
    return places(np.concatenate([numbers, shifted]), drawn, entries)


def dataset(court: Court, x: Vector, refined: Refined, where: Sequence[Place], verdict: dict[str, Any]) -> xr.Dataset:
    """Everything measured, with names and units."""
    known = court.known
    spread = known.simulations.std(axis=0, ddof=1)
    found = refined.attribution
    entry = [e.name for e in court.asked.entries]
    column = [f"{p.label}/{k}" for p in court.asked.proposals for k in range(len(p.basis))]
    candidate = [p.label for p in court.asked.proposals]
    best = np.zeros(len(entry))
    if found.explanations:
        columns = columns_of(court.candidates, found.explanations[0].members)
        best = refined.templates[:, columns] @ found.explanations[0].fit.amplitudes
    return xr.Dataset(
        {
            "data": ("entry", x, {"long_name": "evidence of the data"}),
            "mean": ("entry", court.null.mean, {"long_name": "mean of the model, referee's offset included"}),
            "standard_deviation": ("entry", spread, {"long_name": "scatter of the model"}),
            "z": ("entry", (x - court.null.mean) / spread, {"long_name": "data less mean, over scatter"}),
            "explained": ("entry", best / spread, {"long_name": "best explanation, over scatter"}),
            "templates": (("entry", "column"), refined.templates, {"long_name": "response per unit coordinate"}),
            "correlation": (("candidate", "other"), found.correlation, {"long_name": "white canonical correlation"}),
            "drop": ("candidate", [s.drop for s in found.singles], {"long_name": "fall of chi^2, fitted alone"}),
            "calibration": ("draw", court.calibration.combined, {"long_name": "smaller probability, without a gap"}),
            "place_z": ("place", [p.z for p in where], {"long_name": "deviate of a group"}),
            "place_p": ("place", [p.p for p in where], {"long_name": "probability, trials included"}),
        },
        coords={"entry": entry, "column": column, "candidate": candidate, "other": candidate},
        attrs={
            "verdict": json.dumps(verdict),
            "configuration": config.to_json(court.run),
            "entries": json.dumps([asdict(e) for e in court.asked.entries]),
            "places": json.dumps([asdict(p.entry) for p in where]),
            "simulations": len(known.simulations),
            "skies_of_responses": CONSTRAINED_SKIES,
        },
    )
