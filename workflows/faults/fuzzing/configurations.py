"""Configurations that were valid before one to four things in them were changed."""

import contextlib
import copy
import io
import math
import random
import shutil
import string
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcsim import cli
from mcsim.errors import InputError

from .damage import damaged_bytes
from .judge import Outcome, judge
from .samples import TOML, base, use, write_files


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


def command(*words: str) -> None:
    """Run the command line in this process; what it says on standard error is raised as the error that it was."""
    said, argv = io.StringIO(), sys.argv
    sys.argv = ["mcsim", *words]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
            cli.main()
    except SystemExit as end:
        if end.code == 2:
            raise InputError(said.getvalue().removesuffix("\n")) from None
        if end.code:
            raise AssertionError(f"exit code {end.code}: {said.getvalue()}") from None
    finally:
        sys.argv = argv


def read_and_use(path: Path, folder: Path) -> None:
    """``mcsim config`` on a file, then all that a run does with it."""
    command("config", str(path))
    use(path, folder, 0)


def fuzz(count: int, seed: int, seconds: float, folder: Path) -> Outcome:
    """Mutated configurations, as tables and as text of TOML files; these go through the command line, too."""
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
            judge(f"toml {number}", lambda path=path: read_and_use(path, folder), outcome)
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
