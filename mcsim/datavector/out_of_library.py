"""Load effects that no library has from a Python file, and simulate the response of the data vector to them."""

from dataclasses import dataclass, replace

from mcsim import config, systematics
from mcsim.datavector.analysis import Job, data_vectors
from mcsim.datavector.campaign import Batch, with_effects
from mcsim.errors import InputError
from mcsim.simulation.channels import table_of
from mcsim.support.arrays import Vector
from mcsim.systematics import Effect, Library

SKIES = 2  #: skies that the response to an out-of-library effect is the mean of


@dataclass(frozen=True)
class OutOfLibrary:
    """An effect that no library has, in one channel, and the response of the data vector per unit of its amplitude."""

    kind: type[Effect]
    channel: str | None
    response: Vector


def load(path: str) -> dict[str, type[Effect]]:
    """Return the effects that a Python file defines, by name.

    InputError if the file cannot be run, or defines no effect, or one whose name the library has.
    """
    found = {kind.name: kind for kind in systematics.in_file(path)}
    taken = sorted(set(found) & set(systematics.catalogue()))
    if not found or taken:
        wrong = f"{taken[0]}, which the library has" if taken else "no effect"
        raise InputError(f"{path} defines {wrong}; let it define effects of its own.")
    return found


def library_with(path: str | None) -> Library | None:
    """Return the catalogue with the effects of a file; None, the catalogue itself, without a file."""
    return None if path is None else {**systematics.catalogue(), **load(path)}


def responses(run: config.RunConfig, file: str, call: Batch) -> dict[str, list[OutOfLibrary]]:
    """Simulate the response to a unit of each effect of a file, by name: sample by sample, without noise."""
    channels = [channel.name for channel in run.channels]
    units = [
        (channel, kind(amplitude=kind.step))
        for kind in load(file).values()
        for channel in ([None] if kind.scope == "common" else channels)
    ]
    # An effect of no strength: the dipole is seen and subtracted only where there is some effect.
    idle = [config.Effect(name="beam_width", channel=name, parameters={"amplitude": 0.0}) for name in channels]
    added = [table_of(one, channel) for channel, one in units]
    quiet = replace(run.unfiltered(), channels=tuple(channel.without_noise() for channel in run.channels))
    runs = [with_effects(quiet, [*idle, *more]) for more in ((), *([one] for one in added))]
    jobs = [
        (Job(config.to_json(run), config.to_json(one), 0, SKIES, True, content=config.digest(run, "nuisance")), file)
        for one in runs
    ]
    simulated = dict(call(_data_vectors, jobs))
    before, *after = (simulated[index].mean(axis=0) for index in range(len(jobs)))
    result: dict[str, list[OutOfLibrary]] = {}
    for (channel, one), mean in zip(units, after, strict=True):
        result.setdefault(one.name, []).append(OutOfLibrary(type(one), channel, (mean - before) / one.amplitude))
    return result


def _data_vectors(job: Job, file: str) -> Vector:
    return data_vectors(job, library_with(file))
