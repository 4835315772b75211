"""What scores are made of, and that it is made once."""

from dataclasses import replace

import healpy
import numpy as np
import pytest

from mcsim import config, systematics
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.wiener_filter import model_of, shared_sky, wiener_filter
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.simulation import pixel_means, simulate
from mcsim.simulation.pixel_means import mean_gain
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix

HALVES = ((0.0, 0.5), (0.5, 1.0))


@pytest.mark.slow
def test_gain_of_every_half_is_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    model = replace(ScanModel.load("wmap"), sample_period_s=61.0, duration_days=365.0)
    line = model.line_of_sight("A")
    site = systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="ecliptic",
        nside=8,
        lmax=8,
        beam=Beam.elliptical(330.0, 300.0, angle_deg=20.0, lmax=8),
        pointing=systematics.Pointing(model, replace(line, sample_period_s=None)),
        dipole_uk=np.zeros(3),
    )
    drifts = [systematics.get("gain_drift")(amplitude=0.01, phase_deg=phase) for phase in (0.0, 90.0)]
    passes = []
    monkeypatch.setattr(pixel_means, "mean_gain", lambda *args: passes.append(args) or mean_gain(*args))
    for _ in range(2):
        for drift in drifts:
            for share in HALVES:
                np.testing.assert_array_equal(pixel_means.gain_of(drift, site, share), mean_gain((drift,), site, share))
    assert len(passes) == 4
    # A sine of the year is positive in its first half and as negative in its second.
    first, second = (pixel_means.gain_of(drifts[1], site, share).mean() for share in HALVES)
    assert first == pytest.approx(0.01 * 2 / np.pi, rel=0.1)
    assert second == pytest.approx(-first, rel=0.1)


def test_channels_of_one_beam_are_filtered_as_each_by_itself() -> None:
    """The filter is a sum over maps, whatever is analysed together."""
    channels = [
        {
            "name": name,
            "beam": {"kind": "gaussian", "fwhm_arcmin": fwhm_arcmin},
            "noise": {"sigma0_uk": sigma0_uk},
            "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
        }
        for name, fwhm_arcmin, sigma0_uk in (("W1", 700.0, 10.0), ("V1", 900.0, 30.0), ("W2", 700.0, 20.0))
    ]
    run = {
        "schema": 1,
        "name": "alike",
        "sky": {"spectrum": "wmap7", "lmax": 16},
        "map": {"nside": 8, "splits": ["half1", "half2"]},
        "channel": channels,
    }
    model = model_of(survey(config.load(run)), DiagnosisSettings())
    assert sorted(members for _, members in model.alike) == [(0, 1, 4, 5), (2, 3)]
    maps = simulate.maps(model.survey, 0)
    total, gain = np.zeros(alm_.size(16), dtype=np.complex128), np.zeros(17)
    for map_uk, part in zip(maps, model.parts, strict=True):
        response = model.response[part.channel]
        total += alm_.multiply(healpix.analysis(map_uk, 16, 1), response / part.noise_power, 16)
        gain += response**2 / part.noise_power
    expected = alm_.multiply(total, model.cl / (1.0 + model.cl * gain), 16)
    np.testing.assert_allclose(shared_sky(model, list(maps)), expected, rtol=1e-11, atol=1e-11)


def test_squares_of_residuals_have_all_modes_that_the_sky_does_not_fill() -> None:
    """Of two maps of n pixels the filtered sky takes sum (2l + 1) C_l / (C_l + N_l) of the 2n."""
    channel = {
        "name": "W1",
        "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0},
        "noise": {"sigma0_uk": 20.0},
        "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
    }
    run = config.load(
        {
            "schema": 1, "name": "modes", "sky": {"spectrum": "wmap7", "lmax": 24}, "ensemble": {"seed": 4},
            "map": {"nside": 16, "splits": ["a", "b"]}, "channel": [channel],
        }
    )  # fmt: skip
    whole = survey(run)
    model = model_of(whole, DiagnosisSettings())
    skies, pixels = 10, 12 * 16**2
    found, holed = [], []
    for number in range(skies):
        maps = [np.array(one) for one in simulate.maps(whole, number)]
        found.append(wiener_filter(model, maps).squares.sum())
        for one in maps:
            one[: pixels // 10] = healpy.UNSEEN
        holed.append(wiener_filter(model, maps).squares.sum())
    taken = np.sum((2.0 * np.arange(model.lmax + 1) + 1.0) * model.sky_power)
    assert taken > 100.0
    sigma = np.sqrt(2.0 * (2.0 * pixels - taken) / skies)
    assert abs(np.mean(found) - (2.0 * pixels - taken)) < 4.0 * sigma
    assert abs(np.mean(np.subtract(holed, found))) < 4.0 * sigma * np.sqrt(0.1 / 0.9)
