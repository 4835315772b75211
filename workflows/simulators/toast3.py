"""Simulate a run by TOAST 3: its convolution (SimTotalconvolve), its pixels and its binning.

    pip install "toast==3.*"
    python workflows/simulators/toast3.py MODEL.toml FOLDER [--realization 0]

The boresight is given sample by sample (inputs.pointing): SimSatellite has phases of its own.
"""

import tempfile
from pathlib import Path

import healpy
import numpy as np
import toast
import toast.ops
from astropy import units as u
from astropy.table import QTable
from inputs import Channel, Inputs, Maps, Vector, binned, blocks, parts, pointing
from numpy.typing import NDArray
from toast import qarray


class Convolution(toast.ops.SimTotalconvolve):
    """SimTotalconvolve with longitudes from 0 to 2 pi: TOAST 3.0.6 has them below 0, which ducc0 0.42 refuses."""

    def get_buffer(self, theta, phi, psi, det, verbose):  # type: ignore[no-untyped-def]
        return super().get_buffer(theta, phi % (2 * np.pi), psi, det, verbose)


def simulate(
    inputs: Inputs,
    turned_deg: float = 0.0,
    epsilon: float = 1e-8,
    beammmax: int = -1,
    fwhm_arcmin: float = 0.0,
    calibrate: bool = True,
    nest: bool = False,
) -> Maps:
    """Return the maps of a run.

    ``epsilon``, ``beammmax``, ``fwhm`` (of a beam in the sky, which is divided out; its own default is 4 arcmin) and
    ``calibrate`` (False: half the signal) are arguments of SimTotalconvolve, ``nest`` of PixelsHealpix; ``turned_deg``
    turns the detector about its line of sight.
    """
    maps = {}
    detector = toast.ops.PointingDetectorSimple()
    for channel in inputs.channels:
        with tempfile.TemporaryDirectory() as folder:
            sky, beam = str(Path(folder) / "sky.fits"), str(Path(folder) / "beam.fits")
            healpy.write_alm(sky, inputs.sky, lmax=inputs.lmax, out_dtype=float)
            blm = channel.beam.blm[:, : inputs.lmax + 1]
            packed = np.concatenate([blm[m, m:] for m in range(len(blm))])
            healpy.write_alm(
                beam, packed, lmax=inputs.lmax, mmax=len(blm) - 1, mmax_in=len(blm) - 1, out_dtype=np.float64
            )
            convolve = Convolution(
                detector_pointing=detector, sky_file=sky, beam_file=beam, sky_file_dict={}, beam_file_dict={},
                dxx=False, pol=False, epsilon=epsilon, beammmax=beammmax, fwhm=fwhm_arcmin * u.arcmin,
                calibrate=calibrate, det_data_units=u.K,
            )  # fmt: skip
            pixels = toast.ops.PixelsHealpix(nside=inputs.nside, nest=nest, detector_pointing=detector)
            for name, samples in parts(inputs, channel):
                seen = [_observed(channel, b, inputs.frame, (turned_deg, convolve, pixels)) for b in blocks(samples)]
                maps[name] = binned(inputs.nside, iter(seen))
    return maps


def _observed(
    channel: Channel, samples: range, frame: str, how: tuple[float, toast.ops.Operator, toast.ops.Operator]
) -> tuple[NDArray[np.int64], Vector]:
    """Return the pixel and the signal of samples."""
    turned_deg, convolve, pixels = how
    turn = qarray.rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(turned_deg))
    rate = 1.0 / channel.model.period_of_samples(channel.line) * u.Hz
    angles = {key: [0.0] * u.rad for key in ("pol_angle", "psi_pol")}
    table = QTable({"name": ["horn"], "quat": [turn.flatten()], "pol_leakage": [0.0], **angles})
    plane = toast.instrument.Focalplane(detector_data=table, sample_rate=rate)
    telescope = toast.instrument.Telescope("horn", focalplane=plane, site=toast.instrument.SpaceSite("L2"))
    data = toast.Data(toast.Comm())
    observation = toast.Observation(data.comm, telescope, len(samples), name="part")
    data.obs.append(observation)
    theta, phi, psi = pointing(channel, samples, frame)
    # SimTotalconvolve adds half a turn to psi.
    boresight = qarray.from_iso_angles(theta, phi, psi - np.pi)
    observation.shared.create_column("boresight_radec", shape=(len(samples), 4), dtype=np.float64)
    observation.shared["boresight_radec"].set(np.asarray(boresight).reshape(-1, 4))
    observation.shared.create_column("flags", shape=(len(samples),), dtype=np.uint8)
    observation.shared["flags"].set(np.zeros(len(samples), np.uint8))
    convolve.apply(data)
    pixels.apply(data)
    return np.array(observation.detdata["pixels"][0]), np.array(observation.detdata["signal"][0])


if __name__ == "__main__":
    from command import main

    main(__doc__, simulate)
