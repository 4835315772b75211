"""The grammar: every structure that a reconstruction can say, with the scores that measure it.

A structure acts at a stage (added to the signal, a gain, the beam, a square, a rotation, the noise, the sky), in a
frame (sky, scan, spacecraft, time), in one channel or all, and in the splits alike, oppositely, or in one of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import poch

from mcsim.instrument.scan.model import SECONDS_PER_DAY
from mcsim.reconstruction.scores import (
    ACTED_ON,
    ELONGATION,
    GAIN,
    GROWTH,
    HARMONICS,
    HISTORY,
    MODULATION,
    MONTH,
    ORDERS,
    PERIODIC,
    SUN,
    TURNED,
    Key,
    Scene,
    View,
)
from mcsim.reconstruction.structure import ALIKE, ANY, LINE, MOTION, OFFSET, OPPOSITE, Structure
from mcsim.reconstruction.time_functions import HISTORIES, LOBES, histories
from mcsim.sphere import real
from mcsim.sphere.rotation import FRAMES, rotation_matrix
from mcsim.support.arrays import Matrix, Vector

LOBE = 2  #: highest degree and spin of what a lobe sees

LOWEST = "degrees 0-1"  #: kind of a monopole and a dipole
ALSO_COMMON = ("monopole", "dipole", LOWEST)
"""Patterns that all channels may have alike: in the sky itself, but skies of a model have none of them."""


def structures(scene: Scene) -> tuple[Structure, ...]:
    """Return every structure of the grammar for the maps of a survey."""
    found = [*_of_maps(scene), *_of_channels(scene)]
    ranges = range(len(scene.fine) - 1)
    found.append(_plain(scene, "power", "", "power", None, [("power", b) for b in ranges]))
    return tuple(found)


def _plain(scene: Scene, stage: str, frame: str, kind: str, channel: str | None, keys: list[Key]) -> Structure:
    rows = np.array([[scene.place[key]] for key in keys])
    return Structure(stage, "", frame, kind, channel, ALIKE, None, rows, np.ones(1))


def _rows(scene: Scene, keys: Sequence[Key], views: Sequence[int]) -> NDArray[np.int64]:
    """Return the places of scores, named without the map, in each of some maps, shape (keys, views)."""
    return np.array([[scene.place[(*key[:1], i, *key[1:])] for i in views] for key in keys])


def _of_channels(scene: Scene) -> Iterator[Structure]:
    """Yield the spectrum of a channel's noise, and its power that is common to splits."""
    for c, name in enumerate(scene.channels):
        if len(scene.of(c)) > 1:
            ranges = range(len(scene.fine) - 1)
            yield _plain(scene, "noise", "", "spectrum", name, [("difference", c, b) for b in ranges])
            yield _plain(scene, "added", "sky", "power", name, [("common", c, b) for b in ranges])


def _of_maps(scene: Scene) -> Iterator[Structure]:
    """Yield the structures that are measured in maps, for one channel and for all."""
    groups: list[tuple[str | None, tuple[int, ...]]] = [(name, scene.of(c)) for c, name in enumerate(scene.channels)]
    if len(groups) > 1:
        groups.append((None, tuple(range(len(scene.views)))))
    for name, views in groups:
        for split, factors in _splits(scene.splits):
            kept = [i for i in views if factors[scene.views[i].split] != 0.0]
            weights = np.array([factors[scene.views[i].split] for i in kept])
            for stage, acts_on, frame, kind, keys, mix in _forms(scene, split, kept):
                fixed = frame == "sky" and not kind.startswith("orientation")
                if name is None and split == ALIKE and (fixed or stage in ("square", "cube")):
                    if stage != "added" or kind not in ALSO_COMMON:
                        continue  # what all maps see alike is the sky itself, which the model knows as random
                    stage, frame = "power", ""
                rows = _rows(scene, keys, kept)
                own = name, split, None, rows, weights, mix, tuple(kept), _tried(scene, kind)
                yield Structure(stage, acts_on, frame, kind, *own)
        yield from _high_orders(scene, name, views)
    yield from _modulations(scene)
    yield from _scaled(scene)


def _tried(scene: Scene, kind: str) -> float:
    """Return the number of structures of a kind, or of frequencies, among which the data choose."""
    if kind.startswith("period"):
        return scene.time_lines[0].tried
    if kind.startswith(HISTORIES):
        return float(len(histories(1.0)))
    if kind.startswith("source"):
        return scene.places
    return float(len(LOBES)) if kind.startswith("crossing") else 1.0


def _splits(splits: Sequence[str]) -> Iterator[tuple[str, tuple[float, ...]]]:
    yield ALIKE, (1.0,) * len(splits)
    if len(splits) == 2:
        yield OPPOSITE, (1.0, -1.0)
    if len(splits) > 1:
        for k, name in enumerate(splits):
            yield name, tuple(float(j == k) for j in range(len(splits)))


_Form = tuple[str, str, str, str, list[Key], Matrix | None]


def _forms(scene: Scene, split: str, kept: list[int]) -> Iterator[_Form]:
    """Yield stage, what it acts on, frame, kind, keys without the map, and mix."""
    view = scene.views[kept[0]]
    yield from _added(scene)
    yield from _turned(scene, view)
    lobe: list[Key] = [("lobe", 0), ("lobe", 1), ("dipole",)]
    yield "added", "dipole", "spacecraft", "lobe", lobe, None
    for name in view.elsewhere:
        if all(name in scene.views[i].elsewhere for i in kept):
            for on in ACTED_ON[:2]:
                yield "elsewhere", on, "spacecraft", name, [("elsewhere", name, on)], None
            if name.startswith(LINE):
                yield "added", "dipole", "spacecraft", name, lobe, scene.elsewhere[view.channel][name][:, :3]
    for on in ("", *ACTED_ON) if split == ALIKE else PERIODIC:
        yield from _timed(scene, view, on)
    noise: list[Key] = [("noise", j) for j in range(9)]
    yield "noise", "", "", "level", noise[:1], None
    yield "noise", "", "", "latitude ecliptic", noise, _latitudes(scene.frame, 2)[0][1][[0, 2]]
    yield "noise", "", "", "degrees 0-2", noise, None
    yield "gain", "sky and dipole", "", "constant", [("gain", 0)], None
    for s in range(min(scene.split_orders, len(view.w)) + 1):
        for kind, mix in _profiles(scene, s):
            yield "beam", "sky", "scan", kind, _beam(scene, s), mix
    for wave, s, size in view.moves:
        moving: list[Key] = [("moving", wave, s, c) for c in range(size)]
        if wave == SUN:
            yield "rotation", "sky and dipole", SUN, MOTION, moving, None
        else:
            yield "beam", "sky", "scan", f"order {s} {wave}", moving, None
    yield from _of_the_sky(scene)
    if split != ALIKE:
        return
    for on in PERIODIC if scene.timed else ():
        keys: list[Key] = [("history", on, k) for k in range(HISTORY)]
        for kind, mix in histories(scene.time_lines[0].duration_s / SECONDS_PER_DAY).items():
            yield "gain" if on else "added", on, "time", kind, keys, mix
    spin: list[Key] = [("", f"spin {k}", c) for k in range(1, ELONGATION + 1) for c in (0, 1)]
    for kind, mix in LOBES.items() if scene.timed else ():
        yield "added", "", "Sun", kind, [("added", 0), *spin], mix


def _of_the_sky(scene: Scene) -> Iterator[_Form]:
    """Yield what acts on the sky that a map sees: gains with a pattern, powers of the signal, rotations."""
    top = min(GAIN, scene.lmax)
    for acts_on, key in (("sky and dipole", "gain"), ("sky", "gain of the sky")):
        if key != "gain":
            yield "gain", acts_on, "", "constant", [(key, 0)], None
        for degree in sorted({min(degree, top) for degree in (1, 2, top)}):
            rows: list[Key] = [(key, j) for j in range((degree + 1) ** 2)]
            yield "gain", acts_on, "sky", f"degrees 0-{degree}", rows, None
        for kind, zonal in _latitudes(scene.frame, top):
            yield "gain", acts_on, "sky", kind, [(key, j) for j in range((top + 1) ** 2)], zonal
    yield "gain", "dipole", "", "constant", [("dipole",)], None
    for acts_on, key in (("sky and dipole", "square"), ("sky", "square of the sky")):
        yield "square", acts_on, "", "square", [(key,)], None
        yield "square", acts_on, "", OFFSET, [("added", 0), (key,)], None
    yield "cube", "sky and dipole", "", "cube", [("cube",)], None
    yield "rotation", "sky and dipole", "sky", "rotation", [("rotation", axis) for axis in range(3)], None


def _timed(scene: Scene, view: View, on: str) -> Iterator[_Form]:
    """Yield what follows time or orientation, where these are known: added to samples, or times what it acts on.

    The Sun is at azimuth 0 about the spin axis, and at a fixed distance from it: its distance from the line of sight is
    an even function of the spin phase.
    """
    stage = "gain" if on else "added"
    known = {**view.waves, **view.periods}
    waves: dict[str, list[Key]] = {name: [(on, name, c) for c in range(len(own))] for name, own in known.items()}
    for name, keys in waves.items():
        wave, _, harmonic = name.partition(" ")
        if wave == "period" or (wave != "Sun" and int(harmonic or 1) <= HARMONICS):
            yield stage, on, "spacecraft" if wave == "orientation" else "time", name, keys, None
    if not scene.timed or on in ACTED_ON[1:]:
        return
    constant: Key = ("gain" if on else "added", 0)
    for wave in ("spin", "year"):
        every = [key for k in range(1, HARMONICS + 1) for key in waves[f"{wave} {k}"]]
        yield stage, on, "time", f"{wave} {ANY}", [constant, *every], None
    month = [key for k in range(MONTH[0], MONTH[1] + 1) for key in waves[f"year {k}"]]
    yield stage, on, "time", "month", month, None
    yield stage, on, "Sun", "dipole", waves["Sun"], None
    cosines = [waves[f"spin {k}"][0] for k in range(1, ELONGATION + 1)]
    yield stage, on, "Sun", "elongation", [constant, *cosines], None


def _added(scene: Scene) -> Iterator[_Form]:
    """Yield patterns on the sky that are added: of few degrees, and zonal ones."""
    for kind in scene.views[0].sources:
        yield "added", "", "sky", kind, [("source", kind)], None
    for degree, kind in enumerate(("monopole", "dipole", "quadrupole")):
        yield "added", "", "sky", kind, [("added", j) for j in range(degree**2, (degree + 1) ** 2)], None
    for degree in sorted({min(top, scene.degree) for top in (1, 2, 4, scene.degree)}):
        yield "added", "", "sky", f"degrees 0-{degree}", [("added", j) for j in range((degree + 1) ** 2)], None
    keys: list[Key] = [("added", j) for j in range((scene.degree + 1) ** 2)]
    for kind, zonal in _latitudes(scene.frame, scene.degree):
        yield "added", "", "sky", kind, keys, zonal


def _turned(scene: Scene, view: View) -> Iterator[_Form]:
    """Yield patterns of few degrees that turn with the beam: of one spin, and those of all as a lobe makes them."""
    for s in view.spins:
        for top, degrees in ((s, f"degree {s}"), (TURNED[s], f"degrees {s}-{TURNED[s]}")):
            yield "added", "", "sky", f"orientation {s} {degrees}", _turning(s, top), None
    if len(view.spins) == LOBE:
        every: list[Key] = [("added", j) for j in range((LOBE + 1) ** 2)]
        every += [key for s in view.spins for key in _turning(s, LOBE)]
        yield "added", "", "spacecraft", f"degrees 0-{LOBE}", every, None
        yield "added", "", "spacecraft", "Galaxy", every, _galaxy(scene.frame)


def _turning(s: int, top: int) -> list[Key]:
    return [("turned", s, p, j) for p in (0, 1) for j in range(s**2, (top + 1) ** 2)]


def _galaxy(frame: str) -> Matrix:
    """Return a constant and the quadrupole about the galactic pole, of E and B of every spin up to LOBE."""
    quadrupole = real.zonal(rotation_matrix(frame, "galactic")[2], LOBE)[LOBE]
    fields = [quadrupole, *(quadrupole[s**2 :] for s in range(1, LOBE + 1) for _ in (0, 1))]
    return np.vstack([np.eye(1, sum(map(len, fields))), block_diag(*fields)])


def _latitudes(frame: str, top: int) -> list[tuple[str, Matrix]]:
    """Return the real coefficients of patterns of one latitude alone, by what they are called."""
    poles = {name: rotation_matrix(frame, name)[2] for name in FRAMES}
    zonal = {f"latitude {name}": real.zonal(pole, top) for name, pole in poles.items()}
    return [*((f"{name} 0-2", each[:3]) for name, each in zonal.items() if top > 2), *zonal.items()]


def _beam(scene: Scene, s: int) -> list[Key]:
    ranges = range(len(scene.edges(max(s, 1))) - 1)
    return [("beam", s, b, c) for b in ranges for c in ((0, 1) if s else (0,))]


def _profiles(scene: Scene, s: int) -> list[tuple[str, Matrix | None]]:
    """Return the profiles of a change of a beam at order s, by what they are called: free in ranges, or a power of l.

    The power is s, as for the derivatives of a Gaussian, sqrt((l + s)! / (l - s)!), and 2 for s = 0, l (l + 1), as for
    its width: the dipole, at l = 1, tells that from l^s. A halo about the beam is a constant at low l.
    """
    spans = [np.arange(low, high) for low, high in pairwise(scene.edges(max(s, 1)))]
    middle = np.array([np.sqrt(ell[0] * ell[-1]) for ell in spans])
    shape = np.array([np.mean(np.sqrt(poch(ell - s + 1.0, 2 * s)) / ell**s) for ell in spans])
    if s == 0:
        shape = (middle + 1.0) / scene.lmax
    mix: Matrix = np.kron(shape, np.eye(2 if s else 1)).astype(np.float64)
    found: list[tuple[str, Matrix | None]] = [(f"order {s} as l^{s or 2}", mix), (f"order {s}", None)]
    if s == 0:
        low = np.where(np.arange(len(middle)) <= len(middle) // 2, scene.lmax / middle, 0.0)
        found.append(("order 0 at low l", low[None]))
    return found


def _high_orders(scene: Scene, name: str | None, views: tuple[int, ...]) -> Iterator[Structure]:
    """Yield the orders of a beam that are measured in the sum of a channel's maps, which stands in its first."""
    first = [i for i in views if i == scene.of(scene.views[i].channel)[0]]
    for s in range(scene.split_orders + 1, min(ORDERS, len(scene.views[views[0]].w)) + 1):
        rows = _rows(scene, _beam(scene, s), first)
        for kind, mix in _profiles(scene, s):
            yield Structure("beam", "sky", "scan", kind, name, ALIKE, None, rows, np.ones(len(first)), mix)


def _modulations(scene: Scene) -> Iterator[Structure]:
    """Yield patterns that multiply the sky itself: in all channels alike, without the dipole, of one degree each."""
    keys: dict[str, list[Key]] = {
        **{f"degree {k}": [("modulation", j) for j in range(k**2, (k + 1) ** 2)] for k in range(1, MODULATION + 1)},
        "degree 1 as a boost": [("boost", axis) for axis in range(3)],
    }
    for kind, own in keys.items():
        rows = np.array([[scene.place[key]] for key in own])
        yield Structure("modulation", "sky", "sky", kind, None, ALIKE, None, rows, np.ones(1))


def _scaled(scene: Scene) -> Iterator[Structure]:
    """Yield what all channels have in proportion to a power of the frequency, but separated components.

    Light is added, whether it is fixed to the sky or follows beam, spacecraft, time or Sun; gains and beams depart as
    GROWTH.
    """
    if not scene.shared:
        return
    for k, index in enumerate(scene.scalings):
        for split, views, weights in _in_proportion(scene, index):
            for form in _forms(scene, split, list(views)):
                if form[:2] == ("added", ""):
                    yield _shared(scene, split, index, views, weights, form)
        keys: list[Key] = [("summed", k, b) for b in range(len(scene.fine) - 1)]
        yield replace(_plain(scene, "added", "sky", "power", None, keys), index=index)
    for split, views, weights in _in_proportion(scene, GROWTH):
        for form in _forms(scene, split, list(views)):
            if form[:2] in (("gain", "sky and dipole"), ("beam", "sky")):
                yield _shared(scene, split, GROWTH, views, weights, form)


def _in_proportion(scene: Scene, index: float) -> Iterator[tuple[str, tuple[int, ...], Vector]]:
    """Yield splits, the maps that have a signal there, and how strong it is in each."""
    for split, factors in _splits(scene.splits):
        weights = scene.scaling(index) * [factors[scene.views[i].split] for i in scene.shared]
        yield split, tuple(np.array(scene.shared)[weights != 0.0].tolist()), weights[weights != 0.0]


def _shared(scene: Scene, split: str, index: float, views: tuple[int, ...], weights: Vector, form: _Form) -> Structure:
    stage, acts_on, frame, kind, keys, mix = form
    own = None, split, index, _rows(scene, keys, views), weights, mix, views, _tried(scene, kind)
    return Structure(stage, acts_on, frame, kind, *own)
