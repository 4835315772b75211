"""Simulate a run by a plain healpy pipeline: a smoothed map, looked up at every sample, binned.

    python workflows/simulators/healpy_pipeline.py MODEL.toml FOLDER [--realization 0]

The beam is its circular window, as in most such pipelines: a beam of another shape makes a difference (mmax_cut 0).
"""

from collections.abc import Iterator

import healpy
import numpy as np
from inputs import Inputs, Maps, Vector, binned, blocks, parts, pointing
from numpy.typing import NDArray

from mcsim.sphere.healpix import pixel_window


def simulate(
    inputs: Inputs, finer: int = 16, interpolated: bool = True, window: bool = False, nest: bool = False
) -> Maps:
    """Return the maps of a run.

    Parameters
    ----------
    inputs
        Sky, beams and scans.
    finer
        nside of the smoothed map over that of the run's.
    interpolated
        Interpolate between four pixels (``healpy.get_interp_val``), or take the value of the nearest one.
    window
        Multiply the sky by the pixel window, as ``alm2map(pixwin=True)`` does (which looks it up on the network).
    nest
        Number the pixels of the result as NESTED.
    """
    nside = finer * inputs.nside
    maps = {}
    for channel in inputs.channels:
        smoothed = healpy.almxfl(inputs.sky, channel.beam.window[: inputs.lmax + 1])
        if window:
            smoothed = healpy.almxfl(smoothed, pixel_window(inputs.nside, inputs.lmax))
        sky = healpy.alm2map(smoothed, nside, lmax=inputs.lmax)

        def signal(samples: range, channel=channel, sky=sky) -> Iterator[tuple[NDArray[np.int64], Vector]]:
            for block in blocks(samples):
                theta, phi, _ = pointing(channel, block, inputs.frame)
                pixel = healpy.ang2pix(inputs.nside, theta, phi, nest=nest)
                if interpolated:
                    yield pixel, np.asarray(healpy.get_interp_val(sky, theta, phi))
                else:
                    yield pixel, sky[healpy.ang2pix(nside, theta, phi)]

        for name, samples in parts(inputs, channel):
            maps[name] = binned(inputs.nside, signal(samples))
    return maps


if __name__ == "__main__":
    from command import main

    main(__doc__, simulate)
