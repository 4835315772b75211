"""Effects on the gain: constant, of one split, with the year, with the spin, with the signal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics.base import Alm, Bound, Draw, Effect, Site, Wording
from mcsim.systematics.parametrization import Angle, Parametrization, Vector, reciprocal
from mcsim.systematics.product import multiplied
from mcsim.systematics.spacecraft import spin_phase


@dataclass(frozen=True, kw_only=True)
class Calibration(Effect):
    """Gain 1 + amplitude of sky and dipole alike, at all times; the noise stays as it is.

    Notes
    -----
    It acts as a beam of the integral 1 + amplitude. The dipole is subtracted with the fiducial gain, 1: amplitude times
    the dipole is left.
    """

    name = "calibration"
    scope = "channel"
    unit = "fraction"
    title = "calibration"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "Absolute calibration on a dipole that is known, or was measured, with an error."
    signature = "L = 0 and the dipole: the same factor at all degrees and times, in this channel alone."
    source = "Jarosik et al. 2011, ApJS 192, 14 (0.2 %); Planck 2015 results V, A&A 594, A5"
    step = 1e-3
    parametrization = Parametrization(proportional=True)
    bounds = (Bound("amplitude", -0.5, 0.5, "a prior of this library: half of the dipole is seen by eye"),)

    def beam(self, beam: Beam, site: Site) -> Beam:
        return replace(beam, blm=(1.0 + _leaving_signal(self)) * beam.blm)

    def inverse(self) -> Self:
        return replace(self, amplitude=reciprocal(self.amplitude))


@dataclass(frozen=True, kw_only=True)
class SplitCalibration(Effect):
    """Gain 1 + amplitude in one split of the survey alone, of sky and dipole alike; the noise stays as it is.

    Attributes
    ----------
    amplitude
        Fraction.
    split
        Name of the split.

    Notes
    -----
    The dipole is subtracted with the fiducial gain, 1: amplitude times the dipole is left in the map of the split.
    """

    name = "split_calibration"
    scope = "channel"
    unit = "fraction"
    title = "calibration of one split"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "Parts of a survey that were calibrated one by one, such as years or sets of detectors."
    signature = "The same factor of sky and dipole at all degrees, in one split and in no other of the channel."
    source = "Jarosik et al. 2011, ApJS 192, 14 (gain of every year); Planck 2015 results VIII, A&A 594, A8 (of rings)"
    step = 1e-3
    bounds = (Bound("amplitude", -0.5, 0.5, "a prior of this library: half of the dipole is seen by eye"),)
    proposed = False

    split: str = ""

    @classmethod
    def variants_in(cls, splits: Sequence[str]) -> tuple[Mapping[str, Any], ...]:
        return tuple({"split": name} for name in splits) if len(splits) > 1 else cls.variants

    def steady_gain(self, site: Site) -> float:
        if self.split not in site.splits:
            several = len(site.splits) > 1
            known = f"choose from {', '.join(site.splits)}" if several else "name two or more splits in map.splits"
            raise InputError(f"effect {self.name}: split = {self.split!r} is no split of {site.channel}; {known}.")
        return _leaving_signal(self) if site.split == self.split else 0.0


def _leaving_signal(effect: Effect) -> float:
    """Return the amplitude of a calibration; InputError for one that leaves no signal."""
    if effect.amplitude <= -1.0:
        raise InputError(
            f"effect {effect.name}: amplitude = {effect.amplitude:g} leaves no signal; choose one above -1."
        )
    return effect.amplitude


@dataclass(frozen=True, kw_only=True)
class GainDrift(Effect):
    """Gain 1 + amplitude cos(2 pi t / orbit period - phase), of sky and dipole alike.

    Attributes
    ----------
    amplitude
        Fraction.
    phase_deg
        Part of the year at which the gain is highest, as an angle from the start of the survey.

    Notes
    -----
    The dipole is subtracted with the fiducial gain, 1: what is left of it is most of the effect.
    """

    name = "gain_drift"
    scope = "channel"
    unit = "fraction"
    title = "annual gain drift"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "Temperature of the receiver over the year, followed imperfectly by the calibration."
    signature = (
        "Sky and dipole modulated with the year: additive at low l, ordered by the scan, opposite in the halves."
    )
    source = "Jarosik et al. 2007, ApJS 170, 263 (gain model)"
    step = 2e-4
    bounds = (Bound("amplitude", 0.0, 0.1, "a prior of this library: far beyond any radiometer in use"),)
    parametrization = Angle(parameter="phase_deg")

    phase_deg: float = 0.0

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        if self.amplitude == 0.0:
            return None
        turns = time_s / site.pointed(self.name).model.orbit_period_s
        return np.asarray(self.amplitude * np.cos(2.0 * np.pi * turns - np.deg2rad(self.phase_deg)))


@dataclass(frozen=True, kw_only=True)
class GainSpin(Effect):
    """Gain 1 + amplitude cos(spin phase - phase), of sky and dipole alike.

    Attributes
    ----------
    amplitude
        Fraction.
    phase_deg
        Spin phase at which the gain is highest: angle of the line of sight about the spin axis, from the Sun's side.

    Notes
    -----
    Harmonics of the spin and gain noise without a phase average out faster than this term, which every spin repeats.
    """

    name = "gain_spin"
    scope = "channel"
    unit = "fraction"
    title = "spin-synchronous gain"
    wording = Wording("{} of the gain", " %", 100.0)
    cause = "A receiver or its supply that is heated by the Sun once every spin, faster than calibration follows."
    signature = "Sky and dipole times a pattern fixed to the Sun: additive at low l, in the frame of the scan."
    source = "Hinshaw et al. 2003, ApJS 148, 63 (limits); Planck 2015 results III, A&A 594, A3 (thermal effects)"
    step = 2e-4
    bounds = (Bound("amplitude", 0.0, 0.1, "a prior of this library: far beyond any radiometer in use"),)
    parametrization = Angle(parameter="phase_deg")
    proposed = False

    phase_deg: float = 0.0

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        if self.amplitude == 0.0:
            return None
        return np.asarray(
            self.amplitude * np.cos(spin_phase(site.pointed(self.name), time_s) - np.deg2rad(self.phase_deg))
        )


@dataclass(frozen=True, kw_only=True)
class Nonlinearity(Effect):
    """The gain rises with the signal: sky and dipole times 1 + amplitude (dipole / largest dipole).

    Attributes
    ----------
    amplitude
        Relative change of the gain from no dipole to its maximum.

    Notes
    -----
    The signal is a (T + D) with T the sky, D = d . n its dipole, d as long as ``sky.dipole_uk``, and a = 1 + amplitude
    D / |d|: the sky is modulated, and a quadrupole amplitude D^2 / |d| appears. T in a, a fiftieth of D, is left out.
    The beam acts afterwards, which is the same where the dipole hardly changes across it.
    """

    name = "nonlinearity"
    scope = "channel"
    unit = "fraction"
    wording = Wording("{} of the gain at the dipole's maximum", " %", 100.0)
    cause = "Analogue-to-digital converters or detectors whose response is curved over the range of the dipole."
    signature = "A quadrupole aligned with the dipole, and the sky modulated along it, the same in both halves."
    source = "Planck 2018 results III, A&A 641, A3 (nonlinearity of converters)"
    step = 2e-4
    bounds = (Bound("amplitude", -0.1, 0.1, "a prior of this library: far beyond any converter in use"),)
    proposed = False

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        largest = float(np.linalg.norm(site.dipole_uk))
        if largest == 0.0:
            raise InputError(f"effect {self.name} on channel {site.channel} follows the dipole; give sky.dipole_uk.")
        x, y, z = self.amplitude * site.dipole_uk / largest

        def relative(*where: Vector) -> Vector:
            return x * where[0] + y * where[1] + z * where[2]

        return sky + multiplied(sky + dipole_alm(site.dipole_uk, site.lmax), site.lmax, relative, 1)
