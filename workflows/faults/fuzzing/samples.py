"""A small run, one valid file of every format that mcsim reads, and what a run makes of them."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from astropy.io import fits
from astropy.table import Table

from mcsim import beamfit, config
from mcsim.ensemble import plan, store
from mcsim.errors import RunError
from mcsim.instrument import beams, scan
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import spectra
from mcsim.support import resources

NSIDE, LMAX = 8, 16

TOML = """schema = 1
name = "fuzz"
[sky]
spectrum = "wmap7"
lmax = 16
[map]
nside = 8
splits = ["a", "b"]
[[channel]]
name = "W1"
beam = { kind = "elliptical_gaussian", fwhm_major_arcmin = 600.0, fwhm_minor_arcmin = 500.0 }
scan = { kind = "parallel_transport", psi0_deg = 5.0 }
noise = { sigma0_uk = 0.5 }
[biposh]
L_max = 1
[ensemble]
realizations = 2
seed = 1
"""


def base() -> dict[str, Any]:
    """A run with most of the keys, small enough for some milliseconds."""
    return {
        "schema": 1,
        "name": "fuzz",
        "sky": {"spectrum": "wmap7", "lmax": LMAX},
        "map": {"nside": NSIDE, "frame": "ecliptic", "splits": []},
        "channel": [
            {
                "name": "A",
                "frequency_ghz": 94.0,
                "beam": {
                    "kind": "elliptical_gaussian",
                    "fwhm_major_arcmin": 600.0,
                    "fwhm_minor_arcmin": 500.0,
                    "angle_deg": 10.0,
                },
                "scan": {"kind": "parallel_transport", "psi0_deg": 5.0},
                "noise": {"sigma0_uk": 1.0},
            }
        ],
        "biposh": {"L_max": 2, "lmax": LMAX, "summary_bin": 5, "weighting": "uniform", "iterations": 1, "pairs": "all"},
        "ensemble": {"realizations": 2, "seed": 3, "paired": True, "keep_maps": False},
        "compute": {"workers": 1, "chunk": 1},
    }


def use(plain: Any, folder: Path, depth: int) -> None:
    """Load a configuration; where it is small, observe a sky and make the store."""
    run = config.load(plain, base=folder)
    if config.from_json(config.to_json(run)) != run:
        raise AssertionError("the JSON of the configuration is another one")
    small = run.map.nside <= 32 and run.sky.lmax <= 64 and run.biposh.L_max <= 6 and len(run.channels) <= 3
    if not small or run.ensemble.realizations > 10**5:
        return
    if any(channel.scan.kind in ("hit_averaged", "differencing") for channel in run.channels) and not depth:
        return  # a year of samples is not what is asked for here
    shared = survey(run)
    values = simulate.realize(shared, 0)
    target = folder / "made.zarr"
    store.create(target, plan.layout(shared), plan.attributes(run))
    shutil.rmtree(target)
    if not all(np.isfinite(values["cl"]).ravel()):
        raise RunError("The power spectrum is not finite.")


def write_files(folder: Path) -> None:
    """One valid file of every format that mcsim reads."""
    rng = np.random.default_rng(1)
    npix = 12 * NSIDE**2
    healpy.write_map(
        folder / "mask.fits", (rng.random(npix) > 0.3).astype(float), coord="E", overwrite=True, dtype=np.float64
    )
    healpy.write_map(
        folder / "sky.fits", rng.normal(size=npix), coord="E", column_units="uK", overwrite=True, dtype=np.float64
    )
    scan.write_moments_fits(folder / "moments.fits", scan.Moments.parallel_transport(NSIDE, np.rad2deg(0.3), 4))
    y, x = np.mgrid[:41, :41] - 20.0
    image = fits.PrimaryHDU(np.exp(-(x**2 / 40 + y**2 / 30)))
    image.header["CDELT1"] = image.header["CDELT2"] = 0.5
    image.writeto(folder / "beam.fits", overwrite=True)
    packed = np.zeros(healpy.Alm.getsize(LMAX, LMAX), dtype=complex)
    beam = beams.Beam.elliptical(600, 500, lmax=LMAX, mmax=4)
    for m in range(beam.mmax + 1):
        packed[healpy.Alm.getidx(LMAX, np.arange(m, LMAX + 1), m)] = beam.blm[m, m:]
    healpy.write_alm(folder / "blm.fits", packed, overwrite=True, out_dtype=np.float64)
    healpy.write_alm(folder / "sky_alm.fits", healpy.map2alm(rng.normal(size=npix), lmax=LMAX), overwrite=True)
    table = spectra.load("wmap7", 40)
    np.savetxt(folder / "spectrum.txt", np.column_stack([np.arange(2, 41), table[2:]]))
    healpy.write_cl(folder / "spectrum.fits", table, overwrite=True, dtype=np.float64)
    angles = np.column_stack([np.arccos(rng.uniform(-1, 1, 4000)), rng.uniform(0, 6.28, (4000, 2))])
    np.savetxt(folder / "pointing.txt", angles)
    np.save(folder / "pointing.npy", angles)
    np.savez(folder / "pointing.npz", theta=angles[:, 0], phi=angles[:, 1], psi=angles[:, 2])
    columns = [fits.Column(name=n, format="D", array=angles[:, i]) for i, n in enumerate(("theta", "phi", "psi"))]
    fits.BinTableHDU.from_columns(columns).writeto(folder / "pointing.fits", overwrite=True)
    (folder / "model.toml").write_text(resources.scan_model("template").read_text())
    (folder / "run.toml").write_text(TOML)
    rows = [("A,A", 2, 0, 0, a, a + 3, 1.0 / (1 + a), 0.0, 0.1) for a in range(2, 14, 4)]
    measured = Table(rows=rows, names=["pair", "L", "M", "d", "ell_min", "ell_max", "value", "value_imag", "error"])
    for name in ("value", "value_imag", "error"):
        measured[name].unit = "uK2"
    measured.meta |= {"normalisation": "Bennett", "scaling": "l(l+1)/2pi", "frame": "ecliptic"}
    measured.write(folder / "data.ecsv", format="ascii.ecsv", overwrite=True)
    (folder / "run.toml").unlink()


def with_(section: str, **changes: Any) -> dict[str, Any]:
    """The base configuration with a file in it."""
    plain = base()
    if section in ("beam", "scan"):
        plain["channel"][0][section] = changes
    elif section == "sky":
        plain["sky"] = {"lmax": LMAX, **changes}
    else:
        plain[section] |= changes
    return plain


def readers(folder: Path) -> dict[str, Callable[[], object]]:
    """File -> what reads it."""

    def using(plain: dict[str, Any]) -> Callable[[], object]:
        return lambda: use(plain, folder, 1)

    found = {
        "mask.fits": using(with_("map", mask="mask.fits", mask_apodisation_deg=10.0)),
        "sky.fits": using(with_("sky", map="sky.fits")),
        "sky_alm.fits": using(with_("sky", alm="sky_alm.fits")),
        "moments.fits": using(with_("scan", kind="moments", path="moments.fits")),
        "beam.fits": using(with_("beam", kind="map", path="beam.fits", cut_deg=9.0)),
        "blm.fits": using(with_("beam", kind="blm", path="blm.fits")),
        "spectrum.txt": using(with_("sky", spectrum="spectrum.txt")),
        "spectrum.fits": using(with_("sky", spectrum="spectrum.fits")),
        "model.toml": lambda: scan.ScanModel.load(folder / "model.toml"),
        "data.ecsv": lambda: beamfit.measurement(folder / "data.ecsv", base()),
    }
    for suffix in ("txt", "npy", "npz", "fits"):
        name = f"pointing.{suffix}"
        found[name] = using(with_("scan", kind="pointing", path=name))
    return found
