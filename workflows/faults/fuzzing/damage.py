"""What happens to files: bytes flipped, cut, doubled; headers that lie; numbers that are none."""

import contextlib
import random
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits


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
