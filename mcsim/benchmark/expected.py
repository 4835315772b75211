"""Where each effect of the library should show: frame, L and parity of its signature."""

from dataclasses import dataclass

Place = tuple[str | None, int | None, str | None]
"""Frame, L and parity of a place, None where it has none."""


@dataclass(frozen=True)
class Signature:
    """What counts as the right place; empty: any.

    Attributes
    ----------
    frames, L, parity
        Of which one each must be met.
    """

    frames: frozenset[str] = frozenset()
    L: frozenset[int] = frozenset()
    parity: frozenset[str] = frozenset()

    def met(self, place: Place) -> bool:
        """Whether a place is right in frame, L and parity."""
        frame, L, parity = place
        return (
            (not self.frames or frame in self.frames)
            and (not self.L or L in self.L)
            and (not self.parity or parity is None or parity in self.parity)
        )


def _signature(frame: str = "", L: tuple[int, ...] = (), parity: str = "") -> Signature:
    return Signature(frozenset([frame] if frame else []), frozenset(L), frozenset([parity] if parity else []))


# An effect at an angle to the scan turns even parity to odd, so that those with an angle have either; a vector on the
# sky points anywhere and belongs to no frame.
SIGNATURES = {
    "beam_ellipticity": _signature("ecliptic", (2, 4)),
    "beam_coma": _signature("ecliptic", (1, 3)),
    "beam_sidelobe": _signature("", (0, 1, 2)),
    "beam_width": _signature("", (0,), "even"),
    "beam_noncircularity": _signature("ecliptic", (1, 2, 3, 4)),
    "pointing_offset": _signature("ecliptic", (1,)),
    "time_constant": _signature("ecliptic", (1, 2)),
    "gain_drift": _signature("ecliptic", (0, 1, 2)),
    "dipole_residual": _signature("", (1,)),
    "transmission_imbalance": _signature("ecliptic"),
    "noise_anisotropy": _signature("ecliptic", (0, 2), "even"),
    "noise_level": _signature("", (0,), "even"),
    "foreground_residual": _signature("galactic"),
    "point_sources": _signature("", (0,), "even"),
    "dipole_modulation": _signature("", (1,), "even"),
    "quadrupole_modulation": _signature("", (2,), "even"),
    "boost": _signature("", (1,), "even"),
    "pixelization": _signature("", (0, 1)),
    "mapmaking_convergence": _signature("ecliptic"),
    "orientation_averaging": _signature("ecliptic", (2,)),
    "spectrum": _signature("", (0,), "even"),
}
"""From the table of signatures of the library: the frame that the effect is fixed to, and L of the coefficients that it
makes (0: power spectra and variances)."""


def places_right(names: list[str], places: list[Place]) -> bool | None:
    """Whether one of the places is right for one of the effects; None where the effects have no known signature."""
    known = [SIGNATURES[name] for name in names if name in SIGNATURES]
    if not known:
        return None
    return any(signature.met(place) for signature in known for place in places)
