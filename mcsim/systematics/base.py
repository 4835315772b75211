"""What an effect is: a named change of the simulation, which is none where its amplitude is zero.

An effect acts through hooks, one for each stage of a survey, composed in the order sky, beam, pointing, gain, noise,
map. A hook that an effect does not define changes nothing. Every hook serves both routes: the default one (spin maps
and orientation moments) and the sample-by-sample one, so that adding an effect to a run, proposing it in a diagnosis
and putting it into the referee are one act.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import LineOfSight, Moments, ScanModel

Alm = NDArray[np.complex128]
Map = NDArray[np.float64]
Vector = NDArray[np.float64]
Draw = Callable[[str], np.random.Generator]
"""From the name of a stage to its stream of random numbers in this realization."""


@dataclass(frozen=True)
class Pointing:
    """How one channel of a survey was pointed, as a function of time.

    Attributes
    ----------
    model, line
        The scan and the channel's line of sight.
    time_range
        Part of the survey in this map, as fractions of its samples.
    """

    model: ScanModel
    line: LineOfSight
    time_range: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Site:
    """What an effect may know of where it acts: one channel of a survey.

    Attributes
    ----------
    channel, frequency_ghz
        Name and frequency; None where the configuration gives none.
    frame, nside, lmax
        Of the maps (nside 0: rings without pixels), and the highest degree of the sky.
    beam
        As believed, before any effect.
    pointing
        Of the whole survey; None where only moments are known.
    dipole_uk
        The dipole that the survey sees and takes off as believed: a vector in the frame of the maps, zeros without.
    whole
        Gives the beam with the orders that it has without an m_max; None where they are not known.
    """

    channel: str
    frequency_ghz: float | None
    frame: str
    nside: int
    lmax: int
    beam: Beam
    pointing: Pointing | None = None
    dipole_uk: Vector = field(default_factory=lambda: np.zeros(3))
    whole: Callable[[], Beam] | None = None

    def pointed(self, effect: str) -> Pointing:
        """The pointing; InputError where it is not known."""
        if self.pointing is None:
            raise InputError(
                f"effect {effect} on channel {self.channel} depends on when and how the survey was pointed; give the "
                'channel a scan of kind "hit_averaged", or moments with a scan model (scan.model).'
            )
        return self.pointing

    def whole_beam(self, effect: str) -> Beam:
        """The beam with the orders that are left out of ``beam``; InputError where none are."""
        whole = None if self.whole is None else self.whole()
        if whole is None or whole.mmax <= self.beam.mmax:
            raise InputError(
                f"effect {effect} on channel {self.channel} adds the orders of the beam that m_max leaves out, but the "
                f"beam has none beyond m = {self.beam.mmax}; give a beam that is not circular, with beam.m_max below "
                "its highest order."
            )
        return whole

    def frequency(self, effect: str) -> float:
        """The frequency in GHz; InputError where it is not known."""
        if self.frequency_ghz is None:
            raise InputError(
                f"effect {effect} depends on frequency, but channel {self.channel} has none; give its frequency_ghz."
            )
        return self.frequency_ghz


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Base class: what every effect has, and hooks that change nothing.

    A subclass is a frozen dataclass whose fields are its parameters, ``amplitude`` first; zero amplitude is no effect.

    Attributes
    ----------
    name
        As in ``[[effect]]`` and in verdicts.
    scope
        "channel": acts in one channel; "common": alike in all of them.
    unit
        Of the amplitude.
    cause, signature, source
        What makes it, how it shows, and where that is from: one sentence each, for people.
    step
        Amplitude at which responses are measured: small enough to be linear.
    own_score
        Whether a diagnosis should listen with a template of its own: not where a hook draws random numbers, nor where
        what is always listened for (dipoles, variances, spectra, modulations) says it all.
    draws
        Whether a hook draws random numbers, at positive amplitudes at least.
    mean_response
        Whether a diagnosis holds to the response in the mean over skies, and not to that in the sky that was observed.
        So for a change of power alone, or one that makes a typical sky of another: in one sky it hangs on the
        fluctuations that the spectra have anyway.
    side
        Sign of the amplitudes at which responses are measured; 0: both. Where it is not 0, a negative amplitude is not
        one of nature, and a diagnosis does not name it.
    most
        Largest amplitude, in absolute value, of nature; a diagnosis names no larger one.
    variants
        Settings, fixed parameters, that a diagnosis proposes side by side.

    Examples
    --------
    An effect of one's own, which a package offers under the entry points ``mcsim.effects``:

    >>> from dataclasses import dataclass, replace
    >>> import mcsim
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Squint(mcsim.Effect):
    ...     name = "squint"
    ...     scope = "channel"
    ...     unit = "relative change of b_l2"
    ...     cause = "A beam more elongated than measured."
    ...     signature = "L = 2, as the beam's own."
    ...     step = 0.01
    ...
    ...     def beam(self, beam, site):
    ...         blm = beam.blm.copy()
    ...         blm[2] *= 1.0 + self.amplitude
    ...         return replace(beam, blm=blm)
    >>> Squint(amplitude=0.1).scaled(0.5)
    Squint(amplitude=0.05)
    """

    name: ClassVar[str]
    scope: ClassVar[Literal["channel", "common"]]
    unit: ClassVar[str]
    cause: ClassVar[str]
    signature: ClassVar[str]
    source: ClassVar[str] = ""
    step: ClassVar[float]
    matched_filter: ClassVar[bool] = True
    sign: ClassVar[Literal[-1, 0, 1]] = 0
    draws: ClassVar[bool] = False
    mean_response: ClassVar[bool] = False
    max_amplitude: ClassVar[float] = np.inf
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)

    amplitude: float = 0.0

    # Stages, in the order in which they act.

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Coefficients of the sky that the channel looks at, uK, up to ``site.lmax``."""
        return sky

    def beam(self, beam: Beam, site: Site) -> Beam:
        """The beam about the line of sight."""
        return beam

    def pointing(self, beam: Beam, site: Site) -> Beam:
        """The beam about the *believed* line of sight, where the true one is displaced or smeared."""
        return beam

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        """Relative error of the gain at these times since the start, shape (n,); None: no error."""
        return None

    def noise(self, site: Site) -> Map | None:
        """Factor of the variance of every pixel's samples, shape (npix,); None: one."""
        return None

    def spread(self) -> float:
        """By what factor the samples' offsets from the centre of their pixel shrink."""
        return 1.0

    def orientations(self, moments: Moments, site: Site) -> Moments:
        """Orientation moments of the true scan from the believed ones."""
        return moments

    def differencing(self, imbalance: float, iterations_short: int) -> tuple[float, int]:
        """True transmission imbalance of a differencing scan, and by how many iterations its map-making falls short."""
        return imbalance, iterations_short

    # The same in the sample-by-sample route, where it can be said more directly than by a hook above.

    def moved(self, theta: Vector, phi: Vector, psi: Vector) -> tuple[Vector, Vector, Vector] | None:
        """True direction and orientation of samples from the believed ones; None: :meth:`pointing` says it all."""
        return None

    def lags(self) -> tuple[tuple[float, float], ...] | None:
        """(weight, delay in seconds) of the earlier signals that make up a sample; None: as :meth:`moved`."""
        return None

    # What the diagnosis asks for.

    @classmethod
    def basis(cls) -> tuple[Self, ...]:
        """Effects of amplitude ``step`` whose responses span those of all its parameters, to first order."""
        return (cls(amplitude=cls.step),)

    def coordinates(self) -> Vector:
        """The effect in its linear components: its response is the sum of coordinates times the basis' per step."""
        return np.array([self.amplitude])

    @classmethod
    def constrained(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Of fitted coordinates what data tell: all of them, where an effect does not say which are beyond them.

        Parameters
        ----------
        coordinates
            Shape (basis,).
        precision
            Inverse of their covariance, shape (basis, basis).
        """
        return coordinates

    @classmethod
    def nearest(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Self:
        """The effect whose coordinates are nearest in the metric ``precision``, shape (k, k)."""
        return cls(amplitude=float(coordinates[0]))

    def parameters(self) -> dict[str, Any]:
        """All parameters but the amplitude, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "amplitude"}

    def scaled(self, factor: float) -> Self:
        """The same effect with ``factor`` times the amplitude."""
        return replace(self, amplitude=factor * self.amplitude)


def polar(coordinates: Vector, multiple: int = 1) -> tuple[float, float]:
    """Norm, and angle in degrees, of a (cos, sin) pair whose angle counts ``multiple`` times."""
    x, y = (float(value) for value in coordinates)
    return float(np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)) / multiple)


def build(kind: type[Effect], parameters: Mapping[str, Any]) -> Effect:
    """An effect from a table of parameters.

    Raises
    ------
    InputError
        For a parameter that the effect does not have, or a value that is no finite number where one is needed.
    """
    known = {f.name: f for f in fields(kind)}
    values: dict[str, Any] = {}
    for key, value in parameters.items():
        if key not in known:
            raise InputError(f"effect {kind.name} has no parameter {key!r}; it has {', '.join(known)}.")
        values[key] = _checked(kind.name, key, value, getattr(kind(), key))
    return kind(**values)


def _checked(effect: str, key: str, value: Any, default: Any) -> Any:
    if isinstance(default, str):
        if isinstance(value, str):
            return value
        raise InputError(f"effect {effect}: {key} = {value!r} must be a text.")
    if isinstance(default, tuple):
        if isinstance(value, list | tuple) and (not default or len(value) == len(default)):
            return tuple(float(_checked(effect, key, item, 0.0)) for item in value)
        size = f"{len(default)} numbers" if default else "numbers"
        raise InputError(f"effect {effect}: {key} = {value!r} must be a list of {size}.")
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"effect {effect}: {key} = {value!r} must be a finite number.")
    return float(value)
