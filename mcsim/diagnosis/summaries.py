"""The data vector: a short vector of summary statistics, each with a description."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.matched_filters import normalised_difference, sky_of
from mcsim.diagnosis.wiener_filter import FilteredMaps, Model, by_degree
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotation_matrix

Map = NDArray[np.float64]
Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Element:
    """Describe one element of the data vector.

    Attributes
    ----------
    name
        Unique.
    statistic
        "map": residual maps against the sky and the scan; "cl"; "biposh"; "noise"; "score": matched filter.
    channels, split
        Whose; no split if all maps of a channel count.
    fold
        0 or 1 if there is a similar element whose noise is independent: a fit may use the one and be tested with the
        other. None if there is none.
    ell
        Range of degrees, None if all or none.
    L, M, parity, frame
        As for BipoSH coefficients, if they apply.
    kind
        What is measured, one of the keys of :data:`KINDS`.
    component
        Which of the numbers that are alike in all else, in words: "real", "x", "even pixels".
    effect
        Of a matched filter, the effect that it is matched to, in words.
    """

    name: str
    statistic: str
    channels: tuple[str, ...]
    split: str | None = None
    fold: int | None = None
    ell: tuple[int, int] | None = None
    L: int | None = None
    M: int | None = None
    parity: str | None = None
    frame: str | None = None
    kind: str = "other"
    component: str | None = None
    effect: str | None = None

    @property
    def family(self) -> str:
        """Return what is measured in words, with the order of a beam's kernel."""
        if self.effect is not None:
            return f"matched filter: {self.effect}"
        return KINDS.get(self.kind, self.kind) + (f", order {self.L}" if self.kind == "beam" else "")

    @property
    def words(self) -> str:
        """Return what was measured, where and in which component, in words."""
        degrees = "" if self.ell is None else f"ℓ {self.ell[0]}" + f"–{self.ell[1]}" * (self.ell[1] > self.ell[0])
        whose = () if self.effect is not None else (", ".join(self.channels), self.split)
        return ", ".join(filter(None, (self.family, *whose, degrees, self.component)))


KINDS = {
    "beam": "residual × sky through the beam",
    "dipole": "dipole of the residual",
    "plane": "Galactic plane in the residual",
    "noise": "noise variance",
    "square": "residual × sky²",
    "common": "residual power common to splits",
    "difference": "power of the split difference",
    "contrast": "contrast of frequencies",
    "sky": "power spectrum of the shared sky",
    "isotropy": "modulation of the shared sky",
    "matched": "matched filter",
    "biposh": "BipoSH of residual × sky",
    "cross": "cross power of residuals",
    "table": "measured spectrum",
}
"""What the elements of the data vector measure, in words."""


@dataclass(frozen=True)
class Block:
    """Compute some elements together."""

    elements: tuple[Element, ...]
    values: Callable[[Model, FilteredMaps], Vector] = field(repr=False)


def blocks_of(model: Model) -> tuple[Block, ...]:
    """Return the blocks that do not depend on a candidate: about 30 elements a channel, and some of the sky."""
    blocks = [_beam_block(model, i) for i in range(len(model.parts))]
    blocks += [_additive_block(model, i) for i in range(len(model.parts))]
    blocks += [_plane_block(model, i) for i in range(len(model.parts))]
    for channel in range(len(model.response)):
        blocks += [_noise_block(model, channel), _linearity_block(model, channel)]
        if len(model.of(channel)) > 1:
            blocks.append(_repeated_block(model, channel))
    contrast = _contrast_block(model)
    return (*blocks, *([contrast] if contrast else []), _sky_block(model), _isotropy_block(model))


def bins(low: int, high: int, number: int) -> list[tuple[int, int]]:
    """Return ranges of degrees, both ends included, with about the same number of modes."""
    edges = np.sqrt(np.linspace(low**2, (high + 1) ** 2, number + 1)).astype(int)
    return [(int(a), int(b) - 1) for a, b in pairwise(edges)]


def scales(lmax: int) -> list[tuple[int, int]]:
    """Return ranges of degrees for steep spectra: each starts at about four times the one before."""
    edges = [low for low in (2, 13, 49) if low < lmax] + [lmax + 1]
    return [(a, b - 1) for a, b in pairwise(edges)]


def _label(model: Model, part: int) -> tuple[str, str | None]:
    channel, _, split = model.parts[part].name.partition(":")
    return channel, split or None


def _frame(model: Model) -> str:
    return model.survey.frame


def _beam_block(model: Model, part: int) -> Block:
    """Project D_s(l) on B_l l^s, the change of a beam at order s, in few bins."""
    channel, split = _label(model, part)
    frame, lmax = _frame(model), model.lmax
    ell = np.arange(lmax + 1)
    beam = model.survey.channels[model.parts[part].channel].site.beam
    kernels, elements = [], []
    first, split_orders = part == model.of(model.parts[part].channel)[0], model.settings.split_beam_orders
    for s in range(min(model.settings.beam_orders if first else split_orders, model.parts[part].moments.smax) + 1):
        shape = beam.blm[0, : lmax + 1].real * (ell / lmax) ** max(s, 1)
        for low, high in bins(2, lmax, model.settings.beam_bins[s]):
            kernel = np.where((ell >= low) & (ell <= high), shape, 0.0)
            for quadrature in ("re", "im") if s else ("re",):
                kernels.append((s, quadrature, kernel))
                elements.append(
                    Element(
                        f"beam/{model.parts[part].name}/m{s}{quadrature}/{low}-{high}",
                        "map",
                        (channel,),
                        split if s <= split_orders else None,
                        _fold(model, part) if s <= split_orders else None,
                        (low, high),
                        L=s,
                        M=0,
                        parity="even",
                        frame=frame,
                        kind="beam",
                        component={"re": "real" if s else None, "im": "imaginary"}[quadrature],
                    )
                )

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found = [
            np.dot(kernel, getattr(filtered.orders[part, s], _PARTS[quadrature])) for s, quadrature, kernel in kernels
        ]
        return np.array(found)

    return Block(tuple(elements), values)


_PARTS = {"re": "real", "im": "imag"}


def _additive_block(model: Model, part: int) -> Block:
    """Measure the dipole of the residual: x, y, z."""
    channel, split = _label(model, part)
    elements = tuple(
        Element(
            f"dipole/{model.parts[part].name}/{axis}",
            "map",
            (channel,),
            split,
            _fold(model, part),
            (1, 1),
            L=1,
            frame=_frame(model),
            kind="dipole",
            component=axis,
        )
        for axis in "xyz"
    )
    one, two = alm_.start(model.lmax, 0) + 1, alm_.start(model.lmax, 1) + 1

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        alm = filtered.adjoint[part]
        return np.array([-alm[two].real, alm[two].imag, alm[one].real])

    return Block(elements, values)


def _plane_block(model: Model, part: int) -> Block:
    """Measure the residual along the Galactic plane, against its mean over the sky."""
    channel, split = _label(model, part)
    matrix = rotation_matrix(_frame(model), "galactic")
    height = matrix[2] @ np.stack(healpy.pix2vec(model.nside, np.arange(12 * model.nside**2)))
    profile = 1.0 / (1.0 + (height / model.settings.plane_width) ** 2)
    profile -= profile.mean()
    element = Element(
        f"plane/{model.parts[part].name}",
        "map",
        (channel,),
        split,
        _fold(model, part),
        (2, model.settings.large_scales),
        L=2,
        M=0,
        parity="even",
        frame="galactic",
        kind="plane",
    )

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        return np.array([float(filtered.residual[part] @ profile)])

    return Block((element,), values)


def _noise_block(model: Model, channel: int) -> Block:
    """Measure variance over expectation in bands of ecliptic latitude, alternate pixels apart."""
    parts = model.of(channel)
    name = model.survey.channels[channel].name
    matrix = rotation_matrix(_frame(model), "ecliptic")
    x, y, z = healpy.pix2vec(model.nside, np.arange(12 * model.nside**2))
    height = np.abs(matrix[2] @ np.stack([x, y, z]))
    alternate = np.arange(height.size) % 2
    seen = np.all([model.parts[i].precision > 0 for i in parts[:2]], axis=0)
    rows, elements = [], []
    for half in (0, 1):
        for low, high in pairwise(model.settings.latitude_edges):
            band = seen & (height >= low) & (height <= high) & (alternate == half)
            if not band.any():
                continue  # behind a mask, or never scanned
            rows.append(band.astype(float))
            elements.append(
                Element(
                    f"noise/{name}/{low:g}-{high:g}/pixels{half}",
                    "noise",
                    (name,),
                    None,
                    half,
                    L=0,
                    frame="ecliptic",
                    kind="noise",
                    component=f"|sin β| {low:g}–{high:g}, {'odd' if half else 'even'} pixels",
                )
            )
    bands = np.stack(rows)

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found: Vector = bands @ normalised_difference(model, filtered, parts)
        return found

    return Block(tuple(elements), values)


def _linearity_block(model: Model, channel: int) -> Block:
    """Correlate the residual with the square of the sky: a gain that depends on the signal."""
    parts, name = model.of(channel), model.survey.channels[channel].name

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        return np.array([sum(np.dot(filtered.residual[i], filtered.expected[i] ** 2) for i in parts)])

    return Block((Element(f"square/{name}", "map", (name,), kind="square"),), values)


def _repeated_block(model: Model, channel: int) -> Block:
    """Measure the residual power common to the channel's first two maps, and that of their difference."""
    first, second = model.of(channel)[:2]
    name = model.survey.channels[channel].name
    ranges = scales(model.lmax)
    elements = tuple(
        Element(f"{kind}/{name}/{low}-{high}", "cl", (name,), None, None, (low, high), L=0, kind=kind)
        for kind in ("common", "difference")
        for low, high in ranges
    )

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        a, b = filtered.adjoint[first], filtered.adjoint[second]
        common, apart = by_degree(a, b, model.lmax), by_degree(a - b, a - b, model.lmax)
        return np.array([power[low : high + 1].sum() for power in (common, apart) for low, high in ranges])

    return Block(elements, values)


def _contrast_block(model: Model) -> Block | None:
    """Measure the power of the contrast of lowest and highest frequency, common to two splits, by Galactic latitude."""
    channels = model.survey.channels
    frequencies = [channel.site.frequency_ghz for channel in channels]
    known = sorted({f for f in frequencies if f is not None})
    if len(known) < 2 or any(len(model.of(c)) < 2 for c in range(len(channels))):
        return None
    groups = [[c for c, f in enumerate(frequencies) if f == end] for end in (known[0], known[-1])]
    top = min(model.settings.large_scales, model.lmax)
    nside = max(1, 1 << (top // 3).bit_length() - 1) * 2
    matrix = rotation_matrix(_frame(model), "galactic")
    height = np.abs(matrix[2] @ np.stack(healpy.pix2vec(nside, np.arange(12 * nside * nside))))
    bands = np.stack(
        [(height >= low) & (height <= high) for low, high in pairwise(model.settings.latitude_edges)]
    ).astype(float)
    names = tuple(channels[c].name for group in groups for c in group)
    elements = tuple(
        Element(
            f"contrast/{low:g}-{high:g}",
            "map",
            names,
            ell=(2, top),
            L=0,
            frame="galactic",
            kind="contrast",
            component=f"|sin b| {low:g}–{high:g}",
        )
        for low, high in pairwise(model.settings.latitude_edges)
    )

    def smoothed(model: Model, filtered: FilteredMaps, split: int) -> Map:
        total = np.zeros(alm_.size(model.lmax), dtype=np.complex128)
        for group, sign in zip(groups, (1.0, -1.0), strict=True):
            for c in group:
                part = model.of(c)[split]
                weight = np.mean(model.parts[part].precision) * healpy.nside2npix(model.nside)
                total += sign / len(group) / weight * filtered.adjoint[part]
        low = alm_.resize(total, model.lmax, top)
        low[: min(2, top + 1)] = 0.0
        low[top + 1] = 0.0
        found: Map = healpix.synthesis(low[None], nside, top)[0]
        return found

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found: Vector = bands @ (smoothed(model, filtered, 0) * smoothed(model, filtered, 1))
        return found

    return Block(elements, values)


def _sky_block(model: Model) -> Block:
    """Measure the spectrum of the sky over its expectation, minus one, odd and even degrees apart."""
    names = tuple(channel.name for channel in model.survey.channels)
    large = [(2, 11), (12, 40)] if model.lmax > model.settings.large_scales else []
    ranges = [*large, *bins(41 if large else 2, model.lmax, model.settings.sky_bins - len(large))]
    ell = np.arange(model.lmax + 1)
    rows, elements = [], []
    for fold, parity in enumerate(("even", "odd")):
        for low, high in ranges:
            weight = np.where((ell >= low) & (ell <= high) & (ell % 2 == fold), 2.0 * ell + 1.0, 0.0)
            if weight.any():
                rows.append(weight / weight.sum())
                name, which = f"sky/{low}-{high}/{parity}", f"{parity} degrees"
                own = Element(name, "cl", names, None, fold, (low, high), L=0, kind="sky", component=which)
                elements.append(own)
    means = np.stack(rows)

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found: Vector = means @ sky_of(model, filtered)
        return found

    return Block(tuple(elements), values)


_FORMS = {"zz": "3z² − 1", "xx": "x² − y²"}


def _isotropy_block(model: Model) -> Block:
    """Measure the modulation of the shared sky, real L = 1 and L = 2: the integral of (S^-1 s^) s^ times a form.

    S^-1 s^ is cut to two ranges of degrees, one for each fold.
    """
    names = tuple(channel.name for channel in model.survey.channels)
    lmax, nside = model.lmax, model.nside
    x, y, z = healpy.pix2vec(nside, np.arange(12 * nside**2))
    forms = np.stack([x, y, z, 1.5 * z**2 - 0.5, x * z, y * z, x**2 - y**2, x * y])
    named = (
        ("x", 1, 1),
        ("y", 1, 1),
        ("z", 1, 0),
        ("zz", 2, 0),
        ("xz", 2, 1),
        ("yz", 2, 1),
        ("xx", 2, 2),
        ("xy", 2, 2),
    )
    ranges = bins(2, lmax, 2)
    elements = tuple(
        Element(
            f"isotropy/{form}/{low}-{high}",
            "biposh",
            names,
            None,
            fold,
            (low, high),
            L,
            M,
            "even",
            _frame(model),
            kind="isotropy",
            component=_FORMS.get(form, form),
        )
        for fold, (low, high) in enumerate(ranges)
        for form, L, M in named
    )
    ell = np.arange(lmax + 1)
    inverse = np.divide(1.0, model.cl, out=np.zeros(lmax + 1), where=model.cl > 0)
    filters = [np.where((ell >= low) & (ell <= high), inverse, 0.0) for low, high in ranges]

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        sky = healpix.synthesis(filtered.sky[None], nside, lmax)[0]
        weighted = [healpix.synthesis(alm_.multiply(filtered.sky, f, lmax)[None], nside, lmax)[0] for f in filters]
        return np.concatenate([forms @ (sky * field) for field in weighted])

    return Block(elements, values)


def _fold(model: Model, part: int) -> int | None:
    """Return the place of a map among its channel's, alternately 0 and 1; None for the only one."""
    members = model.of(model.parts[part].channel)
    return members.index(part) % 2 if len(members) > 1 else None
