"""Effects: named changes of the simulation, each absent at zero amplitude.

An effect acts through hooks, one for each stage of a survey, composed in the order sky, beam, pointing, gain, signal,
noise, map. A hook that an effect does not define changes nothing. Every hook serves both routes: the default one (spin
maps and orientation moments) and the sample-by-sample one, so that an effect that is added to a run, is a candidate of
a diagnosis, or acts in the time-ordered reference is one and the same.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mcsim.errors import InputError
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import LineOfSight, Moments, ScanModel
from mcsim.support.numbers import measured
from mcsim.systematics.hooks import guard
from mcsim.systematics.parametrization import Parametrization, Vector

Alm = NDArray[np.complex128]
Map = NDArray[np.float64]
Draw = Callable[[str], np.random.Generator]
"""From the name of a stage to its stream of random numbers in this realization."""


@dataclass(frozen=True)
class Pointing:
    """Describe how one channel of a survey was pointed: the scan, and the channel's line of sight."""

    model: ScanModel
    line: LineOfSight


@dataclass(frozen=True)
class Site:
    """Describe the channel of a survey in which an effect acts."""

    #: channel, frequency_ghz: name and frequency; None where the configuration gives none
    channel: str
    frequency_ghz: float | None
    #: frame, nside, lmax: of the maps (nside 0: rings without pixels), and the highest degree of the sky
    frame: str
    nside: int
    lmax: int
    beam: Beam  #: fiducial beam, before any effect
    pointing: Pointing | None = None  #: of the whole survey; None if only moments are known
    #: dipole that the survey sees and subtracts with the fiducial gain: a vector in the frame of the maps
    dipole_uk: Vector = field(default_factory=lambda: np.zeros(3))
    #: returns the beam with the orders that it has without an m_max; None if they are not known
    whole: Callable[[], Beam] | None = None
    #: False: the map is one of a component separation, in which foregrounds are not looked for
    foregrounds: bool = True
    #: splits, split: names of those of the survey, and whose samples are meant; None: all, and none where no split acts
    splits: tuple[str, ...] = ()
    split: str | None = None

    def pointed(self, effect: str) -> Pointing:
        """Return the pointing; raise InputError if it is not known."""
        if self.pointing is None:
            raise InputError(
                f"effect {effect} on channel {self.channel} depends on when and how the survey was pointed; give the "
                "channel one line of sight (scan.line_of_sight), the same in all splits, in a scan of kind "
                '"hit_averaged", or in moments with a scan model (scan.model).'
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
    """How an amplitude is printed."""

    text: str = "{}"  #: sentence with {} for scale * amplitude + offset, its error and symbol
    symbol: str = ""  #: of the unit in which it is printed
    scale: float = 1.0
    offset: float = 0.0
    #: sentence for the absolute value of a negative amplitude; None: ``text``, with the sign
    negative: str | None = None


@dataclass(frozen=True)
class Bound:
    """Bound a parameter of an effect by what is possible: a diagnosis names no effect beyond it.

    ``source`` says where the range, both ends included, is from.
    """

    parameter: str
    low: float
    high: float
    source: str


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Derive an effect from this class, whose hooks change nothing.

    A subclass is a frozen dataclass whose fields are its parameters, ``amplitude`` first. Zero amplitude is no effect:
    ``sky``, ``beam``, ``pointing``, ``signal`` and ``excess`` are not called then; what the others return changes
    nothing.

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
    setting_words
        "parameter = value" of a fixed parameter -> the same as people read it; left out: name and value with spaces.
    cause, signature, source
        What makes it, how it shows, and where that is from: one sentence each, for people.
    step
        Amplitude at which responses are measured: small enough to be linear.
    variants
        Fixed parameters with which the effect is a candidate, one candidate for each.
    bounds
        Ranges of the parameters that are possible; angles and directions have none.
    parametrization
        How a diagnosis fits it; left out: the amplitude alone, of either sign.
    proposed
        False: a diagnosis proposes it only where it is asked for by name (``mcsim diagnose --with NAME``), or where it
        explains the data in the place of effects that are about to be named (of one split: or of none).
    rank
        Order of effects on a beam's shape: -2 completes the fiducial one, -1 stretches, 1 adds what no other changes.

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
    setting_words: ClassVar[Mapping[str, str]] = {}
    wording: ClassVar[Wording | None] = None
    cause: ClassVar[str]
    signature: ClassVar[str]
    source: ClassVar[str] = ""
    step: ClassVar[float]
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)
    bounds: ClassVar[tuple[Bound, ...]] = ()
    parametrization: ClassVar[Parametrization] = Parametrization()
    proposed: ClassVar[bool] = True
    rank: ClassVar[int] = 0

    amplitude: float = 0.0

    def __init_subclass__(cls) -> None:
        """Refuse a class that says itself how it is fitted, which nobody would read there; guard a user's hooks."""
        super().__init_subclass__()
        misplaced = [key for key in vars(cls) if key in dir(Parametrization) and not key.startswith("_")]
        if misplaced:
            raise InputError(
                f"effect {cls.__name__} says {', '.join(misplaced)} itself; let its parametrization say it, as in "
                "parametrization = Parametrization(stochastic=True)."
            )
        if not cls.__module__.startswith("mcsim."):
            guard(cls)

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

    def steady_gain(self, site: Site) -> float:
        """Return the relative error of the gain that all samples of ``site.split`` share, whenever they were taken."""
        return 0.0

    def signal(self, time_s: Vector, theta: Vector, phi: Vector, psi: Vector, site: Site) -> Vector:
        """Return what is added to samples at these times and fiducial pointings, uK, shape (n,)."""
        return np.zeros_like(time_s)

    def noise(self, site: Site) -> Map | None:
        """Return the factor of the variance of every pixel's samples, shape (npix,); None: one."""
        return None

    def knee(self, f_knee_hz: float) -> float:
        """Return the true knee frequency of noise with memory from the fiducial one, Hz."""
        return f_knee_hz

    def excess(self, count: Vector, rng: np.random.Generator) -> Vector:
        """Return the sums, uK, shape (n,), of what is added at random to each of ``count`` samples, shape (n,)."""
        return np.zeros_like(count)

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

    # What people and configurations read.

    @classmethod
    def variants_in(cls, splits: Sequence[str]) -> tuple[Mapping[str, Any], ...]:
        """Return the fixed parameters with which it is a candidate in a survey of these splits."""
        return cls.variants

    def parameters(self) -> dict[str, Any]:
        """Return all parameters but the amplitude, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "amplitude"}

    @classmethod
    def label(cls, channel: str | None = None, settings: Mapping[str, Any] | None = None) -> str:
        """Return the effect's name as people read it, with the channel that it acts in and fixed parameters."""
        name = (cls.title or cls.name.replace("_", " ")) + (f" of {channel}" if channel else "")
        pairs = [(f"{key} = {value}", f"{key.replace('_', ' ')} {value}") for key, value in (settings or {}).items()]
        return ", ".join((name, *(cls.setting_words.get(text, words) for text, words in pairs)))

    @classmethod
    def format_amplitude(cls, amplitude: float, sigma: float = 0.0) -> str:
        """Return an amplitude with its error (0: none) and unit as people read it.

        Examples
        --------
        >>> from mcsim.systematics.beams import BeamEllipticity
        >>> BeamEllipticity.format_amplitude(0.159, 0.008)
        'axis ratio 1.159 ± 0.008'
        """
        how = cls.wording or Wording(text="{} " + f"({cls.unit})".replace("{", "{{").replace("}", "}}"))
        if amplitude < 0.0 and how.negative is not None:
            return how.negative.format(measured(-how.scale * amplitude + how.offset, how.scale * sigma, how.symbol))
        return how.text.format(measured(how.scale * amplitude + how.offset, how.scale * sigma, how.symbol))

    def within_bounds(self) -> Self:
        """Return the effect with each parameter moved to the nearest value within its bounds."""
        values = {one.parameter: getattr(self, one.parameter) for one in self.bounds}
        moved = {one.parameter: min(max(values[one.parameter], one.low), one.high) for one in self.bounds}
        return self if moved == values else replace(self, **moved)

    def direction(self) -> str:
        """Return where the amplitude points, in words; empty for an effect without a direction."""
        return ""

    def describe(self, sigma: float = 0.0, errors: Mapping[str, float] | None = None) -> str:
        """Return amplitude, error and direction as people read them; ``errors``: of other fitted parameters."""
        return " ".join(filter(None, (self.format_amplitude(self.amplitude, sigma), self.direction())))

    def along(self, parameter: str) -> Vector:
        """Return the vector of length ``amplitude`` along a parameter; InputError where that is zero."""
        direction = np.array(getattr(self, parameter))
        norm = float(np.linalg.norm(direction))
        if norm == 0.0:
            raise InputError(f"effect {self.name}: {parameter} are all zero; give a direction, or amplitude = 0.")
        return np.asarray(self.amplitude * direction / norm)

    def scaled(self, factor: float) -> Self:
        """Return the same effect with ``factor`` times the amplitude."""
        return replace(self, amplitude=factor * self.amplitude)

    def inverse(self) -> Self:
        """Return the effect that takes this one back where both act: exactly, or to first order in the amplitude."""
        return self.scaled(-1.0)


@dataclass(frozen=True, kw_only=True)
class DirectedEffect(Effect):
    """Derive an effect from this class whose parameter is a vector in the frame of the maps.

    Attributes
    ----------
    amplitude
        Length.
    lon_deg, lat_deg
        Direction.
    """

    lon_deg: float = 0.0
    lat_deg: float = 0.0

    @property
    def vector(self) -> Vector:
        """Return the components x, y, z."""
        lon, lat = np.deg2rad([self.lon_deg, self.lat_deg])
        return self.amplitude * np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])

    def direction(self) -> str:
        """Return longitude and latitude in the frame of the maps."""
        lon, lat = round(self.lon_deg) % 360, round(self.lat_deg)  # neither 360 degrees nor -0
        return f"towards longitude {lon}°, latitude {lat}°".replace("-", "−")


def described(effect: Effect, frame: str, sigma: float = 0.0, errors: Mapping[str, float] | None = None) -> str:
    """Return :meth:`Effect.describe`, with the frame of the maps behind a direction."""
    words = effect.describe(sigma, errors)
    return f"{words} ({frame})" if isinstance(effect, DirectedEffect) else words


def acts_through(effect: Effect | type[Effect], *hooks: str) -> bool:
    """Return True if an effect, or the effects of a class, act through one of these hooks."""
    kind = effect if isinstance(effect, type) else type(effect)
    return any(getattr(kind, hook) is not getattr(Effect, hook) for hook in hooks)
