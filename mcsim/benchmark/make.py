"""Make a challenge: maps of surveys in which something may be wrong, and sealed keys that say what."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark import toml
from mcsim.benchmark.learned_model import LearnedModel, evidence_with, learned_model
from mcsim.benchmark.out_of_library import introduced, load
from mcsim.benchmark.prior import CaseSampler, Drawn, OutOfLibrary, Prior
from mcsim.benchmark.truth import KEYS, MAPS, SEAL, Member, Truth, key_path, new_nonce, sealed, write_whole
from mcsim.diagnosis.analysis import Job, analysis_of
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.batch import Batch, asking, batch
from mcsim.diagnosis.inference import DiagnosisContext
from mcsim.diagnosis.knowledge import after_jobs, seeded, with_effects
from mcsim.diagnosis.refine import significant_templates
from mcsim.errors import InputError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import rng
from mcsim.support.folders import appearing, writable
from mcsim.support.progress import reporting

Vector = NDArray[np.float64]

SETTINGS = "challenge.json"
SKIES = 6
"""Skies that a strength is measured on."""

INVENTED_SKIES = 2
EPSILON = 1e-7
"""Of the interpolation of samples, relative to the dipole: 0.3 nK."""

SMALLER = 0.7
"""Factor between one trial of an amplitude and the next."""

ATTEMPTS = 16
LARGER = 1.5
"""Most that an effect may be stronger than was drawn."""


def make(
    model: str | Path | Mapping[str, Any] | config.RunConfig,
    folder: str | Path,
    cases: int,
    seed: int,
    *,
    sampled_share: float = 0.5,
    prior: Prior | None = None,
    out_of_library: str | Path | None = None,
    simulations: int | None = None,
    workers: int | None = None,
    quiet: bool = True,
) -> Path:
    """Make cases that are not there yet.

    Parameters
    ----------
    model
        A run: what a diagnosis is told to believe.
    folder
        Gets ``cases/case-NNN`` (maps, model.toml, SEAL), ``keys/case-NNN.json`` and ``challenge.json``.
    cases
        Number in all; a folder can be filled in several calls, and a call that was interrupted repeated.
    seed
        Of the draws. It is kept among the keys: who knows it knows them.
    sampled_share
        Share of the maps that are made sample by sample, by another route than that which diagnoses. Inventions always
        are.
    prior
        What is drawn.
    inventions
        Python file with classes of effects that no library has; None: nothing is invented.
    simulations
        That the scatter of the evidence is learned from; default: ten for every number of it.
    workers
        Processes; default: the model's; 0: this one.
    quiet
        Report no progress.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        For a run that cannot be used, or a folder with a challenge of other settings.
    """
    run = model if isinstance(model, config.RunConfig) else config.load(model)
    target, prior, lent = (
        Path(folder),
        prior or Prior(),
        None if out_of_library is None else str(Path(out_of_library).resolve()),
    )
    for channel in survey(run).channels if sampled_share > 0.0 or lent else ():
        sampled.check(channel)
    writable(target)
    settings = {
        "schema": 1,
        "model": config.to_dict(run),
        "prior": prior.plain(),
        "sampled_share": sampled_share,
        "inventions": None if lent is None else sorted(load(lent)),
        "simulations": simulations,
    }
    _settle(target / SETTINGS, settings)
    _settle(target / KEYS / SETTINGS, {"seed": seed})
    names = [f"case-{number:03d}" for number in range(cases)]
    missing = [number for number, name in enumerate(names) if not (target / MAPS / name).is_dir()]
    if not missing:
        return target
    with batch(run.compute.workers if workers is None else workers) as call:
        context = prepared(run, analysis_of(run), asking(call, quiet), simulations)
        sampler = sampler_of(context, prior)
        kinds = sampler.kinds(seed, cases, lent is not None)
        if any(kinds[number] == "invented" for number in missing):
            sampler = replace(sampler, out_of_library=_responses(context, lent, call))
        text = config.to_json(run)
        with reporting("cases", float(len(missing)), "cases", quiet) as report:
            tasks = (
                (text, simulations, str(target), names[number], sampler.draw(kinds, seed, number),
                 *_drawn_seed(seed, number, sampled_share), lent)
                for number in missing
            )  # fmt: skip
            for done, _ in enumerate(call(make_case, tasks)):
                report(float(done + 1))
    return target


def sampler_of(context: DiagnosisContext, prior: Prior) -> CaseSampler:
    """What draws the cases of a model."""
    analysis = context.analysis
    return CaseSampler(
        prior, analysis.proposals, analysis.columns, significant_templates(context.known), context.null.expected_snr, {}
    )


def _settle(path: Path, settings: Mapping[str, Any]) -> None:
    text = json.dumps(settings, indent=1, sort_keys=True) + "\n"
    if not path.is_file():
        write_whole(path, text)
    elif path.read_text() != text:
        raise InputError(f"{path} is of a challenge with other settings; use those again, or another folder.")


def _drawn_seed(seed: int, number: int, share: float) -> tuple[int, bool]:
    draw = rng.generator(seed, number, "challenge/data")
    # Far from the seeds that people choose, and from those that a diagnosis learns with.
    return int(draw.integers(2**40, 2**62)), bool(draw.random() < share)


def _responses(context: DiagnosisContext, out_of_library: str | None, call: Batch) -> dict[str, list[OutOfLibrary]]:
    """Responses of the evidence to a unit of every invention, seen sample by sample, without noise."""
    assert out_of_library is not None  # nothing is invented without
    run, found = context.run, []
    quiet = replace(run, channels=tuple(replace(c, noise=config.Noise()) for c in run.channels))
    for kind in load(out_of_library).values():
        for channel in [None] if kind.scope == "common" else [spec.name for spec in run.channels]:
            found.append((kind, channel, kind(amplitude=kind.step)))
    # An effect of no strength: the dipole is seen and taken off only where there is some effect.
    idle = tuple(config.Effect(name="beam_width", channel=c.name, parameters={"amplitude": 0.0}) for c in run.channels)
    jobs = [_samples(run, with_effects(quiet, idle), out_of_library)]
    for kind, channel, effect in found:
        table = config.Effect(
            name=kind.name, channel=channel, parameters={"amplitude": effect.amplitude, **effect.parameters()}
        )
        jobs.append(_samples(run, with_effects(quiet, (*idle, table)), out_of_library))
    answers: list[Vector] = [np.empty(0)] * len(jobs)
    for index, answer in call(evidence_with, ((job, out_of_library) for job in jobs)):
        answers[index] = answer.mean(axis=0)
    result: dict[str, list[OutOfLibrary]] = {}
    for (kind, channel, effect), answer in zip(found, answers[1:], strict=True):
        result.setdefault(kind.name, []).append(OutOfLibrary(kind, channel, (answer - answers[0]) / effect.amplitude))
    return result


def _samples(fiducial: config.RunConfig, simulated: config.RunConfig, out_of_library: str) -> Job:
    # While they are lent inventions are in the catalogue; they must not be proposed.
    return Job(
        config.to_json(fiducial), config.to_json(simulated), 0, INVENTED_SKIES, True, tuple(load(out_of_library))
    )


def make_case(
    model: str,
    simulations: int | None,
    folder: str,
    case: str,
    drawn: Drawn,
    seed: int,
    sample_by_sample: bool,
    out_of_library: str | None,
) -> str:
    """Task: maps, seal and key of one case; the key first, the folder of the maps, complete, last."""
    target, run = Path(folder), config.from_json(model)
    key = key_path(target, case)
    if key.is_file():
        truth = Truth.read(key)
    else:
        members = drawn.members
        if drawn.kind not in ("none", "invented"):
            members = _measured(model, simulations, members, seed)
        sample_by_sample = sample_by_sample or drawn.kind == "invented"
        truth = Truth(case, drawn.kind, members, drawn.without, seed, sample_by_sample, new_nonce())
        write_whole(key, truth.text())
    with appearing(target / MAPS / case) as scratch:
        for name, map_uk in maps_of(run, truth, out_of_library):
            channel, _, split = name.partition(":")
            _write_map(scratch / f"{channel}{'_' if split else ''}{split}.fits", map_uk, run.map.frame)
        fiducial = {**config.to_dict(run), "name": case}
        (scratch / "model.toml").write_text(toml.text(fiducial))
        (scratch / "question.json").write_text(json.dumps({"without": list(truth.without)}) + "\n")
        (scratch / SEAL).write_text(f"{sealed(key)}  {KEYS}/{case}.json\n")
    return case


def maps_of(run: config.RunConfig, truth: Truth, out_of_library: str | None) -> list[tuple[str, Vector]]:
    """Maps of a truth, by name."""
    data = with_effects(seeded(run, truth.seed), [member.table() for member in truth.members])
    with introduced(out_of_library):
        shared = survey(data)
        if truth.sampled:
            return sampled.maps(shared, 0, epsilon=EPSILON)
        return list(zip(shared.map_names, simulate.maps(shared, 0), strict=True))


def _measured(model: str, simulations: int | None, members: Sequence[Member], seed: int) -> tuple[Member, ...]:
    """Members with the strengths that their amplitudes have; smaller ones where the drawn amplitude is impossible.

    So too where the effect, far beyond a straight line, is much stronger than was drawn. What draws has the strength of
    its mean response, any other effect that of its response in the sky and noise of the case.
    """
    learned = learned_model(model, simulations)
    null = learned.context.null
    found = []
    for member in members:
        for attempt in range(ATTEMPTS):
            factor = SMALLER**attempt
            assert member.candidate is not None  # it is of the library
            proposal = learned.context.analysis.proposals[member.candidate]
            scaled = {**member.parameters, "amplitude": factor * member.parameters["amplitude"]}
            effect = proposal.kind(**scaled)
            try:
                jobs = after_jobs(learned.context.run, learned.context.analysis, [proposal.table(effect)], SKIES)
                one, two = (answer for answer in learned.ask(jobs))
            except InputError:
                continue
            reference = learned.context.known.reference
            # Two halves of the skies, so that their noise does not count as strength.
            halves = (one - reference[: len(one)], two - reference[len(one) : len(one) + len(two)])
            first, second = (null.whiten_templates(half.mean(axis=0)[:, None])[:, 0] for half in halves)
            strength = float(np.sqrt(max(null.unbiased * float(first @ second), 0.0)))
            if strength > LARGER * member.strength and attempt + 1 < ATTEMPTS:
                continue  # its response is no straight line
            coordinates = tuple(float(value) for value in effect.coordinates())
            if not proposal.kind.draws:
                strength = _strength_here(learned, proposal.table(effect), seed)
            found.append(replace(member, parameters=scaled, coordinates=coordinates, strength=strength))
            break
        else:
            raise InputError(f"effect {member.name} can have no amplitude that is strong enough; leave it out.")
    return tuple(found)


def _strength_here(learned: LearnedModel, effect: config.Effect, seed: int) -> float:
    """White length of what an effect changes in one sky; a modulation, say, makes a dipole of its quadrupole."""
    run = seeded(learned.context.run, seed)
    fiducial = config.to_json(learned.context.run)
    jobs = [Job(fiducial, config.to_json(with_effects(run, effects)), 0, 1) for effects in ((), (effect,))]
    before, after = learned.ask(jobs)
    return learned.context.null.expected_snr(after[0] - before[0])


def _write_map(path: Path, map_uk: Vector, frame: str) -> None:
    healpy.write_map(
        path, map_uk, dtype=np.float64, coord={"ecliptic": "E", "galactic": "G", "equatorial": "C"}[frame],
        column_units="uK", column_names=["TEMPERATURE"], fits_IDL=False,
    )  # fmt: skip
