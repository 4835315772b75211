"""Measured spectra instead of maps: a table of binned BipoSH coefficients, or C_l, against simulations of the model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import config, systematics
from mcsim.beamfit.data import Row, Scaling, parts, project
from mcsim.beamfit.table import COLUMNS, in_uk2, read_ecsv, scaling_of
from mcsim.bipolar import Mode
from mcsim.diagnosis import knowledge
from mcsim.diagnosis.analysis import Analysis, Job, analysis_of
from mcsim.diagnosis.inference import Diagnosis, DiagnosisContext, confirmed, dataset, partial_explanation_of, shrink_of
from mcsim.diagnosis.knowledge import Ask, Knowledge, Plan
from mcsim.diagnosis.refine import Refined, Respond, refine, significant_templates
from mcsim.diagnosis.report_arrays import report_arrays
from mcsim.diagnosis.summaries import Block, Element
from mcsim.diagnosis.validation import Prediction, Shrink
from mcsim.diagnosis.verdict import detectable_of, verdict_of
from mcsim.diagnosis.where import Place, places
from mcsim.errors import InputError
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import FRAMES, rotate_biposh
from mcsim.systematics import Effect

Vector = NDArray[np.float64]

SKIES = 24
"""Skies that a response is the mean of: in spectra of one sky it scatters with that sky."""

TOO_QUIET = 1e-6
"""Probability of so small a departure, below which the table cannot be what it says."""

POWER_RATIO = 25.0
LARGEST = 1000.0
"""Median ratio of C_l to the model's, and size of BipoSH in standard deviations, beyond which the unit is wrong."""

CORRELATED = 5.0
"""Correlation of two entries, times the root of the number of simulations, that is no chance."""

_SPECTRAL_HOOKS = ("sky", "beam", "pointing", "spread", "orientations", "noise")
"""Hooks that change spectra of a map. A drift of the gain does so in the lowest degrees only and is not proposed."""


@dataclass(frozen=True)
class Spectra:
    """A table of measured spectra.

    Attributes
    ----------
    path
        Where it is from.
    frame
        Of its coefficients.
    rows, pairs
        What each number is, and the pair of maps that it belongs to.
    scaling
        Of all numbers.
    value, error
        uK^2, shape (p,); an error is NaN where the table has none.
    realizations
        Number of skies that the values are the mean of.
    """

    path: str
    frame: str
    rows: tuple[Row, ...]
    pairs: tuple[str, ...]
    scaling: Scaling
    value: Vector
    error: Vector
    realizations: int

    @property
    def elements(self) -> tuple[Element, ...]:
        """Where every number was heard; bins are in fold 0 and 1 alternately."""
        bins = sorted({(row.ell_min, row.ell_max) for row in self.rows})
        return tuple(self._entry(row, pair, bins) for row, pair in zip(self.rows, self.pairs, strict=True))

    def _entry(self, row: Row, pair: str, bins: Sequence[tuple[int, int]]) -> Element:
        maps = [name.partition(":") for name in pair.split(",")]
        splits = {name[2] for name in maps if name[2]}
        ell, mode = (row.ell_min, row.ell_max), row.mode
        kind = f"BipoSH {mode.name}, {'imaginary' if row.imaginary else 'real'}" if mode.L else "spectrum"
        return Element(
            f"{kind}/{pair}/{ell[0]}-{ell[1]}, {_words(self.scaling)}",
            "biposh" if mode.L else "cl",
            tuple(dict.fromkeys(name[0] for name in maps)),
            splits.pop() if len(splits) == 1 else None,
            bins.index(ell) % 2,
            ell,
            mode.L,
            mode.M,
            mode.parity,
            self.frame,
        )

    def of(self, simulated: config.RunConfig, first: int, count: int) -> NDArray[np.float64]:
        """The same numbers of simulations, shape (count, p), by the function that runs an ensemble."""
        shared = survey(simulated)
        found = [simulate.realize(shared, r)["biposh"] for r in range(first, first + count)]
        biposh, labels = np.stack(found), list(shared.pair_names)
        result = np.empty((count, len(self.rows)))
        for pair in dict.fromkeys(self.pairs):
            own = [i for i, name in enumerate(self.pairs) if name == pair]
            coefficients = biposh[:, labels.index(pair)]
            rows = [self.rows[i] for i in own]
            spectra = {row.mode: coefficients[:, shared.estimator.modes.index(row.mode)] for row in rows}
            result[:, own] = project(rows, self.scaling, spectra)
        return result

    def __call__(self, job: Job) -> NDArray[np.float64]:
        """Task: the evidence of simulations."""
        return self.of(config.from_json(job.simulated), job.first, job.count)


def read_spectra(path: str | Path, run: config.RunConfig) -> Spectra:
    """Read measured spectra that a run claims to describe.

    Parameters
    ----------
    path
        ECSV table as for :func:`mcsim.beamfit.read_table`, with rows L = M = d = 0 for power spectra, which in the
        Bennett normalisation are C_l. Several pairs stand together; without a column ``pair`` the table belongs to the
        first map. Without ``value_imag`` only real parts are used; ``error`` may be left out. The header's ``meta``
        must give ``normalisation``, ``scaling`` and, unless all rows have L = 0, ``frame``; ``realizations`` says of
        how many skies the values are the mean (default: 1).
    run
        What is believed.

    Raises
    ------
    InputError
        For a table that cannot be read, leaves open what its numbers are, or goes beyond the run.
    """
    table = read_ecsv(path)
    missing = [name for name in (*COLUMNS, "value") if name not in table.colnames]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}; give {', '.join(COLUMNS)} and value.")
    scaling = scaling_of(path, table.meta)
    maps = config.map_names(run)
    known = [f"{x},{y}" for i, x in enumerate(maps) for y in maps[i:]]
    lmax = config.analysis_lmax(run)
    real = in_uk2(path, table, "value")
    unknown: Vector = np.full(len(table), np.nan)
    imag = in_uk2(path, table, "value_imag") if "value_imag" in table.colnames else unknown
    stated = in_uk2(path, table, "error") if "error" in table.colnames else unknown
    rows: list[Row] = []
    pairs: list[str] = []
    values: list[float] = []
    errors: list[float] = []
    for number, line in enumerate(table):
        mode, low, high = _mode(path, line, scaling), int(line["ell_min"]), int(line["ell_max"])
        pair = str(line["pair"]) if "pair" in table.colnames else known[0]
        if pair not in known:
            raise InputError(f"{path}: {pair} is no pair of the model's maps; use one of {'; '.join(known)}.")
        if not 0 <= low <= high <= lmax:
            raise InputError(
                f"{path}: the bin ell = {low} ... {high} is not within 0 ... {lmax}, the model's analysis; leave the "
                "row out or raise sky.lmax."
            )
        ell = np.arange(low, high + 1)
        other = ell - mode.d
        exists = (other >= 0) & (other <= lmax) & (other + ell >= mode.L)
        alone = len(set(pair.split(","))) == 1
        if not exists.any() or (alone and not mode.in_auto):
            raise InputError(
                f"{path}: there is no {mode.name} of {pair} at l2 = {low} ... {high}, or it repeats another; leave the "
                "row out."
            )
        for imaginary in parts(mode):
            value = float((imag if imaginary else real)[number])
            if imaginary and not np.isfinite(value):
                continue
            if not np.isfinite(value):
                raise InputError(f"{path}: {mode.name} at ell = {low}-{high} is {value:g}; leave the row out.")
            rows.append(Row(mode, low, high, imaginary))
            pairs.append(pair)
            values.append(value)
            # The error of a mode with M > 0 is that of its modulus; its two parts share the variance.
            errors.append(float(stated[number]) * (1.0 if mode.M == 0 else np.sqrt(0.5)))
    if len(set(zip(rows, pairs, strict=True))) < len(rows) or not rows:
        raise InputError(f"{path} gives a bin of one mode twice, or nothing at all; keep one row of each.")
    frame = _frame(path, table.meta, run, any(row.mode.L for row in rows))
    count = _realizations(path, table.meta)
    return Spectra(
        str(path), frame, tuple(rows), tuple(pairs), scaling, np.array(values), np.array(errors), realizations=count
    )


def _words(scaling: Scaling) -> str:
    factor = "l(l+1)/2pi" if scaling.spectrum else "1"
    return f"{'Bennett' if scaling.bennett else 'Hajian-Souradeep'} times {factor}"


def _mode(path: str | Path, line: Any, scaling: Scaling) -> Mode:
    mode = Mode(int(line["L"]), int(line["M"]), int(line["d"]))
    if not (0 <= mode.M <= mode.L and abs(mode.d) <= mode.L):
        raise InputError(f"{path}: the mode {mode.name} does not exist; it needs 0 <= M <= L and |d| <= L.")
    if mode.parity == "odd" and scaling.bennett and not scaling.summary:
        raise InputError(
            f"{path}: {mode.name} has odd parity, which the Bennett normalisation does not have; leave it out."
        )
    return mode


def _frame(path: str | Path, meta: Any, run: config.RunConfig, needed: bool) -> str:
    frame = run.map.frame
    found = str(meta.get("frame", "" if needed else frame)).lower()
    if not found:
        raise InputError(f'{path} does not say its frame; add frame: "{frame}" to its meta, if that is the one.')
    if found != frame:
        raise InputError(f"{path} is in the {found} frame, the model in the {frame} one; set map.frame to {found}.")
    return found


def _realizations(path: str | Path, meta: Any) -> int:
    count = meta.get("realizations", 1)
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InputError(f"{path} is the mean of {count!r} realizations; give a whole number from 1 in its meta.")
    return count


def estimator_for(run: config.RunConfig, measured: Spectra) -> config.RunConfig:
    """The run with the estimator that a table needs: its L, its pairs, no twins; what is believed stays."""
    both = any(name.partition(",")[0] != name.partition(",")[2] for name in measured.pairs)
    biposh = replace(run.biposh, L_max=max(row.mode.L for row in measured.rows), pairs="all" if both else "auto")
    return replace(run, biposh=biposh, ensemble=replace(run.ensemble, paired=False, keep_maps=False))


def analysis_of_spectra(
    run: config.RunConfig, measured: Spectra, without: Sequence[str] = (), nthreads: int = 1
) -> Analysis:
    """What to ask of a table: effects of the library that change spectra; the numbers of the table are the evidence."""
    deaf = [name for name, kind in systematics.catalogue().items() if not _changes_spectra(kind)]
    analysis = analysis_of(run, (*without, *deaf), nthreads)
    return replace(analysis, blocks=(Block(measured.elements, lambda model, filtered: measured.value),))


def _changes_spectra(kind: type[Effect]) -> bool:
    return any(getattr(kind, hook) is not getattr(Effect, hook) for hook in _SPECTRAL_HOOKS)


def plan(run: config.RunConfig, analysis: Analysis, simulations: int | None = None) -> Plan:
    """All simulations that a table is judged with: of the model, and with every effect and without it, same skies."""
    whole = knowledge.plan(run, analysis, simulations, time_ordered=False)
    kept = [
        (replace(job, count=SKIES) if purpose[0] == "response" else job, purpose)
        for job, purpose in zip(whole.jobs, whole.purposes, strict=True)
    ]
    return Plan(tuple(job for job, _ in kept), tuple(purpose for _, purpose in kept))


def _after(run: config.RunConfig, analysis: Analysis, found: Sequence[config.Effect]) -> list[Job]:
    """Simulations with effects at frozen amplitudes, of the skies of the responses."""
    planned = plan(run, analysis, 0)
    return [
        replace(job, simulated=config.to_json(knowledge.with_effects(config.from_json(job.simulated), found)))
        for job, purpose in zip(planned.jobs, planned.purposes, strict=True)
        if purpose[0] == "reference"
    ]


def of_mean(known: Knowledge, realizations: int) -> Knowledge:
    """What simulations say of the mean of several skies.

    Notes
    -----
    A mean of R skies less that of N simulations has the covariance C (1/R + 1/N); the tests take it to be 1 + 1/N times
    that of the simulations. These are drawn together about their mean until it is: the tests stay exact.
    """
    count = len(known.simulations)
    scale = np.sqrt((count + realizations) / (realizations * (count + 1.0)))
    mean = known.simulations.mean(axis=0)
    return replace(known, simulations=mean + scale * (known.simulations - mean))


def diagnose_maps(context: DiagnosisContext, case: str, measured: Spectra, ask: Ask) -> Diagnosis:
    """Judge a table of spectra.

    Parameters
    ----------
    court
        Of the model, with :func:`of_mean` of what its simulations have taught.
    case
        Name of the case.
    measured
        The table.
    ask
        Runs further simulations, with effects at the amplitudes that are found.

    Raises
    ------
    InputError
        For numbers that cannot be in the unit, or the mean of as many skies, as the table says.

    Notes
    -----
    The scatter is always that of simulations of the model, over the number of skies behind the mean: it knows how the
    numbers hang together, which errors in a table do not say. These are only compared with it, in a note.
    The shrink is fitted to every other bin and judged on the others. Where simulations find entries of the two
    correlated, what the former predict of the latter is taken out; the correlation that remains is stated.
    Rotated to other frames are only spectra with every M, real and imaginary.
    """
    analysis, known, x = context.analysis, context.known, measured.value
    _check(measured, context)

    def respond(found: Sequence[config.Effect], skies: int) -> NDArray[np.float64]:
        # Whatever number is asked for: each of these skies has its spectra already.
        after = np.concatenate(ask(_after(context.run, analysis, found)))
        changes: NDArray[np.float64] = after - known.reference[: len(after)]
        return changes

    t = significant_templates(known)
    refined = refine(
        known,
        context.null,
        x,
        t,
        context.candidates,
        analysis.proposals,
        context.calibration,
        respond,
        measured.realizations,
    )
    found = refined.attribution
    notes = list(_notes(measured, known.simulations))
    shrink = None
    if found.explanations:
        found, shrink = confirmed(context, found, _shrink(context, x, refined, respond), notes)
    where = _where(measured, known.simulations)
    able = detectable_of(context.null, refined.templates, context.candidates, analysis.proposals)
    filtered = partial_explanation_of(context, x, refined, found, respond)
    verdict = verdict_of(case, found, context.candidates, analysis.proposals, where, shrink, able, notes, filtered)
    # Of no sky: a table has no maps to show.
    dark = [np.zeros(12 * analysis.model.nside**2) for _ in analysis.model.parts]
    shown = report_arrays(
        analysis.model, dark, known.simulations, context.null, found, context.candidates, analysis.proposals
    )
    evidence = dataset(context, x, replace(refined, attribution=found), where, verdict)
    evidence = evidence.merge(shown.drop_vars(["residual_map", "map"]), combine_attrs="no_conflicts")
    evidence.attrs |= {"table": measured.path, "skies_behind_the_mean": measured.realizations}
    return Diagnosis(verdict, evidence, found)


def _check(measured: Spectra, context: DiagnosisContext) -> None:
    power = np.array([row.mode.L == 0 for row in measured.rows])
    size = np.abs(measured.value) / np.sqrt(np.mean(context.known.simulations**2, axis=0))
    unit = "is the unit in its header the right one, and the scaling?"
    if power.any() and not 1.0 / POWER_RATIO < np.median(size[power]) < POWER_RATIO:
        raise InputError(
            f"{measured.path}: C_l are {np.median(size[power]):.2g} times the model's, beyond {POWER_RATIO:g}; {unit}"
        )
    if not power.all() and np.median(size[~power]) > LARGEST:
        raise InputError(
            f"{measured.path}: BipoSH are {np.median(size[~power]):.2g} times as large as the simulations', beyond "
            f"{LARGEST:g}; {unit}"
        )
    if 1.0 - context.null.pvalue(measured.value) < TOO_QUIET:
        raise InputError(
            f"{measured.path} departs from the model by chi^2 = {context.null.chi2(measured.value):.2g} in "
            f"{context.null.dimension} numbers, far less than a mean of {measured.realizations} skies can; say of how "
            "many in its meta (realizations), or correct its unit."
        )


def _notes(measured: Spectra, simulations: NDArray[np.float64]) -> Iterator[str]:
    ratio = float(np.median(measured.error / simulations.std(axis=0, ddof=1)))
    if np.isfinite(ratio) and not 0.5 < ratio < 2.0:
        yield (
            f"The table's errors are {ratio:.2g} times the scatter of simulations of the model for a mean of "
            f"{measured.realizations} skies; the latter was used."
        )


def _shrink(
    context: DiagnosisContext, x: Vector, refined: Refined, respond: Respond
) -> tuple[Prediction, Shrink, str] | None:
    """As :func:`shrink_of`, with fresh entries from which the others predict nothing."""
    turn, words = _independent(context)
    known = replace(context.known, simulations=context.known.simulations @ turn.T, offset=turn @ context.known.offset)
    turned = replace(
        refined,
        templates=turn @ refined.templates,
        candidates=tuple(c if c.scatter is None else replace(c, scatter=turn @ c.scatter) for c in refined.candidates),
    )
    found = shrink_of(
        replace(context, known=known), turn @ x, turned, lambda effects, skies: respond(effects, skies) @ turn.T
    )
    return None if found is None else (found[0], found[1], words)


def _independent(context: DiagnosisContext) -> tuple[NDArray[np.float64], str]:
    """Matrix that takes from the entries of fold 1 what those of fold 0 predict, and the correlation in words."""
    folds = np.array([element.fold for element in context.analysis.elements])
    used, fresh = np.flatnonzero(folds == 0), np.flatnonzero(folds == 1)
    count, size = len(context.known.simulations), len(folds)
    if not len(used) or not len(fresh):
        return np.eye(size), ""
    r = np.corrcoef(context.known.simulations.T).reshape(size, size)[np.ix_(fresh, used)]
    rms, chance = float(np.sqrt(np.mean(r**2))), 1.0 / np.sqrt(count)
    words = f"alternate bins (frozen on the others; rms correlation {rms:.3f}, by chance {chance:.3f}"
    hanging = np.any(np.abs(r) > CORRELATED * chance, axis=0)
    turn = np.eye(size)
    if hanging.any():
        known = used[hanging]
        centred = context.known.simulations - context.known.simulations.mean(axis=0)
        slopes = np.linalg.lstsq(centred[:, known], centred[:, fresh], rcond=None)[0]
        turn[np.ix_(fresh, known)] = -slopes.T
        words += f"; what {len(known)} of them predict is taken out"
    return turn, words + ")"


def _where(measured: Spectra, simulations: NDArray[np.float64]) -> list[Place]:
    views = list(_views(measured))
    matrix = np.stack([np.zeros(len(measured.rows)), *(row for _, row in views)])[1:]
    drawn = np.concatenate([simulations, simulations @ matrix.T], axis=1)
    elements = (*measured.elements, *(element for element, _ in views))
    return places(np.concatenate([measured.value, matrix @ measured.value]), drawn, elements)


def _views(measured: Spectra) -> Iterator[tuple[Element, Vector]]:
    """M = 0 in other frames, where the table has every M: entry, and what it is the product of with the values."""
    at = {(pair, row): i for i, (pair, row) in enumerate(zip(measured.pairs, measured.rows, strict=True))}
    for (pair, row), number in at.items():
        mode = row.mode
        if mode.L == 0 or mode.M > 0:
            continue
        family = [Mode(mode.L, M, mode.d) for M in range(mode.L + 1)]
        needed = [(m, part, at.get((pair, row._replace(mode=m, imaginary=part)))) for m in family for part in parts(m)]
        if any(i is None for _, _, i in needed):
            continue
        unit = np.zeros((len(measured.rows), len(family), 1), dtype=np.complex128)
        for m, part, i in needed:
            unit[i, m.M, 0] = 1j if part else 1.0
        for frame in FRAMES:
            if frame != measured.frame:
                turned = rotate_biposh(unit, [(m.L, m.M, m.d) for m in family], measured.frame, frame)[:, 0, 0]
                own = measured.elements[number]
                yield (
                    replace(own, name=f"{own.name} {frame}", frame=frame),
                    turned.imag if row.imaginary else turned.real,
                )
