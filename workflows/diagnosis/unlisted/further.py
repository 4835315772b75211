"""Reconstruct maps with further systematics of no library, which were written when the reconstruction was done.

python further.py [FIRST:LAST]     cases of these numbers, as lines that unlisted.py summary reads
"""

import os
import sys
from dataclasses import dataclass, replace

import healpy
import numpy as np
from unlisted import ANY, ask, known, row, scored

from mcsim import config
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.instrument.scan import MapGrid
from mcsim.simulation import simulate, tod
from mcsim.simulation.survey import survey
from mcsim.sphere.sky import dipole_alm
from mcsim.systematics import Effect

NSIDE, FINE, LMAX, FWHM = 32, 128, 64, np.deg2rad(3.5)
STRENGTHS = (10.0, 20.0)


@dataclass(frozen=True, kw_only=True)
class Corners(Effect):
    """A beam with four corners: b_l4 grows as l^4."""

    name = "corners"
    scope = "channel"
    unit = "of b_l0 at lmax"
    cause = "A square horn."
    signature = "m = 4."
    step = 0.1

    def beam(self, beam, site):
        """Return the beam with its order 4."""
        ell = np.arange(beam.lmax + 1.0)
        blm = np.zeros((max(beam.mmax, 4) + 1, beam.lmax + 1), dtype=complex)
        blm[: beam.mmax + 1] = beam.blm
        blm[4, 4:] += (self.amplitude * beam.blm[0].real * (ell / LMAX) ** 4)[4:]
        return replace(beam, blm=blm)


class Sky:
    """One realization of the model of two channels, and means over samples of what is added to it."""

    def __init__(self, seed):
        self.run, self.context, self.scene, self.search = known("two")
        self.survey, self.seed = survey(self.run), seed
        self.sites = [channel.site for channel in self.survey.channels]
        self.maps = np.array(list(simulate.maps(self.survey, seed)))
        self.draw = np.random.default_rng([2031, seed])
        self.n = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
        sky = simulate.draw_sky(self.survey, seed) + dipole_alm(self.sites[0].dipole_uk, LMAX)
        self.alm = healpy.smoothalm(sky, fwhm=FWHM)

    def added(self, function, channels, splits=(0, 1)):
        """Return the change of all maps by a function of samples and site."""
        change = np.zeros_like(self.maps)
        for c in channels:
            site = self.sites[c]
            for k in splits:
                grid = MapGrid(NSIDE, site.frame, self.run.map.span(k))
                stage = tod.with_signal(lambda samples, site=site: function(samples, site))
                change[2 * c + k] = tod.bin_samples(
                    stage(tod.samples(site.pointing.model, site.pointing.line, grid)), NSIDE
                )[0]
        return change

    def on_maps(self, values, channels):
        """Return the change of all maps by values of pixels."""
        change = np.zeros_like(self.maps)
        for c in channels:
            change[2 * c : 2 * c + 2] = values
        return change


def direction(samples):
    """Return the unit vectors of samples, shape (3, n)."""
    return healpy.ang2vec(samples.theta, samples.phi).T


def phase(samples, site):
    """Return the spin phase: the angle about the spin axis."""
    model, line = site.pointing.model, site.pointing.line
    return 2 * np.pi * (samples.time_s / model.spin_period_s % 1.0) + np.deg2rad(
        model.spin_phase_deg + line.azimuth_deg
    )


def pulse(sky):
    """Return a pulse of 25 degrees once a spin."""
    start = sky.draw.uniform(0, 2 * np.pi)
    return sky.added(lambda s, site: np.exp((np.cos(phase(s, site) - start) - 1.0) / 0.19), [0])


def glare(sky):
    """Return light that falls with the distance from the Sun, in both channels."""

    def function(s, site):
        model = site.pointing.model
        turn = 2 * np.pi * s.time_s / model.orbit_period_s + np.deg2rad(model.orbit_phase_deg)
        away = np.arccos(np.clip(-(np.cos(turn) * direction(s)[0] + np.sin(turn) * direction(s)[1]), -1.0, 1.0))
        return np.exp(-away / np.deg2rad(15.0))

    return sky.added(function, [0, 1])


def spillover(sky):
    """Return the dipole in a lobe 120 degrees from the line of sight, sidewards, in the first half."""

    def function(s, site):
        side = np.stack([-np.sin(s.phi), np.cos(s.phi), 0.0 * s.phi])
        south = np.cross(side.T, direction(s).T).T
        across = np.cos(s.psi + 1.0) * south + np.sin(s.psi + 1.0) * side
        return site.dipole_uk @ (np.cos(np.deg2rad(120.0)) * direction(s) + np.sin(np.deg2rad(120.0)) * across)

    return sky.added(function, [1], [0])


def latitudes(sky):
    """Return a gain that grows with the square of the sine of galactic latitude."""
    pole = healpy.Rotator(coord=["G", "E"])([0.0, 0.0, 1.0])
    return sky.on_maps((pole @ sky.n) ** 2 * healpy.alm2map(sky.alm, NSIDE), [0])


def corners(sky):
    """Return a beam with four corners."""
    table = config.Effect(name="corners", channel=sky.run.channels[1].name, parameters={"amplitude": 1.0})
    acting = survey(replace(sky.run, effects=(table,)), library={"corners": Corners})
    return np.array(list(simulate.maps(acting, sky.seed))) - sky.maps


def turned(sky):
    """Return a channel whose maps are turned by 6' about some axis."""
    axis = sky.draw.normal(size=3)
    turn = healpy.Rotator(rot=list(np.degrees(1.7e-3) * axis / np.linalg.norm(axis)), eulertype="XYZ")
    return sky.on_maps(healpy.alm2map(turn.rotate_alm(sky.alm) - sky.alm, NSIDE), [0])


def seasons(sky):
    """Return an offset that goes up and down twice a year."""
    return sky.added(lambda s, site: np.cos(4 * np.pi * s.time_s / site.pointing.model.orbit_period_s - 0.5), [1])


def noisy_plane(sky):
    """Return more noise near the galactic plane."""
    pole, parts = healpy.Rotator(coord=["G", "E"])([0.0, 0.0, 1.0]), sky.context.analysis.model.parts
    change = np.zeros_like(sky.maps)
    for row_ in (2, 3):
        spread = np.exp(-0.5 * ((pole @ sky.n) / 0.3) ** 2) / np.sqrt(parts[row_].precision)
        change[row_] = spread * sky.draw.normal(size=len(spread))
    return change


def clouds(sky):
    """Return clouds on the sky that both channels see, as dust at their frequencies."""
    alm = sky.draw.normal(size=(healpy.Alm.getsize(5), 2)) @ [1.0, 1j]
    pattern = np.exp(0.5 * healpy.alm2map(alm, NSIDE) / np.sqrt(np.mean(np.abs(alm) ** 2)))
    factors = [(site.frequency_ghz / 94.0) ** 1.5 for site in sky.sites for _ in range(2)]
    return np.array(factors)[:, None] * pattern


def fluttering(sky):
    """Return a gain that goes up and down three times a spin."""
    fine = healpy.alm2map(sky.alm, FINE)

    def function(s, site):
        return fine[healpy.ang2pix(FINE, s.theta, s.phi)] * np.cos(3 * phase(s, site) - 1.0)

    return sky.added(function, [1])


# Channel: index, or None for all; right words as in unlisted.py.
CASES = (
    (pulse, ("added", "time", ("spin",)), 0, "alike"),
    (glare, ("added", "Sun", ("elongation",)), None, "alike"),
    (spillover, ("added", "spacecraft", ("lobe",)), 1, "half1"),
    (latitudes, ("gain", "sky", ANY), 0, "alike"),
    (corners, ("beam", "scan", ("order 4",)), 1, "alike"),
    (turned, ("rotation", "sky", ANY), 0, "alike"),
    (seasons, ("added", "time", ("year",)), 1, "alike"),
    (noisy_plane, ("noise", "", ANY), 1, "alike"),
    (clouds, ("added", "sky", ANY), None, "alike"),
    (fluttering, ("gain", "time", ("spin",)), 1, "alike"),
)


def main(span="0:99"):
    """Scale each systematic to an S/N of the data vector, and print what is said of it."""
    for case in range(len(STRENGTHS) * len(CASES))[slice(*map(int, span.split(":")))]:
        make, truth, channel, split = CASES[case % len(CASES)]
        wanted, sky, factor = STRENGTHS[case // len(CASES)], Sky(90_000 + case), 1.0
        change, analysis, null = make(sky), sky.context.analysis, sky.context.null
        before = analysis.data_vector(list(sky.maps))
        for _ in range(4):
            factor *= wanted / null.expected_snr(analysis.data_vector(list(sky.maps + factor * change)) - before)
        data = ObservedMaps(sky.context, list(sky.maps + factor * change), ask)
        found, reduction = unlisted.structures_of(data, sky.scene, sky.search, scored)
        owner = None if channel is None else sky.run.channels[channel].name
        row("further", make.__name__, [(*truth, (split,))], owner, wanted, "", found, reduction)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(*sys.argv[1:])
