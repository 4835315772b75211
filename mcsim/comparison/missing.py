"""What a comparison cannot compare: maps of one side alone or of no model, effects of the model, different skies."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mcsim import config
from mcsim.comparison.result import NotCompared
from mcsim.ensemble.maps import file_names, first_realization
from mcsim.errors import InputError
from mcsim.sphere import spectra


def not_compared(
    paths: Sequence[str | Path], sides: Sequence[Mapping[str, object]], run: config.RunConfig | None
) -> tuple[NotCompared, ...]:
    """Return the maps of the model or of a side that are not compared, and warn of them."""
    wanted = () if run is None else config.map_names(run)
    present = [_names(path, side, run) for path, side in zip(paths, sides, strict=True)]
    found = tuple(_lacking(wanted, *present))
    if found:
        warnings.warn(
            f"not compared: {'; '.join(one.words for one in found)}; give both sides, and the model, the same channels "
            "and splits.",
            stacklevel=4,
        )
    return found


def warn_of_effects(run: config.RunConfig) -> None:
    """Warn of effects that a description of a side does not have: all but those on the shape of its beam."""
    if run.effects:
        named = ", ".join(dict.fromkeys(one.name for one in run.effects))
        warnings.warn(
            f"the model {run.name} has effects ({named}), which are left out of the description of a side: what is "
            "found is relative to the survey without them; name a model without effects, whose beam is that of the "
            "side.",
            stacklevel=4,
        )


def check_skies(a: str | Path, b: str | Path) -> None:
    """Raise InputError for two descriptions that draw different skies; those of stored maps have one of their own."""
    here, there = (config.load(side) for side in (a, b))
    if any(run.ensemble.maps is not None for run in (here, there)):
        return
    keys: dict[str, list[object]] = {"sky.lmax": [run.sky.lmax for run in (here, there)]}
    if all(run.sky.alm is None and run.sky.map is None for run in (here, there)):
        keys |= {"sky.spectrum": [_spectrum(run) for run in (here, there)]}
        keys |= {"ensemble.seed": [run.ensemble.seed for run in (here, there)]}
    for key, (one, other) in keys.items():
        if one != other:
            values = f" = {one} and {other}" if isinstance(one, int) else ""
            raise InputError(
                f"{a} and {b} have different skies ({key}{values}), and a comparison is one of the same sky; give both "
                "the same [sky] and ensemble.seed."
            )


def _spectrum(run: config.RunConfig) -> bytes:
    return b"" if run.sky.spectrum is None else spectra.load(run.sky.spectrum, run.sky.lmax).tobytes()


def _lacking(wanted: Sequence[str], a: set[str], b: set[str]) -> Iterator[NotCompared]:
    for name in dict.fromkeys((*wanted, *sorted(a | b))):
        unknown = ("model",) if wanted and name not in wanted else ()
        sides = unknown or tuple(label for label, own in (("a", a), ("b", b)) if name not in own)
        if sides:
            yield NotCompared(name, sides)


def _names(path: str | Path, side: Mapping[str, object], run: config.RunConfig | None) -> set[str]:
    """Return the names of all maps of a side; those of files that are no map of the model's are the files'."""
    if not Path(path).is_dir():
        return set(side)
    known = set() if run is None else set(file_names(run).values())
    others = {file.stem for file in first_realization(Path(path)).glob("*.fits") if file.name not in known}
    return set(side) | others
