"""The evidence: one short vector of numbers, each of which says where it was heard."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.matched_filters import normalised_difference, sky_of
from mcsim.diagnosis.wiener_filter import BEAM_ORDERS, SPLIT_BEAM_ORDERS, FilteredMaps, Model, by_degree
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotation_matrix

Map = NDArray[np.float64]
Vector = NDArray[np.float64]

SKY_BINS = 8
"""Bins of the spectrum of the sky that the maps share, even and odd degrees apart."""

BEAM_BINS = {0: 4, 1: 2, 2: 2, 3: 1, 4: 1}
"""Bins in l of what the sky says about the orders of a beam."""

LATITUDES = (0.0, 0.25, 0.6, 1.0)
"""Edges in |sin latitude| of bands of the sky."""

PLANE = 0.2
"""Width in sin b of the profile of the galactic plane."""

LARGE_SCALES = 64
"""Degree up to which signals fixed to the sky are compared between channels."""


@dataclass(frozen=True)
class Element:
    """Where one number of the evidence was heard.

    Attributes
    ----------
    name
        Unique.
    statistic
        "map": residual maps against the sky and the scan; "cl"; "biposh"; "noise"; "score": matched to an effect.
    channels, split
        Whose; no split where all maps of a channel count.
    fold
        0 or 1 where there is an entry like it whose noise is independent: a fit may use the one and be judged by the
        other. None where there is none.
    ell
        Range of degrees, None where all or none.
    L, M, parity, frame
        As for BipoSH coefficients, where they apply.
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


@dataclass(frozen=True)
class Block:
    """Entries that are computed together."""

    elements: tuple[Element, ...]
    values: Callable[[Model, FilteredMaps], Vector] = field(repr=False)


def blocks_of(model: Model) -> tuple[Block, ...]:
    """What is listened for whatever the effect: about 30 numbers a channel, and some on the sky."""
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
    """Ranges of degrees, both ends included, with about the same number of modes."""
    edges = np.sqrt(np.linspace(low**2, (high + 1) ** 2, number + 1)).astype(int)
    return [(int(a), int(b) - 1) for a, b in pairwise(edges)]


def scales(lmax: int) -> list[tuple[int, int]]:
    """Ranges of degrees for signals that fall steeply: each starts at about four times the one before."""
    edges = [low for low in (2, 13, 49) if low < lmax] + [lmax + 1]
    return [(a, b - 1) for a, b in pairwise(edges)]


def _label(model: Model, part: int) -> tuple[str, str | None]:
    channel, _, split = model.parts[part].name.partition(":")
    return channel, split or None


def _frame(model: Model) -> str:
    return model.survey.config.map.frame


def _beam_block(model: Model, part: int) -> Block:
    """D_s(l) with the kernels of a beam's change at order s, B_l l^s, in few bins."""
    channel, split = _label(model, part)
    frame, lmax = _frame(model), model.lmax
    ell = np.arange(lmax + 1)
    beam = model.survey.channels[model.parts[part].channel].site.beam
    kernels, elements = [], []
    first = part == model.of(model.parts[part].channel)[0]
    for s in range(min(BEAM_ORDERS if first else SPLIT_BEAM_ORDERS, model.parts[part].moments.smax) + 1):
        shape = beam.blm[0, : lmax + 1].real * (ell / lmax) ** max(s, 1)
        for low, high in bins(2, lmax, BEAM_BINS[s]):
            kernel = np.where((ell >= low) & (ell <= high), shape, 0.0)
            for quadrature in ("re", "im") if s else ("re",):
                kernels.append((s, quadrature, kernel))
                elements.append(
                    Element(
                        f"beam/{model.parts[part].name}/m{s}{quadrature}/{low}-{high}",
                        "map",
                        (channel,),
                        split if s <= SPLIT_BEAM_ORDERS else None,
                        _fold(model, part) if s <= SPLIT_BEAM_ORDERS else None,
                        (low, high),
                        L=s,
                        M=0,
                        parity="even",
                        frame=frame,
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
    """The dipole of the residual: x, y, z."""
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
        )
        for axis in "xyz"
    )
    one, two = alm_.start(model.lmax, 0) + 1, alm_.start(model.lmax, 1) + 1

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        alm = filtered.adjoint[part]
        return np.array([-alm[two].real, alm[two].imag, alm[one].real])

    return Block(elements, values)


def _plane_block(model: Model, part: int) -> Block:
    """What is left along the galactic plane, against its mean over the sky."""
    channel, split = _label(model, part)
    matrix = rotation_matrix(_frame(model), "galactic")
    height = matrix[2] @ np.stack(healpy.pix2vec(model.nside, np.arange(12 * model.nside**2)))
    profile = 1.0 / (1.0 + (height / PLANE) ** 2)
    profile -= profile.mean()
    element = Element(
        f"plane/{model.parts[part].name}",
        "map",
        (channel,),
        split,
        _fold(model, part),
        (2, LARGE_SCALES),
        L=2,
        M=0,
        parity="even",
        frame="galactic",
    )

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        return np.array([float(filtered.residual[part] @ profile)])

    return Block((element,), values)


def _noise_block(model: Model, channel: int) -> Block:
    """Variance over expectation in bands of ecliptic latitude; alternate pixels are fresh to the others."""
    parts = model.of(channel)
    name = model.survey.channels[channel].name
    matrix = rotation_matrix(_frame(model), "ecliptic")
    x, y, z = healpy.pix2vec(model.nside, np.arange(12 * model.nside**2))
    height = np.abs(matrix[2] @ np.stack([x, y, z]))
    alternate = np.arange(height.size) % 2
    seen = np.all([model.parts[i].precision > 0 for i in parts[:2]], axis=0)
    rows, elements = [], []
    for half in (0, 1):
        for low, high in pairwise(LATITUDES):
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
                )
            )
    bands = np.stack(rows)

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found: Vector = bands @ normalised_difference(model, filtered, parts)
        return found

    return Block(tuple(elements), values)


def _linearity_block(model: Model, channel: int) -> Block:
    """What is left against the square of the sky: a gain that depends on the signal."""
    parts, name = model.of(channel), model.survey.channels[channel].name

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        return np.array([sum(np.dot(filtered.residual[i], filtered.expected[i] ** 2) for i in parts)])

    return Block((Element(f"square/{name}", "map", (name,)),), values)


def _repeated_block(model: Model, channel: int) -> Block:
    """Power of the residual that the channel's first two maps have in common, and of what they have not."""
    first, second = model.of(channel)[:2]
    name = model.survey.channels[channel].name
    ranges = scales(model.lmax)
    elements = tuple(
        Element(f"{kind}/{name}/{low}-{high}", "cl", (name,), None, None, (low, high), L=0)
        for kind in ("common", "difference")
        for low, high in ranges
    )

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        a, b = filtered.adjoint[first], filtered.adjoint[second]
        common, apart = by_degree(a, b, model.lmax), by_degree(a - b, a - b, model.lmax)
        return np.array([power[low : high + 1].sum() for power in (common, apart) for low, high in ranges])

    return Block(elements, values)


def _contrast_block(model: Model) -> Block | None:
    """Power common to two maps of the contrast between the lowest and the highest frequency, by galactic latitude."""
    channels = model.survey.channels
    frequencies = [channel.site.frequency_ghz for channel in channels]
    known = sorted({f for f in frequencies if f is not None})
    if len(known) < 2 or any(len(model.of(c)) < 2 for c in range(len(channels))):
        return None
    groups = [[c for c, f in enumerate(frequencies) if f == end] for end in (known[0], known[-1])]
    top = min(LARGE_SCALES, model.lmax)
    nside = max(1, 1 << (top // 3).bit_length() - 1) * 2
    matrix = rotation_matrix(_frame(model), "galactic")
    height = np.abs(matrix[2] @ np.stack(healpy.pix2vec(nside, np.arange(12 * nside * nside))))
    bands = np.stack([(height >= low) & (height <= high) for low, high in pairwise(LATITUDES)]).astype(float)
    names = tuple(channels[c].name for group in groups for c in group)
    elements = tuple(
        Element(f"contrast/{low:g}-{high:g}", "map", names, None, None, (2, top), L=0, frame="galactic")
        for low, high in pairwise(LATITUDES)
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
    """Spectrum of the sky over its expectation, minus one; odd degrees are fresh to even ones."""
    names = tuple(channel.name for channel in model.survey.channels)
    large = [(2, 11), (12, 40)] if model.lmax > LARGE_SCALES else []
    ranges = [*large, *bins(41 if large else 2, model.lmax, SKY_BINS - len(large))]
    ell = np.arange(model.lmax + 1)
    rows, elements = [], []
    for fold, parity in enumerate(("even", "odd")):
        for low, high in ranges:
            weight = np.where((ell >= low) & (ell <= high) & (ell % 2 == fold), 2.0 * ell + 1.0, 0.0)
            if weight.any():
                rows.append(weight / weight.sum())
                elements.append(Element(f"sky/{low}-{high}/{parity}", "cl", names, None, fold, (low, high), L=0))
    means = np.stack(rows)

    def values(model: Model, filtered: FilteredMaps) -> Vector:
        found: Vector = means @ sky_of(model, filtered)
        return found

    return Block(tuple(elements), values)


def _isotropy_block(model: Model) -> Block:
    """Modulation of the sky that the maps share, real L = 1 and L = 2: the integral of (S^-1 s^) s^ times a form.

    Two ranges of degrees, with S^-1 s^ cut to them, the one fresh to the other.
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
        Element(f"isotropy/{form}/{low}-{high}", "biposh", names, None, fold, (low, high), L, M, "even", _frame(model))
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
    """Place of a map among its channel's, alternately 0 and 1; None for the only one."""
    members = model.of(model.parts[part].channel)
    return members.index(part) % 2 if len(members) > 1 else None
