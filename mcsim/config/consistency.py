"""What settings of a run do not go together: rings without pixels, filtered maps, widths in another unit."""

import math
import warnings
from typing import Any

from mcsim.config import preparation
from mcsim.config.noise import in_words, is_noise_free

NARROWEST = 0.03  #: width of a beam, radians, times lmax: a Gaussian of it has B_l > 0.9999 up to lmax


def warn_of_units(run: Any) -> None:
    """Warn of beams that no map of the run shows: their widths may be in radians."""
    for channel in run.channels:
        for side in ("beam", "beam_b"):
            for key in ("fwhm_arcmin", "fwhm_major_arcmin"):
                width = getattr(getattr(channel, side), key, math.inf)
                if math.radians(width / 60.0) * run.sky.lmax < NARROWEST:
                    warnings.warn(
                        f"channel[{channel.name}].{side}.{key} = {width:g} is narrower than any map of sky.lmax = "
                        f"{run.sky.lmax} shows; the unit is arcmin, and {width:g} rad are "
                        f"{60.0 * math.degrees(width):.4g} arcmin.",
                        stacklevel=3,
                    )


def check_rings(run: Any) -> None:
    """Refuse settings that need pixels, or moments that depend on more than colatitude."""
    remedy = 'or set map.grid = "healpix"'
    for channel in run.channels:
        kind = channel.scan.kind
        if kind not in ("parallel_transport", "hit_averaged"):
            raise ValueError(
                f'channel[{channel.name}].scan is of kind "{kind}", which grid = "gl" cannot bear; use '
                f'"parallel_transport" or "hit_averaged", {remedy}'
            )
        if kind == "hit_averaged" and run.map.frame != "ecliptic":
            raise ValueError(
                f'map.frame = "{run.map.frame}", but with grid = "gl" the limit of a scan depends on '
                f'ecliptic colatitude alone; set frame = "ecliptic" {remedy}'
            )
        if getattr(channel.scan, "sample_period_s", None) is not None:
            raise ValueError(
                f"channel[{channel.name}].scan.sample_period_s = {channel.scan.sample_period_s:g}, but with "
                f'grid = "gl" a scan is its limit of endless time, without samples; remove it {remedy}'
            )
        if not is_noise_free(channel.noise):
            raise ValueError(
                f'channel[{channel.name}].{in_words(channel.noise)}, but grid = "gl" has no pixels to draw noise in; '
                f"remove the noise {remedy}"
            )
    for key, given in (
        ("mask of a channel", any(channel.mask is not None for channel in run.channels)),
        ("ensemble.keep_maps = true", run.ensemble.keep_maps),
        ("[[preparation]]", bool(run.preparation)),
        ('biposh.weighting = "hits"', run.biposh.weighting == "hits"),
        (f"biposh.iterations = {run.biposh.iterations}", run.biposh.iterations > 0),
    ):
        if given:
            raise ValueError(f'{key} needs pixels, but grid = "gl" has none; remove it {remedy}')


def check_filter(run: Any) -> None:
    """Refuse settings that the inverse covariance takes the place of, or cannot bear."""
    if not run.biposh.filtered:
        if run.biposh.probes is not None:
            raise ValueError('biposh.probes is given without a filter; remove it or set filter = "inverse_covariance"')
        return
    # What is fitted and subtracted has any amplitude for the filter, and masked pixels have no weight.
    changing = next((one.kind for one in run.preparation if not preparation.may_keep_pixels(one)), "")
    for key, given in (
        ('map.grid = "gl"', run.map.grid == "gl"),
        (f'[[preparation]] kind = "{changing}"' + " with coefficients" * (changing == "templates"), bool(changing)),
        ('biposh.weighting = "hits"', run.biposh.weighting == "hits"),
        (f"biposh.iterations = {run.biposh.iterations}", run.biposh.iterations > 0),
        ("sky without spectrum", run.sky.spectrum is None),
    ):
        if given:
            raise ValueError(
                f'{key} does not go with biposh.filter = "inverse_covariance", which weights the pixels of maps as '
                "they are made by the spectrum of the sky and their noise; change one of the two"
            )
    for channel, split in run.each_map:
        if is_noise_free(channel.noise_of(split)) or channel.scan.kind == "differencing":
            raise ValueError(
                f'channel[{channel.name}] has no noise in its pixels, but biposh.filter = "inverse_covariance" '
                "needs it; give it noise and a scan of one beam, or remove the filter"
            )
