"""Inject every difference that ``mcsim compare`` names into maps made by ducc0 and healpy, and count what it says.

    python workflows/simulators/injected.py [single|pair|identical ...] [--only REGEX] [--pairs 20] [--seed 1]
        [-o ROWS]

Side B, and side A but of identical pairs, is made by stranger.py. Small surveys (nside 32, lmax 64), so that many fit.
"""

import argparse
import random
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import healpy
import inputs
import numpy as np
from rows import Rows
from stranger import ELL, LMAX, NPIX, NSIDE, SCANS, Survey, Vector, run_of

import mcsim
from mcsim import config
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey
from mcsim.sphere.healpix import pixel_window
from mcsim.sphere.rotation import rotate_alm

NOISE_UK = 60.0
"""Noise of a sample, where it is shared."""


def turned(sky: Vector, degrees: float) -> Vector:
    """Return a sky turned about the z axis."""
    return sky * np.exp(-1j * healpy.Alm.getlm(LMAX)[1] * np.deg2rad(degrees))


def changes(given: inputs.Inputs, scan: str) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """Return the arguments of two sizes of every difference, by the name that is right."""
    window, beam = pixel_window(NSIDE, LMAX), given.channels[0].beam.window[: LMAX + 1]
    x, late = np.array(healpy.pix2vec(NSIDE, np.arange(NPIX))), 0.01 if scan == "litebird" else 0.0005
    theta, phi = healpy.pix2ang(NSIDE, np.arange(NPIX))
    mirrored = np.pi - theta, phi
    names = [name for c in given.channels for name, _ in inputs.parts(given, c)]

    def filtered(factor: Vector) -> dict[str, Any]:
        return {"sky": lambda sky: healpy.almxfl(sky, factor)}

    def mapped(change: Callable[[Vector], Vector]) -> dict[str, Any]:
        return {"after": lambda m: np.where(m == healpy.UNSEEN, m, change(m))}

    def widened(factor: float) -> dict[str, Any]:
        sigma = np.deg2rad(1.0) * 179.0 / 60.0 / np.sqrt(8.0 * np.log(2.0))
        return filtered(np.exp(-0.5 * ELL * (ELL + 1) * sigma**2 * (factor**2 - 1.0)))

    def noise(share: float) -> dict[str, Any]:
        draw = np.random.default_rng(5)
        own = {name: NOISE_UK * draw.standard_normal(NPIX) for name in names}
        first = dict.fromkeys(names, own[names[0]])
        return {"noise": {n: (1.0 - share) * own[n] + share * first[n] for n in names}}

    return {
        "psi_offset": ({"psi": lambda p: p + 0.8}, {"psi": lambda p: p + 0.03}),
        "psi_sign": ({"psi": lambda p: -p},) * 2,
        "beam_conjugated": ({"beam": lambda b: b.blm.conj()},) * 2,
        "mmax_cut": ({"beam": lambda b: b.blm[:1]}, {"beam": lambda b: b.blm[:3]}),
        "lmax_cut": (filtered(ELL <= 40), filtered(ELL <= 57)),
        "beam_window": (filtered(beam), filtered(1.0 / beam)),
        "pixel_window": (filtered(window), filtered(1.0 / window)),
        "pixel_centres": ({"centred": True},) * 2,
        "time_shift": ({"late": 10.0 * late}, {"late": -late}),
        "spin_sign": ({"motion": {"spin_period_s": -1.0}},) * 2,
        "precession_sign": ({"motion": {"precession_period_s": -1.0}},) * 2,
        "frame_rotated": (
            {"sky": lambda sky: rotate_alm(sky, LMAX, "galactic", "ecliptic")},
            {"sky": lambda sky: turned(sky, 0.1)},
        ),
        "frame_reversed": ({"sky": np.conj}, mapped(lambda m: m[healpy.ang2pix(NSIDE, *mirrored)])),
        "calibration": (filtered(np.full(LMAX + 1, 1.02)), filtered(np.full(LMAX + 1, 0.9996))),
        "unit": (mapped(lambda m: 1e-6 * m), mapped(lambda m: m / 1.2505)),
        "monopole": (mapped(lambda m: m + 5.0), mapped(lambda m: m - 0.3)),
        "dipole": (mapped(lambda m: m + 3300.0 * x[0]), mapped(lambda m: m + 0.6 * x[1] - 0.3 * x[2])),
        "ordering": tuple({"after": lambda m, to=to: healpy.reorder(m, **{to: True})} for to in ("r2n", "n2r")),
        "split_exchanged": ({"exchange": "split"},) * 2,
        "channel_exchanged": ({"exchange": "channel"},) * 2,
        "noise_shared": (noise(1.0) | {"base": noise(0.0)}, noise(0.4) | {"base": noise(0.0)}),
        "map_making": (
            {"drift_uk": 200.0, "baseline": 256, "base": {"drift_uk": 200.0}},
            {"drift_uk": 20.0, "baseline": 60, "base": {"drift_uk": 20.0}},
        ),
        "interpolation": ({"grid": (NSIDE, True)}, {"grid": (4 * NSIDE, False)}),
        "pointing_offset": ({"tilt_deg": 0.2}, {"tilt_deg": 0.02}),
        "beam_width": (widened(1.05), widened(0.995)),
        "gain_drift": ({"gain": lambda t: 0.02 * np.sin(t)}, {"gain": lambda t: 0.002 * np.cos(t + 0.5)}),
        "unknown": (
            mapped(lambda m: m + 1e-3 * m**2 / 10.0),
            mapped(lambda m: m + 2.0 * np.exp(-((x[0] - 0.8) ** 2 + (x[1] - 0.6) ** 2 + x[2] ** 2) / 0.05)),
        ),
    }  # fmt: skip


SHARE = ACCURACY = 1e-3
"""Of two changes each must add this to the variance of the difference, and to its rms over the sky's."""

TIMED = frozenset({"time_shift", "spin_sign", "precession_sign", "gain_drift", "pointing_offset", "map_making"})
"""What needs more than samples without their time."""


Prepared = tuple[config.RunConfig, dict[str, Any], list[dict[str, Any]]]


def untimed(scan: str, shape: str, names: tuple[str, ...]) -> tuple[str, str]:
    """Return scan and beam, without files of samples where the time of samples matters."""
    return scan, "ellipse" if "file" in shape and TIMED.intersection(names) else shape


def sides(run: config.RunConfig, put: list[dict[str, Any]]) -> tuple[dict[str, Vector], dict[str, Vector]]:
    """Return the maps of both sides, with changes put in on side B."""
    given = inputs.of(run)
    change = {key: value for one in put for key, value in one.items()}
    base, exchange = change.pop("base", {}), change.pop("exchange", None)
    for key in ("sky", "after"):
        both = [one[key] for one in put if key in one]
        if len(both) > 1:
            change[key] = lambda values, both=both: both[1](both[0](values))
    a, b = (replace(Survey(given), **one).maps() for one in (base, base | change))
    if exchange:
        names = list(b)
        order = names[1::-1] + names[2:] if exchange == "split" else names[2:] + names[:2]
        b = dict(zip(names, (b[name] for name in order), strict=True))
    return a, b


def prepared(scan: str, shape: str, names: tuple[str, ...], sizes: tuple[int, ...], seed: int) -> Prepared:
    """Return the run of a case, the noise of both sides, and the changes of side B."""
    channels = ("T", "U") if "channel_exchanged" in names else ("T",)
    run = run_of(scan, "circular" if "interpolation" in names else shape, channels, seed)
    if "noise_shared" in names:
        run = replace(run, channels=tuple(replace(c, noise=config.Noise(sigma0_uk=NOISE_UK)) for c in run.channels))
    table = changes(inputs.of(run), scan)
    noise = {"base": table["noise_shared"][0]["base"] if shape == "ellipse noisy" else {}}
    return run, noise, [table[name][size] for name, size in zip(names, sizes, strict=True)]


def matters(scan: str, shape: str, names: tuple[str, ...], sizes: tuple[int, ...], seed: int) -> bool:
    """Return True if each of two changes adds a per mille of the variance to the other, and of the sky's rms."""
    run, noise, put = prepared(scan, shape, names, sizes, seed)
    a, b = sides(run, [noise, *put])
    seen = {name: (a[name] != healpy.UNSEEN) & (b[name] != healpy.UNSEEN) for name in a}

    def rms(one: dict[str, Vector], other: dict[str, Vector]) -> float:
        return float(
            np.std(np.concatenate([(one[n] - other[n])[s & (other[n] != healpy.UNSEEN)] for n, s in seen.items()]))
        )

    added = [rms(b, sides(run, [noise, one])[1]) for one in put]
    sky = rms(a, {name: 0.0 * map_ for name, map_ in a.items()})
    return min(added) > max(SHARE**0.5 * rms(a, b), ACCURACY * sky)


def in_files(run: config.RunConfig, folder: str) -> config.RunConfig:
    """Return a run that knows the samples of its first channel from files alone, in a random order."""
    given, [spec, *others] = inputs.of(run), run.channels
    for name, samples in inputs.parts(given, given.channels[0]):
        angles = np.stack(inputs.pointing(given.channels[0], samples, given.frame), axis=1)
        np.save(f"{folder}/{name}.npy", np.random.default_rng(1).permutation(angles))
    scan = config.ScanPointing(path=f"{folder}/{spec.name}_{{split}}.npy")
    return replace(run, channels=(replace(spec, scan=scan), *others))


def judged(scan: str, shape: str, names: tuple[str, ...], sizes: tuple[int, ...], seed: int = 1) -> tuple[str, str]:
    """Return whether the answer is right, and a row of the table."""
    run, noise, put = prepared(scan, shape, names, sizes, seed)
    a, b = sides(run, [noise, *put])
    if not names:
        a = dict(sampled.maps(survey(run), 0))
        if shape == "circular":
            b = Survey(inputs.of(run), grid=(32 * NSIDE, True)).maps()
    with tempfile.TemporaryDirectory() as folder:
        model = in_files(run, folder) if shape == "ellipse file" else run
        start = time.process_time()
        found = mcsim.compare(list(a.values()), list(b.values()), model)
    seconds, channel = time.process_time() - start, found.channels[0]
    answers = [{d.name for d in one} for one in (channel.differences, *channel.alternatives)]
    wanted = {name for name in names if name != "unknown"}
    if channel.verdict in ("unknown", "identical") and not ("unknown" in names or not names):
        right = channel.verdict
    elif channel.verdict in ("unknown", "identical"):
        right = "yes"
    else:
        right = "yes" if answers[0] == wanted else "among equals" if wanted in answers else "wrong"
    said = " + ".join(f"{d.name} {d.amplitude:.4g}" for d in channel.differences) or found.verdict
    if channel.nearest and not channel.differences:
        said += f" (nearest {' and '.join(d.name for d in channel.nearest)}: {channel.nearest_explains:.0%})"
    others = ", ".join("+".join(sorted(one)) for one in answers[1:])
    what = " + ".join(f"{name}/{size}" for name, size in zip(names, sizes, strict=True))
    return right, (
        f"| {scan} {shape} | {what} | {channel.accuracy:.1e} | {said} | {100 * (1 - channel.left):.2f} | {others} | "
        f"{right} | {seconds:.0f} |"
    )


def cases(tables: list[str], pairs: int, seed: int) -> Iterator[tuple[str, str, tuple[str, ...], tuple[int, ...]]]:
    """Yield scan, beam, names and sizes."""
    draw = random.Random(seed)
    names = list(changes(inputs.of(run_of("wmap", "ellipse")), "wmap"))
    kinds = [(scan, shape) for scan in SCANS for shape in ("ellipse", "pear", "ellipse file", "ellipse noisy")]
    for number, name in enumerate(names if "single" in tables else []):
        for size in (0, 1):
            yield (*kinds[(2 * number + size + seed) % len(kinds)], (name,), (size,))
    alone = ("unknown", "unit", "noise_shared", "channel_exchanged", "map_making", "interpolation")
    drawn = 0
    while drawn < (pairs if "pair" in tables else 0):
        both = tuple(draw.sample([name for name in names if name not in alone], 2))
        case = (*untimed(*draw.choice(kinds), both), both, (draw.randrange(2), draw.randrange(2)))
        if matters(*case, seed=seed + drawn):
            drawn += 1
            yield case
    for number in range(pairs if "identical" in tables else 0):
        yield list(SCANS)[number % 3], ("ellipse", "pear", "circular")[number // 3 % 3], (), ()


def main() -> None:
    """Print the table and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", default=["single"])
    parser.add_argument("--only", default="")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="file of the rows; those that it holds are not made again")
    given = parser.parse_args()
    counts: Counter[str] = Counter()
    rows = Rows(given.output)
    for number, case in enumerate(cases(given.tables, given.pairs, given.seed)):
        case = (*untimed(*case[:3]), *case[2:])
        if re.search(given.only, " ".join(case[2])):
            seed = given.seed + number
            counts[rows.made(f"{case} {seed}", lambda case=case, seed=seed: judged(*case, seed=seed))] += 1
    print(dict(counts))


if __name__ == "__main__":
    main()
