"""Simulate a run by litebird_sim 0.18: its scanning strategy, its pointing, its convolution; binned here.

    pip install "litebird_sim==0.18.*"
    python workflows/simulators/litebird.py MODEL.toml FOLDER [--realization 0]

Its own map-makers solve for Q and U and take a part of what the beam's shape does out of I: samples are binned here.
"""

from collections.abc import Iterator

import ducc0
import litebird_sim as lbs
import numpy as np
from inputs import Channel, Inputs, Maps, Vector, binned, blocks, parts

_ECLIPTIC = lbs.CoordinateSystem.Ecliptic


class Strategy(lbs.SpinningScanningStrategy):
    """litebird_sim's spin, precession and orbit, with phases at t = 0."""

    delay_s = orbit_rad = 0.0
    orbit_period_s = 365.25 * 86400.0

    def all_spin_to_ecliptic(self, result_matrix, sun_earth_angles_rad, time_vector_s):  # type: ignore[no-untyped-def]
        angles = self.orbit_rad + 2 * np.pi * np.asarray(time_vector_s) / self.orbit_period_s
        super().all_spin_to_ecliptic(result_matrix, angles, np.asarray(time_vector_s) + self.delay_s)


def simulate(
    inputs: Inputs,
    turned_deg: float = 0.0,
    single_precision: bool = False,
    epsilon: float = 1e-8,
    mmax: int | None = None,
    nside_centering: int | None = None,
    step_s: float | None = None,
) -> Maps:
    """Return the maps of a run.

    ``single_precision``, ``epsilon`` (its own defaults: True, 1e-5) and ``mmax`` are arguments of its
    BeamConvolutionParameters, ``nside_centering`` of convolve_sky; ``step_s`` is its delta_time_s (default: a sample,
    so that no quaternion is interpolated); ``turned_deg`` turns the instrument about its line of sight.
    """
    if inputs.frame != "ecliptic":
        raise ValueError(f"litebird_sim points in ecliptic coordinates, the run's maps are {inputs.frame}.")
    base = ducc0.healpix.Healpix_Base(inputs.nside, "RING")
    dtype = np.float32 if single_precision else np.float64
    maps = {}
    for channel in inputs.channels:
        # An x axis along the radius; its psi, counted from east to north, is to ducc0 half a turn from ours.
        highest, signs = channel.beam.mmax, (-1.0) ** np.arange(channel.beam.mmax + 1)
        packed = np.concatenate([signs[m] * channel.beam.blm[m, m : inputs.lmax + 1] for m in range(highest + 1)])
        kept = highest if mmax is None else mmax
        given = {
            "sky_alms": lbs.SphericalHarmonics(inputs.sky[None], inputs.lmax, inputs.lmax, coordinates=_ECLIPTIC),
            "beam_alms": lbs.SphericalHarmonics(packed[None], inputs.lmax, highest, coordinates=_ECLIPTIC),
            "convolution_params": lbs.BeamConvolutionParameters(inputs.lmax, kept, single_precision, epsilon),
        } | {"pointings_dtype": dtype, "nside_centering": nside_centering, "append_to_report": False}

        def signal(samples: range, given=given, channel=channel) -> Iterator[tuple[Vector, Vector]]:
            for block in blocks(samples):
                run = _pointed(channel, block, step_s, turned_deg, dtype)
                run.convolve_sky(**given)
                [seen] = run.observations
                angles = seen.get_pointings(0)[0][: len(block), :2].astype(float)
                yield base.ang2pix(angles), seen.tod[0, : len(block)].astype(float)

        for name, samples in parts(inputs, channel):
            maps[name] = binned(inputs.nside, signal(samples))
    return maps


def _pointed(  # type: ignore[no-untyped-def]
    channel: Channel, samples: range, step_s: float | None, turned_deg: float, dtype: type
):
    model, line, period = channel.model, channel.line, channel.model.period_of_samples(channel.line)
    start_s, length_s = samples.start * period, len(samples) * period
    imo = lbs.Imo(flatfile_location=lbs.PTEP_IMO_LOCATION)
    run = lbs.Simulation(start_time=start_s, duration_s=length_s, random_seed=1, profile_time=False, imo=imo)
    # Its precession and spin start half a turn later than ours; the delay makes the precession's phase.
    delay = (model.precession_phase_deg - 180.0) / 360.0 * model.precession_period_s
    tilt, turns = np.deg2rad(model.precession_angle_deg), 1.0 / model.spin_period_s
    scan = Strategy(tilt, 1.0 / model.precession_period_s, turns)
    scan.delay_s, scan.orbit_period_s, scan.orbit_rad = delay, model.orbit_period_s, np.deg2rad(model.orbit_phase_deg)
    run.set_scanning_strategy(scan, delta_time_s=step_s or period, append_to_report=False)
    azimuth = np.deg2rad(model.spin_phase_deg + line.azimuth_deg - 180.0) - 2 * np.pi * delay * turns
    turn, boresight = np.deg2rad([turned_deg, line.boresight_angle_deg])
    run.set_instrument(lbs.InstrumentInfo("one horn", turn, boresight, azimuth))
    tod = lbs.TodDescription("tod", lbs.Units.K_CMB, dtype, "signal")
    run.create_observations(lbs.DetectorInfo(line.name, sampling_rate_hz=1.0 / period), tods=[tod])
    run.prepare_pointings(append_to_report=False)
    return run


if __name__ == "__main__":
    from command import main

    main(__doc__, simulate)
