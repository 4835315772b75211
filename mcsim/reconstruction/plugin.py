"""From a structure and its coordinates to an effect: as a class for the simulator, and as a Python file."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pprint import pformat
from typing import Any

import numpy as np

from mcsim.reconstruction.forms import FORMS, Form, Towards
from mcsim.reconstruction.grammar import LOBE
from mcsim.reconstruction.result import HEAD
from mcsim.reconstruction.scores import ACTED_ON, ELSEWHERE, MONTH, Scene
from mcsim.reconstruction.structure import ALIKE, OPPOSITE, Structure
from mcsim.reconstruction.time_functions import HISTORIES
from mcsim.support.arrays import Vector

CONSTANT = float(np.sqrt(4.0 * np.pi))  #: real coefficient of degree 0 of a map that is one everywhere

_FILE = '''"""{sentence}

{head} Use it in a run,

    [[effect]]
    name = "{name}.py"{channel}
    amplitude = 1.0

propose it in a diagnosis with mcsim diagnose --with {name}.py, or offer it under the entry points mcsim.effects.
"""

from dataclasses import dataclass

from mcsim.reconstruction import {base}


@dataclass(frozen=True, kw_only=True)
class {title}({base}):
    """As it was found at amplitude 1."""

{body}
'''


@dataclass(frozen=True)
class Plugin:
    """An effect of a form: the name of its base class, and its class variables."""

    name: str
    base: str
    channel: str | None
    values: dict[str, Any]

    def kind(self) -> type[Form]:
        """Return the class."""
        values = {"__module__": __name__, "__annotations__": {}, "name": self.name, **self.values}
        made: type[Form] = dataclass(frozen=True, kw_only=True)(type(self.name, (FORMS[self.base],), values))
        return made

    def scaled(self, factor: float) -> "Plugin":
        """Return the effect with ``factor`` times the numbers that its amplitude multiplies."""
        key = next(k for k in ("coefficients", "values", "rotation", "velocity", "factor") if k in self.values)
        old = self.values[key]
        new = factor * old if isinstance(old, float) else tuple(factor * one for one in old)
        return replace(self, values={**self.values, key: new})

    def source(self, sentence: str) -> str:
        """Return the text of a Python file that defines the effect."""
        values = {"name": self.name, "signature": sentence, **self.values}
        lines = [f"    {key} = {_literal(value)}" for key, value in values.items()]
        of = str(self.channel)
        toml = f"'{of}'" if '"' in of and "'" not in of else json.dumps(of, ensure_ascii=False)
        channel = "" if self.kind().scope == "common" else f"\n    channel = {toml}"
        title = "".join(part.capitalize() for part in self.name.split("_"))
        text = {"head": HEAD, "sentence": _quoted(sentence), "name": self.name, "base": self.base, "title": title}
        return _FILE.format(**text, channel=_quoted(channel), body="\n".join(lines))


def _quoted(text: str) -> str:
    """Return text as it stands in a docstring."""
    return text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')


def _literal(value: Any) -> str:
    return pformat(value, width=100, compact=True).replace("\n", "\n    ")


def plugin(name: str, structure: Structure, theta: Vector, scene: Scene) -> Plugin | None:
    """Return the effect of a structure with fitted coordinates; None if no effect of the simulator can be like it.

    These are powers of unknown patterns, beams that follow a wave, what depends on time or orientation where the
    pointing is not known, and what differs between splits but is not a gain and does not add to the signal.
    """
    made = _form(structure, theta, scene)
    if made is None:
        return None
    base, values = made
    if base in ("AddedToSamples", "GainOverTime", "GainOfOne") and not scene.timed:
        return None
    common = structure.channel is None and len(scene.channels) > 1
    scope = {"scope": "common"} if common or base == "SkyPower" else {}
    fixed = base in ("AddedPattern", "CompactSource", "GainPattern", "RotatedSky", "BoostedSky", "NoisePattern")
    frame = {"frame": scene.frame} if fixed or values.get("wave") == "sky" else {}
    if values.get("wave") == "orientation":
        frame = {"frame": scene.scan_frame}
    shared = {} if structure.index is None else {"index": structure.index, "foreground": True}
    return Plugin(name, base, structure.channel or scene.channels[0], {**scope, **frame, **values, **shared})


def _form(structure: Structure, theta: Vector, scene: Scene) -> tuple[str, dict[str, Any]] | None:
    """Return the name of the form, and its class variables."""
    pattern, alike = _numbers(structure, theta), structure.split == ALIKE
    acting: dict[str, Any]
    splits: dict[str, Any] = {} if alike else {"splits": _factors(structure.split, scene.splits)}
    if splits and scene.by_rings:
        splits |= {"by_rings": True}
    timed: dict[str, Any] = {"coefficients": pattern, **splits}
    if structure.kind.startswith(HISTORIES):
        timed = {"coefficients": (1.0,), "splits": pattern}
    elif structure.frame in ("spacecraft", "time", "Sun"):
        timed |= _wave(structure)
    match structure.stage, structure.frame:
        case "added", "sky" if structure.kind.startswith("orientation"):
            return "AddedToSamples", {"wave": "sky", "spins": (int(structure.kind.split()[1]),), **timed}
        case "added", "sky" if structure.kind.startswith("source"):
            lon_deg, lat_deg = map(float, structure.kind.split()[1:])
            place = {"lon_deg": lon_deg, "lat_deg": lat_deg}
            return ("CompactSource", {"factor": float(theta[0]), **place}) if alike else None
        case "added", "sky" if structure.kind != "power":
            if alike:
                return "AddedPattern", {"coefficients": pattern}
            return "AddedToSamples", {"wave": "sky", "coefficients": pattern, **splits}
        case "added", "spacecraft" | "time" | "Sun":
            return "AddedToSamples", timed
        case "gain", "time" | "spacecraft" | "Sun" if structure.acts_on == "sky and dipole":
            return "GainOverTime", timed
        case "gain", "time" | "spacecraft":
            return "GainOfOne", {"on_sky": structure.acts_on == "sky", **timed}
        case "elsewhere", _ if alike:
            acting = {"towards": _towards(structure, scene), "on_dipole": "dipole" in structure.acts_on}
            return "Elsewhere", {"factor": float(theta[0]), "top": ELSEWHERE, **acting}
        case "gain", _ if not alike and structure.kind == "constant" and _whole(structure, scene):
            shares = dict(zip(scene.splits, splits["splits"], strict=True))
            return "GainOfSplits", {"factor": float(theta[0]) / CONSTANT, "splits": shares}
        case "gain", _ if not alike:
            value = float(theta[0]) / (1.0 if structure.acts_on == "dipole" else CONSTANT)
            timed |= {"coefficients": (value,)} if structure.kind == "constant" else {"wave": "sky"}
            if structure.acts_on == "sky and dipole":
                return "GainOverTime", timed
            return "GainOfOne", {"on_sky": structure.acts_on == "sky", **timed}
        case "gain", _:
            one = (float(theta[0]) * CONSTANT,) if structure.acts_on == "dipole" else pattern
            acting = {"on_sky": "sky" in structure.acts_on, "on_dipole": "dipole" in structure.acts_on}
            return "GainPattern", {"coefficients": one, **acting}
        case "beam", _ if alike and not structure.moving:
            order = structure.order
            values = tuple(map(complex, np.reshape(pattern, (-1, 2)) @ [1.0, 1j])) if order else pattern
            edges = scene.edges(max(order, 1))
            return "BeamOrder", {"order": order, "edges": edges, "top": scene.lmax, "values": values}
        case "square" | "cube", _ if alike:
            acting = {"power": 2 if structure.stage == "square" else 3, "on_dipole": "dipole" in structure.acts_on}
            *constant, factor = map(float, theta)
            offset = {"offset": constant[0] / CONSTANT / factor} if constant else {}
            return "SignalPower", {"factor": factor, **offset, **acting}
        case "rotation", _ if alike and not structure.moving:
            return "RotatedSky", {"rotation": tuple(map(float, theta))}
        case "noise", _ if structure.kind != "spectrum" and alike:
            return "NoisePattern", {"coefficients": pattern}
        case "power", _ if structure.kind != "power":
            return "AddedPattern", {"coefficients": pattern}
        case "power", _:
            return "SkyPower", {"edges": scene.fine, "values": tuple(map(float, theta))}
        case "modulation", _ if structure.kind.endswith("boost"):
            return "BoostedSky", {"velocity": pattern}
        case "modulation", _:
            degree = int(structure.kind.split()[1])
            pattern = (*(0.0,) * degree**2, *pattern)
            return "GainPattern", {"coefficients": pattern, "on_sky": True, "on_dipole": False}
    return None


def _whole(structure: Structure, scene: Scene) -> bool:
    """Return True for what acts on all that a survey sees: on the sky alone, too, where there is no dipole."""
    return structure.acts_on == ACTED_ON[0] or (structure.acts_on == ACTED_ON[1] and not scene.dipole_uk.any())


def _wave(structure: Structure) -> dict[str, Any]:
    """Return the class variables that say which function of time and orientation a structure follows."""
    wave, _, rest = structure.kind.partition(" ")
    if structure.frame == "Sun":
        return {"wave": "Sun"} if wave == "dipole" else {"wave": "spin", "harmonic": 0}
    if structure.stage == "added" and structure.acts_on == "dipole":
        return {"wave": "lobe"}
    if wave in ("Galaxy", "degrees"):
        return {"wave": "sky", "spins": tuple(range(LOBE + 1))}
    if wave == "month":
        return {"wave": "year", "harmonic": MONTH[0]}
    if wave == "period":
        return {"wave": wave, "period_s": float(rest)}
    return {"wave": wave, "harmonic": int(rest)} if rest.isdigit() else {"wave": wave, "harmonic": 0}


def _numbers(structure: Structure, theta: Vector) -> tuple[float, ...]:
    """Return the real coefficients of a pattern."""
    found = theta if structure.mix is None else structure.mix.T @ theta
    if structure.kind == "elongation":  # of cosines alone
        found = np.delete(np.stack([found, np.zeros_like(found)], axis=1).ravel(), 1)
    if structure.kind.startswith(("elongation", "crossing")) or structure.in_any_way:  # a constant has no sine
        return float(found[0]) / CONSTANT, 0.0, *map(float, found[1:])
    lower = {"dipole": 1, "quadrupole": 4}.get(structure.kind, 0) if structure.frame != "Sun" else 0
    return tuple(map(float, np.append(np.zeros(lower), found)))


def _factors(split: str, splits: Sequence[str]) -> tuple[float, ...]:
    return (1.0, -1.0) if split == OPPOSITE else tuple(float(name == split) for name in splits)


def _towards(structure: Structure, scene: Scene) -> Towards | dict[str, Towards]:
    """Return where a signal from elsewhere is from: in the frame of every beam alike, or by channel."""
    pairs = zip(scene.channels, scene.elsewhere, strict=True)
    found = {name: there[structure.kind] for name, there in pairs if structure.channel in (None, name)}
    each = {name: tuple(tuple(map(float, one)) for one in rows) for name, rows in found.items()}
    first, *others = found.values()
    return each if any(not np.allclose(first, one, atol=1e-9) for one in others) else next(iter(each.values()))
