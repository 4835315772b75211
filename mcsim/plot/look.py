"""Text and figure of a beam or of a scan, for the commands that show one."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mcsim import config
from mcsim.errors import InputError
from mcsim.instrument import beams, scan
from mcsim.plot.beam import beam_figure
from mcsim.plot.scan import scan_figure
from mcsim.simulation import channels
from mcsim.support.folders import user_path
from mcsim.support.progress import reporting

LMAX = 2048  #: of the coefficients that are shown, by default


@dataclass(frozen=True)
class Look:
    """A name, a text for the terminal, and a figure."""

    name: str
    text: str
    figure: Figure


def look_at_beams(
    source: str | Path, lmax: int | None = None, m_max: int | None = None, pixel_deg: float | None = None
) -> Iterator[Look]:
    """Yield the text and figure of the beams of a run configuration, of a beam map, or of a file of b_lm or B_l.

    ``source`` is a TOML configuration or packaged workflow (every channel is shown), or a file: a FITS image is a beam
    map, a FITS table holds b_lm or, in a single column, B_l, a text (.txt, .dat) B_l, .npz a saved beam. ``lmax`` is by
    default 2048, or what the file holds or its pixels resolve, and of b_lm or B_l in a run its ``sky.lmax``; ``m_max``
    is chosen from the beam, and ``pixel_deg``, the side of a pixel of a beam map in degrees, read from its header.
    InputError for what the source does not have, or says itself.
    """
    path = user_path(source)
    if path.is_dir() or (not path.exists() and path.suffix not in ("", ".toml")):
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{path} {what}; give a beam map or b_lm (FITS), or a configuration.")
    if path.suffix == ".toml" or not path.exists():
        run = config.load(source)
        _refuse(f"{source} is a configuration, which says", "itself", m_max=m_max, pixel_deg=pixel_deg)
        for channel in run.channels:
            spec = channel.beam
            image = channels.load_beam_map(channel.name, spec) if isinstance(spec, config.BeamMap) else None
            tabled = isinstance(spec, config.BeamBlm | config.BeamWindow)
            degree = lmax or (run.sky.lmax if tabled else _reach(image))
            yield _look_at(channel.name, channels.load_beam(channel, degree), image)
    elif path.suffix not in (".txt", ".dat", ".npz") and beams.holds_image(path):
        image = beams.read_map(path, pixel_deg=pixel_deg)
        yield _look_at(path.name, beams.Beam.from_map(image, lmax or _reach(image), m_max), image)
    elif path.suffix != ".npz" and (path.suffix in (".txt", ".dat") or beams.holds_window(path)):
        _refuse(f"{source} holds B_l of a circular beam, which has no", "", m_max=m_max or None, pixel_deg=pixel_deg)
        window = beams.read_window(path, lmax)
        yield _look_at(path.name, beams.Beam.from_window(window, min(lmax or LMAX, window.size - 1)), None)
    else:
        _refuse(f"{source} holds b_lm, which have no", "", pixel_deg=pixel_deg)
        yield _look_at(path.name, beams.Beam.from_blm(path, lmax, m_max), None)


def _reach(image: beams.BeamMap | None) -> int:
    """Return the highest degree that is shown by default, and that the pixels of a beam map resolve."""
    return LMAX if image is None else min(LMAX, int(np.pi / image.pixel_rad))


def _refuse(why: str, end: str, **options: float | None) -> None:
    """Raise InputError for an option that is given and would change nothing."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{' '.join(filter(None, (why, name, end)))}; leave out --{name.replace('_', '-')}.")


def _look_at(name: str, shown: beams.Beam, image: beams.BeamMap | None) -> Look:
    text = beams.format_summary(beams.summarize(shown, image))
    return Look(name, f"{name}\n{text}", beam_figure(shown, image, title=name))


def look_at_scan(
    model: str | Path,
    nside: int = 256,
    smax: int = 4,
    frame: str = "ecliptic",
    sample_period_s: float | None = None,
    line_of_sight: str | None = None,
) -> Look:
    """Return a scan model's hits, orientation moments and reduction of a beam's ellipticity, in text and figure.

    ``model`` is a packaged name or a TOML file. Moments of spin up to ``smax`` in ``frame`` are cached. The time
    between samples, in seconds, and the line of sight are by default the model's. Progress is reported on standard
    error. An invalid model, line of sight or size raises InputError.
    """
    if smax < 2:
        raise InputError(f"smax = {smax} is too small for a look at a scan, which is about w_2; take 2 or more.")
    loaded = scan.ScanModel.load(model)
    if sample_period_s is not None:
        loaded = loaded.with_sampling(sample_period_s)
    if line_of_sight is not None:
        loaded = loaded.with_lines_of_sight(line_of_sight)
    with reporting("orientation moments", 1.0, "", quiet=False) as report:
        folder = scan.cached_moments(loaded, scan.MapGrid(nside, frame), smax, os.cpu_count() or 1, report)
    moments = scan.Moments.load(folder)
    alone = frame == "ecliptic" and line_of_sight is None and len(loaded.default_lines) == 1
    beside = loaded if alone and scan.has_limit(loaded) else None
    return Look(loaded.name, scan.summary(loaded.name, moments), scan_figure(moments, loaded.name, beside))
