"""A structure in a sentence, and the known effect that makes such structures."""

from itertools import pairwise

import numpy as np

from mcsim.reconstruction.plugin import CONSTANT
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.structure import ALIKE, ANY, OFFSET, OPPOSITE, Structure
from mcsim.support.arrays import Matrix, Vector
from mcsim.support.numbers import measured
from mcsim.systematics import Library
from mcsim.systematics.spacecraft import scan_direction

_DERIVATIVES = {1: "gradient", 2: "second derivative", 3: "third derivative", 4: "fourth derivative"}

_LIKE: tuple[tuple[str, str, str, str], ...] = (
    ("beam", "scan", "order 0 at low l", "beam_sidelobe"), ("beam", "scan", "order 0", "beam_width"),
    ("beam", "scan", "order 1", "pointing_offset"), ("beam", "scan", "order 2", "beam_ellipticity"),
    ("beam", "scan", "order 3", "beam_coma"), ("gain", "time", "year", "gain_drift"),
    ("gain", "time", "spin", "gain_spin"), ("gain", "", "constant", "calibration"),
    ("added", "time", "spin", "spin_synchronous_offset"), ("added", "spacecraft", "", "sidelobe_pickup"),
    ("added", "Sun", "dipole", "orbital_dipole"), ("added", "sky", "dipole", "dipole_residual"),
    ("added", "sky", "monopole", "monopole_residual"), ("added", "sky", "latitude galactic", "foreground_residual"),
    ("square", "", "", "nonlinearity"), ("cube", "", "", "nonlinearity"),
    ("noise", "", "latitude", "noise_anisotropy"), ("noise", "", "level", "noise_level"),
    ("power", "", "monopole", "monopole_residual"), ("power", "", "dipole", "dipole_residual"),
    ("power", "", "power", "point_sources"), ("modulation", "sky", "degree 1 as a boost", "boost"),
    ("modulation", "sky", "degree 1", "dipole_modulation"),
    ("modulation", "sky", "degree 2", "quadrupole_modulation"),
)  # fmt: skip
"""Stage, frame and how the kind starts of structures, and the effect of the library that makes such; the first fits."""


def cause(structure: Structure, library: Library) -> str:
    """Return a known cause of such structures with its reference, or nothing."""
    light = structure.index is not None and (structure.stage, structure.frame) == ("added", "sky")
    name = "foreground_residual" if light else ""
    if (structure.stage, structure.kind) == ("gain", "constant") and structure.split not in (ALIKE, OPPOSITE):
        name = "split_calibration"
    for stage, frame, kind, effect in _LIKE if not name else ():
        if structure.stage == stage and structure.frame == frame and structure.kind.startswith(kind):
            name = effect
            break
    if name not in library:
        return ""
    kind_ = library[name]
    source = f" ({kind_.source})" if kind_.source else ""
    tried = "" if kind_.proposed else f"; --with {name} proposes it"
    return f"{kind_.label()}: {kind_.cause.rstrip('.')}{source}{tried}"


def says(structure: Structure, theta: Vector, covariance: Matrix, scene: Scene) -> str:
    """Return what a structure with these coordinates is and where, as the beginning of a sentence."""
    spans = profile_ranges(structure, scene)
    free = spans is not None and structure.mix is None and not structure.kind.endswith("low l")
    count = len(spans) if spans is not None and free else 1
    most = _most(theta, covariance, count)
    own = theta.reshape(count, -1)[most] if structure.stage == "beam" else theta
    what = _what(structure, own, scene.frame)
    if (structure.stage, structure.kind) == ("noise", "level") and structure.split != OPPOSITE:
        share, error = 100.0 / CONSTANT * theta[0], 100.0 / CONSTANT * np.sqrt(covariance[0, 0])
        what = f"{what.removesuffix(')')}, {measured(float(share), float(error), ' %')} of its variance)"
    return ", ".join(filter(None, (what, _degrees(structure, spans, most), *_where(structure, scene))))


def _most(theta: Vector, covariance: Matrix, count: int) -> int:
    """Return which range of a profile the data show best: sizes are of powers of l, and noise at low l."""
    each = np.arange(theta.size).reshape(count, -1)
    return int(np.argmax([theta[rows] @ np.linalg.pinv(covariance[np.ix_(rows, rows)]) @ theta[rows] for rows in each]))


def _what(structure: Structure, theta: Vector, frame: str) -> str:
    kind, number = structure.kind, structure.kind.rpartition(" ")[2]
    on = structure.acts_on.replace("sky and dipole", "sky and dipole alike")
    match structure.stage, structure.frame:
        case "added", "sky" if kind.startswith("orientation"):
            _, order, degrees = kind.split(maxsplit=2)
            turns = f"turns with the beam (order {order}, {_pattern(degrees)})"
            return f"is added to the signal, fixed to the sky, and {turns}"
        case "added", "sky" if kind.startswith("source"):
            lon_deg, lat_deg = map(float, kind.split()[1:])
            place = f"longitude {lon_deg:.0f}° and latitude {lat_deg:.0f}° ({frame})"
            return f"is a compact source, at {place}".replace("-", "−")
        case "added", "sky":
            return f"is added to the signal, fixed to the sky ({_pattern(kind)})"
        case "added", "spacecraft" if kind == "lobe":
            return f"is the dipole as a lobe fixed to the spacecraft sees it, {_lobe(structure, theta)}"
        case "added", "spacecraft" if kind == "Galaxy":
            return "is added to the signal as the Galaxy is in a lobe fixed to the spacecraft"
        case "added", "spacecraft" if kind.startswith("degrees"):
            return f"is added to the signal as a sky ({_pattern(kind)}) is in a lobe fixed to the spacecraft"
        case "added", "Sun":
            if kind.startswith("crossing"):
                return f"is added to the signal as by the Sun in a lobe, at {kind.split()[1]}° of the spin"
            return f"is added to the signal and depends on {SUN[kind]}"
        case "added", "spacecraft" if kind.startswith("line"):
            return f"is the dipole as the line of sight of {kind.partition(' ')[2]} sees it at the same time"
        case "elsewhere", _:
            return f"has {on} as seen elsewhere: {_there(kind)}"
        case "added", "spacecraft":
            return f"is added to the signal, fixed to the spacecraft (order {number} in the orientation of the beam)"
        case "added", _:
            return f"is added to the signal and follows the {_wave(kind)}"
        case "gain", "spacecraft":
            return f"is proportional to {on}, and follows the orientation of the beam (order {number})"
        case "gain", "Sun":
            return f"is proportional to {on}, and depends on {SUN[kind]}"
        case "gain", "time":
            return f"is proportional to {on}, and follows the {_wave(kind)}"
        case "gain", "sky":
            return f"is proportional to {on}, with a pattern fixed to the sky ({_pattern(kind)})"
        case "gain", _:
            return f"is proportional to {on}"
        case "beam", _ if structure.moving:
            change = "a change of the beam's width" if kind.startswith("order 0") else _derivative(structure.order)
            return f"follows {change} that varies with the {_wave(structure.moving)}"
        case "beam", _:
            return _order(structure.order, theta)
        case "square", _:
            return f"follows the square of {structure.acts_on}" + ", and a constant" * (kind == OFFSET)
        case "cube", _:
            return f"follows the cube of {structure.acts_on}"
        case "rotation", "Sun":
            return "follows the gradient of the sky along the Earth's motion, or towards the Sun"
        case "rotation", _:
            return "follows the gradient of the sky along a rotation fixed to the sky"
        case "noise", _:
            shape = {"level": "everywhere alike", "spectrum": "at some degrees more than at others"}
            return f"is noise ({shape.get(kind) or _pattern(kind)})"
        case "power", _:
            which = "" if kind == "power" else f", where the model's has none ({_pattern(kind)})"
            return f"is power of the sky itself{which}"
    if kind.endswith("boost"):
        return "modulates and moves the sky itself, as a velocity does"
    return f"modulates the sky itself ({_pattern(kind)})"


def _order(order: int, theta: Vector) -> str:
    if order == 0:
        return "follows the sky, as a change of the round part of the beam does"
    # b_lm of a beam turned by a has the phase e^(-i m a); a displacement along x has b_l1 < 0, a stretch b_l2 > 0.
    total = complex(*theta) * (-1) ** order
    angle = -np.rad2deg(np.angle(total)) / order
    return f"follows {_derivative(order)} {scan_direction(angle, 360.0 / order)}"


def _derivative(order: int) -> str:
    return f"the {_DERIVATIVES[order]} of the sky"


def _pattern(kind: str) -> str:
    first, _, rest = kind.partition(" ")
    if first == "latitude":
        pole, _, degrees = rest.partition(" ")
        return f"by {pole} latitude" + (f", {_pattern(f'degrees {degrees}')}" if degrees else "")
    if first in ("degrees", "degree"):
        return f"ℓ {rest.replace('-', '–')}"
    return {"power": "pattern not known, by its power in ℓ"}.get(kind, kind)


def _there(kind: str) -> str:
    what, _, where = kind.partition(" ")
    if what == "lag":
        return "in place of the line of sight, along the scan before, in a tail"
    if what == "spin":
        turns = f"{where.lstrip('+-')} of a spin"
        return f"{turns} {'before' if where[0] == '-' else 'after'}" if where[0] in "+-" else f"{turns} away"
    return f"along the line of sight of {where}" if what == "line" else "in the opposite direction"


def _wave(kind: str) -> str:
    wave, _, harmonic = kind.partition(" ")
    if wave == "trend":
        return "time, growing steadily"
    if wave == "month":
        return "month"
    if wave in _IN_TIME:
        return _IN_TIME[wave].format(harmonic)
    if wave == "period":
        seconds, name = float(harmonic), "day"
        for unit, size in (("day", 86400.0), ("hour", 3600.0), ("minute", 60.0)):
            name, number = unit, seconds / size
            if number >= 2.0:
                break
        return f"time, with a period of {number:.4g} {name}s"
    often = {ANY: ", in any way", "1": ""}.get(harmonic, f", {_TIMES.get(harmonic)} a {wave}")
    return ("year" if wave == "year" else "spin phase") + often


_IN_TIME = {
    "from": "time, from day {} on",
    "until": "time, until day {}",
    "step": "time, with a step on day {}",
    "decay": "time, falling by e in {} days from the start on",
    "rise": "time, rising by e in {} days until the end",
}
"""Functions of the survey's time, with their day or days."""

_TIMES = {"2": "twice", "3": "three times", "4": "four times"}

SUN = {
    "dipole": "the angles of the line of sight to the directions of the Sun and of the Earth's motion, as a dipole",
    "elongation": "the distance from the Sun alone",
}
"""What a signal or a gain depends on in the frame of the Sun."""


def _lobe(structure: Structure, theta: Vector) -> str:
    """Return where a lobe points that sees the dipole like this, as a sentence goes on."""
    x, y, z = map(float, theta if structure.mix is None else structure.mix.T @ theta)
    towards = scan_direction(np.rad2deg(np.arctan2(y, x)))
    if structure.mix is not None:  # the dipole along the line of sight was subtracted from the maps
        return f"away from the line of sight, {towards}"
    away = np.rad2deg(np.arctan2(np.hypot(x, y), z))
    return f"{away:.0f}° from the line of sight" + (f", {towards}" if 5.0 < away < 175.0 else "")


def _degrees(structure: Structure, spans: list[tuple[int, int]] | None, most: int) -> str:
    """Return the degrees with most of a profile, for a profile."""
    if spans is None:
        return ""
    if structure.kind.endswith("low l"):
        low = (structure.mix[0] > 0).sum() if structure.mix is not None else 1
        return f"as a halo about the beam does, up to ℓ {spans[low - 1][1]}"
    if structure.mix is not None:
        return f"growing as ℓ{SUPERSCRIPT[structure.kind[-1]]}"
    low, high = spans[most]
    return f"most at ℓ {low}–{high}" if high > low else f"most at ℓ {low}"


SUPERSCRIPT = {"1": "", "2": "²", "3": "³", "4": "⁴"}


def _where(structure: Structure, scene: Scene) -> list[str]:
    several = len(scene.channels) > 1
    alone = f"{structure.channel} alone" if several else f"{structure.channel}"
    found = ["all channels" if structure.channel is None and several else alone]
    if structure.index is not None and not all(scene.foregrounds):
        found = ["all channels that have foregrounds"]
    if structure.channel is None and not several:
        found = []
    if structure.index is not None:
        power = f"as the frequency to the power {structure.index:g}".replace("-", "−")
        found.append(power if structure.index else "alike in these")
    if len(scene.splits) > 1 and structure.views:
        same = {ALIKE: "the same in all splits", OPPOSITE: f"opposite in {' and '.join(scene.splits)}"}
        found.append(same.get(structure.split, f"in {structure.split} alone"))
    return found


def profile_ranges(structure: Structure, scene: Scene) -> list[tuple[int, int]] | None:
    """Return the ranges of degrees, both ends included, of a structure with a profile in l; None for others."""
    if structure.stage == "beam" and not structure.moving:
        edges = scene.edges(max(structure.order, 1))
    elif structure.kind in ("power", "spectrum"):
        edges = scene.fine
    else:
        return None
    return [(low, high - 1) for low, high in pairwise(edges)]


def profile(
    structure: Structure, theta: Vector, covariance: Matrix, scene: Scene
) -> tuple[tuple[int, int, float, float], ...]:
    """Return the profile in l: first and last degree, size and its error; of a complex one the modulus."""
    if (spans := profile_ranges(structure, scene)) is None:
        return ()
    if structure.mix is not None:
        theta, covariance = structure.mix.T @ theta, structure.mix.T @ covariance @ structure.mix
    values, errors = theta.reshape(len(spans), -1), np.sqrt(np.diag(covariance)).reshape(len(spans), -1)
    sizes = values[:, 0] if values.shape[1] == 1 else np.linalg.norm(values, axis=1)
    spread = np.sqrt(np.mean(errors**2, axis=1))
    return tuple((*span, float(a), float(e)) for span, a, e in zip(spans, sizes, spread, strict=True))
