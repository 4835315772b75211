"""Make a challenge, maps in which effects may act and sealed keys that say which, and diagnose its cases."""

import json
import secrets
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mcsim import config
from mcsim.benchmark import folder as files
from mcsim.benchmark.case import Drawn, Member, Truth
from mcsim.benchmark.folder import Settings
from mcsim.benchmark.models import LearnedModel, learned_model, workers_of
from mcsim.benchmark.sampler import CaseSampler
from mcsim.config.load import to_toml
from mcsim.datavector.campaign import Batch, seeded, with_effects
from mcsim.datavector.map_checks import of_pixel_means, read_maps
from mcsim.datavector.out_of_library import library_with, responses
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.maps import POINTING, file_names, write_map
from mcsim.ensemble.runner import Workers
from mcsim.errors import InputError
from mcsim.simulation import nuisance, sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import rng
from mcsim.support.arrays import Vector
from mcsim.support.folders import appearing, user_path, writable
from mcsim.support.progress import reporting
from mcsim.systematics import if_possible

SMALLER = 0.7  #: factor between one trial of an amplitude and the next

ATTEMPTS = 16
STRONGER = 1.5  #: largest ratio of the simulated to the drawn expected S/N


def make(
    settings: Settings, folder: str | Path, cases: int, seed: int, *, workers: Workers | None = None, quiet: bool = True
) -> Path:
    """Make those of a number of cases of a challenge that are not there, or not whole; return the folder.

    It gets ``cases/case-NNN`` (maps, model.toml, question.json, SEAL), ``keys/case-NNN.json`` and ``challenge.json``. A
    folder can be filled in several calls, and a call that was interrupted repeated. The seed of the draws is kept among
    the keys, because it determines them. ``workers`` is the number of processes; None: the model's; 0: this process;
    or the address of a running scheduler, or a Dask client, whose workers share cache and folder.
    InputError if the run cannot be used, or the folder holds a challenge with other settings.
    """
    if cases < 1:
        raise InputError(f"a challenge of {cases} cases is none; ask for at least 1.")
    target, file = user_path(folder), settings.out_of_library
    if file is not None:
        settings = replace(settings, out_of_library=(file := str(Path(file).resolve())))
    # Cases are diagnosed from wherever that is asked for.
    including = (str(Path(name).resolve()) if name.endswith(".py") else name for name in settings.including)
    settings = replace(settings, including=tuple(including))
    for channel in survey(settings.model).channels if settings.sampled_share > 0.0 or file else ():
        try:
            sampled.check(channel)
        except InputError as error:
            if file is not None:  # what the library does not have is made sample by sample alone
                raise
            raise InputError(f"{str(error).rstrip('.')}, or make no map so (--sampled-share 0).") from None
    writable(target)
    names = [f"case-{number:03d}" for number in range(cases)]
    files.check_keys(target, names)
    settings.check(target, seed)
    own = file_names(settings.model).values()
    missing = [number for number, case in enumerate(names) if not files.is_whole(target, case, own)]
    if not missing:
        settings.write(target, seed)
        return target
    with workers_of(settings, workers, quiet) as call:
        sampler = CaseSampler(settings.prior, learned_model(settings))
        kinds = sampler.kinds(seed, cases, file is not None)
        if file is not None and any(kinds[number] == "invented" for number in missing):
            sampler = replace(sampler, out_of_library=responses(settings.model, file, call))
        drawn = [_truth(sampler.draw(kinds, seed, number), seed, number, settings.sampled_share) for number in missing]
        settings.write(target, seed)  # now that nothing is left to refuse
        _each_case(call, make_case, [(settings, target, truth) for truth in drawn], quiet)
    return target


def _truth(drawn: Drawn, seed: int, number: int, sampled_share: float) -> Truth:
    """Return the key of a case as far as it is drawn: without measured strengths and nonce."""
    draw = rng.generator(seed, number, "challenge/data")
    # Far from the seeds that people choose, and from those that a diagnosis learns with.
    own = int(draw.integers(2**40, 2**62))
    by_sample = bool(draw.random() < sampled_share) or drawn.kind == "invented"
    return Truth(**vars(drawn), case=f"case-{number:03d}", seed=own, sampled=by_sample)


def make_case(settings: Settings, folder: Path, truth: Truth) -> None:
    """Make maps, seal and key of one case: the key first; the folder of the maps, complete, last.

    It takes the place of one that has lost its seal, or another of its files.
    """
    case, run = truth.case, settings.model
    names = file_names(run)
    if files.key_path(folder, case).is_file():
        truth = files.read_key(folder, case)
    else:
        members = truth.members
        if truth.kind != "invented":
            members = tuple(_measured(learned_model(settings), member, truth.seed) for member in members)
        truth = files.write_key(folder, replace(truth, members=members, nonce=secrets.token_hex(32)))
    with appearing(folder / files.MAPS / case) as scratch:
        for name, map_uk in maps_of(run, truth, settings.out_of_library):
            write_map(scratch / names[name], map_uk, config.prepared_grid(run)[1], [POINTING[truth.sampled]])
        (scratch / files.MODEL).write_text(to_toml(replace(run, name=case)), encoding="utf-8")
        (scratch / files.QUESTION).write_text(json.dumps({"without": list(truth.without)}) + "\n")
        (scratch / files.SEAL).write_text(f"{files.key_hash(folder, case)}  {files.KEYS}/{case}.json\n")
        if not files.is_whole(folder, case, names.values()):
            shutil.rmtree(folder / files.MAPS / case, ignore_errors=True)


def maps_of(run: config.RunConfig, truth: Truth, file: str | None = None) -> list[tuple[str, Vector]]:
    """Simulate the maps of a case, uK, by name; nuisances of the run are drawn from their priors."""
    acting = [config.Effect(name=m.name, channel=m.channel, parameters=dict(m.parameters)) for m in truth.members]
    acting += nuisance.tables(run, truth.seed, 0)
    data = seeded(with_effects(run, acting), truth.seed)
    shared = survey(data, library=library_with(file))
    if truth.sampled:
        return sampled.maps(shared, 0)
    return list(zip(shared.map_names, simulate.maps(shared, 0), strict=True))


def _measured(model: LearnedModel, member: Member, seed: int) -> Member:
    """Return a member with the expected S/N that it has in simulations.

    The amplitude is lowered where the drawn one is impossible, or where the effect, no longer linear, would be much
    stronger than was drawn. The S/N of a stochastic effect is that of its mean response, that of any other one belongs
    to the very sky and noise of the case.
    """
    assert member.candidate is not None  # it is of the library
    candidate = model.candidates[member.candidate]
    for attempt in range(ATTEMPTS):
        parameters = {**member.parameters, "amplitude": SMALLER**attempt * member.parameters["amplitude"]}
        effect = candidate.effect(**parameters)
        strength = None
        with if_possible():
            strength = model.expected_snr(candidate.table(effect))
        if strength is None or (strength > STRONGER * member.strength and attempt + 1 < ATTEMPTS):
            continue
        coordinates = tuple(float(value) for value in candidate.parametrization.coordinates(effect))
        if not candidate.parametrization.stochastic:
            strength = model.expected_snr_on_sky(candidate.table(effect), seed)
        return replace(member, parameters=parameters, coordinates=coordinates, strength=strength)
    raise InputError(f"effect {member.name} can have no amplitude that is strong enough; leave it out.")


def run(folder: str | Path, *, workers: Workers | None = None, quiet: bool = True) -> int:
    """Diagnose the cases of a challenge that have no verdict yet, without opening the keys; return their number.

    The folder, filled by :func:`make`, gets ``verdicts/case-NNN`` with ``verdict.json`` and ``answer.json`` (the data
    vector and the fits behind the verdict). ``workers`` as for :func:`make`.
    InputError if the folder holds no challenge, or verdicts on other data, or cases that have keys are lost.
    """
    target = user_path(folder)
    missing = []
    for case in files.all_cases(target):
        if files.is_answered(target, case):
            files.check_answer(target, case)
        else:
            missing.append(case)
    settings = Settings.read(target)
    if missing:
        # Cases of one library follow each other, so that a worker seldom changes its library.
        ordered = sorted((files.question(settings, target, case), case) for case in missing)
        with workers_of(settings, workers, quiet) as call:
            _each_case(call, diagnose_case, [(settings, target, case, names) for names, case in ordered], quiet)
    return len(missing)


def diagnose_case(settings: Settings, folder: Path, case: str, without: tuple[str, ...]) -> None:
    """Write the verdict of one case; its folder appears complete or not at all."""
    model = learned_model(settings, without)
    seen = model.context.analysis.model, folder / files.MAPS / case
    maps = read_maps(*seen)  # first, as it says what is wrong with them
    known = model.context.of_pixel_means if of_pixel_means(*seen) else model.context
    found = diagnose_data(ObservedMaps(known, maps, model.simulate), case)
    answer = {
        "seal": files.seal(folder, case),
        "evidence": [float(value) for value in found.data],
        "maximum": found.test.maximum,
        "explanations": [
            {
                "proposals": [found.candidates[member].label for member in one.candidates],
                "amplitudes": list(one.coordinates),
                "errors": list(one.errors),
            }
            for one in found.sets
        ],
    }
    with appearing(folder / files.VERDICTS / case) as scratch:
        (scratch / "verdict.json").write_text(json.dumps(found.to_json(), indent=1, allow_nan=False) + "\n")
        (scratch / files.ANSWER).write_text(json.dumps(answer) + "\n")


def _each_case(call: Batch, task: Callable[..., None], arguments: Sequence[tuple[Any, ...]], quiet: bool) -> None:
    """Run a task for every case, in any order, and report progress."""
    with reporting("cases", float(len(arguments)), "cases", quiet) as report:
        for done, _ in enumerate(call(task, arguments), 1):
            report(float(done))
