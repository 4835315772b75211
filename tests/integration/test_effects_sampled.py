"""Each effect in the default route against the survey made sample by sample: shape and amplitude of its response."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import healpy
import numpy as np
import pytest

from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of, check_asked
from mcsim.ensemble import expectation
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import Survey, survey
from out_of_library import Crosstalk
from refusals import refused

NSIDE = 16
"""Of the interpolation, relative to the dipole: 0.3 nK."""


def prepared(
    name: str | None = None,
    dipole_uk: float = 3364.5,
    sigma0_uk: float = 0.0,
    beam: dict[str, Any] | None = None,
    nside: int = NSIDE,
    denser: float = 1.0,
    **parameters: Any,
) -> Survey:
    """A year of WMAP's scan, 80 samples in a pixel, or ``denser``; a beam three pixels wide, round if not given."""
    table: dict[str, Any] = {
        "schema": 1,
        "name": "effect",
        "sky": {"spectrum": "wmap7", "lmax": 3 * nside - 1, "dipole_uk": dipole_uk},
        "map": {"nside": nside},
        "channel": [
            {
                "name": "W1",
                "frequency_ghz": 94.0,
                "beam": beam or {"kind": "gaussian", "fwhm_arcmin": 9600.0 / nside},
                "noise": {"sigma0_uk": sigma0_uk},
                "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 32768.0 / nside**2 / denser},
            }
        ],
        "biposh": {"L_max": 2},
        "ensemble": {"realizations": 1, "seed": 3},
    }
    if name is not None:
        where = {"channel": "W1"} if systematics.get(name).scope == "channel" else {}
        table["effect"] = [{"name": name, **where, **parameters}]
    return survey(config.load(table))


@lru_cache
def plain(nside: int = NSIDE, denser: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Maps of both routes without effects."""
    run = prepared(nside=nside, denser=denser)
    ((name, map_uk),) = sampled.maps(run, 0)
    assert (name,) == run.map_names
    return simulate.maps(run, 0)[0], map_uk


DENSER = {"beam_coma": 2.0}
"""Times as many samples where their scatter in a pixel tells the routes apart."""


RESPONSES = {
    "beam_ellipticity": {"amplitude": 0.1, "angle_deg": 20.0},
    "beam_coma": {"amplitude": 0.02, "angle_deg": 20.0},
    "beam_sidelobe": {"amplitude": 0.002, "quadrupole": 0.5, "calibrated": "dipole"},
    "beam_width": {"amplitude": 0.02},
    "calibration": {"amplitude": 0.003},
    "pointing_offset": {"amplitude": 10.0, "angle_deg": 70.0},
    "time_constant": {"amplitude": 0.05},
    "gain_drift": {"amplitude": 0.01, "phase_deg": 30.0},
    "dipole_residual": {"amplitude": 10.0, "lon_deg": 20.0, "lat_deg": 30.0},
    "monopole_residual": {"amplitude": 10.0},
    "boost": {"amplitude": 0.001, "lon_deg": 20.0, "lat_deg": 30.0},
    "foreground_residual": {"amplitude": 5.0},
    "gain_spin": {"amplitude": 0.01, "phase_deg": 30.0},
    "bandpass_mismatch": {"amplitude": 5.0},
    "sidelobe_pickup": {"amplitude": 0.002, "width_deg": 20.0},
    "nonlinearity": {"amplitude": 0.002},
    "orbital_dipole": {"amplitude": 0.02, "phase_deg": 40.0},
    "spin_synchronous_offset": {"amplitude": 2.0, "phase_deg": 30.0},
    "pointing_jitter": {"amplitude": 800.0},
    "lensing": {"amplitude": 4.0},
}


@pytest.mark.parametrize("name", RESPONSES)
def test_both_routes_respond_alike(name):
    denser = DENSER.get(name, 1.0)
    parameters, without = RESPONSES[name], plain(denser=denser)
    changed = prepared(name, denser=denser, **parameters)
    default = simulate.maps(changed, 0)[0] - without[0]
    reference = sampled.maps(changed, 0)[0][1] - without[1]
    product = default @ reference / np.sqrt((default @ default) * (reference @ reference))
    amplitude = default @ reference / (default @ default)
    print(f"{name}: rms {np.std(reference):.3f} uK, cosine {product:.5f}, sampled over default {amplitude:.4f}")
    assert product > 0.99
    assert amplitude == pytest.approx(1.0, abs=0.02)


def test_a_beam_with_all_of_its_orders_back_is_the_beam():
    """In both routes, where the fiducial beam is the circular part alone and the effect adds the rest."""
    ellipse = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 640.0, "fwhm_minor_arcmin": 560.0, "angle_deg": 20.0}
    fiducial = ellipse | {"m_max": 0}
    whole, circular = (prepared(beam=beam, dipole_uk=0.0) for beam in (ellipse | {"m_max": 4}, fiducial))
    restored = prepared("beam_noncircularity", beam=fiducial, dipole_uk=0.0, amplitude=1.0)
    for route in (
        lambda one: simulate.maps(one, 0)[0],
        lambda one: sampled.maps(one, 0)[0][1],
    ):
        expected, found, without = (route(one) for one in (whole, restored, circular))
        assert np.std(expected - without) > 0.1
        assert np.abs(found - expected).max() < 1e-5 * np.std(expected - without)


def test_samples_at_the_centres_lose_window_and_centroid():
    """The scatter of the samples in a pixel, which the default route does not know, keeps the two at a cosine of 0.97.

    Without a dipole: it is taken off with the fiducial window.
    """
    without, changed = plain(nside=32), prepared("pixelization", dipole_uk=0.0, nside=32, amplitude=1.0)
    centred = [simulate.maps(changed, 0)[0], sampled.maps(changed, 0)[0][1]]
    default, reference = (map_uk - plain for map_uk, plain in zip(centred, without, strict=True))
    assert default @ reference / np.sqrt((default @ default) * (reference @ reference)) > 0.96
    assert default @ reference / (default @ default) == pytest.approx(1.0, abs=0.02)
    # At the centres both routes are exact.
    assert np.abs(centred[0] - centred[1]).max() < 1e-3


def test_noise_follows_hits_and_effects():
    """Less the sky, the variance times hits over what is asked for is a chi^2 of one degree, pixel by pixel."""
    noisy, quiet = (prepared("noise_anisotropy", 0.0, sigma0_uk, amplitude=0.5) for sigma0_uk in (1000.0, 0.0))
    noise = sampled.maps(noisy, 0, epsilon=1e-4)[0][1] - sampled.maps(quiet, 0, epsilon=1e-4)[0][1]
    latitude = np.deg2rad(healpy.pix2ang(NSIDE, np.arange(noise.size), lonlat=True)[1])
    variance = 1e6 * (1.0 + 0.5 * (3.0 * np.sin(latitude) ** 2 - 1.0)) / noisy.channels[0].maps[0].moments.hits
    np.testing.assert_allclose(noisy.channels[0].maps[0].noise_uk ** 2, variance)
    for part in (np.abs(latitude) < 0.3, np.abs(latitude) > 0.9):
        assert np.mean((noise**2 / variance)[part]) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / part.sum()))


def test_excess_noise_has_its_variance_and_its_tails_in_both_routes():
    """The sum of n Gaussians, n Poisson of mean m: of variance m and fourth moment 3 (m + m^2), pixel by pixel."""
    fraction, glitch_uk = 0.01, 200.0
    noisy, quiet = prepared("excess_noise", 0.0, amplitude=fraction, glitch_uk=glitch_uk), prepared(dipole_uk=0.0)
    hits = quiet.channels[0].maps[0].moments.hits
    mean = fraction * hits
    routes = [
        simulate.maps(noisy, 0)[0] - simulate.maps(quiet, 0)[0],
        sampled.maps(noisy, 0, epsilon=1e-4)[0][1] - sampled.maps(quiet, 0, epsilon=1e-4)[0][1],
    ]
    for map_uk in routes:
        square = (map_uk * hits / glitch_uk) ** 2
        error = np.sqrt(np.sum(3.0 * (mean + mean**2) - mean**2))
        assert abs(np.sum(square - mean)) < 4.0 * error
        # Pixels without a hit are the share exp(-m), whatever the size of the others.
        empty = np.exp(-mean)
        assert abs(np.sum((square < 1e-6) - empty)) < 4.0 * np.sqrt(np.sum(empty * (1.0 - empty)))
    assert abs(np.corrcoef(*routes)[0, 1]) < 4.0 / np.sqrt(hits.size)


def test_what_samples_cannot_do_is_refused():
    changed = prepared("orientation_averaging", amplitude=0.0)
    with refused("orientation_averaging", "W1"):
        sampled.maps(changed, 0)


def test_what_only_samples_can_do_is_refused():
    """An effect without ``pointing`` would be in the maps of one route, and not in those of the other."""
    without = prepared()
    acting = config.Effect(name="invented_crosstalk", channel="W1", parameters={"amplitude": 0.02})
    run, library = replace(without.config, effects=(acting,)), {"invented_crosstalk": Crosstalk}
    changed = survey(run, library=library)
    assert np.std(sampled.maps(changed, 0)[0][1] - plain()[1]) > 0.1
    for made in (simulate.maps, simulate.realize):
        with refused("invented_crosstalk", "W1", "pointing"):
            made(changed, 0)
    with refused("invented_crosstalk", "pointing"):
        expectation.scanned_beams(changed, 2)
    analysis = analysis_of(prepared(sigma0_uk=1.0).config, library=library)
    assert not analysis.candidates
    with refused("invented_crosstalk", "pointing"):
        check_asked(analysis, ["invented_crosstalk"])
