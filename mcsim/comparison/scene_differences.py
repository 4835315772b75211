"""Differences of beam, scan, sky and pixels: what side B simulates otherwise than side A."""

from dataclasses import replace
from itertools import permutations
from typing import ClassVar

import healpy
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from mcsim.comparison.description import EXTRA_ORDERS
from mcsim.comparison.differences import Difference, State
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import WEAKEST, Maps, Scene
from mcsim.comparison.sky_of_maps import mean_map
from mcsim.instrument.beams import Beam
from mcsim.instrument.beams.coefficients import power_by_order
from mcsim.instrument.scan import Moments
from mcsim.instrument.scan.pointing import pointing
from mcsim.simulation import convolve
from mcsim.simulation.channels import NEGLECTED
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import FRAMES, rotation_matrix, turn_alm
from mcsim.sphere.sky import dipole_alm
from mcsim.support.arrays import Vector

_SMALL = 1e-3  #: small angle in radians, share of a sample, or change of a variance, over which responses are linear
WIDEST = 99.0  #: largest variance of a smoothing over the beam's: ten times its width; more would make any sky vanish
FAINT = 0.1  #: share of the rms below which a time shift that explains it is not looked for


def _orders(beam: Beam) -> NDArray[np.int64]:
    """Return the orders of a beam that can be seen: quadrature leaves a little in all of them."""
    power = power_by_order(beam.blm)
    return np.flatnonzero(power > NEGLECTED * power.sum())


class PsiOffset(Difference):
    """psi of side B is that of side A plus an angle."""

    name, unit = "psi_offset", "deg"
    met = "polarisation angle counted from another axis of the focal plane, or from the meridian instead of the scan"
    smooth = turns = True

    def starts(self, state: State) -> list[Vector]:
        """Return the small angle that fits, and a grid; a beam of even orders is the same half a turn on."""
        assert state.scene is not None
        orders = _orders(state.scene.beam)
        if orders.max() == 0:
            return []
        slope = state.scene.turned(_SMALL).maps() - state.scene.maps()
        small = np.rad2deg(_SMALL * state.fit([slope])[0])
        angles = [90.0, *(sign * angle for angle in (30.0, 60.0) for sign in (1, -1))]
        if (orders % 2).any():
            angles += [180.0, -90.0, 120.0, -120.0, 150.0, -150.0]
        return [np.array([angle]) for angle in (small, *angles)]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return scene.turned(float(np.deg2rad(value[0])))

    def amplitude(self, value: Vector) -> float:
        return 180.0 - (180.0 - float(value[0])) % 360.0

    def equivalent(self, value: Vector) -> list[tuple[str, float, str]]:
        return [("beam_turned", self.amplitude(value), "deg")]


class PsiSign(Difference):
    """psi of side B counts the other way round."""

    name, unit = "psi_sign", "1 = reversed"
    met = "COSMO and IAU conventions, or a reflected focal plane"
    turns = mirrors = True

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return scene.reversed()


class BeamConjugated(Difference):
    """The beam of side B has b_lm of the opposite sign of m: it is a mirror image."""

    name, unit = "beam_conjugated", "1 = opposite m"
    met = "beam coefficients of e^(im phi) where e^(-im phi) was meant"
    turns = mirrors = True
    ways = (1.0, -1.0)
    counted = False

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        signs = np.where(np.arange(scene.beam.mmax + 1) % 2 == 1, value[0], 1.0)
        return replace(scene, beam=replace(scene.beam, blm=signs[:, None] * scene.beam.blm.conj()))


class FrameRotated(Difference):
    """The sky of side B is that of side A, turned about a pole."""

    name, unit = "frame_rotated", "deg"
    met = "Galactic for ecliptic coordinates, or a longitude counted from another origin"
    smooth = True

    def __init__(self, frame: str) -> None:
        self.frame = frame

    def starts(self, state: State) -> list[Vector]:
        """Return the best angle about each frame's pole, and the rotations from one frame to another."""
        assert state.scene is not None
        lmax, nthreads = min(state.scene.lmax, 2 * state.pair.nside), state.scene.nthreads
        shown = state.scene.preparations[0].frame if state.scene.preparations else self.frame
        to_sky = rotation_matrix(shown, self.frame)
        a, b = (_turned(_mean_alm(side, state, lmax), lmax, to_sky, nthreads) for side in (state.maps, state.pair.b))
        found = []
        for frame in FRAMES:
            to_pole = rotation_matrix(self.frame, frame)
            one, other = (_turned(alm, lmax, to_pole, nthreads) for alm in (a, b))
            angle = _best_angle(one, other, lmax)
            pole = to_pole.T @ np.array([0.0, 0.0, 1.0])
            if abs(angle) > 1e-7:
                found.append(np.rad2deg(angle) * pole)
        for start, end in permutations(FRAMES, 2):
            found.append(np.rad2deg(Rotation.from_matrix(rotation_matrix(start, end)).as_rotvec()))
        lost = [float(np.sum(np.abs(b - _turned(a, lmax, _matrix(value), nthreads)) ** 2)) for value in found]
        best = int(np.argmin(lost))
        return [found[best]] if lost[best] < float(np.sum(np.abs(b - a) ** 2)) else []

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene, sky=_turned(scene.sky, scene.lmax, _matrix(value), scene.nthreads))

    def amplitude(self, value: Vector) -> float:
        return float(np.linalg.norm(value))

    def parameters(self, value: Vector) -> dict[str, float | str]:
        lon, lat = healpy.vec2ang(value, lonlat=True)
        return {"pole_lon_deg": float(lon[0]), "pole_lat_deg": float(lat[0]), "frame": self.frame}


def _matrix(rotation_deg: Vector) -> Vector:
    return np.asarray(Rotation.from_rotvec(np.deg2rad(rotation_deg)).as_matrix())


def _turned(alm: NDArray[np.complex128], lmax: int, matrix: Vector, nthreads: int) -> NDArray[np.complex128]:
    return alm if np.array_equal(matrix, np.eye(3)) else turn_alm(alm, lmax, matrix, nthreads)


def _mean_alm(maps: Maps, state: State, lmax: int) -> NDArray[np.complex128]:
    nthreads = 1 if state.scene is None else state.scene.nthreads
    return healpix.analysis(mean_map(maps, state.pair.seen), lmax, iterations=1, nthreads=nthreads)


def _best_angle(a: NDArray[np.complex128], b: NDArray[np.complex128], lmax: int) -> float:
    """Return the angle about the z axis that turns a into b best: a_lm becomes e^(-i m angle) a_lm."""
    orders = alm_.orders(lmax)
    power = np.zeros(lmax + 1, dtype=np.complex128)
    np.add.at(power, orders, np.conj(a) * b)

    def lost(angle: float) -> float:
        return -float(np.sum(np.real(power * np.exp(1j * np.arange(lmax + 1) * angle))))

    number = 16 * lmax
    step = 2.0 * np.pi / number
    signs = np.where(np.arange(lmax + 1) % 2 == 1, -1.0, 1.0)  # angles from -pi on
    start = step * int(np.argmax(np.fft.ifft(signs * power, number).real)) - np.pi
    return float(minimize_scalar(lost, bounds=(start - step, start + step), method="bounded").x)


class TimeShift(Difference):
    """The signal of side B is attributed to a pointing so many samples earlier than on side A."""

    name, unit = "time_shift", "samples"
    met = "time stamps at the end of an integration instead of its middle"
    smooth = True
    natural = 1e-3

    def __init__(self) -> None:
        self._largest = np.inf

    def within(self, value: Vector) -> Vector:
        """Return the shift, of at most ten widths of the beam: farther on, the sky is another one altogether."""
        return np.clip(value, -self._largest, self._largest)

    def starts(self, state: State) -> list[Vector]:
        """Return the shift that fits best, of at most two widths of the beam, from where others are looked for."""
        scene, pair = state.scene, state.pair
        if scene is None or pair.channel is None or pair.channel.site.pointing is None:
            return []
        width = np.sqrt(-np.log(max(scene.beam.window[scene.lmax], 1e-12)) * 2.0) / scene.lmax
        largest = 2.0 * width / _radians_per_sample(pair)
        self._largest = 5.0 * largest
        bare, value = scene.maps(), 0.05 * largest
        for _ in range(3):
            moved = self.scene(scene, np.array([value]), pair).maps() - bare
            size = float(state.fit([moved])[0])
            value = float(np.clip(value * size, -largest, largest))
            told = size * np.linalg.norm(state.beside(moved)) / np.linalg.norm(state.rest(state.maps)).clip(1e-300)
            if abs(value) < 1e-6 * largest or abs(told) < FAINT:
                return []
        return [np.array([value])]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        spin = pair.channel.site.pointed(self.name).model.spin_period_s if pair.channel is not None else 1.0
        return replace(scene, late=float(value[0]), step=float(np.sign(spin)) * _radians_per_sample(pair))


def _radians_per_sample(pair: ChannelPair) -> float:
    """Return the median way of a channel's line of sight in the time of a sample, which may be more than a turn."""
    assert pair.channel is not None
    pointed = pair.channel.site.pointed("time_shift")
    later = pointed.model.ahead(_SMALL * pointed.model.period_of_samples(pointed.line))
    here, there = (healpy.ang2vec(*pointing(m, pointed.line, 0, 4096)[:2]) for m in (pointed.model, later))
    return float(np.median(np.linalg.norm(there - here, axis=1))) / _SMALL


class ReversedMotion(Difference):
    """A motion of the scan of side B turns the other way round."""

    unit = "1 = reversed"
    stage = 1
    motion: ClassVar[str]

    def __init__(self) -> None:
        self._made: dict[tuple[float, float, int], tuple[Moments, ...]] = {}

    def starts(self, state: State) -> list[Vector]:
        known = state.pair.channel is not None and state.pair.channel.site.pointing is not None
        return super().starts(state) if known else []

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        assert pair.channel is not None
        pointing = pair.channel.site.pointed(self.name)
        model = scene.motion or pointing.model
        model = replace(model, **{self.motion: -getattr(model, self.motion)}).with_lines_of_sight(pointing.line.name)
        whole = scene if pair.scene is None else pair.scene
        smax = min(scene.moments[0].smax, whole.beam.mmax + EXTRA_ORDERS)
        key = model.spin_period_s, model.precession_period_s, smax
        if key not in self._made:
            self._made[key] = tuple(
                Moments.from_model(model, scene.nside, smax, pair.channel.site.frame, span, scene.nthreads)
                for span in scene.spans
            )
        moved = replace(scene, moments=self._made[key], motion=model, psi=(1, 0.0))
        oriented = (moved if scene.psi[0] > 0 else moved.reversed()).turned(scene.psi[1])
        return oriented.at_centres() if scene.centred else oriented


class SpinSign(ReversedMotion):
    """The spin of side B turns the other way round."""

    name, motion = "spin_sign", "spin_period_s"
    met = "a left-handed spin in one of two scan generators"


class PrecessionSign(ReversedMotion):
    """The precession of side B turns the other way round."""

    name, motion = "precession_sign", "precession_period_s"
    met = "precession rates of opposite sign in two scan generators"


class PixelCentres(Difference):
    """Samples of side B are moved to the centres of their pixels."""

    name, unit = "pixel_centres", "1 = samples at the centres"
    met = "pointing rounded to pixels before the sky is looked up"
    mutual = True

    def starts(self, state: State) -> list[Vector]:
        known = state.scene is not None and state.scene.moments[0].dtheta is not None
        return super().starts(state) if known else []

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene.at_centres(), window=np.ones_like(scene.window))


class PixelWindow(Difference):
    """The pixel window is once more (+1) or once less (-1) in side B."""

    name, unit = "pixel_window", "times too often"
    met = "a window applied to the sky and again by the samples' spread, or forgotten for a map made at centres"
    ways = (1.0, -1.0)
    mutual = True

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        own = healpix.pixel_window(scene.nside, scene.lmax)
        return replace(scene, window=scene.window * own ** value[0])


class BeamWindow(Difference):
    """The circular part of the beam is once more (+1) or once less (-1) in side B."""

    name, unit = "beam_window", "times too often"
    met = "an input map that is smoothed already, or an unsmoothed one taken for smoothed"
    ways = (1.0, -1.0)
    mutual = True

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        window = scene.beam.window[: scene.lmax + 1]
        factor = np.where(window > WEAKEST, np.maximum(window, WEAKEST) ** value[0], 1.0 if value[0] < 0 else 0.0)
        return replace(scene, sky=alm_.multiply(scene.sky, factor, scene.lmax))


class Smoothing(Difference):
    """The sky of side B is smoothed by a circular Gaussian more, or less, than that of side A."""

    name, unit = "beam_width", "fraction of the FWHM"
    met = "a map that is smoothed or deconvolved besides, or a beam of another width"
    smooth = True
    natural = 0.1

    def within(self, value: Vector) -> Vector:
        return np.clip(value, -0.99, WIDEST)

    def starts(self, state: State) -> list[Vector]:
        """Return the variance of the Gaussian over that of the beam."""
        assert state.scene is not None
        step = self.scene(state.scene, np.array([_SMALL]), state.pair).maps() - state.scene.maps()
        return [np.array([max(_SMALL * state.fit([step])[0], -0.9)])]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        ell = np.arange(scene.lmax + 1)
        factor = np.exp(-0.5 * ell * (ell + 1) * max(value[0], -1.0) * _variance(scene))
        return replace(scene, sky=alm_.multiply(scene.sky, factor, scene.lmax))

    def inverse(self, value: Vector) -> Vector:
        """Return the variance over that of the other side's beam."""
        return -value / (1.0 + value)

    def amplitude(self, value: Vector) -> float:
        return float(np.sqrt(max(1.0 + value[0], 0.0)) - 1.0)

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {"by": "a circular Gaussian"}


class SmoothingWithDipole(Smoothing):
    """The same of a sky with the dipole of the model, which both sides subtract as the beam of side A sees it."""

    met = "a beam of another width than the one through which the dipole is subtracted"

    def starts(self, state: State) -> list[Vector]:
        channel = state.pair.channel
        return super().starts(state) if channel is not None and channel.site.dipole_uk.any() else []

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        assert pair.channel is not None
        dipole = dipole_alm(pair.channel.site.dipole_uk, scene.lmax)
        smoothed = super().scene(replace(scene, sky=scene.sky + dipole), value, pair)
        return replace(smoothed, sky=smoothed.sky - dipole)

    def parameters(self, value: Vector) -> dict[str, float | str]:
        return {**super().parameters(value), "of": "the sky and its dipole"}


def _variance(scene: Scene) -> float:
    """Return sigma^2 of the Gaussian whose window is the beam's where that has fallen to a half, or ends."""
    window = scene.beam.window[: scene.lmax + 1] / scene.beam.window[0]
    end = max(int(np.argmax(np.append(window, 0.0) < 0.5)) - 1, 1)
    return float(-2.0 * np.log(min(max(window[end], 1e-6), 1.0 - 1e-9)) / (end * (end + 1)))


class LmaxCut(Difference):
    """Sky or beam of side B end at a lower degree."""

    name, unit = "lmax_cut", "highest l"
    met = "b_lm of a lower lmax than the sky's, padded with zeros"

    def starts(self, state: State) -> list[Vector]:
        """Return the degree from which on side B has least: of maps, and by what changes of the sky, without holes."""
        assert state.scene is not None
        scene, lmax = state.scene, min(state.scene.lmax, 3 * state.pair.nside - 1)
        a, change = (_mean_alm(maps, state, lmax) for maps in (state.maps, state.pair.b - state.maps))
        whole = alm_.resize(convolve.circular_alm(scene.sky, scene.response), scene.lmax, lmax)
        found = set()
        for before in (a, whole):
            kept, gone = (alm_.power(x, lmax) for x in (change, before + change))
            lost = np.cumsum(kept) + gone.sum() - np.cumsum(gone)
            found.add(int(np.argmin(lost)))
        return [np.array([float(best)]) for best in sorted(found) if 2 <= best < lmax]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        kept = np.arange(scene.lmax + 1) <= value[0]
        return replace(scene, sky=alm_.multiply(scene.sky, kept.astype(float), scene.lmax))


class MmaxCut(Difference):
    """The beam of side B has lower azimuthal orders alone."""

    name, unit = "mmax_cut", "highest m"
    met = "an mmax of the convolution below that of the beam"

    def starts(self, state: State) -> list[Vector]:
        assert state.scene is not None
        orders = _orders(state.scene.beam)
        return [np.array([float(m)]) for m in orders[:-1]]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        return replace(scene, beam=scene.beam.truncated(int(value[0])))
