"""Files shipped with mcsim: scan models, workflows and power spectra.

An installed wheel has them inside the package; a source checkout (or an editable installation of it) has
``scan_models`` and ``workflows`` beside the package, where people look for them.
"""

import os
from functools import cache
from pathlib import Path

from mcsim.errors import InputError
from mcsim.support.folders import user_path

_PACKAGE = Path(__file__).resolve().parents[1]


def scan_model(name_or_path: str | Path) -> Path:
    """Find a scan model: a packaged name, for example ``"wmap"``, or the path of a TOML file; refuse anything else.

    A packaged name wins: write ``./wmap`` for a file of that name.
    """
    return _find("scan model", "scan_models", ".toml", name_or_path)


def workflow(name_or_path: str | Path) -> Path:
    """Find a run configuration: a packaged name, for example ``"quickstart"``, or a path. See :func:`scan_model`."""
    return _find("run configuration", "workflows", ".toml", name_or_path)


def spectrum(name_or_path: str | Path) -> Path:
    """Find a power spectrum: a packaged name, for example ``"wmap7"``, or a path. See :func:`scan_model`."""
    return _find("power spectrum", "data", ".txt", name_or_path)


def names(kind: str) -> tuple[str, ...]:
    """Return the packaged names, sorted; ``kind``: ``"scan_models"``, ``"workflows"``, ``"data"`` (spectra)."""
    return _found(_PACKAGE, kind)[1]


@cache
def _found(package: Path, kind: str) -> tuple[Path, tuple[str, ...]]:
    """Return the folder of a kind and the names in it: looked up once, as every survey asks for them."""
    inside, suffix = package / kind, ".txt" if kind == "data" else ".toml"
    folder = inside if inside.is_dir() else package.parent / kind
    return folder, tuple(sorted(path.stem for path in folder.glob(f"*{suffix}")))


def _find(noun: str, kind: str, suffix: str, name_or_path: str | Path) -> Path:
    folder, known = _found(_PACKAGE, kind)
    if str(name_or_path) in known:
        return folder / f"{name_or_path}{suffix}"
    path = user_path(name_or_path)
    if os.path.isfile(path):  # False also for a name that no file system takes
        return path.resolve()
    raise InputError(
        f"{noun} {str(name_or_path)!r} is neither a file (looked for {str(path)!r}) nor packaged with mcsim; "
        f"give a path or one of: {', '.join(known) or 'none is packaged'}."
    )
