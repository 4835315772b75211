"""Power that the asymmetry of W1's beam leaks from the dipole into the quadrupole and beyond.

    python workflows/full-scan/dipole.py

The sky is the Sun's dipole alone, 3364.5 uK towards Galactic (263.99, 48.26) degrees. What the odd orders of the beam
see of it depends on where the beam's centre is taken to be, and for a dipole on nothing else: on the distance e of the
mean of the whole beam from that centre. The power goes with e^2. Differences see d . (n_A + e_A - n_B - e_B): where the
sides are mirror images e_A - e_B lies along n_A - n_B, which gives a dipole again and leaks nothing to l > 1.
MCSIM_DATA is set as for the runs of this folder.
"""

from pathlib import Path

import healpy
import numpy as np

from mcsim import bipolar, config
from mcsim.simulation import convolve, differencing
from mcsim.simulation.survey import Channel, Survey, survey
from mcsim.sphere import healpix, rotation, spectra
from mcsim.sphere.sky import dipole_alm

HERE = Path(__file__).parent
AMPLITUDE_UK, LONGITUDE_DEG, LATITUDE_DEG = 3364.5, 263.99, 48.26


def leaked_map(shared: Survey, channel: Channel, sky: np.ndarray) -> np.ndarray:
    """Return what the non-circular part of the beam adds to the map of the dipole, uK."""
    if channel.side_b is not None:
        ((_, _, difference),) = differencing.maps(channel, sky, None, seed=0, realization=0, nthreads=2)
        return difference
    spins = convolve.spin_maps(sky, channel.response, channel.site.nside, nthreads=2)
    return convolve.noncircular_map(spins, channel.maps[0].moments)


def main() -> None:
    """Print D_l of what is leaked beside the sky's own."""
    galactic = AMPLITUDE_UK * np.array(healpy.ang2vec(LONGITUDE_DEG, LATITUDE_DEG, lonlat=True))
    vector = rotation.rotation_matrix("galactic", "ecliptic") @ galactic
    ell = np.arange(1, 6)
    scale = ell * (ell + 1.0) / (2.0 * np.pi)
    for name in ("parallel-transport", "hit-averaged", "full-scan", "full-scan-turned"):
        shared = survey(config.load(HERE / f"{name}.toml"), nthreads=2)
        (channel,) = shared.channels
        if name == "parallel-transport":
            offset = -channel.beam.blm[1, 1] / np.sqrt(3.0 / (8.0 * np.pi))
            x, y = np.rad2deg(offset.real) * 60.0, np.rad2deg(-offset.imag) * 60.0
            print(f"mean of the whole beam off its centre: x {x:.3f}', y {y:.3f}'")
            own = spectra.load(shared.config.sky.spectrum, 6)
            print(f"{'CMB, D_l for l = 1 ... 5 [uK^2]':34s}" + " ".join(f"{v:11.4g}" for v in scale * own[ell]))
        leaked = leaked_map(shared, channel, dipole_alm(vector, shared.config.sky.lmax))
        alm = healpix.analysis(leaked, 6, iterations=3)
        power = bipolar.power_spectrum(alm, alm, 6)
        print(f"{name:34s}" + " ".join(f"{v:11.4g}" for v in scale * power[ell]) + f"   rms {leaked.std():.4f} uK")


if __name__ == "__main__":
    main()
