"""Signal to noise of the beams' BipoSH: maps without noise, and the degrees that count."""

from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest

from mcsim.ensemble.prediction import predict

NSIDE, LMAX = 8, 12
WIDE = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 1000.0, "fwhm_minor_arcmin": 850.0}
ROUND, NARROW = ({"kind": "gaussian", "fwhm_arcmin": fwhm} for fwhm in (900.0, 700.0))


def channel(name: str, beam: dict[str, Any], sigma0_uk: float = 0.0, psi0_deg: float = 0.0) -> dict[str, Any]:
    scan = {"kind": "parallel_transport", "psi0_deg": psi0_deg}
    return {"name": name, "beam": beam, "scan": scan, "noise": {"sigma0_uk": sigma0_uk}}


def predicted(*channels: dict[str, Any], **map_: Any) -> Any:
    return predict(
        {
            "schema": 1,
            "name": "small",
            "sky": {"spectrum": "wmap7", "lmax": LMAX},
            "map": {"nside": NSIDE, **map_},
            "biposh": {"L_max": 2, "summary_bin": 4},
            "channel": list(channels),
        },
        snr=True,
    )


def total(*channels: dict[str, Any], **map_: Any) -> float:
    return float(predicted(*channels, **map_)["signal_to_noise_total"])


def test_maps_without_noise_that_see_the_same_count_once() -> None:
    """Any two of them were infinite, circular beams too, and a map that was given twice."""
    one = total(channel("A", WIDE))
    assert one > 1.0
    assert total(channel("A", WIDE), splits=["a", "b"]) == pytest.approx(one, rel=1e-12)
    assert total(channel("A", ROUND), channel("B", NARROW)) == 0.0
    known = total(channel("A", ROUND), channel("C", WIDE, 1.0))
    assert total(channel("A", ROUND), channel("B", NARROW), channel("C", WIDE, 1.0)) == pytest.approx(known, rel=1e-12)
    assert one < known < np.inf
    # With little noise two splits have the limit of none.
    assert total(channel("A", WIDE, 0.01), splits=["a", "b"]) == pytest.approx(one, rel=1e-5)


def test_nothing_hides_what_tells_maps_without_noise_apart() -> None:
    longer = WIDE | {"fwhm_major_arcmin": 1010.0}
    for other in (channel("B", longer), channel("B", WIDE, psi0_deg=10.0), channel("B", ROUND)):
        assert total(channel("A", WIDE), other) == np.inf


def test_masks_count_where_maps_without_noise_are_compared(tmp_path: Path) -> None:
    vectors = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    for name, axis in (("A", [0.0, 0.0, 1.0]), ("B", [0.5, 0.0, 0.8])):
        mask = np.clip(np.abs(np.array(axis) @ vectors) / 0.5, 0.0, 1.0) ** 2
        healpy.write_map(tmp_path / f"{name}.fits", mask, dtype=np.float64, coord="E")
    alone = total(channel("A", WIDE), mask=str(tmp_path / "A.fits"))
    twice = total(channel("A", WIDE), channel("B", WIDE), mask=str(tmp_path / "A.fits"))
    both = str(tmp_path / "{channel}.fits")
    more, round_ = (total(channel("A", WIDE), channel("B", beam), mask=both) for beam in (WIDE, ROUND))
    assert twice == pytest.approx(alone, rel=1e-12)
    assert alone < more < np.inf
    assert round_ == np.inf


def test_degrees_that_the_sky_does_not_have_say_nothing() -> None:
    """With 0.01 uK of noise the monopole that the beam makes of the quadrupole had nearly all of the signal."""
    quiet, noisy = predicted(channel("A", WIDE)), predicted(channel("A", WIDE, 0.01))
    for name in ("signal_to_noise", "signal_to_noise_binned", "signal_to_noise_total"):
        np.testing.assert_allclose(noisy[name], quiet[name], rtol=1e-4)
