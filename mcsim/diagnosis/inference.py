"""Infer from one data set whether, where, by which effects and how far it departs from the model."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mcsim import config
from mcsim.diagnosis.candidate import columns_of, tables_at
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.places import Place
from mcsim.diagnosis.refine import Refined, Refiner, with_scatter
from mcsim.diagnosis.report_arrays import report_arrays
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.validation import Halves, Prediction, Shrink
from mcsim.diagnosis.verdict import detectable_of, sentence, verdict_of
from mcsim.errors import InputError
from mcsim.stats.gaussian import Fit

Vector = NDArray[np.float64]
Reduction = tuple[Prediction, Shrink, str]


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


def diagnose_data(data: DataSet, case: str) -> Diagnosis:
    """Diagnose observed maps or measured spectra.

    Parameters
    ----------
    data
        :class:`~mcsim.diagnosis.observed_maps.ObservedMaps` or
        :class:`~mcsim.diagnosis.measured_spectra.MeasuredSpectra`.
    case
        Name of the case.

    Raises
    ------
    InputError
        If the data cannot be what they claim to be.
    """
    context = data.context
    analysis, candidates = context.analysis, context.candidates
    refiner = Refiner(
        context.null, data.x, context.calibration, context.bank.curvature, data.respond, context.settings,
        data.realizations,
    )  # fmt: skip
    refined = refiner.run(data.templates(), candidates)
    found = refined.attribution
    exchanged = data.exchanged(found)
    notes = [*exchanged, *data.notes()]
    if exchanged:
        # An order of the maps in which the model fits says more than any effect.
        found = found.unexplained()
    reduction = None
    if found.explanations:
        found = _with_errors(data, refined, found)
        found, reduction = confirmed(context, found, reduction_of(data, refined), notes)
    where = data.places()
    able = detectable_of(context.null, refined.templates, candidates)
    partial = None if exchanged else refined.partial
    if partial is None and not exchanged and found.verdict == "unknown":
        partial = refiner.detected_in(refined.templates, refined.candidates)
    verdict = verdict_of(case, found, candidates, where, reduction, able, notes, partial)
    maps = data.maps()
    # Measured spectra have no maps to show.
    shown = maps or [np.zeros(12 * analysis.model.nside**2) for _ in analysis.model.parts]
    arrays = report_arrays(analysis.model, shown, context.ensemble.simulations, context.null, found, candidates)
    if maps is None:
        arrays = arrays.drop_vars(["residual_map", "map"])
    evidence = dataset(context, data.x, replace(refined, attribution=found), where, verdict)
    evidence = evidence.merge(arrays, combine_attrs="no_conflicts").assign_attrs(data.attrs())
    return Diagnosis(verdict, evidence, found)


def confirmed(
    context: DiagnosisContext, found: Attribution, reduction: Reduction | None, notes: list[str]
) -> tuple[Attribution, Reduction | None]:
    """Return attribution and reduction if they hold once the best set is simulated.

    A set that increases the excess chi^2 of the held-out data, or reduces it by less than half of the prediction, both
    beyond error, is not named. Held-out data without excess beyond its own error measure no reduction. ``notes`` gets
    a sentence on either.
    """
    if reduction is None:
        return found, None
    limit = context.settings.reduction_sigma
    before, fraction, expected = reduction[1].before, reduction[1].fraction, reduction[0].fraction
    increased = fraction.value * before.value + limit * fraction.sigma * abs(before.value) < 0.0
    short = expected.value - fraction.value > limit * np.hypot(expected.sigma, fraction.sigma)
    if increased or (short and before.value > 0.0 and fraction.value < 0.5 * min(expected.value, 1.0)):
        best = " and ".join(context.candidates[member].label for member in found.explanations[0].members)
        does = f"increases the excess chi^2 of the other from {before.value:.3g} to {reduction[1].after.value:.3g}"
        if reduction[1].after.value < before.value:
            does = f"removes {fraction.value:.0%} of the other's excess chi^2, not the predicted {expected.value:.0%}"
        notes.append(f"The best fit, {best}, is not named: simulated with its amplitude from one half, it {does}.")
        return found.unexplained(), None
    if before.value < before.sigma:
        notes.append(
            f"No reduction is given: the half that would measure it has no excess chi^2 by itself ({before.value:.2g} "
            f"+- {before.sigma:.2g})."
        )
        return found, None
    return found, reduction


def _with_errors(data: DataSet, refined: Refined, found: Attribution) -> Attribution:
    """Return the attribution, the best set with the errors that its amplitudes have with its effects in the data.

    The scatter of stochastic effects is known already: the fit was made with it.
    """
    context, best = data.context, found.explanations[0]
    if any(refined.candidates[member].scatter is not None for member in best.members):
        return found
    try:
        pair = data.respond.pair(tables_at(context.candidates, best.members, best.fit))
    except InputError:
        return found  # between what was fitted and what can be
    if pair is None:
        return found
    t = refined.templates[:, columns_of(context.candidates, best.members)]
    own = replace(best, fit=with_scatter(context.null, t, best.fit, *pair))
    return replace(found, explanations=(own, *found.explanations[1:]))


def reduction_of(data: DataSet, refined: Refined) -> Reduction | None:
    """Fit one half of the data vector, freeze, add the effects to the simulator, and test the other half.

    None if there are no halves, one of them is hardly sensitive to the effects, or the half that is fitted asks for an
    amplitude that an effect cannot have. Without splits the halves are degrees and pixels, which constrain beams and
    pointing little.
    """
    context = data.context
    members, best = refined.attribution.explanations[0].members, refined.attribution.explanations[0].fit
    t = refined.templates[:, columns_of(context.candidates, members)]
    scatters = [one for one in (refined.candidates[member].scatter for member in members) if one is not None]
    ensemble, x, snr = context.ensemble, data.x, context.null.expected_snr(t @ best.amplitudes)
    matrix, words = data.halves()
    if matrix is not None:
        ensemble, x, t, scatters = ensemble.remix(matrix), matrix @ x, matrix @ t, [matrix @ one for one in scatters]
    halves = Halves.of(ensemble, x)
    if halves is None or halves.expected_snr(t @ best.amplitudes) < context.settings.half_snr_share * snr:
        return None

    def respond(frozen: Fit) -> Vector:
        acting = tables_at(context.candidates, members, frozen)
        change: Vector = data.respond(acting, context.settings.constrained_skies).mean(axis=0)
        return change if matrix is None else matrix @ change

    try:
        return *halves.reduction(t, respond, scatters), words
    except InputError:
        return None


def dataset(
    context: DiagnosisContext, x: Vector, refined: Refined, where: Sequence[Place], verdict: dict[str, Any]
) -> xr.Dataset:
    """Everything measured, with names and units."""
    known = context.ensemble
    spread = known.simulations.std(axis=0, ddof=1)
    found = refined.attribution
    element = [e.name for e in context.analysis.elements]
    column = [f"{p.label}/{k}" for p in context.candidates for k in range(len(p.columns))]
    candidate = [p.label for p in context.candidates]
    best = np.zeros(len(element))
    if found.explanations:
        columns = columns_of(context.candidates, found.explanations[0].members)
        best = refined.templates[:, columns] @ found.explanations[0].fit.amplitudes
    return xr.Dataset(
        {
            "data": ("entry", x, {"long_name": "evidence of the data"}),
            "mean": (
                "entry",
                context.null.mean,
                {"long_name": "mean of the model, with the offset of the reference"},
            ),
            "standard_deviation": ("entry", spread, {"long_name": "scatter of the model"}),
            "z": ("entry", (x - context.null.mean) / spread, {"long_name": "data less mean, over scatter"}),
            "explained": ("entry", best / spread, {"long_name": "best explanation, over scatter"}),
            "templates": (("entry", "column"), refined.templates, {"long_name": "response per unit coordinate"}),
            "correlation": (("candidate", "other"), found.correlation, {"long_name": "white canonical correlation"}),
            "drop": ("candidate", [s.delta_chi2 for s in found.singles], {"long_name": "fall of chi^2, fitted alone"}),
            "calibration": ("draw", context.calibration.combined, {"long_name": "smaller probability, without a gap"}),
            "place_z": ("place", [p.z for p in where], {"long_name": "deviate of a group"}),
            "place_p": ("place", [p.p for p in where], {"long_name": "probability, trials included"}),
        },
        coords={"entry": element, "column": column, "candidate": candidate, "other": candidate},
        attrs={
            "verdict": json.dumps(verdict),
            "configuration": config.to_json(context.run),
            "entries": json.dumps([asdict(e) for e in context.analysis.elements]),
            "places": json.dumps([asdict(p.element) for p in where]),
            "simulations": len(known.simulations),
            "skies_of_responses": context.settings.constrained_skies,
            "settings": json.dumps(asdict(context.settings)),
        },
    )
