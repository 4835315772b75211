"""A simulator that is not mcsim's: healpy, numpy, a Gaussian beam and white noise."""

import healpy
import numpy as np

FWHM_ARCMIN, NOISE_UK, NSIDE, LMAX = 500.0, 30.0, 16, 24


class HealpySurvey:
    """One channel, V, observed twice."""

    effects = ("beam_width",)  # of mcsim's library, that it can add itself

    def simulate(self, seed, effects=()):
        """Return the maps of one seed, uK, RING order."""
        draw = np.random.default_rng(seed)
        wider = sum(effect.parameters["amplitude"] for effect in effects)
        window = healpy.gauss_beam(np.deg2rad(FWHM_ARCMIN * (1.0 + wider) / 60.0), lmax=LMAX)
        sky = healpy.alm2map(healpy.almxfl(self.sky(draw), window), NSIDE)
        first, second = draw.normal(scale=NOISE_UK, size=(2, sky.size))
        return {"V": {"a": sky + first, "b": sky + second}}

    def sky(self, draw):
        """Draw a_lm with l (l + 1) C_l constant."""
        ell, m = healpy.Alm.getlm(LMAX)
        cl = np.where(ell > 1, 6000.0 / np.maximum(ell * (ell + 1.0), 1.0), 0.0)
        real, imaginary = draw.normal(size=(2, ell.size))
        return np.sqrt(cl) * np.where(m > 0, (real + 1j * imaginary) / np.sqrt(2.0), real)
