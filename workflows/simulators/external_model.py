"""litebird_sim 0.18 as the model of a diagnosis, and data that its own systematics have changed.

    python workflows/simulators/external_model.py --nulls 100 > external.md

The class is what ``simulator = "external_model.py:Litebird"`` in a run's TOML names. One process; two half-years of two
detectors, 122 s samples, nside 16.
"""

import argparse
import sys
from dataclasses import replace

import healpy
import litebird_sim as lbs
import numpy as np
from inputs import CALLS, binned, of, parts, processor_seconds, timed
from litebird import _ECLIPTIC, _pointed
from scipy.stats import kstest

import mcsim
from mcsim import config
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.diagnosis.agreement import agreement
from mcsim.diagnosis.context import context
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.ensemble.external import source_of
from mcsim.sphere import spectra
from mcsim.stats.look_elsewhere import global_test

PERIOD_S = 122.0
MODEL = {
    "schema": 1,
    "name": "litebird-model",
    "sky": {"spectrum": "wmap7", "lmax": 40},
    "map": {"nside": 16, "splits": ["half1", "half2"]},
    "biposh": {"L_max": 2},
    "channel": [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 350.0},
            "noise": {"sigma0_uk": 20.0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": PERIOD_S, "line_of_sight": line},
        }
        for name, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
    ],
}
NONE = {"amplitude": 0.0}
FLAWS = (
    {},
    {"ellipticity": 0.1},
    {"ellipticity": 0.2},
    {"ellipticity": 0.35},
    {"offset": 4.0},
    {"offset": 8.0},
    {"offset": 16.0},
    {"drift": 0.01},
    {"drift": 0.03},
    {"quadratic": 40.0},
    {"quadratic": 120.0},
    {"thermal": 0.3},
    {"thermal": 1.0},
    {"knee": 0.1},
    {"knee": 0.5},
)
PROPOSED = ("beam_ellipticity", "beam_width", "gain_drift", "noise_level", "pointing_offset")


class Litebird:
    """litebird_sim's scanning, pointing, beams, convolution and noise; binned here.

    ``flaws``: sizes of its systematics in W1, by name: ``ellipticity`` of its Gaussian beam (gauss_beam_to_alm), an
    ``offset`` of the focal plane in arcmin (PointingSys), a ``drift`` of the gain over each half-year and a ``thermal``
    one that follows a temperature, of which it is the scale in K (apply_gaindrift), ``quadratic`` response in 1/K
    (apply_quadratic_nonlin), a ``knee`` of its noise in mHz (add_one_over_f_noise).
    """

    effects = ("beam_ellipticity", "beam_width", "noise_level")

    def __init__(self, run: mcsim.RunConfig, **flaws: float) -> None:
        self.inputs, self.flaws = of(run), flaws
        self.sigma = {channel.name: channel.noise.sigma0_uk for channel in run.channels}
        self.fwhm = {channel.name: np.deg2rad(channel.beam.fwhm_arcmin / 60.0) for channel in run.channels}
        self.cl = spectra.load(run.sky.spectrum, run.sky.lmax)
        self.scans = []
        for channel in self.inputs.channels:
            for name, samples in parts(self.inputs, channel):
                told = _pointed(channel, samples, None, 0.0, float)
                true = angles = self._angles(told)[: len(samples)]
                if channel.name == "W1" and self._moved(told):
                    told.prepare_pointings(append_to_report=False)
                    true = self._angles(told)[: len(samples)]
                pixels = healpy.ang2pix(self.inputs.nside, angles[:, 0], angles[:, 1])
                self.scans.append((channel.name, name, true, pixels))

    def _moved(self, told):  # type: ignore[no-untyped-def]
        """Move the pointing as its module does; return whether it was."""
        if "offset" in self.flaws:
            self._systems(told).focalplane.add_offset(np.deg2rad(self.flaws["offset"] / 60.0), "x")
        return "offset" in self.flaws

    @staticmethod
    def _systems(told):  # type: ignore[no-untyped-def]
        [seen] = told.observations
        told.detectors[0].orient, told.detectors[0].pol = "Q", "T"
        told.detectors[0].name = "000_one_horn"  # as its module for pointing wants it
        return lbs.PointingSys(told, seen, told.detectors)

    @staticmethod
    def _angles(told):  # type: ignore[no-untyped-def]
        [seen] = told.observations
        angles = seen.get_pointings(0)[0].astype(float)
        angles[:, 1] %= 2.0 * np.pi  # as ducc0 wants them
        return angles

    @timed
    def simulate(self, seed, effects=(), sky=None):  # type: ignore[no-untyped-def]
        """Return the maps of one seed, with effects of mcsim's library, on a given sky if there is one."""
        draw, lmax = np.random.default_rng(seed), self.inputs.lmax
        drawn = self._sky(draw)
        sky = drawn if sky is None else sky
        added = {(e.name, e.channel): e.parameters for e in effects}
        maps = {}
        for channel, part, angles, pixels in self.scans:
            own = {name: given for (name, of_channel), given in added.items() if of_channel == channel}
            beam, order = self._beam(channel, own)
            tod = np.zeros(len(pixels))
            how = lbs.BeamConvolutionParameters(lmax, order, False, 1e-6)
            alm = lbs.SphericalHarmonics(self._light(sky, channel)[None], lmax, lmax, coordinates=_ECLIPTIC)
            lbs.add_convolved_sky_to_one_detector(tod, alm, beam, angles, None, None, how, 1)
            if channel == "W1":
                self._respond(tod, part, angles)
            noise = (1.0 + own.get("noise_level", NONE)["amplitude"]) * self.sigma[channel]
            self._disturb(tod, channel, part, noise, draw)
            maps[part] = binned(self.inputs.nside, iter([(pixels, tod)]))
        return maps

    def _light(self, sky, channel):  # type: ignore[no-untyped-def]
        """Return a sky in the band of a channel."""
        return sky

    def _disturb(self, tod, channel, part, noise, draw):  # type: ignore[no-untyped-def]
        """Add the noise of a part of a channel, uK rms."""
        if channel == "W1" and "knee" in self.flaws:
            lbs.add_one_over_f_noise(tod, self.flaws["knee"], 1e-6, 1.0, noise, 1.0 / PERIOD_S, draw)
        else:
            lbs.add_white_noise(tod, noise, draw)

    def _respond(self, tod, part, angles):  # type: ignore[no-untyped-def]
        """Change the time line of a part, seen at these angles."""
        draw = np.random.default_rng(0)
        if "drift" in self.flaws:
            drift = lbs.GainDriftParams(
                sigma_drift=self.flaws["drift"],
                calibration_period_sec=len(tod),
                sampling_dist=lbs.SamplingDist.GAUSSIAN,
                sampling_gaussian_loc=1.0,
                sampling_gaussian_scale=0.0,
            )
            lbs.apply_gaindrift_for_one_detector(tod, 1.0, drift_params=drift, random=draw)
        if "thermal" in self.flaws:
            drift = lbs.GainDriftParams(
                drift_type=lbs.GainDriftType.THERMAL_GAIN,
                thermal_fluctuation_amplitude_K=self.flaws["thermal"],
                detector_mismatch=0.0,
            )
            lbs.apply_gaindrift_for_one_detector(tod, 1.0 / PERIOD_S, drift_params=drift, random=draw)
        if "quadratic" in self.flaws:
            bent = lbs.NonLinParams(self.flaws["quadratic"] * 1e-6, 0.0)
            lbs.apply_quadratic_nonlin_for_one_detector(tod, nl_params=bent, random=draw)

    def _sky(self, draw):  # type: ignore[no-untyped-def]
        ell, m = healpy.Alm.getlm(self.inputs.lmax)
        real, imaginary = draw.normal(size=(2, ell.size))
        return np.sqrt(self.cl[ell]) * np.where(m > 0, (real + 1j * imaginary) / np.sqrt(2.0), real)

    def _beam(self, channel, own):  # type: ignore[no-untyped-def]
        """Return the beam of a channel with effects, and its highest order."""
        ellipse = own.get("beam_ellipticity", NONE)
        if channel == "W1" and "ellipticity" in self.flaws:
            ellipse = {"amplitude": self.flaws["ellipticity"]}
        order = 4 if ellipse["amplitude"] else 0
        fwhm = self.fwhm[channel] * (1.0 + own.get("beam_width", NONE)["amplitude"])
        ratio, angle = 1.0 + abs(ellipse["amplitude"]), np.deg2rad(ellipse.get("angle_deg", 0.0))
        if ellipse["amplitude"] < 0.0:
            angle += np.pi / 2.0
        return lbs.gauss_beam_to_alm(self.inputs.lmax, order, fwhm, ratio, angle, None), order


def ask(jobs):  # type: ignore[no-untyped-def]
    return [data_vectors(job) for job in jobs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nulls", type=int, default=100)
    parser.add_argument("--per-element", type=int, default=5, help="simulations for each element of the data vector")
    parser.add_argument("--seed", type=int, default=4242, help="of the sky and noise that all systematics share")
    given = parser.parse_args()
    run = config.load(MODEL)
    library = {name: kind for name, kind in mcsim.effects().items() if name in PROPOSED}
    settings = mcsim.DiagnosisSettings(sims_per_element=given.per_element, scan_sims=100)
    model = Litebird(run)
    source = source_of(run, model)
    analysis = analysis_of(run, library=library, settings=settings, source=source)
    native = replace(analysis, source=None)
    context(native, *campaign.learned(native, ask))  # compiles, and fills caches that both models share
    CALLS.clear()
    start = processor_seconds()
    known = context(analysis, *campaign.learned(analysis, ask))
    found = agreement(known)
    spent, theirs, called = processor_seconds() - start, sum(CALLS), len(CALLS)
    print(f"data vector of {known.null.dimension} independent elements, {len(known.ensemble.simulations)} simulations")
    print(f"agreement of mcsim's own simulation: p = {found.pvalue:.3g}, nearest {found.nearest}")
    start = processor_seconds()
    plain = context(native, *campaign.learned(native, ask, len(known.ensemble.simulations)))
    own = processor_seconds() - start
    print(f"processor time {spent:.1f} s, {theirs:.1f} s in {called} calls of litebird_sim; own model {own:.1f} s")
    print(f"ratio, litebird_sim's own time aside: {(spent - theirs) / own:.2f}", flush=True)
    data = [analysis.data_vector(source.maps(0, seed)) for seed in range(given.nulls)]
    for one, name in ((known, "litebird_sim"), (plain, "mcsim")):
        p = np.array([global_test(one.null, x, one.always, one.calibration).pvalue for x in data])
        print(f"null cases, {name} as the model: {np.sum(p < 0.05)} of {len(p)} below 0.05, ", end="")
        print(f"KS p = {kstest(p, 'uniform').pvalue:.2g}")
    print(flush=True)
    table(Litebird, run, FLAWS, (known, plain), given.seed)


def table(simulator, run, flaws, models, seed):  # type: ignore[no-untyped-def]
    """Print what diagnoses with two models say of data with each systematic."""
    print("| systematic of litebird_sim in W1 | p | litebird_sim as the model | p | mcsim as the model |")
    print("|---|---|---|---|---|")
    for flaw in flaws:
        maps = simulator(run, **flaw).simulate(seed)
        data = [maps[name.replace(":", "_")] for name in config.map_names(run)]
        what = ", ".join(f"{name} {value:g}" for name, value in flaw.items()) or "none"
        answers = " | ".join(answer(diagnose_data(ObservedMaps(one, data, ask), "case")) for one in models)
        print(f"| {what} | {answers} |", flush=True)


def answer(result):  # type: ignore[no-untyped-def]
    """Return p-value and verdict of a diagnosis as two cells of a table."""
    named = " or ".join(", ".join(f"{e.name} {e.channel} {e.words}" for e in s.effects) for s in result.sets)
    if result.kind == "unknown":
        named = f"nearest {result.candidates[result.nearest].label}, cosine {result.cosine:.2f}"
    return f"{result.test.pvalue:.2g} | {result.kind}{', ' * bool(named)}{named}"


if __name__ == "__main__":
    sys.exit(main())
