"""Where each effect shows: the frame that it is fixed to, and L and parity of the coefficients that it makes."""

from collections.abc import Sequence
from typing import NamedTuple

Place = tuple[str | None, int | None, str | None]  #: frame, L and parity of a coefficient; None where it has none


class Signature(NamedTuple):
    """Frame, L and parity that an effect can show in; empty: any."""

    frame: str = ""
    L: tuple[int, ...] = ()
    parity: str = ""

    def matches(self, place: Place) -> bool:
        """Return True if a place is right in frame, L and parity."""
        frame, L, parity = place
        right = (not self.frame or frame == self.frame) and (not self.L or L in self.L)
        return right and (not self.parity or parity in (None, self.parity))


# From the table of signatures of the library: the frame that an effect is fixed to, and L of the coefficients that it
# makes (0: power spectra and variances). An effect at an angle to the scan turns even parity to odd, so that those with
# an angle have either; a vector on the sky points anywhere and belongs to no frame.
SIGNATURES = {
    "beam_ellipticity": Signature("ecliptic", (2, 4)),
    "beam_coma": Signature("ecliptic", (1, 3)),
    "beam_sidelobe": Signature("", (0, 1, 2)),
    "beam_width": Signature("", (0,), "even"),
    "calibration": Signature("", (0, 1), "even"),
    "split_calibration": Signature("", (0, 1), "even"),
    "beam_noncircularity": Signature("ecliptic", (1, 2, 3, 4)),
    "pointing_offset": Signature("ecliptic", (1,)),
    "time_constant": Signature("ecliptic", (1, 2)),
    "gain_drift": Signature("ecliptic", (0, 1, 2)),
    "dipole_residual": Signature("", (1,)),
    "monopole_residual": Signature("", (0, 1), "even"),
    "transmission_imbalance": Signature("ecliptic"),
    "noise_anisotropy": Signature("ecliptic", (0, 2), "even"),
    "noise_level": Signature("", (0,), "even"),
    "noise_knee": Signature("ecliptic", (0, 2), "even"),
    "foreground_residual": Signature("galactic"),
    "point_sources": Signature("", (0,), "even"),
    "dipole_modulation": Signature("", (1,), "even"),
    "quadrupole_modulation": Signature("", (2,), "even"),
    "boost": Signature("", (1,), "even"),
    "pixelization": Signature("", (0, 1)),
    "mapmaking_convergence": Signature("ecliptic"),
    "orientation_averaging": Signature("ecliptic", (2,)),
    "spectrum": Signature("", (0,), "even"),
    "sidelobe_pickup": Signature("ecliptic"),
    "nonlinearity": Signature("", (0, 1, 2)),
    "gain_spin": Signature("ecliptic", (0, 1, 2)),
    "bandpass_mismatch": Signature("galactic"),
    "orbital_dipole": Signature("ecliptic", (0, 1)),
    "spin_synchronous_offset": Signature("ecliptic"),
    "pointing_jitter": Signature("", (0,), "even"),
    "excess_noise": Signature("", (0,), "even"),
    "lensing": Signature("", (0,), "even"),
}


def any_place_right(names: Sequence[str], places: Sequence[Place]) -> bool | None:
    """Return True if a place is right for one of the effects; None if none of them has a known signature."""
    known = [SIGNATURES[name] for name in names if name in SIGNATURES]
    return any(signature.matches(place) for signature in known for place in places) if known else None
