"""Effects of free form: each is a stage of the simulation at which numbers that were found, not physics, act.

A reconstruction writes a class derived from one of these, with its numbers as class variables. Its only parameter is
``amplitude``: 1 as it was found, 0 absent. Patterns on the sky are real coefficients (:mod:`mcsim.sphere.real`) in the
frame of the maps that they were found in; maps that are made in another one see them turned.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar, Literal

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.beams.coefficients import unpacked
from mcsim.instrument.scan.model import SECONDS_PER_DAY
from mcsim.reconstruction.sky_changes import raised, rotations
from mcsim.reconstruction.sources import at, points
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, real, rotation
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Matrix
from mcsim.systematics.base import Alm, Draw, Effect, Map, Site
from mcsim.systematics.parametrization import Parametrization, Vector
from mcsim.systematics.product import multiplied
from mcsim.systematics.sky import boosted
from mcsim.systematics.spacecraft import axes, heading, line_of_sight, orientation, spin_phase

REFERENCE_GHZ = 94.0
Towards = tuple[tuple[float, ...], ...]
"""Unit vectors, along x and y of a beam and outward, each with a weight."""

_NSIDE = 128  #: of the map that a pattern of low degree is looked up in


@dataclass(frozen=True, kw_only=True)
class Form(Effect):
    """Derive the forms from this class.

    Attributes
    ----------
    frame
        Of the maps that the numbers were found in; None: they are the same in any.
    """

    name: ClassVar[str] = "form"
    scope: ClassVar[Literal["channel", "common"]] = "channel"
    unit = "1 = as found"
    cause = "Not known: reconstructed from data."
    signature = "As reconstructed."
    step = 1.0
    proposed = False
    parametrization = Parametrization(matched_filter=False)
    frame: ClassVar[str | None] = None

    def frame_of(self, site: Site) -> str:
        """Return the frame of the numbers: that of the maps if they are the same in any."""
        return self.frame or site.frame

    def turn(self, site: Site) -> Matrix:
        """Return the rotation of directions from the frame of the numbers into that of the maps, shape (3, 3)."""
        return rotation.rotation_matrix(self.frame_of(site), site.frame)

    def pattern(self, values: tuple[float, ...], site: Site) -> Vector:
        """Return the real coefficients of a pattern in the frame of the maps."""
        degree = int(np.sqrt(len(values))) - 1
        alm = rotation.rotate_alm(real.to_alm(np.array(values), degree), degree, self.frame_of(site), site.frame)
        return real.coefficients(alm, degree, degree)


@dataclass(frozen=True, kw_only=True)
class ByFrequency(Form):
    """What is added or departs, times (frequency / 94 GHz)^``index``.

    A ``foreground``, as all that is known by frequencies, is not in the maps of a component separation.
    """

    index: ClassVar[float] = 0.0
    foreground: ClassVar[bool] = False

    def seen(self, site: Site) -> float:
        """Return by what it is multiplied in a channel."""
        if self.foreground and not site.foregrounds:
            return 0.0
        return (site.frequency(self.name) / REFERENCE_GHZ) ** self.index if self.index else 1.0


@dataclass(frozen=True, kw_only=True)
class AddedPattern(ByFrequency):
    """A pattern fixed to the sky is added, uK."""

    coefficients: ClassVar[tuple[float, ...]]

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        factor = self.amplitude * self.seen(site)
        return sky + factor * real.to_alm(self.pattern(self.coefficients, site), site.lmax)


@dataclass(frozen=True, kw_only=True)
class CompactSource(ByFrequency):
    """A compact source is added, of a flux in uK sr at 94 GHz."""

    lon_deg: ClassVar[float]
    lat_deg: ClassVar[float]
    factor: ClassVar[float]

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        factor = self.amplitude * self.factor * self.seen(site)
        alm = at((self.lon_deg, self.lat_deg), site.lmax)
        return sky + factor * rotation.rotate_alm(alm, site.lmax, self.frame_of(site), site.frame)


@dataclass(frozen=True, kw_only=True)
class GainPattern(ByFrequency):
    """The gain has a pattern fixed to the sky: it acts on sky, on dipole, or on both."""

    coefficients: ClassVar[tuple[float, ...]]
    on_sky: ClassVar[bool] = True
    on_dipole: ClassVar[bool] = True

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        seen = sky if self.on_sky else np.zeros_like(sky)
        if self.on_dipole:
            seen = seen + dipole_alm(site.dipole_uk, site.lmax)
        values, degree = self.pattern(self.coefficients, site), int(np.sqrt(len(self.coefficients))) - 1
        product = multiplied(seen, site.lmax, lambda *n: real.field(values, *n), degree)
        return sky + self.amplitude * self.seen(site) * product


@dataclass(frozen=True, kw_only=True)
class RotatedSky(Form):
    """The sky is turned by a small vector, radians: its gradient along a rotation is added."""

    rotation: ClassVar[tuple[float, float, float]]

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        whole, axis = sky + dipole_alm(site.dipole_uk, site.lmax), self.turn(site) @ self.rotation
        changes = (w * turned for w, turned in zip(axis, rotations(whole, site.lmax), strict=True))
        return sky + self.amplitude * sum(changes, start=np.zeros_like(sky))


@dataclass(frozen=True, kw_only=True)
class BoostedSky(Form):
    """The sky is seen by an observer with a rapidity, which is the velocity in units of light's where that is small."""

    scope = "common"
    velocity: ClassVar[tuple[float, float, float]]

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        x, y, z = self.turn(site) @ self.velocity
        speed = self.amplitude * float(np.linalg.norm(self.velocity))
        return boosted(sky, site.lmax, speed, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))


@dataclass(frozen=True, kw_only=True)
class SignalPower(Form):
    """The signal has its square or cube added, times ``factor``: that of sky and dipole, or of the sky alone.

    ``offset``, uK^power, is added to the power.
    """

    factor: ClassVar[float]  #: uK^(1 - power)
    offset: ClassVar[float] = 0.0
    power: ClassVar[int] = 2
    on_dipole: ClassVar[bool] = True

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Add the power, up to the sky's own degree."""
        whole = sky + dipole_alm(site.dipole_uk, site.lmax) if self.on_dipole else sky
        change = raised(whole, site.lmax, self.power)
        change[0] += np.sqrt(4.0 * np.pi) * self.offset
        return sky + self.amplitude * self.factor * change


@dataclass(frozen=True, kw_only=True)
class SkyPower(Form):
    """The power of the sky is larger by ``values``, a fraction, in ranges of degrees that start at ``edges``."""

    scope = "common"
    edges: ClassVar[tuple[int, ...]]
    values: ClassVar[tuple[float, ...]]

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        more = self.amplitude * steps(self.edges, self.values, site.lmax).real
        return alm_.multiply(sky, np.sqrt(np.maximum(1.0 + more, 0.0)), site.lmax)


@dataclass(frozen=True, kw_only=True)
class BeamOrder(ByFrequency):
    """The order m of the beam changes by value * B_l (l / lmax)^max(m, 1), in ranges of degrees from ``edges`` on.

    ``edges`` has one number more than ``values``: the last is ``top`` + 1.
    """

    order: ClassVar[int]
    edges: ClassVar[tuple[int, ...]]
    values: ClassVar[tuple[complex, ...]]
    top: ClassVar[int]

    def beam(self, beam: Beam, site: Site) -> Beam:
        blm = np.zeros((max(beam.mmax, self.order) + 1, beam.lmax + 1), dtype=np.complex128)
        blm[: beam.mmax + 1] = beam.blm
        ell = np.arange(beam.lmax + 1.0)
        kernel = site.beam.blm[0].real * (ell / self.top) ** max(self.order, 1)
        change = self.amplitude * self.seen(site) * steps(self.edges, self.values, beam.lmax) * kernel
        change[: self.order] = 0.0
        blm[self.order] += change
        return replace(beam, blm=blm)


@dataclass(frozen=True, kw_only=True)
class GainOfSplits(ByFrequency):
    """The gain of sky and dipole errs by ``factor`` times a number for each split of the survey, at all its times."""

    factor: ClassVar[float]
    splits: ClassVar[dict[str, float]]

    def steady_gain(self, site: Site) -> float:
        """Return the error of a split; InputError in a survey of other splits."""
        if set(site.splits) != set(self.splits):
            raise InputError(
                f"effect {self.name} was reconstructed in splits {', '.join(self.splits)}, but those of {site.channel} "
                f"are {', '.join(site.splits) or 'none'}; name them alike."
            )
        return self.amplitude * self.seen(site) * self.factor * self.splits.get(site.split or "", 0.0)


@dataclass(frozen=True, kw_only=True)
class InTime(Form):
    """Derive forms that depend on time from this class."""

    #: "": constant; "spin", "year", "orientation": ``harmonic`` times spin phase, year or psi; "period": ``period_s``
    #: from the start of the survey on; "trend": from -1 to 1 through the survey; "sky": a pattern fixed to it; "Sun":
    #: the line of sight along the Earth's motion, and towards the Sun; of what is added also "lobe": the dipole along
    #: the beam's x and y and the line of sight, uK
    wave: ClassVar[str] = ""
    harmonic: ClassVar[int] = 1
    period_s: ClassVar[float]
    #: of cosine and sine, of this and of each further harmonic, or of the pattern, or of components, or the constant
    coefficients: ClassVar[tuple[float, ...]]
    splits: ClassVar[tuple[float, ...]] = (1.0,)  #: factor in each of as many equal parts of the survey's time
    by_rings: ClassVar[bool] = False  #: True if the parts are every n-th ring, one turn of the spin each, in turn

    def factor(self, time_s: Vector, site: Site) -> Vector:
        """Return the factor of the split that each time is in."""
        if len(set(self.splits)) == 1:
            return np.full(len(time_s), self.splits[0])
        pointing, number, values = site.pointed(self.name), len(self.splits), np.array(self.splits)
        model = pointing.model
        if self.by_rings:
            return values[np.floor(np.asarray(time_s) / abs(model.spin_period_s)).astype(int) % number]
        # By their numbers, as samples are divided among maps.
        sample = np.rint(np.asarray(time_s) / model.period_of_samples(pointing.line))
        ends = [round(part / number * model.samples(pointing.line)) for part in range(1, number)]
        return values[np.searchsorted(ends, sample, side="right")]

    def over_time(self, time_s: Vector, psi: Vector | None, site: Site) -> Vector:
        """Return constant, pattern or wave."""
        if not self.wave:
            return np.full(len(time_s), self.coefficients[0])
        pointing, frame = site.pointed(self.name), self.frame_of(site)
        if self.wave in ("sky", "Sun"):
            beam, _ = line_of_sight(pointing, time_s, frame)
            if self.wave == "Sun":
                towards = (heading(pointing.model, time_s, frame, phase) for phase in (0.0, 0.5 * np.pi))
                return np.array(self.coefficients) @ np.stack([np.sum(one * beam, axis=0) for one in towards])
            return np.asarray(_maps_of(self.coefficients, (0,), frame, frame)[0][0][healpy.vec2pix(_NSIDE, *beam)])
        if self.wave == "trend":
            return self.coefficients[0] * (2.0 * time_s / (pointing.model.duration_days * SECONDS_PER_DAY) - 1.0)
        if self.wave == "spin":
            phase = spin_phase(pointing, time_s)
        elif self.wave == "year":
            phase = 2.0 * np.pi * time_s / pointing.model.orbit_period_s
        elif self.wave == "period":
            phase = 2.0 * np.pi * time_s / self.period_s
        else:
            phase = psi if psi is not None and frame == site.frame else orientation(pointing, time_s, frame)
        found = np.zeros(len(time_s))
        for k, (cosine, sine) in enumerate(zip(self.coefficients[::2], self.coefficients[1::2], strict=True)):
            turned = (self.harmonic + k) * phase
            found += cosine * np.cos(turned) + sine * np.sin(turned)
        return found


@dataclass(frozen=True, kw_only=True)
class AddedToSamples(InTime, ByFrequency):
    """Samples have a signal added, uK, whatever the sky: a wave, a pattern in some splits, or a dipole that turns.

    A pattern is the sum of Q cos s psi + U sin s psi over ``spins``: of spin 0 real coefficients of a map, of others
    those of E and then of B, from degree s on, all up to the same degree.
    """

    spins: ClassVar[tuple[int, ...]] = (0,)

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        if self.wave == "sky":
            pixel, value = healpy.ang2pix(_NSIDE, theta, phi), np.zeros(len(theta))
            maps = _maps_of(self.coefficients, self.spins, self.frame_of(site), site.frame)
            for s, (q, u) in zip(self.spins, maps, strict=True):
                value += np.cos(s * psi) * q[pixel] + np.sin(s * psi) * u[pixel]
        elif self.wave == "lobe":
            outward, south, east = axes(theta, phi)
            cos, sin, (a, b) = np.cos(psi), np.sin(psi), (site.dipole_uk @ south, site.dipole_uk @ east)
            seen = np.stack([cos * a + sin * b, cos * b - sin * a, site.dipole_uk @ outward])
            value = np.array(self.coefficients) @ seen
        else:
            value = self.over_time(time_s, psi, site)
        return np.asarray(self.amplitude * self.seen(site) * self.factor(time_s, site) * value)


@dataclass(frozen=True, kw_only=True)
class GainOverTime(InTime, ByFrequency):
    """The gain of sky and dipole varies in time: a wave, or a constant or a pattern on the sky in some splits."""

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        if self.amplitude == 0.0:
            return None
        size = self.amplitude * self.seen(site)
        return np.asarray(size * self.factor(time_s, site) * self.over_time(time_s, None, site))


@dataclass(frozen=True, kw_only=True)
class GainOfOne(GainOverTime):
    """The gain of the sky alone varies, or that of the dipole alone."""

    on_sky: ClassVar[bool]

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        return super().gain(time_s, site) if self.on_sky else None

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        dipole = site.dipole_uk @ axes(theta, phi)[0] * self.factor(time_s, site) * self.over_time(time_s, psi, site)
        return np.asarray((-1.0 if self.on_sky else 1.0) * self.amplitude * self.seen(site) * dipole)


@dataclass(frozen=True, kw_only=True)
class Elsewhere(Form):
    """Samples have a part of the signal that the beam would have in other directions of its own frame.

    ``factor`` times the weighted sum of sky and dipole there, or the sky alone, up to l = ``top``: a lobe has as many
    orders.
    """

    towards: ClassVar[Towards | dict[str, Towards]]  #: where it is from; by channel, if that differs in their frames
    factor: ClassVar[float]
    on_dipole: ClassVar[bool] = True
    top: ClassVar[int]

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Add Y*_lm of the directions, as of a beam that points there."""
        top = min(self.top, beam.lmax)
        *vector, weight = np.array(self._there(site.channel)).T
        lobe = unpacked(points(np.array(vector), weight, top), top, top)
        kernel = site.beam.window[: top + 1]
        kernel[: 0 if self.on_dipole else 2] = 0.0
        blm = np.zeros((max(beam.mmax, top) + 1, beam.lmax + 1), dtype=np.complex128)
        blm[: beam.mmax + 1] = beam.blm
        blm[: top + 1, : top + 1] += self.amplitude * self.factor * kernel * lobe
        return replace(beam, blm=blm)

    def _there(self, channel: str) -> Towards:
        """Return the directions of a channel; InputError for one that was not reconstructed."""
        if not isinstance(self.towards, dict):
            return self.towards
        if channel not in self.towards:
            raise InputError(
                f"effect {self.name} was reconstructed in channels of other lines of sight, {', '.join(self.towards)}, "
                f"and does not know that of {channel}; name the channels so."
            )
        return self.towards[channel]


@dataclass(frozen=True, kw_only=True)
class NoisePattern(Form):
    """The variance of the noise is larger by a pattern on the sky, as a fraction."""

    coefficients: ClassVar[tuple[float, ...]]

    def noise(self, site: Site) -> Map | None:
        """Return one plus the pattern, at least zero."""
        if self.amplitude == 0.0:
            return None
        pattern = real.field(self.pattern(self.coefficients, site), *healpix.centres(site.nside))
        return np.maximum(1.0 + self.amplitude * pattern, 0.0)


def steps(edges: tuple[int, ...], values: tuple[complex, ...], lmax: int) -> NDArray[np.complex128]:
    """Return the function of l that has a value between each two edges, and is 0 elsewhere, shape (lmax + 1,)."""
    found = np.zeros(lmax + 1, dtype=np.complex128)
    for (low, high), value in zip(pairwise(edges), values, strict=True):
        found[low:high] = value
    return found


@lru_cache(maxsize=4)
def _maps_of(
    coefficients: tuple[float, ...], spins: tuple[int, ...], frame_from: str, frame_to: str
) -> list[NDArray[np.float64]]:
    """Return Q and U of patterns of every spin in another frame, shape (2, npix) each; of spin 0 the map, and zero."""
    fields = sum(2 if s else 1 for s in spins)
    top = round(np.sqrt((len(coefficients) + sum(2 * s**2 for s in spins)) / fields)) - 1
    rest, found = np.array(coefficients), []
    for s in spins:
        count = (top + 1) ** 2 - s**2
        each, rest = np.split(rest, [2 * count if s else count])
        rows = (real.to_alm(np.append(np.zeros(s**2), one), top) for one in each.reshape(-1, count))
        alms = np.stack([rotation.rotate_alm(one, top, frame_from, frame_to) for one in rows])
        made = healpix.synthesis(alms, _NSIDE, top, spin=s)
        found.append(made if s else np.stack([made[0], np.zeros_like(made[0])]))
    return found


FORMS: dict[str, type[Form]] = {
    kind.__name__: kind
    for kind in (
        AddedPattern, CompactSource, GainPattern, GainOfSplits, RotatedSky, BoostedSky, SignalPower, SkyPower,
        BeamOrder, AddedToSamples, GainOverTime, GainOfOne, Elsewhere, NoisePattern,
    )
}  # fmt: skip
"""The forms by the name of their class."""
