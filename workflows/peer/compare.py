"""A realization of the same sky, beam and scan by litebird_sim and by mcsim: what it costs, and whether the maps agree.

    python workflows/peer/compare.py [--repeats 3]

Needs an environment with both (pip install . "litebird_sim==0.18.*"). One horn, one WMAP-like year at 51.2 ms,
nside 256, lmax 512. litebird_sim computes pointings and the convolved signal of ten days in single precision, its
default; seconds per sample are scaled to the year, seconds per observation to twelve observations. Its own map-maker
solves for Q and U and would take the m = 2 signal out of I, so samples are binned here, by ducc0 and numpy. Every
number of threads is measured in a process of its own; one thread in processor seconds, two in wall-clock seconds.
"""

import argparse
import json
import logging
import os
import platform
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version

import ducc0
import healpy
import litebird_sim as lbs
import numpy as np

from mcsim.instrument import scan
from mcsim.instrument.beams import Beam
from mcsim.simulation import convolve
from mcsim.sphere import healpix, sky, spectra

NSIDE, LMAX, M_MAX = 256, 512, 2
FWHM_ARCMIN = (32.3, 29.4)
DAY_S = 86400.0
COST_DAYS = (0.01, 10.0)
OBSERVATIONS_PER_YEAR = 12
AGREE_DAYS = 8.0
MOMENTS_PART = 0.1
"""Share of the year that the moments are timed on."""

Clock = Callable[[], float]

# litebird_sim's angles at t = 0 in terms of mcsim's: its precession starts half a turn later, and so does its spin.
MODEL = replace(
    scan.ScanModel.load("wmap"),
    spin_phase_deg=180.0,
    precession_phase_deg=180.0,
    duration_days=365.25,
)
BORESIGHT_DEG = MODEL.line_of_sight("A").boresight_angle_deg


def horn_sky() -> tuple[np.ndarray, Beam]:
    """The sky's a_lm in uK, and the beam."""
    alm = sky.gaussian_alm(spectra.load("planck2018", LMAX), np.random.default_rng(1))
    return alm, Beam.elliptical(*FWHM_ARCMIN, lmax=LMAX, mmax=M_MAX)


def observation(days: float, quaternion_step_s: float, dtype: type) -> lbs.Simulation:
    """One horn of litebird_sim on MODEL's scan, ready to point."""
    run = lbs.Simulation(
        start_time=0.0,
        duration_s=days * DAY_S,
        random_seed=1,
        profile_time=False,
        imo=lbs.Imo(flatfile_location=lbs.PTEP_IMO_LOCATION),
    )
    run.set_scanning_strategy(
        lbs.SpinningScanningStrategy(
            np.deg2rad(MODEL.precession_angle_deg), 1.0 / MODEL.precession_period_s, 1.0 / MODEL.spin_period_s, 0.0
        ),
        delta_time_s=quaternion_step_s,
        append_to_report=False,
    )
    run.set_instrument(lbs.InstrumentInfo("one horn", spin_boresight_angle_rad=np.deg2rad(BORESIGHT_DEG)))
    run.create_observations(
        lbs.DetectorInfo("horn", sampling_rate_hz=1.0 / MODEL.sample_period_s),
        tods=[lbs.TodDescription("tod", lbs.Units.K_CMB, dtype, "signal")],
    )
    run.prepare_pointings(append_to_report=False)
    return run


def harmonics(alm: np.ndarray, beam: Beam, turn: float) -> dict[str, lbs.SphericalHarmonics]:
    """Sky and beam (turned by ``turn`` about its axis, from x towards y) as litebird_sim takes them."""
    turned = beam.blm * np.exp(-1j * turn * np.arange(M_MAX + 1))[:, None]
    packed = np.concatenate([turned[m, m:] for m in range(M_MAX + 1)])
    frame = lbs.CoordinateSystem.Ecliptic
    return {
        "sky_alms": lbs.SphericalHarmonics(alm[None], LMAX, LMAX, coordinates=frame),
        "beam_alms": lbs.SphericalHarmonics(packed[None], LMAX, M_MAX, coordinates=frame),
    }


def their_map(
    days: float,
    inputs: dict,
    single: bool,
    epsilon: float,
    threads: int,
    step_s: float = 2.0,
    centred: bool = False,
    clock: Clock = time.perf_counter,
) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Binned map, hits, and seconds of pointing, convolution and binning."""
    dtype = np.float32 if single else np.float64
    seconds, start = {}, clock()
    run = observation(days, step_s, dtype)
    seen = run.observations[0]
    seen.precompute_pointings(pointings_dtype=dtype)
    seconds["pointing"], start = clock() - start, clock()
    run.convolve_sky(
        **inputs,
        convolution_params=lbs.BeamConvolutionParameters(LMAX, M_MAX, single_precision=single, epsilon=epsilon),
        pointings_dtype=dtype,
        nside_centering=NSIDE if centred else None,
        append_to_report=False,
        nthreads=threads,
    )
    seconds["convolution"], start = clock() - start, clock()
    angles = seen.pointing_matrix[0, :, :2]
    pixel = ducc0.healpix.Healpix_Base(NSIDE, "RING").ang2pix(angles.astype(np.float64, copy=False), nthreads=threads)
    npix = 12 * NSIDE**2
    hits = np.bincount(pixel, minlength=npix).astype(float)
    total = np.bincount(pixel, weights=seen.tod[0], minlength=npix)
    map_uk = np.divide(total, hits, out=np.zeros(npix), where=hits > 0)
    seconds["binning"] = clock() - start
    return map_uk, hits, seconds | {"samples": float(seen.tod.shape[1])}


def our_map(alm: np.ndarray, response: convolve.Response, moments: scan.Moments, threads: int) -> np.ndarray:
    """The same map from spin transforms and orientation moments, with the centroid term where the moments have one."""
    spins = convolve.spin_maps(alm, response, NSIDE, threads)
    map_uk = convolve.circular_map(alm, response, NSIDE, threads) + convolve.noncircular_map(spins, moments)
    if moments.dtheta is None:
        return map_uk
    gradient = healpix.gradient(convolve.circular_alm(alm, response), NSIDE, LMAX, threads)
    return map_uk + convolve.centroid_map(gradient, moments)


def cost(repeats: int, threads: int) -> dict[str, list[float]]:
    """Seconds of every part, once for each repeat; those of the year are scaled."""
    # Processor time is what an idle machine's clock would show, whoever else is at work; but it adds up threads.
    clock = time.process_time if threads == 1 else time.perf_counter

    def seconds_of(action: Callable[[], object]) -> float:
        start = clock()
        action()
        return clock() - start

    alm, beam = horn_sky()
    inputs = harmonics(alm, beam, np.pi)
    samples = MODEL.samples(MODEL.line_of_sight("A"))
    part = scan.Moments.from_model(
        MODEL.with_lines_of_sight("A"), NSIDE, M_MAX, time_range=(0.0, 0.02), nthreads=threads
    )
    response = convolve.response(beam, LMAX, healpix.pixel_window(NSIDE, LMAX))
    bare = replace(part, dtheta=None, dphi=None)
    map_uk = our_map(alm, response, part, threads)
    # Compiled, and its memory touched, before it is timed.
    their_map(max(COST_DAYS), inputs, True, 1e-5, threads)
    healpix.analysis(map_uk, LMAX, nthreads=threads)
    found: dict[str, list[float]] = {}
    for _ in range(repeats):
        row: dict[str, float] = {}
        low, high = (their_map(days, inputs, True, 1e-5, threads, clock=clock)[2] for days in COST_DAYS)
        for stage in ("pointing", "convolution", "binning"):
            each = (high[stage] - low[stage]) / (high["samples"] - low["samples"])
            # A convolution sets up its interpolator once for every observation; the rest has no cost to speak of.
            fixed = OBSERVATIONS_PER_YEAR * low[stage] if stage == "convolution" else 0.0
            row[f"litebird_sim: {stage}"] = each * samples + fixed
        row["litebird_sim: map"] = sum(row.values())
        row["map2alm (3 iterations)"] = seconds_of(lambda: healpy.map2alm(map_uk, lmax=LMAX))
        row["map2alm (none)"] = seconds_of(lambda: healpy.map2alm(map_uk, lmax=LMAX, iter=0))
        row["mcsim: map"] = seconds_of(lambda: our_map(alm, response, part, threads))
        row["mcsim: map without centroid"] = seconds_of(lambda: our_map(alm, response, bare, threads))
        row["mcsim: analysis"] = seconds_of(lambda: healpix.analysis(map_uk, LMAX, nthreads=threads))
        row["mcsim: moments, once"] = (
            seconds_of(
                lambda: scan.Moments.from_model(
                    MODEL.with_lines_of_sight("A"), NSIDE, M_MAX, time_range=(0.0, MOMENTS_PART), nthreads=threads
                )
            )
            / MOMENTS_PART
        )
        for key, value in row.items():
            found.setdefault(key, []).append(value)
    return found


def ratios(row: dict[str, float]) -> dict[str, float]:
    """What a realization costs there over what it costs here, from one set of seconds."""
    theirs, ours, common = row["litebird_sim: map"], row["mcsim: map"], row["map2alm (3 iterations)"]
    return {
        "map": theirs / ours,
        "map, without the centroid term": theirs / row["mcsim: map without centroid"],
        "map, its pointings kept (7 GB)": (theirs - row["litebird_sim: pointing"]) / ours,
        "map and healpy.map2alm, both": (theirs + common) / (ours + common),
        "map and analysis, each its own": (theirs + common) / (ours + row["mcsim: analysis"]),
        "a single realization, with the moments": theirs / (ours + row["mcsim: moments, once"]),
    }


def agreement() -> None:
    """Print how far the two maps of some days are apart, over the effect of the beam's shape."""
    alm, beam = horn_sky()
    model = replace(MODEL, duration_days=AGREE_DAYS)
    count = 100_000
    theta, phi, psi = scan.pointing.pointing(model, model.line_of_sight("A"), 0, count)
    seen = observation(count * MODEL.sample_period_s / DAY_S, 0.25, np.float64).observations[0]
    angles = seen.get_pointings(0)[0][:count]
    vectors = [np.stack(healpy.ang2vec(a, b)) for a, b in ((theta, phi), (angles[:, 0], angles[:, 1]))]
    apart = np.linalg.norm(vectors[0] - vectors[1], axis=1)
    turn = np.angle(np.exp(1j * (psi - angles[:, 2])))
    print(
        f"pointing of {count} samples: apart by <= {np.degrees(apart.max()) * 3600:.2g} arcsec; "
        f"psi of mcsim minus psi of litebird_sim: {np.degrees(np.abs(turn)).min():.5f} to "
        f"{np.degrees(np.abs(turn)).max():.5f} degrees"
    )
    moments = scan.Moments.from_model(model.with_lines_of_sight("A"), NSIDE, M_MAX, nthreads=2)
    hit = moments.hits > 0
    points = replace(moments, dtheta=None, dphi=None)
    bare = convolve.response(beam, LMAX)
    spread = convolve.response(beam, LMAX, healpix.pixel_window(NSIDE, LMAX))
    circular = convolve.circular_map(alm, bare, NSIDE, 2)

    def rms(map_uk: np.ndarray) -> float:
        return float(np.sqrt(np.mean(map_uk[hit] ** 2)))

    effect = rms(our_map(alm, bare, points, 2) - circular)
    print(f"{AGREE_DAYS:g} days, {hit.mean():.0%} of the sky, {np.median(moments.hits[hit]):.0f} samples a pixel;")
    print(f"sky rms {rms(circular):.2f} uK, effect of the beam's shape {effect:.3f} uK")
    # The x axis of the horn's frame is radial and litebird_sim's psi counts it from east to north. To ducc0, which
    # counts from south to east, the same number means an x axis along -(spin axis x boresight): half a turn from ours.
    for centred, label in ((True, "moved to pixel centres"), (False, "where they are")):
        for turned, text in (
            (np.pi, "beam turned to litebird_sim's psi"),
            (np.pi / 2, "beam turned as if that psi were ducc0's"),
        ):
            theirs, hits, _ = their_map(
                AGREE_DAYS, harmonics(alm, beam, turned), False, 1e-9, 2, step_s=0.25, centred=centred
            )
            both = hit & (hits > 0)
            versions = {"": our_map(alm, bare, points, 2)}
            if not centred:
                versions = {
                    "no pixel terms: ": versions[""],
                    "window: ": our_map(alm, spread, points, 2),
                    "window and centroid: ": our_map(alm, spread, moments, 2),
                }
            for name, ours in versions.items():
                left = float(np.sqrt(np.mean((ours - theirs)[both] ** 2)))
                print(f"  samples {label}, {text}: {name}difference {left:.4g} uK, {left / effect:.3g} of the effect")


def main() -> None:
    """Measure in processes of their own, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--threads", type=int, help="measure the cost with as many threads, print JSON (used by itself)"
    )
    parser.add_argument("--no-agreement", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    if arguments.threads:
        print(json.dumps(cost(arguments.repeats, arguments.threads)))
        return
    names = ("mcsim", "litebird_sim", "ducc0", "healpy", "numpy", "numba")
    print(f"Python {platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in names))
    print(f"nside {NSIDE}, lmax {LMAX}, m_max {M_MAX}; seconds, smallest and median of {arguments.repeats}")
    for threads in (1, 2):
        limits = {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
        command = [sys.executable, __file__, "--threads", str(threads), "--repeats", str(arguments.repeats)]
        measured = subprocess.run(command, env=os.environ | limits, capture_output=True, text=True, check=True)
        print(f"{threads} thread{'s' if threads > 1 else ''}:")
        seconds = json.loads(measured.stdout.splitlines()[-1])
        table = [{key: float(statistic(values)) for key, values in seconds.items()} for statistic in (min, np.median)]
        for key, smallest in table[0].items():
            print(f"  {key:50s} {smallest:10.4g} {table[1][key]:10.4g}")
        for key, of_smallest in ratios(table[0]).items():
            print(f"  ratio, {key:43s} {of_smallest:10.0f} {ratios(table[1])[key]:10.0f}", flush=True)
    if not arguments.no_agreement:
        agreement()


if __name__ == "__main__":
    main()
