"""How an effect is parametrised for a linear fit. This stands beside its physics, which knows nothing of a fit."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def reciprocal(share: float) -> float:
    """Return b with (1 + share) (1 + b) = 1; where that is not positive there is none, and b = -share."""
    return -share / (1.0 + share) if share > -1.0 else -share


@dataclass(frozen=True, kw_only=True)
class Parametrization:
    """Fit the amplitude of an effect alone; derived classes fit further parameters with it.

    An effect has linear components, k in number: its response is the sum of its coordinates times the responses of the
    effects of the basis, each per unit of amplitude.
    """

    #: Sign of the amplitudes at which responses are measured; 0: both. If it is not 0, a negative amplitude is
    #: unphysical, and a diagnosis does not name it.
    sign: Literal[-1, 0, 1] = 0
    max_amplitude: float = np.inf  #: largest physical amplitude, in absolute value; a diagnosis names no larger one
    stochastic: bool = False  #: True if a hook draws random numbers, at positive amplitudes at least
    #: True if a diagnosis uses the mean response over skies, not that of the observed sky: for a change of power alone,
    #: whose response in one sky depends on fluctuations that the spectra have anyway
    mean_response: bool = False
    noise_alone: bool = False  #: True if noise alone changes: typical skies then say by how much the data scatter more
    #: True if the data vector of a diagnosis has a matched filter for it: not if a hook draws random numbers, nor if
    #: dipoles, variances, spectra and modulations, which are always measured, contain all of it
    matched_filter: bool = True
    nonlinear: bool = False  #: True if the response is simulated anew at whatever amplitude is fitted
    #: True if a hook on the beam changes it in proportion to the coordinates, as what is added and gains change maps
    proportional: bool = False

    @property
    def measured(self) -> tuple[str, ...]:
        """Return the parameters beside the amplitude that are given with an error."""
        return ()

    def seen_at(self, frequencies_ghz: Iterable[float | None]) -> Self:
        """Return how the effect is fitted to channels of these frequencies; None: one without foregrounds."""
        return self

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        """Return the parameters of the k effects whose responses span all others; their amplitude is the step."""
        return ({},)

    def coordinates(self, effect: Any) -> Vector:
        """Return the coordinates of an effect, shape (k,)."""
        return np.array([effect.amplitude])

    def typical(self, effect: Any) -> NDArray[np.float64]:
        """Return coordinates at unit amplitude, shape (k, j), over which a detectable amplitude is averaged.

        By default these are the basis: its j = k effects stand for all directions.
        """
        return np.eye(len(self.basis()))

    def constrained(self, coordinates: Vector, precision: NDArray[np.float64]) -> Vector:
        """Return the fitted coordinates that the data constrain, and zeros; by default all of them.

        ``precision`` is the inverse of their covariance, shape (k, k).
        """
        return coordinates

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return amplitude and parameters of the effect nearest to coordinates in the metric ``precision``, (k, k)."""
        return {"amplitude": float(coordinates[0])}


@dataclass(frozen=True, kw_only=True)
class Angle(Parametrization):
    """Fit amplitude and angle as the coordinates amplitude cos(angle) and amplitude sin(angle)."""

    parameter: str = "angle_deg"  #: name of the angle, in degrees
    multiple: int = 1  #: how often the angle counts: 2 for an axis, which is the same again after half a turn

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        return {}, {self.parameter: 90.0 / self.multiple}

    def coordinates(self, effect: Any) -> Vector:
        angle = self.multiple * np.deg2rad(getattr(effect, self.parameter))
        return effect.amplitude * np.array([np.cos(angle), np.sin(angle)])

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        x, y = coordinates
        angle_deg = np.rad2deg(np.arctan2(y, x)) / self.multiple
        return {"amplitude": float(np.hypot(x, y)), self.parameter: float(angle_deg)}


@dataclass(frozen=True, kw_only=True)
class Components(Parametrization):
    """Fit amplitude and direction of a vector as its components."""

    parameter: str  #: name of the direction, a tuple of numbers whose length does not matter
    count: int  #: number of components

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        return tuple({self.parameter: tuple(map(float, row))} for row in np.eye(self.count))

    def coordinates(self, effect: Any) -> Vector:
        return np.asarray(effect.along(self.parameter))

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return norm and direction; no direction of zeros."""
        norm = float(np.linalg.norm(coordinates))
        return {"amplitude": norm} | ({self.parameter: tuple(map(float, coordinates / norm))} if norm else {})


@dataclass(frozen=True, kw_only=True)
class Steps(Parametrization):
    """Fit a whole number n with each unit of which the response grows by a ``factor``, as factor^n - 1."""

    nonlinear: bool = True
    factor: float

    def coordinates(self, effect: Any) -> Vector:
        """Return factor^n - 1, n the amplitude rounded."""
        return np.array([self.factor ** round(effect.amplitude) - 1.0])

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return n, not rounded; a negative amplitude, whatever its size, for a negative coordinate."""
        value = float(coordinates[0])
        return {"amplitude": value if value < 0.0 else float(np.log1p(value) / np.log(self.factor))}


@dataclass(frozen=True, kw_only=True)
class PowerLaw(Parametrization):
    """Fit a signal that grows as a power of frequency, and its index where the channels can tell it.

    Notes
    -----
    With x the ratios, A x^index is fitted as c_1 x^2 + c_2 x^-2 at two frequencies, and with c_3 more at three, where
    both are exact, and by least squares at more of them. Maps of one sky tell a signal in it mostly by their
    differences: an index takes two, of three frequencies, or of two and a map without foregrounds.
    """

    parameter: str  #: name of the index, which is that of the effect where it is not fitted
    reference_ghz: float  #: frequency to which the amplitude belongs
    #: frequencies of the channels over that of the reference; none: the index is not fitted
    ratios: tuple[float, ...] = ()

    @property
    def measured(self) -> tuple[str, ...]:
        return (self.parameter,) if self.ratios else ()

    def seen_at(self, frequencies_ghz: Iterable[float | None]) -> Self:
        """Return the same with the index fitted if there are two differences of frequencies to fit it to."""
        seen = set(frequencies_ghz)
        ratios = tuple(sorted(one / self.reference_ghz for one in seen if one is not None))
        return replace(self, ratios=ratios) if len(seen) > 2 else self

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        return tuple({self.parameter: float(index)} for index in self._pivots) if self.ratios else ({},)

    def coordinates(self, effect: Any) -> Vector:
        if not self.ratios:
            return super().coordinates(effect)
        return np.asarray(effect.amplitude * self._unit(np.array([getattr(effect, self.parameter)]))[:, 0])

    def typical(self, effect: Any) -> NDArray[np.float64]:
        """Return the coordinates at the index of the effect: an amplitude says nothing without one."""
        return self.coordinates(replace(effect, amplitude=1.0))[:, None]

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return amplitude and index; where no power law has these coordinates, the index is as steep as can be."""
        if not self.ratios:
            return super().nearest(coordinates, precision)
        indices = np.linspace(-_STEEPEST, _STEEPEST, 401)
        for _ in range(4):
            along, size = self._projected(indices, coordinates, precision)
            best = int(np.argmax(along**2 / size))
            indices = np.linspace(indices[max(best - 1, 0)], indices[min(best + 1, len(indices) - 1)], 41)
        index = float(indices[len(indices) // 2])
        along, size = self._projected(np.array([index]), coordinates, precision)
        return {"amplitude": float(along[0] / size[0]), self.parameter: index}

    @property
    def _pivots(self) -> Vector:
        """Return the indices of the basis: one for each frequency, up to three."""
        return _PIVOTS[: len(self.ratios)]

    def _unit(self, indices: Vector) -> Vector:
        """Return the coordinates at unit amplitude, shape (k, indices)."""
        x = np.array(self.ratios)[:, None]
        return np.asarray(np.linalg.pinv(x**self._pivots) @ x**indices)

    def _projected(self, indices: Vector, at: Vector, precision: NDArray[np.float64]) -> tuple[Vector, Vector]:
        """Return the products of the unit coordinates with others, and with themselves, in the metric."""
        unit = self._unit(indices)
        return unit.T @ precision @ at, np.maximum(np.sum(unit * (precision @ unit), axis=0), 1e-300)


_PIVOTS = np.array([2.0, -2.0, 0.0])
_STEEPEST = 12.0


@dataclass(frozen=True, kw_only=True)
class SkyVector(Parametrization):
    """Fit amplitude, ``lon_deg`` and ``lat_deg`` of an effect as the components of its ``vector``."""

    def basis(self) -> tuple[Mapping[str, Any], ...]:
        return {}, {"lon_deg": 90.0}, {"lat_deg": 90.0}

    def coordinates(self, effect: Any) -> Vector:
        return np.asarray(effect.vector)

    def nearest(self, coordinates: Vector, precision: NDArray[np.float64]) -> dict[str, Any]:
        """Return norm, longitude from 0 to 360 and latitude; zeros for no vector."""
        x, y, z = coordinates
        lon_deg, lat_deg = np.rad2deg([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
        return {
            "amplitude": float(np.linalg.norm(coordinates)),
            "lon_deg": float(lon_deg % 360.0),
            "lat_deg": float(lat_deg),
        }
