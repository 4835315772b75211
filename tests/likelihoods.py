"""A small survey of two channels, and the likelihood of its maps."""

from dataclasses import replace
from typing import Any

import healpy
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mcsim import config
from mcsim.simulation import simulate
from mcsim.simulation.inverse_covariance import unit_skies
from mcsim.simulation.survey import Survey, survey
from mcsim.sphere.spectra import load

NSIDE, LMAX = 4, 10


def channel(name: str, line: str, fwhm: tuple[float, float], sigma0_uk: float) -> dict[str, Any]:
    beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": fwhm[0], "fwhm_minor_arcmin": fwhm[1], "m_max": 2}
    scan = {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 1501.0, "line_of_sight": line}
    return {"name": name, "frequency_ghz": 94.0, "beam": beam, "noise": {"sigma0_uk": sigma0_uk}, "scan": scan}


def model(**changes: Any) -> config.RunConfig:
    """Two channels of two halves, elliptical beams, uneven hits, a mask, a dipole."""
    mask = (np.abs(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2))[2]) > 0.2).astype(float)
    table = {
        "schema": 1,
        "name": "limits",
        "sky": {"spectrum": "wmap7", "lmax": LMAX, "dipole_uk": 3364.5},
        "map": {"nside": NSIDE, "splits": ["half1", "half2"], "mask": mask},
        "channel": [channel("V1", "A", (1150.0, 900.0), 200.0), channel("W1", "B", (1000.0, 900.0), 300.0)],
    }
    return config.load(table | changes)


def expected_log_likelihood(run: config.RunConfig, basis: np.ndarray, at: tuple[np.ndarray, np.ndarray]) -> float:
    """Mean of ln L of ``run`` over data of this mean and covariance, but for a constant.

    The data are products of maps with the columns of a basis, shape (pixels of all maps, n).
    """
    mean, covariance = moments_of(run)
    factor = cho_factor(basis.T @ covariance @ basis, lower=True)
    shift = basis.T @ (at[0] - mean)
    spread = basis.T @ at[1] @ basis + np.outer(shift, shift)
    return -np.sum(np.log(np.diag(factor[0]))) - 0.5 * np.trace(cho_solve(factor, spread))


def quiet(run: config.RunConfig) -> Survey:
    return survey(replace(run, channels=tuple(channel.without_noise() for channel in run.channels)))


def moments_of(run: config.RunConfig) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the maps of a run, from a map of each unit sky."""
    noise, made = np.concatenate([m.noise_uk for m in survey(run).maps]), quiet(run)
    cl = load("wmap7", run.sky.lmax)
    skies = list(unit_skies(run.sky.lmax))
    mean = simulate.maps(made, 0, sky=0.0 * skies[0][1]).ravel()
    response = np.stack([np.sqrt(cl[ell]) * (simulate.maps(made, 0, sky=sky).ravel() - mean) for ell, sky in skies])
    return mean, response.T @ response + np.diag(noise**2)


def effect(name: str, channel: str | None, amplitude: float, **parameters: Any) -> config.Effect:
    return config.Effect(name=name, channel=channel, parameters={"amplitude": amplitude, **parameters})
