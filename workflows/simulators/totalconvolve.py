"""Simulate a run by ducc0.totalconvolve, sample by sample, with pointing computed here and not by mcsim.

python workflows/simulators/totalconvolve.py MODEL.toml FOLDER [--realization 0]
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import ducc0
import healpy
import numpy as np
from inputs import Inputs, Maps, Vector, binned, blocks, parts, pointing
from numpy.typing import NDArray


def simulate(
    inputs: Inputs,
    epsilon: float = 1e-8,
    mmax: int | None = None,
    turned: Callable[[Vector], Vector] | None = None,
    shift: float = 0.0,
    centred: bool = False,
    displaced_deg: float = 0.0,
) -> Maps:
    """Return the maps of a run.

    Parameters
    ----------
    inputs
        Sky, beams and scans.
    epsilon
        Accuracy of the interpolation.
    mmax
        Highest order of the beam; default: all.
    turned
        What to make of psi, radians.
    shift
        Samples by which the pointing is late: sample k is seen where sample k + shift should be.
    centred
        Look the sky up at the centres of the pixels.
    displaced_deg
        Angle by which the beam looks farther from the spin axis than the samples' pixels say.
    """
    base = ducc0.healpix.Healpix_Base(inputs.nside, "RING")
    maps = {}
    for channel in inputs.channels:
        kmax = channel.beam.mmax if mmax is None else mmax
        blm = np.concatenate([channel.beam.blm[m, m : inputs.lmax + 1] for m in range(kmax + 1)])
        sky = ducc0.totalconvolve.Interpolator(
            inputs.sky[None], blm[None], separate=False, lmax=inputs.lmax, kmax=kmax, epsilon=epsilon, nthreads=1
        )

        def signal(samples: range, channel=channel, sky=sky) -> Iterator[tuple[NDArray[np.int64], Vector]]:
            for block in blocks(samples):
                theta, phi, _ = pointing(channel, block, inputs.frame)
                pixel = base.ang2pix(np.stack([theta, phi], axis=1))
                line = replace(channel.line, boresight_angle_deg=channel.line.boresight_angle_deg + displaced_deg)
                theta, phi, psi = pointing(replace(channel, line=line), block, inputs.frame, shift)
                if centred:
                    theta, phi = healpy.pix2ang(inputs.nside, pixel)
                psi = psi if turned is None else turned(psi)
                yield pixel, sky.interpol(np.stack([theta, phi, psi], axis=1))[0]

        for name, samples in parts(inputs, channel):
            maps[name] = binned(inputs.nside, signal(samples))
    return maps


if __name__ == "__main__":
    from command import main

    main(__doc__, simulate)
