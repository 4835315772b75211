"""What a difference of implementation is: something that side B does otherwise than side A.

A difference changes the scene (sky, beam, window, moments) or the maps. ``starts`` proposes values of it, and those of
smooth differences are refined by least squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.scene import Maps, PointingFiles, Scene
from mcsim.systematics.base import Pointing

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class State:
    """What is predicted for side B so far.

    Attributes
    ----------
    pair
        The channel on both sides; its ``b`` is to be reached.
    scene, maps
        Of the prediction; no scene without a model.
    others
        The other channels.
    """

    pair: ChannelPair
    scene: Scene | None
    maps: Maps
    others: Sequence[ChannelPair]

    def fit(self, templates: Sequence[Maps]) -> Vector:
        """Return the least-squares amplitudes of templates in what is left, over the pixels that are seen."""
        seen = self.pair.seen
        t = np.stack([one[seen] for one in templates])
        found = np.linalg.lstsq(t @ t.T, t @ (self.pair.b - self.maps)[seen], rcond=1e-12)[0]
        return np.asarray(found, dtype=np.float64)


class Difference:
    """A difference of implementation.

    Attributes
    ----------
    name, unit
        As in ``compare.json``.
    met
        Where such a difference was met.
    needs_scene
        True if it cannot be described without a model.
    smooth
        True if the value is refined by least squares.
    slow
        True if it is tried only where nothing else explains the maps.
    enough
        Share of the variance that a set with it must explain at most to be named; 1: as all sets.
    linear
        True if the response is the template of a small amplitude, and so no better than about a per mille.
    exchanges
        True if it exchanges pixels or files, which can be taken back before the rest is looked for.
    """

    name: ClassVar[str]
    unit: ClassVar[str]
    met: ClassVar[str]
    needs_scene: ClassVar[bool] = True
    smooth: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    enough: ClassVar[float] = 1.0
    linear: ClassVar[bool] = False
    exchanges: ClassVar[bool] = False

    def starts(self, state: State) -> list[Vector]:
        """Return the values to try, shape (k,) each."""
        return [np.ones(1)]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        """Return the scene of side B."""
        return scene

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        """Return the maps of side B."""
        return maps

    def undone(self, maps: Maps, value: Vector) -> Maps | None:
        """Return maps of side B as they were before the difference; None if that is not known."""
        return None

    def sampled(self, value: Vector, pair: ChannelPair, pointing: Pointing | PointingFiles) -> Maps | None:
        """Return what side B has more than side A, sample by sample; None: as the scene says."""
        return None

    def amplitude(self, value: Vector) -> float:
        """Return the amplitude as it is reported."""
        return float(value[0])

    def parameters(self, value: Vector) -> dict[str, float | str]:
        """Return what else describes the value."""
        return {}

    def equivalent(self, value: Vector) -> list[tuple[str, float, str]]:
        """Return differences that make the same maps: name, amplitude, unit."""
        return []
