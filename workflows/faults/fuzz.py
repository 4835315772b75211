"""Strange configurations and damaged files: each must end in a result or in one sentence, soon, and leave nothing.

python workflows/faults/fuzz.py --configurations 2000 --files 500
"""

import argparse
import contextlib
import copy
import faulthandler
import io
import json
import math
import random
import shutil
import signal
import string
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import healpy
import numpy as np
from astropy.io import fits
from astropy.table import Table

from mcsim import beams, config, describe, fit, plan, repair, resources, scan, simulate, spectra, store
from mcsim.errors import InputError, RunError
from mcsim.survey import survey

LIMIT_S = 10.0
NSIDE, LMAX = 8, 16


class Slow(BaseException):
    """An input took longer than the limit; no ``except Exception`` swallows it."""


@dataclass
class Outcome:
    """How many inputs ended how, and what went wrong."""

    ends: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    slowest_s: float = 0.0


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise :class:`Slow` in what takes longer."""

    def late(number: int, frame: FrameType | None) -> None:
        raise Slow

    before = signal.signal(signal.SIGPROF, late)  # processor time: other work on the machine is not this input's
    faulthandler.dump_traceback_later(30.0 * seconds, exit=True)  # a call that waits, or never comes back from C
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def judge(name: str, call: Callable[[], object], outcome: Outcome) -> None:
    """Call, and note how it ends."""
    start = time.process_time()
    try:
        with limited(LIMIT_S), contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
        end = "result"
    except (InputError, RunError) as error:
        end, text = "sentence", str(error)
        if "\n" in text or not text.strip() or len(text) > 2000:
            outcome.faults.append(f"{name}: no sentence: {text[:300]!r}")
    except Slow:
        end = "slow"
        outcome.faults.append(f"{name}: took more than {LIMIT_S:g} s of the processor")
    except BaseException as error:
        end = "traceback"
        where = traceback.extract_tb(error.__traceback__)
        own = next((f"{Path(f.filename).name}:{f.lineno}" for f in reversed(where) if "/mcsim/" in f.filename), "?")
        outcome.faults.append(f"{name}: {type(error).__name__}: {str(error)[:200]} ({own})")
    outcome.ends[end] += 1
    outcome.slowest_s = max(outcome.slowest_s, time.process_time() - start)


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


def odd_value(rng: random.Random) -> Any:
    """Something that may stand anywhere."""
    return rng.choice(
        [
            lambda: rng.choice([0, 1, -1, 2, 3, 7, 2**31, 2**63, -(2**70), 10**300, True, False, None]),
            lambda: rng.choice([0.0, -0.0, 1e-320, 1e308, -1.5, 0.1, math.inf, -math.inf, math.nan, 1e-9]),
            lambda: rng.choice(
                [
                    "",
                    " ",
                    "\0",
                    "a\nb",
                    "../../x",
                    "/dev/null",
                    "/dev/zero",
                    "~",
                    "${HOME}",
                    "${NO_X}",
                    "{channel}",
                    "{0}",
                    "{realization:09999999d}",
                    "A" * 5000,
                    "wmap",
                    "wmap7",
                    "%s%n",
                    "🙂",
                    "\ud800",
                    "'; --",
                    "__import__('os')",
                    "!!python/object",
                ]
            ),
            lambda: "".join(rng.choice(string.printable) for _ in range(rng.randrange(30))),
            lambda: [odd_value(rng) for _ in range(rng.randrange(4))],
            lambda: {odd_key(rng): odd_value(rng) for _ in range(rng.randrange(4))},
            lambda: rng.choice([1.0, 2.0, 8, 16, 90.0, 180.0, -90.0]) * rng.choice([1, -1, 0.5, 1e3]),
        ]
    )()


def odd_key(rng: random.Random) -> str:
    """A key that exists somewhere, or none."""
    known = [
        "kind",
        "path",
        "lmax",
        "nside",
        "name",
        "mask",
        "beam",
        "scan",
        "model",
        "effect",
        "splits",
        "m_max",
        "alm",
        "map",
        "amplitude",
        "channel",
        "schema",
        "tolerance",
        "beam_b",
        "pair",
    ]
    return rng.choice([*known, "", "\0", "x" * 300, "unbekannt", "é"])


KINDS: list[dict[str, Any]] = [
    {"kind": "gaussian", "fwhm_arcmin": 600.0},
    {"kind": "hit_averaged", "model": "wmap"},
    {"kind": "moments", "path": "moments.fits"},
    {"kind": "pointing", "path": "pointing.txt"},
    {"kind": "differencing", "model": "template", "pair": "example"},
    {"kind": "map", "path": "beam.fits"},
    {"kind": "blm", "path": "blm.fits"},
]


def mutated(rng: random.Random) -> Any:
    """A configuration that was valid, with one to four things changed anywhere."""
    plain = base()
    for _ in range(rng.choice([1, 1, 1, 2, 3, 4])):
        holders = list(containers(plain))
        holder = rng.choice(holders)
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        action = rng.randrange(6)
        if action == 0 and keys:
            del holder[rng.choice(keys)]
        elif action == 1 and isinstance(holder, dict):
            holder[odd_key(rng)] = odd_value(rng)
        elif action == 2:
            plain["channel"] = (
                [*plain.get("channel", []), copy.deepcopy(rng.choice(base()["channel"]))]
                if isinstance(plain.get("channel", []), list)
                else odd_value(rng)
            )
        elif action == 3 and isinstance(holder, dict):
            holder[rng.choice(["beam", "scan", "beam_b"])] = copy.deepcopy(rng.choice(KINDS))
        elif action == 4 and keys:
            key = rng.choice(keys)
            value = holder[key]
            if isinstance(value, int | float) and not isinstance(value, bool):
                holder[key] = rng.choice([value + 1, value - 1, -value, value * 2, value / 3, str(value), float(value)])
            else:
                holder[key] = odd_value(rng)
        elif keys:
            holder[rng.choice(keys)] = odd_value(rng)
    return plain


def containers(value: Any) -> Iterator[Any]:
    """Every table and list of a structure."""
    if isinstance(value, dict | list):
        yield value
        for item in value.values() if isinstance(value, dict) else value:
            yield from containers(item)


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


def fuzz_configurations(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Mutated configurations, as tables and as text of TOML files."""
    outcome = Outcome()
    end = time.monotonic() + seconds
    write_files(folder)
    kept = {path.name for path in folder.iterdir()}
    for number in range(count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed}/{number}")
        if number % 4 == 3:
            path = folder / "run.toml"
            path.write_bytes(damaged_bytes(TOML.encode(), rng))
            judge(f"toml {number}", lambda path=path: use(path, folder, 0), outcome)
            path.unlink()
        else:
            plain = mutated(rng)
            judge(f"table {number}", lambda plain=plain: use(plain, folder, 0), outcome)
        left = {path.name for path in folder.iterdir()} - kept
        if left:
            outcome.faults.append(f"configuration {number} left {left}")
            for name in left:
                shutil.rmtree(folder / name, ignore_errors=True)
    return outcome


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
    scan.write_moments_fits(folder / "moments.fits", scan.parallel_transport(0.3, NSIDE, 4))
    y, x = np.mgrid[:41, :41] - 20.0
    image = fits.PrimaryHDU(np.exp(-(x**2 / 40 + y**2 / 30)))
    image.header["CDELT1"] = image.header["CDELT2"] = 0.5
    image.writeto(folder / "beam.fits", overwrite=True)
    packed = np.zeros(healpy.Alm.getsize(LMAX, LMAX), dtype=complex)
    beam = beams.elliptical_gaussian(600, 500, 0, LMAX, 4)
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
        "model.toml": lambda: scan.load_model(folder / "model.toml"),
        "data.ecsv": lambda: fit.measurement(folder / "data.ecsv", base()),
    }
    for suffix in ("txt", "npy", "npz", "fits"):
        name = f"pointing.{suffix}"
        found[name] = using(with_("scan", kind="pointing", path=name))
    return found


def damaged_bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes that something happened to."""
    changed = bytearray(data)
    size = len(data)
    action = rng.randrange(9)
    if action == 0:
        return data[: rng.randrange(size)]
    if action == 1:
        for _ in range(rng.choice([1, 3, 30])):
            changed[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif action == 2:  # headers are at the beginning
        for _ in range(rng.choice([1, 3, 10])):
            changed[rng.randrange(min(size, 5760))] ^= 1 << rng.randrange(8)
    elif action == 3:
        start = rng.randrange(size)
        changed[start : start + rng.randrange(1, 4000)] = b"\xff" * min(4000, size - start)
    elif action == 4:
        start = rng.randrange(size)
        stop = min(size, start + 2880)
        changed[start:stop] = bytes(stop - start)
    elif action == 5:
        return bytes(rng.randrange(256) for _ in range(rng.randrange(300)))
    elif action == 6:
        start = rng.randrange(size)
        del changed[start : start + rng.randrange(1, 100)]
    elif action == 7:
        start = rng.randrange(size)
        changed[start:start] = data[: rng.randrange(1, 3000)]
    else:
        digits = [place for place, byte in enumerate(changed[:20000]) if chr(byte).isdigit()]
        for _ in range(rng.choice([1, 1, 2, 4])):
            if digits:
                changed[rng.choice(digits)] = ord(rng.choice("0123456789-.e"))
    return bytes(changed)


CARDS: list[tuple[str, Any]] = [
    ("NAXIS1", 10**12),
    ("NAXIS2", 10**12),
    ("NAXIS2", -1),
    ("TFORM1", "1000000000D"),
    ("TFORM1", "8A"),
    ("TFORM1", "PD(9)"),
    ("TTYPE1", "X"),
    ("NSIDE", 7),
    ("NSIDE", 10**9),
    ("NSIDE", -8),
    ("ORDERING", "NESTED"),
    ("ORDERING", 3),
    ("COORDSYS", "Q"),
    ("BITPIX", 7),
    ("BITPIX", 8),
    ("NAXIS", 99),
    ("TFIELDS", 999),
    ("CDELT1", 0.0),
    ("CDELT1", float("1e300")),
    ("TUNIT1", "Jy"),
    ("TUNIT1", "\x7f"),
    ("TSCAL1", 1e300),
    ("TZERO1", -1e300),
    ("PCOUNT", 10**10),
    ("MAX-LPOL", 10**6),
    ("BSCALE", 0.0),
    ("XTENSION", "IMAGE"),
]


def damage(path: Path, rng: random.Random) -> None:
    """Harm a file: its bytes, a card of its header, or the type and values of its data."""
    if path.suffix == ".fits" and rng.random() < 0.5:
        data = bytearray(path.read_bytes())
        if rng.random() < 0.6:
            key, value = rng.choice(CARDS)
            text = (
                f"'{value}'"
                if isinstance(value, str)
                else f"{value:>20}"
                if not isinstance(value, float)
                else f"{value:>20E}"
            )
            place = data.rfind(f"{key:<8}=".encode())
            card = f"{key:<8}= {text}".ljust(80)[:80].encode()
            if place >= 0:
                data[place : place + 80] = card
            path.write_bytes(bytes(data))
            return
        odd = rng.choice([np.nan, np.inf, -1e300, 1e300, 0.0, -1.0])
        with contextlib.suppress(Exception), fits.open(path) as hdus:
            hdus = fits.HDUList([hdu.copy() for hdu in hdus])
            for hdu in hdus:
                if isinstance(hdu, fits.BinTableHDU):
                    name = rng.choice(hdu.columns.names)
                    column = hdu.data[name].reshape(-1)
                    column[rng.randrange(column.size)] = odd if rng.random() < 0.7 else 0
                    if rng.random() < 0.3:
                        hdu.data[name][...] = odd
                elif hdu.data is not None:
                    hdu.data[rng.randrange(41), rng.randrange(41)] = odd
                    if rng.random() < 0.3:
                        hdu.data[...] = odd
            hdus.writeto(path, overwrite=True)
        return
    path.write_bytes(damaged_bytes(path.read_bytes(), rng))


def fuzz_files(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Damaged files of every format, each read by what reads such files."""
    outcome = Outcome()
    end = time.monotonic() + seconds
    good = folder / "good"
    good.mkdir()
    write_files(good)
    calls = readers(folder)
    for path in good.iterdir():
        shutil.copy(path, folder)
    for name, call in calls.items():  # a fuzzer whose undamaged files fail proves nothing
        call()
        outcome.ends[f"whole {name.split('.')[-1]}"] += 1
    names = sorted(calls)
    for number in range(count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed}/{number}")
        name = names[number % len(names)]
        damage(folder / name, rng)
        judge(f"file {number} {name}", calls[name], outcome)
        shutil.copy(good / name, folder / name)
        if (folder / "made.zarr").exists():
            shutil.rmtree(folder / "made.zarr")
    return outcome


def make_store(path: Path) -> None:
    """A finished store of four realizations, written without a cluster."""
    run = config.load(base() | {"ensemble": {"realizations": 4, "seed": 3}})
    shared = survey(run)
    store.create(path, plan.layout(shared), plan.attributes(run))
    values = [simulate.realize(shared, r) for r in range(4)]
    rows = {name: np.stack([v[name] for v in values]) for name in values[0]}
    for r in range(4):
        store.write(path, r, {name: array[r : r + 1] for name, array in rows.items()}, np.array([True]))


def fuzz_stores(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Stores with one damaged file: described, verified, opened and repaired, or refused in a sentence."""
    outcome = Outcome()
    end = time.monotonic() + seconds
    good, path = folder / "good.zarr", folder / "store.zarr"
    make_store(good)
    run = config.load(base() | {"ensemble": {"realizations": 4, "seed": 3}})
    shared = survey(run)
    expected = store.read(good, 0, 4)
    for number in range(count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed}/{number}")
        shutil.copytree(good, path)
        file = rng.choice(sorted(p for p in path.rglob("*") if p.is_file()))
        before = file.read_bytes()
        file.write_bytes(damaged_bytes(before, rng))
        name = f"store {number} {file.relative_to(path)}"
        judge(f"{name} described", lambda: describe.describe(path), outcome)
        judge(f"{name} verified", lambda: repair.verify(path).text(), outcome)

        def mended() -> None:
            plan.check_same(path, run)
            repair.mend(path, plan.layout(shared), plan.attributes(run))
            rows = store.read(path, 0, store.size(path))
            for key, values in rows.items():
                if key != "done" and not np.array_equal(
                    values[rows["done"]], expected[key][rows["done"]], equal_nan=True
                ):
                    raise AssertionError(f"{key} is silently wrong")

        judge(f"{name} mended", mended, outcome)
        shutil.rmtree(path)
    return outcome


def main() -> int:
    """Fuzz all three; exit code 1 if something ended in neither a result nor a sentence."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--configurations", type=int, default=2000)
    parser.add_argument("--files", type=int, default=500)
    parser.add_argument("--stores", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=300.0, help="for each of the three")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, help="write the counts as JSON")
    chosen = parser.parse_args()
    found = {}
    for name, function in (("configurations", fuzz_configurations), ("files", fuzz_files), ("stores", fuzz_stores)):
        with tempfile.TemporaryDirectory(prefix="mcsim-fuzz-") as folder:
            outcome = function(getattr(chosen, name), chosen.seed, chosen.seconds, Path(folder))
        found[name] = {"ends": dict(outcome.ends), "slowest_s": round(outcome.slowest_s, 2), "faults": outcome.faults}
        print(f"{name}: {dict(outcome.ends)}, slowest {outcome.slowest_s:.1f} s, {len(outcome.faults)} faults")
        for fault in outcome.faults:
            print(f"  {fault}")
    if chosen.output:
        chosen.output.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(result["faults"] for result in found.values()))


if __name__ == "__main__":
    sys.exit(main())
