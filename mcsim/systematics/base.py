"""Effects: named changes of the simulation, each absent at zero amplitude.

An effect acts through hooks, one for each stage of a survey, composed in the order sky, beam, pointing, gain, noise,
map. A hook that an effect does not define changes nothing. Every hook serves both routes: the default one (spin maps
and orientation moments) and the sample-by-sample one, so that an effect that is added to a run, is
a candidate of a diagnosis, or acts in the time-ordered reference is one and the same.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import LineOfSight, Moments, ScanModel
from mcsim.support.numbers import measured

Alm = NDArray[np.complex128]
Map = NDArray[np.float64]
Vector = NDArray[np.float64]
Draw = Callable[[str], np.random.Generator]
"""From the name of a stage to its stream of random numbers in this realization."""


@dataclass(frozen=True)
class Pointing:
    """Describe how one channel of a survey was pointed, as a function of time.

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
    """Describe the channel of a survey in which an effect acts.

    Attributes
    ----------
    channel, frequency_ghz
        Name and frequency; None where the configuration gives none.
    frame, nside, lmax
        Of the maps (nside 0: rings without pixels), and the highest degree of the sky.
    beam
        Fiducial beam, before any effect.
    pointing
        Of the whole survey; None if only moments are known.
    dipole_uk
        Dipole that the survey sees and subtracts with the fiducial gain: a vector in the frame of the maps.
    whole
        Returns the beam with the orders that it has without an m_max; None if they are not known.
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
        """Return the pointing; raise InputError if it is not known."""
        if self.pointing is None:
            raise InputError(
                f"effect {effect} on channel {self.channel} depends on when and how the survey was pointed; give the "
                'channel a scan of kind "hit_averaged", or moments with a scan model (scan.model).'
            )
        return self.pointing

    def whole_beam(self, effect: str) -> Beam:
        """Return the beam with the orders that are left out of ``beam``; raise InputError if none are."""
        whole = None if self.whole is None else self.whole()
        if whole is None or whole.mmax <= self.beam.mmax:
            raise InputError(
                f"effect {effect} on channel {self.channel} adds the orders of the beam that m_max leaves out, but the "
                f"beam has none beyond m = {self.beam.mmax}; give a beam that is not circular, with beam.m_max below "
                "its highest order."
            )
        return whole

    def frequency(self, effect: str) -> float:
        """Return the frequency in GHz; raise InputError if it is not known."""
        if self.frequency_ghz is None:
            raise InputError(
                f"effect {effect} depends on frequency, but channel {self.channel} has none; give its frequency_ghz."
            )
        return self.frequency_ghz


@dataclass(frozen=True)
class Wording:
    """How an amplitude is printed.

    Attributes
    ----------
    text
        Sentence with {} for scale * amplitude + offset, its error and symbol.
    symbol
        Of the unit in which it is printed.
    negative
        Sentence for the absolute value of a negative amplitude; None: ``text``, with the sign.
    """

    text: str = "{}"
    symbol: str = ""
    scale: float = 1.0
    offset: float = 0.0
    negative: str | None = None


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Derive an effect from this class, whose hooks change nothing.

    A subclass is a frozen dataclass whose fields are its parameters, ``amplitude`` first; zero amplitude is no effect.

    Attributes
    ----------
    name
        As in ``[[effect]]`` and in verdicts.
    scope
        "channel": acts in one channel; "common": alike in all of them.
    unit
        Of the amplitude.
    title, wording
        Name and amplitude as people read them; left out: the name with spaces, and the amplitude with its unit.
    cause, signature, source
        What makes it, how it shows, and where that is from: one sentence each, for people.
    step
        Amplitude at which responses are measured: small enough to be linear.
    matched_filter
        True if the data vector of a diagnosis has a matched filter for it: not if a hook draws random numbers, nor if
        dipoles, variances, spectra and modulations, which are always measured, contain all of it.
    stochastic
        True if a hook draws random numbers, at positive amplitudes at least.
    mean_response
        True if a diagnosis uses the mean response over skies, not that of the observed sky: for a change of power
        alone, whose response in one sky depends on fluctuations that the spectra have anyway.
    sign
        Sign of the amplitudes at which responses are measured; 0: both. If it is not 0, a negative amplitude is
        unphysical, and a diagnosis does not name it.
    max_amplitude
        Largest physical amplitude, in absolute value; a diagnosis names no larger one.
    variants
        Fixed parameters with which the effect is a candidate, one candidate for each.

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
    title: ClassVar[str] = ""
    wording: ClassVar[Wording | None] = None
    cause: ClassVar[str]
    signature: ClassVar[str]
    source: ClassVar[str] = ""
    step: ClassVar[float]
    matched_filter: ClassVar[bool] = True
    sign: ClassVar[Literal[-1, 0, 1]] = 0
    stochastic: ClassVar[bool] = False
    mean_response: ClassVar[bool] = False
    max_amplitude: ClassVar[float] = np.inf
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)

    amplitude: float = 0.0

    # Stages, in the order in which they act.

    def sky(self, sky: Alm, site: Site, draw: Draw) -> Alm:
        """Return coefficients of the sky that the channel sees, uK, up to ``site.lmax``."""
        return sky

    def beam(self, beam: Beam, site: Site) -> Beam:
        """Return the beam about the line of sight."""
        return beam

    def pointing(self, beam: Beam, site: Site) -> Beam:
        """Return the beam about the *fiducial* line of sight, from which the true one is displaced."""
        return beam

    def gain(self, time_s: Vector, site: Site) -> Vector | None:
        """Return the relative error of the gain at times since the start, shape (n,); None: no error."""
        return None

    def noise(self, site: Site) -> Map | None:
        """Return the factor of the variance of every pixel's samples, shape (npix,); None: one."""
        return None

    def spread(self) -> float:
        """Return the factor by which samples move towards the centre of their pixel."""
        return 1.0

    def orientations(self, moments: Moments, site: Site) -> Moments:
        """Return the orientation moments of the true scan from the fiducial ones."""
        return moments

    def differencing(self, imbalance: float, iterations_short: int) -> tuple[float, int]:
        """Return the true imbalance of a differencing scan, and the iterations by which map-making falls short."""
        return imbalance, iterations_short

    # The same in the sample-by-sample route, where it can be said more directly than by a hook above.

    def moved(self, theta: Vector, phi: Vector, psi: Vector) -> tuple[Vector, Vector, Vector] | None:
        """Return true direction and orientation of samples from the fiducial ones; None: see :meth:`pointing`."""
        return None

    def lags(self) -> tuple[tuple[float, float], ...] | None:
        """Return (weight, delay in seconds) of the earlier signals in a sample; None: as :meth:`moved`."""
        return None

    # How the effect is parametrised for a linear fit.

    @classmethod
    def basis(cls) -> tuple[Self, ...]:
        """Return effects of amplitude ``step`` whose responses span those of all parameters, to first order."""
        return (cls(amplitude=cls.step),)

    def coordinates(self) -> Vector:
        """Return the linear components: the response is the sum of coordinates times that of the basis per step."""
        return np.array([self.amplitude])

    @classmethod
    def constrained(cls, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Return the fitted coordinates that the data constrain, and zeros; by default all of them.

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
        """Return the effect whose coordinates are nearest in the metric ``precision``, shape (k, k)."""
        return cls(amplitude=float(coordinates[0]))

    def parameters(self) -> dict[str, Any]:
        """Return all parameters but the amplitude, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "amplitude"}

    @classmethod
    def label(cls, channel: str | None = None) -> str:
        """Return the effect's name as people read it, with the channel that it acts in."""
        return (cls.title or cls.name.replace("_", " ")) + (f" of {channel}" if channel else "")

    @classmethod
    def format_amplitude(cls, amplitude: float, sigma: float = 0.0) -> str:
        """Return an amplitude with its error (0: none) and unit as people read it.

        Examples
        --------
        >>> from mcsim.systematics.beam_ellipticity import BeamEllipticity
        >>> BeamEllipticity.format_amplitude(0.159, 0.008)
        'axis ratio 1.159 ± 0.008'
        """
        how = cls.wording or Wording(symbol=f" ({cls.unit})")
        if amplitude < 0.0 and how.negative is not None:
            return how.negative.format(measured(-how.scale * amplitude, how.scale * sigma, how.symbol))
        return how.text.format(measured(how.scale * amplitude + how.offset, how.scale * sigma, how.symbol))

    def direction(self) -> str:
        """Return where the amplitude points, in words; empty for an effect without a direction."""
        return ""

    def describe(self, sigma: float = 0.0) -> str:
        """Return amplitude, error and direction as people read them."""
        return " ".join(filter(None, (self.format_amplitude(self.amplitude, sigma), self.direction())))

    def scaled(self, factor: float) -> Self:
        """Return the same effect with ``factor`` times the amplitude."""
        return replace(self, amplitude=factor * self.amplitude)


def scan_direction(angle_deg: float, period_deg: float = 360.0) -> str:
    """Return a direction in the frame of the beam, x along the scan, in words."""
    angle = (angle_deg + period_deg / 2.0) % period_deg - period_deg / 2.0
    named = {0.0: "along the scan", 90.0: "across the scan"}
    if period_deg > 180.0:
        named |= {180.0: "against the scan"}
    for at, words in named.items():
        if abs(abs(angle) - at) < _NAMED_WITHIN_DEG:
            return words
    return f"at {angle:.0f}° to the scan".replace("-", "−")


_NAMED_WITHIN_DEG = 5.0


def polar(coordinates: Vector, multiple: int = 1) -> tuple[float, float]:
    """Return norm, and angle in degrees, of a (cos, sin) pair whose angle counts ``multiple`` times."""
    x, y = (float(value) for value in coordinates)
    return float(np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)) / multiple)


def build(kind: type[Effect], parameters: Mapping[str, Any]) -> Effect:
    """Build an effect from a table of parameters.

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
