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
from mcsim.comparison.scene import Maps, Scene
from mcsim.support.arrays import Vector


@dataclass(frozen=True, eq=False)
class State:
    """What is predicted for side B so far."""

    pair: ChannelPair  #: the channel on both sides; its ``b`` is to be reached
    #: scene, maps: of the prediction; no scene without a model
    scene: Scene | None
    maps: Maps
    others: Sequence[ChannelPair]  #: the other channels
    floor: float = 0.0  #: rms in uK up to which maps are called identical
    #: orthonormal changes of the prediction that are fitted besides, over the pixels that are seen, shape (k, n)
    free: NDArray[np.float64] | None = None

    def fit(self, templates: Sequence[Maps]) -> Vector:
        """Return the least-squares amplitudes of templates in what is left, over the pixels that are seen."""
        t = np.stack([self.beside(one) for one in templates])
        size = np.maximum(np.linalg.norm(t, axis=1), 1e-300)
        t /= size[:, None]
        return np.asarray(np.linalg.lstsq(t @ t.T, t @ self.rest(self.maps), rcond=1e-12)[0] / size)

    def beside(self, maps: Maps) -> Vector:
        """Return maps over the pixels that are seen, without the part of the changes that are fitted besides."""
        values = maps[self.pair.seen]
        return values if self.free is None else values - (self.free @ values) @ self.free

    def rest(self, maps: Maps) -> Vector:
        """Return what maps leave of side B, as :meth:`beside` does."""
        return self.beside(self.pair.b - maps)


class Difference:
    """A difference of implementation."""

    #: name, unit, met: as in ``compare.json``; ``met`` says where such a difference was met
    name: str
    unit: str
    met: str
    needs_scene: ClassVar[bool] = True  #: True if it cannot be described without a model
    smooth: ClassVar[bool] = False  #: True if the value is refined by least squares
    natural: ClassVar[float] = 1.0  #: size of a value that is neither small nor large
    #: when it is tried: 0 at once, 1 where those leave something, 2 where nothing else explains the maps
    stage: ClassVar[int] = 0
    #: share of the variance that a set with it must explain at most to be named; 1: as all sets
    enough: ClassVar[float] = 1.0
    #: True if the response is proportional to the value, which is then fitted at once
    proportional: ClassVar[bool] = False
    #: True if the response is the template of a small amplitude, and so no better than about a per mille
    linear: bool = False
    #: True if it exchanges pixels, files or units, which can be taken back before the rest is looked for
    exchanges: ClassVar[bool] = False
    #: True if it turns or mirrors samples or beam: what two of these make together neither says by itself
    turns: ClassVar[bool] = False
    mirrors: ClassVar[bool] = False  #: True if what turns samples or beam before it has the other sign after it
    #: ways, mutual: values to try where only some are possible; True if the other side's has the other sign
    ways: ClassVar[tuple[float, ...]] = (1.0,)
    mutual: ClassVar[bool] = False
    moved: ClassVar[int | None] = None  #: how many numbers of the value are moved, the first ones; None: all
    counted: ClassVar[bool] = True  #: False: there is no amount of it, and the amplitude is 1

    def starts(self, state: State) -> list[Vector]:
        """Return the values to try, shape (k,) each."""
        return [np.array([way]) for way in self.ways]

    def scene(self, scene: Scene, value: Vector, pair: ChannelPair) -> Scene:
        """Return the scene of side B."""
        return scene

    def maps(self, maps: Maps, value: Vector, state: State) -> Maps:
        """Return the maps of side B."""
        return maps

    def undone(self, maps: Maps, value: Vector) -> Maps | None:
        """Return maps of side B as they were before the difference; None if that is not known."""
        return None

    def axes(self, value: Vector) -> Vector:
        """Return unit vectors along which the value may be moved, shape (any, k)."""
        return np.eye(value.size)[: self.moved if self.smooth or self.proportional or self.moved else 0]

    def within(self, value: Vector) -> Vector:
        """Return the nearest value that is possible."""
        return value

    def inverse(self, value: Vector) -> Vector:
        """Return the value that says what side A does otherwise than side B."""
        return -value if self.smooth or self.proportional or self.mutual else value

    def response(self, value: Vector, scene: Scene, pair: ChannelPair) -> Maps | None:
        """Return what it makes of a scene whose sky is not that of ``maps``; None: what scene and maps say."""
        return None

    def sampled(self, value: Vector, scene: Scene, pair: ChannelPair) -> Maps | None:
        """Return what side B has more than side A, sample by sample; None: as the scene says."""
        return None

    def size(self, value: Vector) -> float:
        """Return the size of what it leaves over that in the larger unit of the two sides."""
        return 1.0

    def amplitude(self, value: Vector) -> float:
        """Return the amplitude as it is reported."""
        return float(value[0]) if self.counted else 1.0

    def said(self, value: Vector) -> str:
        """Return the amplitude in words, where its sign alone would mislead."""
        return ""

    def found(self, value: Vector) -> str:
        """Return in words what side A has more than side B, where the inverse of that may say less."""
        return ""

    def parameters(self, value: Vector) -> dict[str, float | str]:
        """Return what else describes the value."""
        return {}

    def equivalent(self, value: Vector) -> list[tuple[str, float, str]]:
        """Return differences that make the same maps: name, amplitude, unit."""
        return []
