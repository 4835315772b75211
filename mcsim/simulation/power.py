r"""Sky power above ``sky.lmax`` that pixels see all the same, against what their statistics tolerate.

The pixels of a map have the variance R = sigma^2 + sum_{l > l_a} v_l beyond the degrees l_a that are analysed, with
v_l = (2l + 1)/4pi C_l B_l^2 w_l^2 after beam, pixel window and preparation. If the simulations lack the v_l above
``sky.lmax``, N pixels measure an excess chi^2 of N v/R where chance gives sqrt(2 N): the most sensitive statistic is
moved by s = sqrt(N/2) v/R standard deviations, and the chi^2 of the whole data vector by about s^2 for each statistic
that depends on it. ``TOLERANCE`` keeps that small against sqrt(2 N_dof) of any data vector. At s = 0.5 noise levels and
beam widths are off by 0.5 standard deviations, and 7 % instead of 5 % of perfect skies are called different (36 of 500,
workflows/preparation/check.py); the degree that a refusal names keeps s below ``ENOUGH``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.errors import InputError
from mcsim.simulation import mapmaking, windows
from mcsim.simulation.channels import CIRCULAR, load_beam
from mcsim.simulation.survey import Channel, Survey, SurveyMap
from mcsim.sphere import spectra
from mcsim.support.arrays import Map

TOLERANCE = 0.5
"""Standard deviations by which neglected power may move the variance of the pixels of a map before it is refused."""

ENOUGH = 0.1
"""The same for the ``sky.lmax`` that is called enough; above it a diagnosis of prepared maps says what is left out."""

SIGNAL_FLOOR = 1e-3  #: least noise over the rms of the sky, for maps without noise: that of the diagnosis
REACH, HIGHEST = 24, 8192  #: degrees that are looked at: up to 24 nside of the prepared pixels, and this many


@dataclass(frozen=True)
class Neglected:
    """Power above ``sky.lmax`` that the pixels of a map see."""

    name: str  # of the map
    nside: int  # of its pixels
    lmax: int  # sky.lmax of the run
    needed: int  # the sky.lmax that is enough
    spectrum: str  # where C_l are from
    last: int  # its last degree
    rms_uk: float  # of the neglected power per pixel
    shift: float  # of the variance of all pixels, in standard deviations

    def __str__(self) -> str:
        """Say it in a sentence with the remedy."""
        remedy = f"set sky.lmax to {self.needed} or more (biposh.lmax may stay)"
        if self.last < self.needed:
            remedy += f", with a spectrum that reaches it: {self.spectrum} ends at {self.last}"
        harm = f"where at most {TOLERANCE:g} are tolerable"
        if self.shift <= TOLERANCE:
            harm = "and fitted noise levels and beam widths about as much"
        return (
            f"sky.lmax = {self.lmax} leaves out sky power of {self.rms_uk:.2g} uK rms that the pixels of map "
            f"{self.name} (nside {self.nside}) see; it moves their variance by {self.shift:.3g} standard deviations, "
            f"{harm}; {remedy}."
        )


def neglected(survey: Survey) -> Neglected | None:
    """Return the power that the worst map of a survey misses; None without a spectrum, or if it is tolerable.

    Where maps are prepared, whose simulations and data may reach further than any sky.lmax, it must be negligible.
    """
    run = survey.config
    if run.sky.spectrum is None or run.map.grid != "healpix":
        return None
    last, found = spectra.last(run.sky.spectrum), []
    for name, tail, shift in _shifts(survey, run.sky.spectrum):
        missing, own = float(np.sqrt(tail[run.sky.lmax])), float(shift[run.sky.lmax])
        needed = _first_below(shift, ENOUGH, survey.lmax)
        if own > (ENOUGH if run.preparation else TOLERANCE):
            found.append(Neglected(name, survey.nside, run.sky.lmax, needed, run.sky.spectrum, last, missing, own))
    worst = max(found, key=lambda one: one.shift, default=None)
    return worst and replace(worst, needed=max(one.needed for one in found))


def reach(survey: Survey, tolerance: float) -> int:
    """Return the degree above which power moves the variance of the pixels of no map by more than ``tolerance``.

    At most that at which the spectrum ends; of a survey of pixels with a spectrum.
    """
    assert survey.config.sky.spectrum is not None  # the caller's survey has one
    shifts = _shifts(survey, survey.config.sky.spectrum)
    needed = max(_first_below(shift, tolerance, survey.lmax) for _, _, shift in shifts)
    return min(needed, spectra.last(survey.config.sky.spectrum))


def _first_below(shift: NDArray[np.float64], tolerance: float, first: int) -> int:
    return first + int(np.argmax(shift[first:] <= tolerance))


def _shifts(survey: Survey, spectrum: str) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the name of every map, the variance that its pixels see above every degree, and what that moves."""
    run = survey.config
    top = max(run.sky.lmax, min(REACH * survey.nside, HIGHEST))
    known = spectra.load(spectrum, min(spectra.last(spectrum), top))
    ell = np.arange(top + 1)
    # Beyond its end the spectrum goes on with constant D_l, which is more than any CMB has.
    end = known.size - 1
    beyond = known[-1] * (end * (end + 1.0)) / np.maximum(ell * (ell + 1.0), 1.0)
    cl = np.where(ell <= end, np.resize(known, top + 1), beyond)
    for spec, channel in zip(run.channels, survey.channels, strict=True):
        seen = (2 * ell + 1) / (4.0 * np.pi) * cl * _window(run, spec, channel, top) ** 2
        tail = np.append(np.cumsum(seen[:0:-1])[::-1], 0.0)
        for m in channel.maps:
            used = m.moments.hits > 0 if m.weight is None else m.weight > 0
            level = _noise_uk(channel, m)
            noise = 0.0 if level is None else float(np.mean(level[used] ** 2))
            total = noise + tail[survey.lmax] + SIGNAL_FLOOR**2 * float(seen.sum())
            yield m.name, tail, np.sqrt(used.sum() / 2.0) * tail / total


def _noise_uk(channel: Channel, m: SurveyMap) -> Map | None:
    """Return the standard deviation of the noise of pixels, of a differencing scan about; None: no noise."""
    if m.noise_uk is not None or m.pairs is None or channel.side_b is None:
        return m.noise_uk
    level = mapmaking.level_uk(m.pairs, channel.side_b.sigma0_uk)
    if level is None or m.preparation is None:
        return level
    return m.preparation.noise_uk(level, m.pairs.hits_a + m.pairs.hits_b)


def check(survey: Survey) -> None:
    """Raise InputError if the run says how its maps are prepared and these would see more sky than is simulated."""
    if survey.config.preparation and (found := neglected(survey)) and found.shift > TOLERANCE:
        raise InputError(str(found))


def check_not_empty(survey: Survey, sky: NDArray | None) -> None:
    """Raise InputError for a sky, a_lm or C_l, that is zero where maps have neither noise nor effects: so are they.

    ``sky``: None where the run has no spectrum.
    """
    run = survey.config
    noise = any(m.noise_uk is not None for m in survey.maps)
    noise = noise or any(one.side_b is not None and one.side_b.sigma0_uk > 0.0 for one in survey.channels)
    if sky is not None and not (np.any(sky) or noise or run.effects):
        source = run.sky.spectrum or run.sky.alm or run.sky.map
        raise InputError(
            f"the sky of {source} is zero up to sky.lmax = {run.sky.lmax}, and no channel has noise, so that all maps "
            "are zero; give the sky power, or the channels noise (noise.sigma0_uk)."
        )


def _window(run: config.RunConfig, spec: config.Channel, channel: Channel, lmax: int) -> NDArray[np.float64]:
    """Return B_l times pixel window and preparation of a channel, up to an lmax beyond the sky's."""
    circular = spec if isinstance(spec.beam, CIRCULAR) else replace(spec, beam=replace(spec.beam, m_max=0))
    try:
        window = load_beam(circular, lmax).window.copy()
    except InputError:  # a file that ends earlier: go on as a Gaussian
        known = load_beam(circular, run.sky.lmax).window
        end, ell = known.size - 1, np.arange(lmax + 1)
        falls = np.log(max(abs(known[-1]), 1e-30)) / (end * (end + 1.0))
        window = np.where(ell <= end, np.resize(known, lmax + 1), np.exp(falls * ell * (ell + 1.0)))
    steps = channel.maps[0].preparation
    if config.pixel_window(run, spec) != "none":
        window *= windows.of_pixels(run.map.resolution, lmax)
    return window if steps is None else window * steps.beam_window(lmax) * steps.pixel_window(lmax)
