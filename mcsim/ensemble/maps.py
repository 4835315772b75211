"""Maps of a run as FITS files, which :func:`mcsim.diagnose` can read."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.ensemble import plan
from mcsim.errors import InputError
from mcsim.simulation import power, sampled, simulate
from mcsim.simulation.channels import check_effects
from mcsim.simulation.survey import survey
from mcsim.sphere.checks import check_whole
from mcsim.sphere.header import first_table, opened
from mcsim.sphere.rotation import FRAMES
from mcsim.support.folders import appearing, unreadable, unwritable, user_path, writable
from mcsim.support.progress import reporting

POINTING: dict[bool, tuple[str, Any]] = {False: ("POINTING", "pixel means"), True: ("POINTING", "samples")}
"""Header card of maps by the default route, and sample by sample: what the pointing of samples is represented by."""


def write_maps(
    source: str | Path | dict[str, Any] | config.RunConfig,
    folder: str | Path,
    realizations: int | slice | None = None,
    *,
    sample_by_sample: bool = False,
    nthreads: int | None = None,
    quiet: bool = True,
) -> list[Path]:
    """Write the maps of a run, effects and noise included, as HEALPix FITS files.

    Parameters
    ----------
    source
        Configuration: a TOML file, the name of a packaged workflow, a dict, or a loaded one.
    folder
        Output folder; it is made if it does not exist.
    realizations
        A number: this one, its files directly in ``folder``. A slice, or None for the whole ensemble: a subfolder for
        each, ``00000`` and so on.
    sample_by_sample
        Use the time-ordered reference: each map is the plain mean of its samples, whose pointing must be known. Sky
        and effects are those of the default route; the noise is another draw.
    nthreads
        Number of threads; default: all processors.
    quiet
        Report no progress on standard error.

    Returns
    -------
    list of Path
        Folders with ``{channel}.fits``, or ``{channel}_{split}.fits`` if the run has splits: uK_CMB in RING order,
        float64, ``healpy.UNSEEN`` where nothing was observed. The header has frame (COORDSYS), unit (TUNIT1), the
        run's name and digest (RUN, DIGEST), the realization (REALIZ), and how the pointing of samples is represented
        (POINTING): by pixel means, or sample by sample.

    Raises
    ------
    InputError
        For bad input, a grid without pixels, a folder that cannot be written, or files that would be overwritten.

    Notes
    -----
    A folder appears complete or not at all. One that an earlier call has written for the same run is kept, so that an
    interrupted call goes on where it was; nothing else is written over. Memory is that of one realization.

    Examples
    --------
    >>> import mcsim
    >>> [folder] = mcsim.write_maps("tiny", "tiny-maps", realizations=0)
    >>> sorted(file.name for file in folder.iterdir())
    ['demo.fits']
    """
    run = config.load(source)
    if run.map.grid != "healpix":
        raise InputError(f'{run.name} has map.grid = "{run.map.grid}" and so no pixels; set map.grid = "healpix".')
    alone = not isinstance(realizations, slice | None)
    if isinstance(realizations, slice | None):
        part = realizations
    else:
        check_whole(realizations, "realizations")
        if realizations >= run.ensemble.realizations:
            raise InputError(
                f"realization {realizations} is not below {run.ensemble.realizations} (ensemble.realizations); choose "
                "one of those, or raise it."
            )
        part = slice(int(realizations), int(realizations) + 1)
    wanted = plan.wanted(run, part)
    names = file_names(run)
    whole = user_path(folder)
    targets = {r: whole if alone else whole / f"{r:05d}" for r in wanted}
    if whole.exists() and not whole.is_dir():
        raise InputError(f"{folder} is a file; choose a folder with -o.")
    alike = [("DIGEST", config.digest(run)), POINTING[sample_by_sample]]
    missing = {
        r: target for r, target in targets.items() if not _written(target, names.values(), [*alike, ("REALIZ", r)])
    }
    if not missing:
        return list(targets.values())
    config.check_skies(run, wanted)
    check_effects(run)
    threads = nthreads or os.cpu_count() or 1
    with reporting("orientation moments", 1.0, "", quiet) as report:
        shared = survey(run, nthreads=threads, progress=report)
    if sample_by_sample:
        for channel in shared.channels:
            sampled.check(channel)
    power.check_not_empty(shared, simulate.draw_sky(shared, wanted.start))  # and finds bad sky files
    writable(whole if not alone else whole.absolute().parent)
    ascii_name = run.name.encode("ascii", "backslashreplace").decode()  # as FITS headers require
    with reporting("maps", float(len(missing)), "realizations", quiet) as report:
        for number, (r, target) in enumerate(missing.items()):
            if sample_by_sample:
                made = dict(sampled.maps(shared, r, threads))
            else:
                made = dict(zip(shared.map_names, simulate.maps(shared, r, threads), strict=True))
            with unwritable(target, "choose another folder with -o"), appearing(target) as scratch:
                header = [("RUN", ascii_name), *alike, ("REALIZ", r)]
                for name, map_uk in made.items():
                    write_map(scratch / names[name], map_uk, shared.frame, header)
            report(number + 1.0)
    return list(targets.values())


def _written(target: Path, names: Iterable[str], wanted: Sequence[tuple[str, Any]]) -> bool:
    """Return True if a folder has the maps of an earlier call, False if it is new; else raise InputError."""
    remedy = "choose another folder with -o"
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return False
    if not target.is_dir() or sorted(names) != sorted(file.name for file in target.iterdir()):
        raise InputError(f"{target} is not empty, and nothing is written over; {remedy}.")
    for path in target.iterdir():
        with unreadable(path, "a map", remedy), opened(path) as hdus:
            found = first_table(hdus).header
        other = next((key for key, value in wanted if found.get(key) != value), None)
        if other is not None:
            raise InputError(
                f"{path} is of another run (its {other} is {found.get(other)}), and nothing is written over; {remedy}."
            )
    return True


def write_map(path: Path, map_uk: NDArray[np.float64], frame: str, header: list[tuple[str, Any]] | None = None) -> None:
    """Write one HEALPix map in RING order, uK, with its frame in the header."""
    healpy.write_map(
        path, map_uk, dtype=np.float64, coord=FRAMES[frame], column_units="uK", column_names=["TEMPERATURE"],
        fits_IDL=False, extra_header=header or (),
    )  # fmt: skip


def first_realization(folder: Path) -> Path:
    """Return the subfolder of realization 0 where :func:`write_maps` made one for each; else the folder itself."""
    first = folder / f"{0:05d}"
    return first if first.is_dir() and not any(folder.glob("*.fits")) else folder


def file_names(run: config.RunConfig) -> dict[str, str]:
    """Return the file name of every map of a run: ``{channel}.fits`` or ``{channel}_{split}.fits``."""
    names = {name: f"{name.replace(':', '_')}.fits" for name in config.map_names(run)}
    for name, file in names.items():
        twice = [other for other, own in names.items() if own == file and other != name]
        if twice:
            raise InputError(f"The maps {name} and {twice[0]} would both be {file}; rename a channel or a split.")
    return names
