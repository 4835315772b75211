"""Put differences into simulators, let ``mcsim compare`` explain them, and print what it says.

    python workflows/simulators/differences.py [identical|single|pair ...] [--skies 3] [--seed 1]
        [-o ROWS]

Side A is totalconvolve.py, side B the simulator of the row; rows of litebird_sim and TOAST are left out where they are
not installed. A row is right if the differences put in are the set named first, or one that is called as good.
"""

import argparse
import importlib
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import healpy
import inputs
import numpy as np
import totalconvolve
from inputs import Inputs, Maps
from rows import Rows

import mcsim
from mcsim import config
from mcsim.comparison.result import ComparisonResult
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey
from mcsim.sphere.healpix import pixel_window
from mcsim.sphere.rotation import rotate_alm

NSIDE, LMAX = 32, 80
"""Of the maps into which differences are put; those with nothing wrong are twice as fine."""
PAIRS = (("mcsim", "litebird"), ("mcsim", "toast3"), ("litebird", "toast3"), ("totalconvolve", "healpy_pipeline"))


def run_of(
    scan: str, seed: int = 1, period_s: float = 62.0, circular: bool = False, finer: int = 1
) -> config.RunConfig:
    """Return a run: one channel, two halves of a year of a packaged scan, decimated, on a map as fine as is wanted."""
    period_s = 34.6 if scan == "planck" and period_s > 34.6 else period_s  # no holes
    beam: dict[str, Any] = {"kind": "gaussian", "fwhm_arcmin": 200.0 / finer}
    if not circular:
        beam = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 220.0 / finer, "fwhm_minor_arcmin": 180.0 / finer}
        beam |= {"angle_deg": 20.0, "m_max": 4}
    line = {"line_of_sight": "A"} if scan == "wmap" else {}
    channel = {"name": "T", "frequency_ghz": 94.0, "beam": beam}
    channel["scan"] = {"kind": "hit_averaged", "model": scan, "sample_period_s": period_s / finer} | line
    return config.load(
        {
            "schema": 1, "name": scan, "sky": {"spectrum": "wmap7", "lmax": finer * LMAX}, "ensemble": {"seed": seed},
            "map": {"nside": finer * NSIDE, "splits": ["half1", "half2"]}, "channel": [channel],
        }
    )  # fmt: skip


def simulated(name: str, given: Inputs, **arguments: Any) -> Maps:
    """Return the maps of a simulator."""
    return importlib.import_module(name).simulate(given, **arguments)


def with_beam(given: Inputs, change: Callable[[np.ndarray], np.ndarray]) -> Inputs:
    """Return inputs whose beams have other coefficients."""
    beams = [replace(c.beam, blm=change(c.beam.blm)) for c in given.channels]
    return replace(given, channels=tuple(replace(c, beam=b) for c, b in zip(given.channels, beams, strict=True)))


def with_sky(given: Inputs, factor: np.ndarray) -> Inputs:
    """Return inputs whose sky is multiplied by a window."""
    return replace(given, sky=healpy.almxfl(given.sky, factor))


def turned_about_pole(given: Inputs, degrees: float) -> Inputs:
    """Return inputs whose sky is turned about the z axis."""
    m = healpy.Alm.getlm(given.lmax)[1]
    return replace(given, sky=given.sky * np.exp(-1j * m * np.deg2rad(degrees)))


def backwards(given: Inputs) -> Inputs:
    """Return inputs whose instruments spin the other way round."""
    models = [replace(c.model, spin_period_s=-c.model.spin_period_s) for c in given.channels]
    return replace(given, channels=tuple(replace(c, model=m) for c, m in zip(given.channels, models, strict=True)))


def each(maps: Maps, change: Callable[[np.ndarray], np.ndarray]) -> Maps:
    """Return maps with a change where they are observed."""
    return {name: np.where(m == healpy.UNSEEN, m, change(m)) for name, m in maps.items()}


def with_dipole(maps: Maps, uk: float) -> Maps:
    """Return maps with a dipole along the x axis."""
    x = uk * np.array(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))[0]
    return each(maps, lambda m: m + x)


def exchanged(maps: Maps) -> Maps:
    """Return maps with the halves' names exchanged."""
    return dict(zip(maps, reversed(list(maps.values())), strict=True))


@dataclass(frozen=True)
class Case:
    """What is put in: into which simulator, what, which names are right, and how side B is made from the inputs."""

    simulator: str
    what: str
    names: tuple[str, ...]
    make: Callable[[Inputs], Maps]
    scan: str = "wmap"
    period_s: float = 62.0
    circular: bool = False


def singles() -> Iterator[Case]:
    """Yield the cases of one difference."""
    L, T, H = "litebird", "totalconvolve", "healpy_pipeline"
    window = pixel_window(NSIDE, LMAX)

    def made(name: str, **arguments: Any) -> Callable[[Inputs], Maps]:
        return lambda given: simulated(name, given, **arguments)

    for angle in (90.0, 1.0):
        yield Case(L, f"instrument turned by {angle:g} deg", ("psi_offset",), made(L, turned_deg=angle), "litebird")
    yield Case(T, "psi of the other sign", ("psi_sign",), made(T, turned=lambda psi: -psi), "planck")
    yield Case(L, "conjugate b_lm", ("beam_conjugated",), lambda i: simulated(L, with_beam(i, np.conj)))
    for angle in (30.0, 3.0):
        turn = np.exp(-1j * np.arange(5) * np.deg2rad(angle))[:, None]
        yield Case(
            L, f"beam turned by {angle:g} deg", ("psi_offset",),
            lambda i, turn=turn: simulated(L, with_beam(i, lambda blm: blm * turn)),
        )  # fmt: skip
    yield Case(
        L, "Galactic for ecliptic sky", ("frame_rotated",),
        lambda i: simulated(L, replace(i, sky=rotate_alm(i.sky, i.lmax, "galactic", "ecliptic"))),
    )  # fmt: skip
    for angle in (1.0, 0.05):
        yield Case(
            L, f"longitudes {angle:g} deg off", ("frame_rotated",),
            lambda i, angle=angle: simulated(L, turned_about_pole(i, angle)),
        )  # fmt: skip
    for shift in (1.0, -0.25):
        yield Case(T, f"time stamps {shift:g} samples off", ("time_shift",), made(T, shift=shift), "litebird", 10.06)
    yield Case(
        H, "alm2map(pixwin=True)", ("pixel_window",), made(H, window=True), circular=True
    )  # fmt: skip
    yield Case(
        L, "pixel window divided out", ("pixel_window",), lambda i: simulated(L, with_sky(i, 1.0 / window))
    )  # fmt: skip
    for size in (1.01, 1.0002):
        yield Case(
            L, f"beam times {size:g}", ("calibration",),
            lambda i, size=size: simulated(L, with_beam(i, lambda blm: size * blm)),
        )  # fmt: skip
    for lmax in (40, 65):
        yield Case(
            L, f"lmax {lmax}", ("lmax_cut",),
            lambda i, lmax=lmax: simulated(L, with_sky(i, np.arange(LMAX + 1) <= lmax)),
        )  # fmt: skip
    for mmax in (0, 2):
        yield Case(L, f"BeamConvolutionParameters(mmax={mmax})", ("mmax_cut",), made(L, mmax=mmax), "planck")
    yield Case(L, f"nside_centering={NSIDE}", ("pixel_centres",), made(L, nside_centering=NSIDE))
    yield Case(H, "NESTED pixels", ("ordering",), made(H, nest=True), circular=True)
    yield Case(L, "sky in K", ("unit",), lambda i: simulated(L, with_sky(i, np.full(LMAX + 1, 1e-6))))
    for size in (3300.0, 1.0):
        yield Case(
            L, f"dipole of {size:g} uK", ("dipole",), lambda i, size=size: with_dipole(simulated(L, i), size), "planck"
        )  # fmt: skip
    yield Case(L, "spin of the other sign", ("spin_sign",), lambda i: simulated(L, backwards(i)), "litebird")
    yield Case(L, "halves exchanged", ("split_exchanged",), lambda i: exchanged(simulated(L, i)))
    yield Case(
        H, "sky smoothed already", ("beam_window",), lambda i: simulated(H, with_sky(i, i.channels[0].beam.window)),
        circular=True,
    )  # fmt: skip
    for size in (5.0, 0.2):
        yield Case(
            L, f"mean of {size:g} uK", ("monopole",), lambda i, size=size: each(simulated(L, i), lambda m: m + size)
        )  # fmt: skip
    for tilt in (0.1, 0.01):
        yield Case(T, f"boresight {tilt:g} deg off", ("pointing_offset",), made(T, displaced_deg=tilt))
    yield Case(L, "its own precision (1e-5, single)", (), made(L, single_precision=True, epsilon=1e-5), "planck")
    yield Case(H, "nearest pixel of nside 256", ("interpolation",), made(H, finer=8, interpolated=False), circular=True)
    width = np.arange(LMAX + 1) * np.arange(1, LMAX + 2) * np.deg2rad(8.0 / 60.0) ** 2 / (16.0 * np.log(2.0))
    yield Case(
        T, "sky divided by a beam of 8 arcmin", ("beam_width",), lambda i: simulated(T, with_sky(i, np.exp(width)))
    )  # fmt: skip
    S = "toast3"
    yield Case(S, "SimTotalconvolve(calibrate=False)", ("calibration",), made(S, calibrate=False))
    yield Case(S, "SimTotalconvolve(fwhm=8 arcmin)", ("beam_width",), made(S, fwhm_arcmin=8.0))
    yield Case(S, "PixelsHealpix(nest=True)", ("ordering",), made(S, nest=True), "litebird")
    for angle in (180.0, 45.0):
        names = ("psi_offset",) if angle < 180.0 else ()
        yield Case(S, f"detector turned by {angle:g} deg", names, made(S, turned_deg=angle), "planck")
    yield Case(H, "a beam without its shape", ("mmax_cut",), made(H))
    yield Case(
        T, "signal with its square, 1e-4/uK", ("unknown",), lambda i: each(simulated(T, i), lambda m: m + 1e-4 * m**2)
    )  # fmt: skip


def pairs() -> Iterator[Case]:
    """Yield the cases of two differences at once."""
    L, H = "litebird", "healpy_pipeline"
    yield Case(
        L, "psi 90 deg, beam times 1.01", ("calibration", "psi_offset"),
        lambda i: simulated(L, with_beam(i, lambda blm: 1.01 * blm), turned_deg=90.0),
    )  # fmt: skip
    yield Case(
        L, "longitudes 1 deg off, dipole of 10 uK", ("dipole", "frame_rotated"),
        lambda i: with_dipole(simulated(L, turned_about_pole(i, 1.0)), 10.0),
    )  # fmt: skip
    yield Case(
        L, "mmax 0, mean of 1 uK", ("mmax_cut", "monopole"),
        lambda i: each(simulated(L, i, mmax=0), lambda m: m + 1.0), "planck",
    )  # fmt: skip
    yield Case(
        L, "pixel centres, psi 90 deg", ("pixel_centres", "psi_offset"),
        lambda i: simulated(L, i, nside_centering=NSIDE, turned_deg=90.0), "litebird",
    )  # fmt: skip
    yield Case(
        H, "pixwin=True, smoothed map 0.5 % too low", ("calibration", "pixel_window"),
        lambda i: simulated(H, with_sky(i, np.full(LMAX + 1, 0.995)), window=True), circular=True,
    )  # fmt: skip
    yield Case(
        L, "lmax 40, halves exchanged", ("lmax_cut", "split_exchanged"),
        lambda i: exchanged(simulated(L, with_sky(i, np.arange(LMAX + 1) <= 40))),
    )  # fmt: skip


def compared(run: config.RunConfig, a: Maps, b: Maps) -> tuple[ComparisonResult, float]:
    """Return what ``mcsim compare`` says, and its processor seconds."""
    start = time.process_time()
    found = mcsim.compare(list(a.values()), list(b.values()), run)
    return found, time.process_time() - start


def judged(case: Case, seed: int) -> tuple[str, str]:
    """Return whether the answer is right, and a row of the table."""
    run = run_of(case.scan, seed, case.period_s, case.circular)
    given = inputs.of(run)
    found, seconds = compared(run, totalconvolve.simulate(given), case.make(given))
    (channel,) = found.channels
    sets = [channel.differences, *channel.alternatives]
    wanted = ("unknown",) if case.names == ("unknown",) else tuple(sorted(case.names))
    answers = [tuple(sorted(d.name for d in one)) for one in sets]
    first = (found.verdict,) if found.verdict == "unknown" else answers[0]
    right = "yes" if first == wanted else "among equals" if wanted in answers[1:] else "**no**"
    said = " + ".join(f"{d.name} {d.amplitude:.5g}" for d in channel.differences) or found.verdict
    if channel.nearest and not channel.differences:
        near = " and ".join(f"{d.name} {d.amplitude:.3g}" for d in channel.nearest)
        said += f" (nearest {near}: {channel.nearest_explains:.0%})"
    others = ", ".join("+".join(d.name for d in one) for one in channel.alternatives)
    return right, (
        f"| {case.scan} | {case.simulator} | {case.what} | {channel.accuracy:.1e} | {said} | "
        f"{100 * (1 - channel.left):.2f} | {others} | {right} | {seconds:.0f} |"
    )


@lru_cache(maxsize=3)
def with_nothing_wrong(name: str, scan: str, seed: int, circular: bool) -> Maps:
    """Return the maps of a simulator, or of mcsim sample by sample."""
    run = run_of(scan, seed, circular=circular, finer=2)
    return dict(sampled.maps(survey(run), 0)) if name == "mcsim" else simulated(name, inputs.of(run))


def identical(scan: str, sides: tuple[str, str], seed: int) -> tuple[str, str]:
    """Return the verdict on a pair with nothing wrong, and a row: what it differs by, and what is said."""
    circular = "healpy_pipeline" in sides
    a, b = (with_nothing_wrong(name, scan, seed, circular) for name in sides)
    found, seconds = compared(run_of(scan, seed, circular=circular, finer=2), a, b)
    return (
        found.verdict,
        f"| {scan} | {' | '.join(sides)} | {seed} | {found.accuracy:.1e} | {found.verdict} | {seconds:.0f} |",
    )


def installed(name: str) -> bool:
    """Tell whether a simulator can be imported."""
    if name == "mcsim":
        return True
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", default=["identical", "single", "pair"])
    parser.add_argument("--skies", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1, help="of the first sky")
    parser.add_argument("--only", default="", help="regular expression of the rows to make")
    parser.add_argument("-o", "--output", type=Path, help="file of the rows; those that it holds are not made again")
    given = parser.parse_args()
    rows, counts = Rows(given.output), Counter[str]()
    if "identical" in given.tables:
        print("| scan | side A | side B | sky | rms over the sky's | verdict | CPU s |\n|---|---|---|---|---|---|---|")
    for sky, scan, sides in product(range(given.skies), ("wmap", "planck", "litebird"), PAIRS):
        if "identical" in given.tables and all(map(installed, sides)) and re.search(given.only, f"{scan} {sides}"):
            seed = given.seed + sky
            counts[rows.made(f"{scan} {sides} {seed}", partial(identical, scan, sides, seed))] += 1
    print("\n| scan | side B | put in | rms / sky | named | explains % | as good | right | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for table, cases in (("single", singles), ("pair", pairs)):
        for case in cases() if table in given.tables else ():
            if installed(case.simulator) and re.search(given.only, case.what):
                key = f"{case.scan} {case.simulator} {case.what} {given.seed}"
                counts[rows.made(key, partial(judged, case, given.seed))] += 1
    print(dict(counts))


if __name__ == "__main__":
    main()
