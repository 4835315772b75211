"""A small run as TOML would give it, the files that it names, and changes of it."""

import copy
from pathlib import Path

import pytest

from mcsim.systematics import registry

REMOVED = object()
DIFFERENCING = {"kind": "differencing", "model": "wmap_focal_plane", "pair": "W1"}


@pytest.fixture
def plain() -> dict:
    """A small valid run as TOML would give it."""
    return {
        "schema": 1,
        "name": "demo",
        "sky": {"spectrum": "wmap7", "lmax": 128},
        "map": {"nside": 64},
        "channel": [
            {
                "name": "W1",
                "frequency_ghz": 94.0,
                "beam": {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 60.0, "fwhm_minor_arcmin": 50},
                "noise": {"sigma0_uk": 0.0},
                "scan": {"kind": "parallel_transport"},
            },
            {
                "name": "V1",
                "beam": {"kind": "gaussian", "fwhm_arcmin": 30.0},
                "scan": {"kind": "hit_averaged", "model": "scan.toml"},
            },
        ],
        "biposh": {"L_max": 2},
        "ensemble": {"realizations": 4, "seed": 1},
    }


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Working folder with the files that such runs name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MCSIM_NO_SUCH_VARIABLE", raising=False)
    for name in ("scan.toml", "mask.fits", "mask_W1.fits", "mask_V1.fits", "beam.fits", "alm.fits", "win.fits"):
        Path(name).write_text(f"contents of {name}")
    for number in range(4):
        Path(f"sky_{number:03d}.fits").write_text(str(number))
    return tmp_path


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """Empty folder that is the cache of one test."""
    monkeypatch.setenv("MCSIM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


@pytest.fixture
def registered(monkeypatch):
    """Register entry points in place of what is installed."""
    registry.catalogue.cache_clear()
    yield lambda *entries: monkeypatch.setattr(registry, "entry_points", lambda group: entries)
    registry.catalogue.cache_clear()


def changed(plain: dict, key: str, value: object) -> dict:
    """Copy with the dotted key (numbers index lists) set, or removed."""
    result = copy.deepcopy(plain)
    *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    holder = result
    for part in parents:
        holder = holder.setdefault(part, {}) if isinstance(holder, dict) else holder[part]
    if value is REMOVED:
        del holder[last]
    else:
        holder[last] = value
    return result
