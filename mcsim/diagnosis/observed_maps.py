"""Observed maps: read them, refuse what the model cannot describe, and prepare them for a diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.campaign import Ask
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.places import Place, places
from mcsim.diagnosis.residual_maps import standardised
from mcsim.diagnosis.responses import Responses
from mcsim.diagnosis.selection import Attribution
from mcsim.diagnosis.wiener_filter import Model, shared_sky
from mcsim.errors import InputError
from mcsim.sphere import header, healpix
from mcsim.stats.look_elsewhere import global_test

Map = NDArray[np.float64]
Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ObservedMaps:
    """Offer observed maps as a data set; see :class:`mcsim.diagnosis.context.DataSet`.

    Attributes
    ----------
    context
        Model, simulations and templates.
    observed
        Maps in the order of the model's, from :func:`read_maps` or :func:`checked`.
    ask
        Runs further simulations, with effects at the amplitudes that are found.
    """

    context: DiagnosisContext
    observed: Sequence[Map]
    ask: Ask

    realizations = 1

    @cached_property
    def _measured(self) -> tuple[Vector, Vector, Vector]:
        """Data vector, bipolar scan and coarse residuals."""
        analysis, ensemble = self.context.analysis, self.context.ensemble
        size = len(analysis.elements)
        found = analysis.data_vector(self.observed, bipolar_scan=True)
        x, scan, coarse = np.split(found, [size, size + ensemble.bipolar_scan.shape[1]])
        return x, scan, coarse.reshape(ensemble.residual_mean.shape)

    @property
    def x(self) -> Vector:
        """Return the data vector."""
        return self._measured[0]

    @cached_property
    def respond(self) -> Responses:
        """Return what simulates responses in skies that are constrained by these maps."""
        context = self.context
        sky = shared_sky(context.analysis.model, self.observed)
        return Responses(context.run, context.analysis, context.ensemble.reference, sky, self.ask)

    def templates(self) -> NDArray[np.float64]:
        """Return the templates; those that depend on the very sky are measured on the observed one if it departs."""
        context, t = self.context, self.context.templates
        settings = context.settings
        groups = context.null.whiten_groups(t, [candidate.columns for candidate in context.candidates])
        if global_test(context.null, self.x, groups, context.calibration).pvalue > settings.alpha:
            return t
        random = [
            index
            for index, candidate in enumerate(context.candidates)
            if context.sky_scatter[index] >= settings.sky_scatter
            and not (candidate.random_response or candidate.effect.mean_response)
        ]
        return context.bank.on_sky(t, context.candidates, random, self.respond, settings.constrained_skies)

    def exchanged(self, found: Attribution) -> list[str]:
        """Return orders of the maps in which the model fits, unless it fits as they are or one effect explains it."""
        context, level = self.context, self.context.settings.exchanged_pvalue
        if found.gap.omnibus > level or (found.explanations and len(found.explanations[0].members) == 1):
            return []
        names = [part.name for part in context.analysis.model.parts]
        notes = []
        for order in exchanges(names):
            p = context.null.pvalue(context.analysis.data_vector([self.observed[i] for i in order]))
            if p > level:
                moved = [f"{names[i]} as {name}" for name, i in zip(names, order, strict=True) if names[i] != name]
                notes.append(f"The model fits (p = {p:.2g}) with maps exchanged: {', '.join(moved)}.")
        return notes

    def notes(self) -> list[str]:
        """Return nothing: maps need no note."""
        return []

    def halves(self) -> tuple[None, str]:
        """Return no matrix, since the noise of the folds is independent, and the folds in words."""
        splits = self.context.run.map.splits
        if len(splits) < 2:
            return None, "odd degrees, alternate pixels"
        return None, f"{' and '.join(splits[1::2])} (frozen on {' and '.join(splits[::2])})"

    def places(self) -> list[Place]:
        """Rank the bipolar scan, and those elements of the data vector that are no matched filters."""
        ensemble, analysis = self.context.ensemble, self.context.analysis
        own = [i for i, element in enumerate(analysis.elements) if element.statistic != "score"]
        count = len(ensemble.bipolar_scan)
        drawn = np.concatenate([ensemble.bipolar_scan, ensemble.simulations[:count][:, own]], axis=1)
        shifted = self.x[own] - ensemble.offset[own]
        elements = (*analysis.bipolar_scan.elements, *(analysis.elements[i] for i in own))
        return places(np.concatenate([self._measured[1], shifted]), drawn, elements, self.context.settings.place_pvalue)

    def residual_maps(self) -> NDArray[np.float64]:
        """Return the residual maps over the scatter of those of simulations, shape (map, npix)."""
        ensemble = self.context.ensemble
        drawn = len(ensemble.bipolar_scan)
        return standardised(self._measured[2], ensemble.residual_mean, ensemble.residual_scatter, drawn)

    def provenance(self) -> dict[str, str | int]:
        """Return nothing."""
        return {}


def read_maps(model: Model, folder: str | Path) -> list[Map]:
    """Read the maps of every channel and split, in the order of the model's.

    Parameters
    ----------
    model
        Fiducial model.
    folder
        With ``{channel}.fits``, or ``{channel}_{split}.fits`` where the model has splits; HEALPix in uK (or the unit
        of its header), ``healpy.UNSEEN`` if not observed, in RING order or with a header that says another.

    Raises
    ------
    InputError
        If a file is missing or unreadable, has another nside, frame or unit, or values that are no map of this survey:
        not finite, constant, without what the fiducial scan hits, or far from the size of the model.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; give one with the observed maps, {_file_name(model, 0)} and so on.")
    return [_read(model, i, folder / _file_name(model, i)) for i in range(len(model.parts))]


def checked(model: Model, maps: Sequence[Map]) -> list[Map]:
    """Check maps given as arrays, in the order of the model's, uK, like those of a folder."""
    if len(maps) != len(model.parts):
        raise InputError(f"{len(maps)} maps were given, the model has {len(model.parts)}; give one for each.")
    return [
        _checked(model, i, np.asarray(map_, dtype=np.float64), f"map {model.parts[i].name}")
        for i, map_ in enumerate(maps)
    ]


def _file_name(model: Model, part: int) -> str:
    channel, _, split = model.parts[part].name.partition(":")
    return f"{channel}_{split}.fits" if split else f"{channel}.fits"


def _read(model: Model, part: int, path: Path) -> Map:
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; the model has a map {model.parts[part].name}, give it under that name."
        )
    map_, frame, unit = healpix.read_map(path)
    expected = model.survey.frame
    if frame not in (None, expected):
        raise InputError(f"{path} is in {frame} coordinates, the model in {expected}; rotate the map.")
    frequency = model.survey.channels[model.parts[part].channel].site.frequency_ghz
    factor = header.to_uk(unit, path, frequency)
    return _checked(model, part, np.where(map_ == healpy.UNSEEN, map_, factor * map_), str(path))


def _checked(model: Model, part: int, map_: Map, name: str) -> Map:
    """Return the map if it can be of the survey."""
    if map_.shape != (12 * model.nside**2,):
        size = healpy.npix2nside(map_.size) if map_.ndim == 1 and healpy.isnpixok(map_.size) else None
        found = f"the shape {map_.shape}" if size is None else f"nside {size}"
        raise InputError(f"{name} has {found}, the model {model.nside}; bring them to the same.")
    broken = int(np.sum(~np.isfinite(map_)))
    if broken:
        raise InputError(f"{name} has {broken} pixels that are not finite; mark what was not observed as UNSEEN.")
    unseen = map_ == healpy.UNSEEN
    fiducial = model.parts[part].precision > 0
    lost = float(np.mean(unseen[fiducial]))
    limits = model.settings
    if lost > limits.missing_share:
        raise InputError(
            f"{name} leaves out {100 * lost:.0f} % of the pixels that the fiducial scan hits, at most "
            f"{100 * limits.missing_share:.0f} % may be; give the model a mask (map.mask) that leaves them out too."
        )
    seen = map_[fiducial & ~unseen]
    rms = float(np.std(seen))
    if rms == 0.0:
        raise InputError(f"{name} is constant; give an observed map.")
    ratio = rms / expected_rms(model, part)
    if not 1.0 / limits.rms_ratio < ratio < limits.rms_ratio:
        raise InputError(
            f"{name} has an rms of {rms:.3g} uK where the model expects {rms / ratio:.3g} uK; is it in another "
            "unit, or is the dipole still in it? Say the unit in its header (TUNIT1), or give it in uK."
        )
    return map_


def expected_rms(model: Model, part: int) -> float:
    """Return the rms over the sky that the model expects in a map, sky and noise, uK."""
    whole = model.survey
    assert whole.cl is not None  # a model of a diagnosis has a spectrum
    channel = whole.channels[model.parts[part].channel]
    response = channel.response.factors[0].real
    ell = np.arange(response.size)
    sky = float(np.sum((2 * ell + 1) / (4 * np.pi) * whole.cl * response**2))
    precision = model.parts[part].precision
    return float(np.sqrt(sky + np.mean(1.0 / precision[precision > 0])))


def exchanges(names: Sequence[str]) -> list[tuple[int, ...]]:
    """Return the orders of the maps in which two channels, or two splits of all channels, are exchanged."""
    places = {name: place for place, name in enumerate(names)}
    channels = list(dict.fromkeys(name.partition(":")[0] for name in names))
    splits = list(dict.fromkeys(name.partition(":")[2] for name in names))
    found = []
    for kind, values in ((0, channels), (2, splits)):
        for i, one in enumerate(values):
            for other in values[:i]:
                swap = {one: other, other: one}
                order = []
                for name in names:
                    parts = list(name.partition(":"))
                    parts[kind] = swap.get(parts[kind], parts[kind])
                    order.append(places["".join(parts)])
                found.append(tuple(order))
    return found
