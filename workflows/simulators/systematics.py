"""Further systematics of litebird_sim 0.18 that act on temperature: data of them diagnosed with two models.

    python workflows/simulators/systematics.py > systematics.md

The instrument is that of external_model.py and sees the dipole too, which is subtracted at the fiducial pointing.
"""

import argparse
from dataclasses import replace
from types import SimpleNamespace

import litebird_sim as lbs
import numpy as np
from astropy.time import Time
from external_model import MODEL, PERIOD_S, Litebird, ask, table
from inputs import parts
from litebird import _pointed
from litebird_sim.dipole import add_dipole_for_one_detector
from litebird_sim.hwp_diff_emiss import add_2f_for_one_detector
from litebird_sim.hwp_harmonics.mueller_methods import compute_signal_for_one_detector

import mcsim
from mcsim import config
from mcsim.datavector import campaign
from mcsim.datavector.analysis import analysis_of
from mcsim.diagnosis.context import context
from mcsim.ensemble.external import source_of
from mcsim.sphere.rotation import rotation_matrix
from mcsim.systematics.galaxy import morphology

DIPOLE_UK, LON_DEG, LAT_DEG = 1e6 * lbs.T_CMB_K * lbs.SOLAR_VELOCITY_KM_S / lbs.C_LIGHT_KM_OVER_S, 264.021, 48.253
GHZ, WIDTH_GHZ, FOREGROUND_UK, INDEX = 94.0, 20.0, 100.0, 1.6
"""Band of W1, and rms in it and spectral index (of brightness temperature) of a foreground that was cleaned."""
SPEED = 46.0 * 2.0 * np.pi / 60.0
"""Of a half-wave plate, radians a second."""
EQUINOX = Time("2025-09-22T18:19:00")
"""The Sun at 180 degrees, as mcsim's scans have it at t = 0."""
REQUESTED = ("bandpass_mismatch", "nonlinearity", "orbital_dipole")
PROPOSED = (
    "beam_ellipticity", "beam_width", "calibration", "dipole_residual", "gain_drift", "noise_level", "pointing_offset",
)  # fmt: skip
FLAWS = (
    {},
    {"jitter": 10.0},
    {"wedge": 15.0},
    {"spacecraft": 8.0},
    {"transmission": 0.998},
    {"hwpss": 10.0},
    {"hwpss": 40.0},
    {"dipole": 0.003},
    {"direction": 10.0},
    {"orbit": 0.05},
    {"doppler": 1.0},
    {"converter": 0.3},
    {"converter": 1.0},
    {"band": 0.05},
    {"correlated": 0.5},
    {"common": 0.5},
)


class Further(Litebird):
    """The same with a dipole in the samples, and other systematics of litebird_sim in W1.

    ``jitter`` of the focal plane (rms per axis) and the circle of a ``wedge`` of a half-wave plate (radius), arcmin,
    and an offset of the whole ``spacecraft``, arcmin (PointingSys); ``transmission`` of the plate, with half of its
    loss at 2f and 4f as well (the Mueller matrices of its harmonics), and its synchronous emission ``hwpss``, uK at 2f
    (add_2f); what is left of the solar ``dipole`` and of that of the ``orbit``, fractions, the ``direction`` of the
    former off by arcmin to the north, and ``doppler``: its quadratic term (add_dipole); ``converter``: a quadratic
    response to sky and dipole, 1/K (apply_quadratic_nonlin); the centre of its ``band`` off by a fraction
    (BandPassInfo), beside a foreground; noise ``correlated`` with V1's (its matrix), or with a 1/f part in ``common``
    of a knee of 0.1 mHz (add_correlated_noise).
    """

    effects = ("noise_level",)

    def __init__(self, run: mcsim.RunConfig, **flaws: float) -> None:
        super().__init__(run, **flaws)
        lon, lat = np.deg2rad([LON_DEG, LAT_DEG])
        towards = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        self.sun = lbs.SOLAR_VELOCITY_KM_S * (rotation_matrix("galactic", "ecliptic") @ towards)
        channel = next(c for c in self.inputs.channels if c.name == "W1")
        self.told = {}
        for name, samples in parts(self.inputs, channel):
            angles = self._angles(_pointed(channel, samples, None, 0.0, float))[: len(samples)]
            self.told[name] = angles, PERIOD_S * samples.start
        self.kept = {}

    def _moved(self, told):  # type: ignore[no-untyped-def]
        draw, size = np.random.default_rng(0), {k: np.deg2rad(v / 60.0) for k, v in self.flaws.items()}
        moved = size.keys() & {"jitter", "wedge", "spacecraft"}
        systems = self._systems(told) if moved else None
        if "jitter" in moved:
            count = told.spin2ecliptic_quats.quats.shape[0]
            for axis in "xy":
                systems.focalplane.add_disturb(size["jitter"] * draw.standard_normal(count), axis)
        if "wedge" in moved:
            told.hwp = lbs.IdealHWP(SPEED)
            systems.hwp.add_hwp_rot_disturb(size["wedge"], SPEED)
        if "spacecraft" in moved:
            systems.spacecraft.add_offset(size["spacecraft"], "y")
        return bool(moved)

    def _respond(self, tod, part, angles):  # type: ignore[no-untyped-def]
        draw, flaws = np.random.default_rng(0), self.flaws
        told, start_s = self.told[part]
        time_s = start_s + PERIOD_S * np.arange(len(tod))
        tod += self._doppler(angles, self.sun)
        if "transmission" in flaws:
            tod[:] = self._through_plate(tod, SPEED * time_s)
        if "converter" in flaws:
            bent = lbs.NonLinParams(flaws["converter"] * 1e-6, 0.0)
            lbs.apply_quadratic_nonlin_for_one_detector(tod, nl_params=bent, random=draw)
        tod -= self._doppler(told, self.sun)
        if "hwpss" in flaws:
            add_2f_for_one_detector(tod, SPEED * time_s, 0.0, flaws["hwpss"])
        if "dipole" in flaws:
            tod += flaws["dipole"] * self._doppler(told, self.sun)
        if "direction" in flaws:
            north = np.array([0.0, 0.0, 1.0])
            north -= (north @ self.sun) * self.sun / (self.sun @ self.sun)
            north *= np.linalg.norm(self.sun) / np.linalg.norm(north)
            tod += np.deg2rad(flaws["direction"] / 60.0) * self._doppler(told, north)
        if "doppler" in flaws:
            more = self._doppler(told, self.sun, lbs.DipoleType.QUADRATIC_FROM_LIN_T) - self._doppler(told, self.sun)
            tod += flaws["doppler"] * more
        if "orbit" in flaws:
            orbit = lbs.SpacecraftOrbit(EQUINOX, solar_velocity_km_s=0.0)
            year = lbs.spacecraft_pos_and_vel(orbit, start_time=EQUINOX, time_span_s=366.0 * 86400.0)
            velocity = year.compute_velocities(EQUINOX + start_s / 86400.0, PERIOD_S, len(tod))
            tod += flaws["orbit"] * self._doppler(told, velocity)

    @staticmethod
    def _doppler(angles, velocity, kind=lbs.DipoleType.LINEAR):  # type: ignore[no-untyped-def]
        """Return the dipole of a velocity in km/s at angles, uK."""
        added = np.zeros(len(angles))
        each = np.broadcast_to(velocity, (len(angles), 3))
        add_dipole_for_one_detector(added, angles, each, lbs.T_CMB_K, GHZ * 1e9, kind)
        return 1e6 * added

    @staticmethod
    def _lit(sky, lmax, share):  # type: ignore[no-untyped-def]
        """Return a sky with a share of the foreground."""
        site = SimpleNamespace(lmax=lmax, frame="ecliptic")
        return sky + share * FOREGROUND_UK * morphology("", site, lambda _: np.random.default_rng(0))

    def _light(self, sky, channel):  # type: ignore[no-untyped-def]
        if channel != "W1" or "band" not in self.flaws:
            return sky
        return self._lit(sky, self.inputs.lmax, _colour(GHZ * (1.0 + self.flaws["band"])) / _colour(GHZ) - 1.0)

    def _through_plate(self, tod, angle):  # type: ignore[no-untyped-def]
        """Return what a half-wave plate lets through, its intensity at 0, 2 and 4 times its turns."""
        lost = 1.0 - self.flaws["transmission"]
        matrices = np.zeros((3, 3, 3))
        matrices[:, 0, 0] = 1.0 - lost, 0.5 * lost, 0.5 * lost
        seen, none = np.zeros(len(tod)), np.zeros(len(tod))
        compute_signal_for_one_detector(
            seen, *matrices, angle, none, tod, none, none, 1.0, 0.0, 0.0, 0.0, False, 0.0, False, 0.0,
            np.zeros((3, 3)), np.zeros((3, 3)),
        )  # fmt: skip
        return seen

    def _disturb(self, tod, channel, part, noise, draw):  # type: ignore[no-untyped-def]
        shared = self.flaws.keys() & {"correlated", "common"}
        if not shared:
            super()._disturb(tod, channel, part, noise, draw)
            return
        half = part.partition("_")[2]
        if half not in self.kept:  # V1 comes before W1
            both, rate, rho = np.zeros((2, len(tod))), 1.0 / PERIOD_S, max(map(self.flaws.get, shared))
            how = (
                {"corr_matrix": [[1.0, rho], [rho, 1.0]]} if "correlated" in shared else {"groups": [0, 0], "rho": rho}
            )
            how |= {"scale": 1e6}  # it gives K
            knee_mhz = 0.1 if "common" in shared else 0.0
            lbs.add_correlated_noise(both, rate, noise / np.sqrt(rate), knee_mhz, 1e-6, 1.0, draw.spawn(2), **how)
            self.kept[half] = both
        tod += self.kept[half][0] if channel == "V1" else self.kept.pop(half)[1]


def _colour(centre_ghz):  # type: ignore[no-untyped-def]
    """Return the foreground in a band, in units of the CMB's temperature, over that at the reference frequency."""
    band = lbs.BandPassInfo(centre_ghz, WIDTH_GHZ, bandtype="top-hat-cosine")
    to_cmb = [lbs.UnitUtils.get_conversion_factor(lbs.Units.K_RJ, lbs.Units.K_CMB, f) for f in band.freqs_ghz]
    power = band.weights * band.freqs_ghz**2
    return np.sum(power * (band.freqs_ghz / GHZ) ** INDEX) / np.sum(power / to_cmb)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[4246, 4247], help="of the sky and noise of a table")
    given = parser.parse_args()
    dipole = {"dipole_uk": DIPOLE_UK, "dipole_lon_deg": LON_DEG, "dipole_lat_deg": LAT_DEG}
    run = config.load(MODEL | {"sky": MODEL["sky"] | dipole})
    library = {name: kind for name, kind in mcsim.effects().items() if name in PROPOSED + REQUESTED}
    settings = mcsim.DiagnosisSettings(sims_per_element=5, scan_sims=100, including=REQUESTED)
    analysis = analysis_of(run, library=library, settings=settings, source=source_of(run, Further(run)))
    known = context(analysis, *campaign.learned(analysis, ask))
    native = replace(analysis, source=None)
    plain = context(native, *campaign.learned(native, ask, len(known.ensemble.simulations)))
    print(f"{known.null.dimension} independent elements; a band 5 % off leaves", end=" ")
    print(f"{FOREGROUND_UK * (_colour(1.05 * GHZ) / _colour(GHZ) - 1.0):.1f} uK rms of the foreground")
    for seed in given.seeds:
        table(Further, run, FLAWS, (known, plain), seed)


if __name__ == "__main__":
    main()
