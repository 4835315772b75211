"""Make a challenge: maps of surveys in which effects may act, and sealed keys that say which."""

import json
import secrets
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import tomli_w
from numpy.typing import NDArray

from mcsim import config
from mcsim.benchmark.case import Drawn, Member, Truth
from mcsim.benchmark.folder import (
    KEYS,
    MAPS,
    SEAL,
    Settings,
    key_hash,
    key_path,
    read_key,
    write_key,
)
from mcsim.benchmark.learned import Batch, LearnedModel, each_case, learned_model, simulated, workers_of
from mcsim.benchmark.out_of_library import library_with, load
from mcsim.benchmark.sampler import CaseSampler, OutOfLibrary
from mcsim.errors import InputError
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import rng
from mcsim.support.folders import appearing, writable

Vector = NDArray[np.float64]

EPSILON = 1e-7
"""Error of the interpolation of samples, relative to the dipole: 0.3 nK."""

SMALLER = 0.7
"""Factor between one trial of an amplitude and the next."""

ATTEMPTS = 16
NONCE_BYTES = 32
STRONGER = 1.5
"""Largest ratio of the simulated to the drawn expected S/N."""


def make(
    settings: Settings, folder: str | Path, cases: int, seed: int, *, workers: int | None = None, quiet: bool = True
) -> Path:
    """Make the cases of a challenge that are not there yet.

    Parameters
    ----------
    settings
        Of the challenge.
    folder
        Gets ``cases/case-NNN`` (maps, model.toml, question.json, SEAL), ``keys/case-NNN.json`` and ``challenge.json``.
    cases
        Number in all. A folder can be filled in several calls, and a call that was interrupted repeated.
    seed
        Of the draws. It is kept among the keys, because it determines them.
    workers
        Number of processes; default: the model's; 0: this process.
    quiet
        Report no progress.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If the run cannot be used, or the folder holds a challenge with other settings.
    """
    if cases < 1:
        raise InputError(f"a challenge of {cases} cases is none; ask for at least 1.")
    target, file = Path(folder), settings.out_of_library
    if file is not None:
        settings = replace(settings, out_of_library=(file := str(Path(file).resolve())))
    for channel in survey(settings.model).channels if settings.sampled_share > 0.0 or file else ():
        sampled.check(channel)
    writable(target)
    settings.write(target, seed)
    missing = [number for number in range(cases) if not (target / MAPS / _name(number)).is_dir()]
    if not missing:
        return target
    with workers_of(settings, workers, quiet) as call:
        sampler = CaseSampler(settings.prior, learned_model(settings).library)
        kinds = sampler.kinds(seed, cases, file is not None)
        if file is not None and any(kinds[number] == "invented" for number in missing):
            sampler = replace(sampler, out_of_library=_responses(settings.model, file, call))
        drawn = [_truth(sampler.draw(kinds, seed, number), seed, number, settings.sampled_share) for number in missing]
        each_case(call, make_case, [(settings, str(target), truth) for truth in drawn], quiet)
    return target


def _name(number: int) -> str:
    return f"case-{number:03d}"


def _truth(drawn: Drawn, seed: int, number: int, sampled_share: float) -> Truth:
    """Return the key of a case as far as it is drawn: without measured strengths and nonce."""
    draw = rng.generator(seed, number, "challenge/data")
    # Far from the seeds that people choose, and from those that a diagnosis learns with.
    own = int(draw.integers(2**40, 2**62))
    by_sample = bool(draw.random() < sampled_share) or drawn.kind == "invented"
    return Truth(**vars(drawn), case=_name(number), seed=own, sampled=by_sample)


def _responses(run: config.RunConfig, file: str, call: Batch) -> dict[str, list[OutOfLibrary]]:
    """Simulate the response of the data vector to a unit of each effect of a file, without noise."""
    # An effect of no strength: the dipole is seen and subtracted only where there is some effect.
    idle = [config.Effect(name="beam_width", channel=c.name, parameters={"amplitude": 0.0}) for c in run.channels]
    found = [
        (kind, channel, kind(amplitude=kind.step))
        for kind in load(file).values()
        for channel in ([None] if kind.scope == "common" else [spec.name for spec in run.channels])
    ]
    added = [
        config.Effect(name=kind.name, channel=channel, parameters={"amplitude": one.amplitude, **one.parameters()})
        for kind, channel, one in found
    ]
    before, *after = simulated(run, [idle, *([*idle, one] for one in added)], file, call)
    result: dict[str, list[OutOfLibrary]] = {}
    for (kind, channel, one), mean in zip(found, after, strict=True):
        result.setdefault(kind.name, []).append(OutOfLibrary(kind, channel, (mean - before) / one.amplitude))
    return result


def make_case(settings: Settings, folder: str, truth: Truth) -> None:
    """Make maps, seal and key of one case: the key first; the folder of the maps, complete, last."""
    target, case = Path(folder), truth.case
    if key_path(target, case).is_file():
        truth = read_key(target, case)
    else:
        members = truth.members
        if truth.kind != "invented":
            model = learned_model(settings)
            members = tuple(_measured(model, member, truth.seed) for member in members)
        truth = replace(truth, members=members, nonce=secrets.token_hex(NONCE_BYTES))
        write_key(target, truth)
    with appearing(target / MAPS / case) as scratch:
        for name, map_uk in maps_of(settings.model, truth, settings.out_of_library):
            _write_map(scratch / f"{name.replace(':', '_')}.fits", map_uk, config.prepared_grid(settings.model)[1])
        plain = {**config.to_dict(settings.model), "name": case}
        (scratch / "model.toml").write_text(tomli_w.dumps(_without_none(plain)), encoding="utf-8")
        (scratch / "question.json").write_text(json.dumps({"without": list(truth.without)}) + "\n")
        (scratch / SEAL).write_text(f"{key_hash(target, case)}  {KEYS}/{case}.json\n")


def maps_of(run: config.RunConfig, truth: Truth, file: str | None = None) -> list[tuple[str, Vector]]:
    """Simulate the maps of a case, uK, by name."""
    effects = (*run.effects, *(member.table() for member in truth.members))
    data = replace(run, effects=effects, ensemble=replace(run.ensemble, seed=truth.seed))
    shared = survey(data, library=library_with(file))
    if truth.sampled:
        return sampled.maps(shared, 0, epsilon=EPSILON)
    return list(zip(shared.map_names, simulate.maps(shared, 0), strict=True))


def _measured(model: LearnedModel, member: Member, seed: int) -> Member:
    """Return a member with the expected S/N that it has in simulations.

    The amplitude is lowered where the drawn one is impossible, or where the effect, no longer linear, would be much
    stronger than was drawn. The S/N of a stochastic effect is that of its mean response, that of any other one belongs
    to the very sky and noise of the case.
    """
    assert member.candidate is not None  # it is of the library
    candidate = model.library.candidates[member.candidate]
    for attempt in range(ATTEMPTS):
        amplitude = SMALLER**attempt * member.parameters["amplitude"]
        parameters = {**member.parameters, "amplitude": amplitude}
        effect = candidate.effect(**parameters)
        try:
            strength = model.expected_snr(candidate.table(effect))
        except InputError:
            continue
        if strength > STRONGER * member.strength and attempt + 1 < ATTEMPTS:
            continue
        coordinates = tuple(float(value) for value in effect.coordinates())
        if not candidate.effect.stochastic:
            strength = model.expected_snr_on_sky(candidate.table(effect), seed)
        return replace(member, parameters=parameters, coordinates=coordinates, strength=strength)
    raise InputError(f"effect {member.name} can have no amplitude that is strong enough; leave it out.")


def _without_none(value: Any) -> Any:
    """Return nested tables without what is None or an empty list: TOML has neither."""
    if isinstance(value, dict):
        return {key: _without_none(one) for key, one in value.items() if one is not None and one != []}
    return [_without_none(one) for one in value] if isinstance(value, list) else value


def _write_map(path: Path, map_uk: Vector, frame: str) -> None:
    healpy.write_map(
        path, map_uk, dtype=np.float64, coord={"ecliptic": "E", "galactic": "G", "equatorial": "C"}[frame],
        column_units="uK", column_names=["TEMPERATURE"], fits_IDL=False,
    )  # fmt: skip
