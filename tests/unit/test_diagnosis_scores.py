"""What scores are made of, and that it is made once."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import healpy
import numpy as np
import pytest
from numpy.typing import NDArray

from mcsim import bipolar, config, systematics
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.matched_filters import matched_filter
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.shared_sky import shared_sky
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.instrument.beams import Beam
from mcsim.instrument.scan import ScanModel
from mcsim.simulation import pixel_means, simulate, windows
from mcsim.simulation.pixel_means import Part, mean_gain
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import FRAMES

HALVES = (Part((0.0, 0.5)), Part((0.5, 1.0)))


@pytest.fixture
def site() -> systematics.Site:
    model = replace(ScanModel.load("wmap"), sample_period_s=61.0, duration_days=365.0)
    return systematics.Site(
        channel="W1",
        frequency_ghz=94.0,
        frame="ecliptic",
        nside=8,
        lmax=8,
        beam=Beam.elliptical(330.0, 300.0, angle_deg=20.0, lmax=8),
        pointing=systematics.Pointing(model, replace(model.line_of_sight("A"), sample_period_s=None)),
        dipole_uk=np.zeros(3),
    )


@pytest.mark.slow
def test_gain_of_every_half_is_kept_apart(monkeypatch: pytest.MonkeyPatch, site: systematics.Site) -> None:
    drifts = [systematics.get("gain_drift")(amplitude=0.01, phase_deg=phase) for phase in (0.0, 90.0)]
    passes = []
    monkeypatch.setattr(pixel_means, "mean_gain", lambda *args, **how: passes.append(args) or mean_gain(*args, **how))
    for _ in range(2):
        for drift in drifts:
            for half in HALVES:
                np.testing.assert_array_equal(pixel_means.gain_of(drift, site, half), mean_gain((drift,), site, half))
    assert len(passes) == 4
    # A sine of the year is positive in its first half and as negative in its second.
    first, second = (pixel_means.gain_of(drifts[1], site, half)[0].real.mean() for half in HALVES)
    assert first == pytest.approx(0.01 * 2 / np.pi, rel=0.1)
    assert second == pytest.approx(-first, rel=0.1)


def test_pixels_that_no_ring_of_a_part_crosses_have_the_gain_of_all_rings(site: systematics.Site) -> None:
    """A part that is the first ring of the year, on which the gain is a hundredth."""
    drift, year = systematics.get("gain_drift")(amplitude=0.01, phase_deg=0.0), (0.0, 1.0)
    all_rings, first_ring = (mean_gain((drift,), site, Part(year, rings)) for rings in (None, (10**6, 0)))
    assert all_rings is not None
    assert first_ring is not None
    crossed = np.any(first_ring != all_rings, axis=0)
    assert 0 < crossed.sum() < 10
    np.testing.assert_allclose(first_ring[0, crossed], 0.01, rtol=1e-3)
    assert np.std(first_ring[0, ~crossed].real) > 1e-3


@dataclass(frozen=True, kw_only=True)
class SaturatedDrift(systematics.Effect):
    """A gain that is not linear in its amplitude."""

    name = "saturated_drift"
    scope = "channel"
    unit = "fraction"
    cause = signature = source = "none"
    step = 1e-3

    def gain(self, time_s: NDArray[np.float64], site: systematics.Site) -> NDArray[np.float64] | None:
        return np.tanh(300.0 * self.amplitude * np.cos(2.0 * np.pi * time_s / 3.15e7)) if self.amplitude else None


@dataclass(frozen=True, kw_only=True)
class ShortStep(systematics.Effect):
    """A gain that is higher by a thousandth for so many seconds, and at none of the times that are looked at."""

    name = "short_step"
    scope = "channel"
    unit = "s"
    cause = signature = source = "none"
    step = 200.0

    def gain(self, time_s: NDArray[np.float64], site: systematics.Site) -> NDArray[np.float64] | None:
        return 1e-3 * ((time_s > 3851.0 * 1000.2) & (time_s < 3851.0 * 1000.2 + self.amplitude))


@pytest.mark.slow
def test_gain_that_is_nothing_at_the_times_that_are_looked_at_takes_a_pass(site: systematics.Site) -> None:
    step = ShortStep(amplitude=1500.0)
    assert not pixel_means._gains(step, site, HALVES[0]).any()
    found = pixel_means.gain_of_all((step,), site, HALVES[0])
    expected = mean_gain((step,), site, HALVES[0])
    assert expected is not None
    assert expected[0].any()
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_drifts_of_all_amplitudes_take_two_passes(monkeypatch: pytest.MonkeyPatch, site: systematics.Site) -> None:
    """One for each phase that spans the others; a gain that is not linear takes one of its own."""
    passes = []

    def one_pass(acting: tuple[systematics.Effect, ...], *args: Any, **how: Any) -> NDArray[np.complex128] | None:
        passes.extend(acting)
        return mean_gain(acting, *args, **how)

    monkeypatch.setattr(pixel_means, "mean_gain", one_pass)
    drift = systematics.get("gain_drift")
    for amplitude, phase_deg in ((0.01, 0.0), (-0.01, 0.0), (0.01, 90.0), (0.02, 30.0), (3e-4, 222.0)):
        effect = drift(amplitude=amplitude, phase_deg=phase_deg)
        found = pixel_means.gain_of_all((effect,), site, HALVES[0], 2)
        np.testing.assert_allclose(found, mean_gain((effect,), site, HALVES[0], 2), rtol=0.0, atol=1e-14)
    assert len(passes) == 2
    bent = SaturatedDrift(amplitude=4e-3)
    found = pixel_means.gain_of_all((effect, bent), site, HALVES[0], 2)
    np.testing.assert_allclose(found, mean_gain((effect, bent), site, HALVES[0], 2), rtol=0.0, atol=1e-12)
    assert passes[2:] == [bent]


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
    assert sorted(members for *_, members in model.alike) == [(0, 1, 4, 5), (2, 3)]
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


def _shown(sky_lmax: int, sigma0_uk: float, **changes: object) -> config.RunConfig:
    """A run at nside 8 of which BipoSH coefficients are wanted up to l = 12."""
    channel = {
        "name": "W1",
        "beam": {"kind": "gaussian", "fwhm_arcmin": 300.0},
        "noise": {"sigma0_uk": sigma0_uk},
        "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
    }
    base = {
        "schema": 1, "name": "shown", "sky": {"spectrum": "wmap7", "lmax": sky_lmax}, "map": {"nside": 8},
        "biposh": {"lmax": 12, "L_max": 2}, "channel": [channel],
    }  # fmt: skip
    return config.load(base | changes)


def test_maps_are_filtered_as_far_as_they_show_the_sky_and_pixels_hold_it() -> None:
    def highest(run: config.RunConfig) -> int:
        return model_of(survey(run), DiagnosisSettings()).lmax

    assert highest(_shown(18, 10.0)) == 18  # the sky ends
    assert highest(_shown(40, 50.0)) == 20  # it is in the noise at 2.5 nside
    assert highest(_shown(40, 5.0)) == 12  # it is not, and pixels no longer hold it
    assert highest(_shown(18, 10.0, preparation=[{"kind": "smooth", "fwhm_arcmin": 400.0}])) == 12
    assert highest(_shown(18, 10.0, preparation=[{"kind": "subtract_dipole"}])) == 18  # pixels and noise stay
    faint = model_of(survey(_shown(18, 100.0)), DiagnosisSettings())
    assert faint.lmax == 14
    snr = faint.sky_power / (1.0 - faint.sky_power)
    assert 0.1 <= snr[-1] < 0.1 * snr[-2] / snr[-1]


def test_biposh_lmax_is_that_of_the_scan_alone() -> None:
    """The data vector does not depend on it; the scan is that of the degrees that the run names."""
    shorter, whole = (analysis_of(one) for one in (_shown(18, 10.0), _shown(18, 10.0, biposh={"L_max": 2})))
    maps = list(simulate.maps(whole.model.survey, 0))
    assert shorter.elements == whole.elements
    assert np.array_equal(shorter.data_vector(maps, slices=True), whole.data_vector(maps, slices=True))
    ends = [max(one.ell[1] for one in run.bipolar_scan.elements) for run in (shorter, whole)]
    assert ends == [12, 18]
    filtered = wiener_filter(whole.model, maps)
    found, reference = shorter.bipolar_scan, bipolar.estimator(2, 12, both_orders=True)
    sky = alm_.resize(filtered.sky, 18, 12)
    expected = bipolar.estimate(reference, alm_.multiply(sky, whole.model.inverse_cl, 12), sky)
    sums = found._sums(filtered)[0, list(FRAMES).index(whole.model.frame)]
    np.testing.assert_allclose(sums.sum(axis=1), np.nan_to_num(expected)[:, 2:].sum(axis=1), rtol=1e-12)


def test_samples_that_stand_closer_leave_the_window_of_a_preparation() -> None:
    """The matched filter of ``pixelization`` on degraded maps is that of the fine pixels."""
    lmax, fine = 12, {"nside": 32, "pixel_window": "computed"}
    run = _shown(40, 10.0, map=fine, biposh={"lmax": lmax}, preparation=[{"kind": "degrade", "nside": 8}])
    model = model_of(survey(run), DiagnosisSettings())
    closer = matched_filter(model, systematics.get("pixelization")(amplitude=0.1), 0)
    assert closer is not None
    orders = np.zeros((len(model.parts), model.settings.beam_orders + 1, model.lmax + 1))
    orders[0, 0, lmax] = 1.0
    filtered: Any = SimpleNamespace(orders=orders)
    window = healpix.pixel_window(32, 40)
    change = windows.stretched(window, 32, 0.9)[lmax] / window[lmax] - 1.0
    assert closer(filtered) == pytest.approx(model.survey.channels[0].beam.blm[0, lmax].real * change, rel=1e-9)
