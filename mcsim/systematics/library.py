"""The library of effects as people look at it."""

from collections import UserDict
from typing import Any

from mcsim.systematics.base import Effect
from mcsim.systematics.registry import catalogue


class Effects(UserDict[str, type[Effect]]):
    """Effects by name, printed one a line with scope, unit and cause."""

    def __repr__(self) -> str:
        """Return a line for each effect."""
        width = max(map(len, self), default=0)
        return "\n".join(
            f"{name:<{width}}  {kind.scope}, {kind.unit}: {kind.cause}" for name, kind in sorted(self.items())
        )

    def _ipython_key_completions_(self) -> list[Any]:
        return sorted(self)


def effects() -> Effects:
    """Return the library of effects: what a run can add and a diagnosis can find.

    Returns
    -------
    mapping
        Name -> class derived from :class:`mcsim.Effect`; printing it lists scope, unit of the amplitude and cause. It
        is a copy: changing it changes no run. Other packages add effects under the entry points ``mcsim.effects``.

    Raises
    ------
    InputError
        If an effect of another package cannot be loaded, is none, or has a name that is taken.

    Examples
    --------
    >>> import mcsim
    >>> library = mcsim.effects()
    >>> "beam_ellipticity" in library
    True
    >>> library["beam_ellipticity"](amplitude=0.05, angle_deg=30.0)
    BeamEllipticity(amplitude=0.05, angle_deg=30.0)
    >>> library["beam_ellipticity"].unit
    'major/minor - 1'
    """
    return Effects(catalogue())
