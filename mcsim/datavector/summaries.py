"""The data vector: a short vector of summary statistics, each with a description."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import healpy
import numpy as np
from numpy.typing import NDArray

from mcsim.bipolar import by_degree
from mcsim.datavector.filter_model import Model
from mcsim.datavector.wiener_filter import FilteredMaps
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix
from mcsim.sphere.rotation import rotation_matrix
from mcsim.support.arrays import Map, Vector, divided
from mcsim.systematics.sky import band_edges


@dataclass(frozen=True)
class Element:
    """Describe one element of the data vector."""

    name: str  # unique, for people: what an element is of stands in the other fields
    statistic: str  # "map": residual maps against sky and scan; "cl"; "biposh"; "noise"; "score": matched filter
    channels: tuple[str, ...]
    split: str | None = None  # None if all maps of a channel count
    # 0 or 1 if there is a similar element whose noise is independent: a fit may use the one and be tested with the
    # other. None if there is none.
    fold: int | None = None
    ell: tuple[int, int] | None = None  # range of degrees, None if all or none
    L: int | None = None  # L, M, parity and frame are as for BipoSH coefficients, if they apply
    M: int | None = None
    parity: str | None = None
    frame: str | None = None
    kind: str = "other"  # what is measured, one of the keys of KINDS
    component: str | None = None  # which of the numbers that are alike in all else: "real", "x", "even pixels"
    effect: str | None = None  # of a matched filter, the effect that it is matched to, in words
    candidate: str | None = None  # the name of that effect

    @property
    def family(self) -> str:
        """Return what is measured in words, with the order of a beam's kernel."""
        if self.effect is not None:
            return f"matched filter: {self.effect}"
        return KINDS.get(self.kind, self.kind) + (f", order {self.L}" if self.kind == "beam" else "")

    @property
    def unit(self) -> str:
        """Return the unit of the number, "1" for one without."""
        return UNITS.get(self.kind, "1")

    @property
    def words(self) -> str:
        """Return what was measured, where and in which component, in words."""
        degrees = "" if self.ell is None else f"ℓ {self.ell[0]}" + f"–{self.ell[1]}" * (self.ell[1] > self.ell[0])
        whose = () if self.effect is not None else (", ".join(self.channels), self.split)
        return ", ".join(filter(None, (self.family, *whose, degrees, self.component)))


def pair_classes(elements: Sequence[Element]) -> NDArray[np.int64]:
    """Return the number of the class of each pair of elements, shape (p, p), the same for pairs that are alike.

    They measure the same two things, in one channel or in two, in one split or in two, whichever these are.
    """
    kinds: dict[tuple[Element, int], int] = {}
    met: dict[tuple[Element, tuple[str, ...], str | None], int] = {}
    kind = np.zeros(len(elements), dtype=np.int64)
    for i, element in enumerate(elements):
        what = replace(element, name="", channels=(), split=None, fold=None, effect=None)
        whose = (what, element.channels, element.split)
        met[whose] = met.get(whose, 0) + 1
        kind[i] = kinds.setdefault((what, met[whose]), len(kinds))
    channels = sorted({channel for element in elements for channel in element.channels})
    seen = np.array([[channel in element.channels for channel in channels] for element in elements], dtype=np.int64)
    split = np.array([str(element.split) for element in elements])
    low, high = np.minimum.outer(kind, kind), np.maximum.outer(kind, kind)
    classes = (low * len(kinds) + high) * (len(channels) + 1) + seen @ seen.T
    return np.asarray(2 * classes + (split[:, None] == split))


KINDS = {
    "beam": "residual × sky through the beam",
    "monopole": "mean of the residual",
    "dipole": "dipole of the residual",
    "plane": "Galactic plane in the residual",
    "noise": "noise variance",
    "square": "residual × sky²",
    "common": "residual power common to splits",
    "difference": "power of the split difference",
    "contrast": "contrast of frequencies",
    "sky": "power spectrum of the shared sky",
    "fine": "power of the shared sky beyond the filter",
    "isotropy": "modulation of the shared sky",
    "matched": "matched filter",
    "biposh": "BipoSH of residual × sky",
    "cross": "cross power of residuals",
    "table": "measured spectrum",
    "residual": "residual at the largest scales",
    "gain": "residual × sky at the largest scales",
}
"""What the elements of the data vector measure, in words."""

UNITS = {
    "monopole": "uK^-1",
    "dipole": "uK^-1",
    "plane": "uK^-1",
    "common": "uK^-2",
    "difference": "uK^-2",
    "contrast": "uK^2",
    "fine": "uK^-2",
    "cross": "uK^-2",
    "table": "uK^2",
    "residual": "uK^-1",
}
"""Units of what has one: residuals of maps are over the variance of their noise, and so in uK^-1."""


@dataclass(frozen=True)
class Block:
    """Compute some elements together: numbers of shape (elements,), or the only one."""

    elements: tuple[Element, ...]
    values: Callable[[FilteredMaps], Vector | float] = field(repr=False)


def blocks_of(model: Model) -> tuple[Block, ...]:
    """Return the blocks that do not depend on a candidate: about 30 elements a channel, and some of the sky."""
    parts = range(len(model.parts))
    blocks = [block(model, i) for block in (_beam_block, _lowest_block, _plane_block) for i in parts]
    for channel in range(len(model.response)):
        blocks += [_noise_block(model, channel), _linearity_block(model, channel)]
        if len(model.of(channel)) > 1:
            blocks.append(_repeated_block(model, channel))
    if model.pooled and len(model.parts) > 1:
        blocks.append(_mean_block(model))
    return (*blocks, *_contrast_blocks(model), _sky_block(model), _isotropy_block(model))


def bins(low: int, high: int, number: int) -> list[tuple[int, int]]:
    """Return ranges of degrees, both ends included, of about as many modes each; of few degrees fewer ranges."""
    edges = np.sqrt(np.linspace(low**2, (high + 1) ** 2, number + 1)).astype(int)
    return [(int(a), int(b) - 1) for a, b in pairwise(edges) if a < b]


def ranges_within(edges: Iterable[int], number: int) -> list[tuple[int, int]]:
    """Return so many ranges of degrees, both ends included, that end before edges, the last of which is the end.

    The ranges of the most modes are halved, or of more ranges than ``number`` those of the fewest modes are joined.
    """

    def modes(ends: tuple[int, int]) -> int:
        return ends[1] ** 2 - ends[0] ** 2

    found = sorted(set(edges))
    while len(found) <= number:
        low, high = max(pairwise(found), key=modes)
        if high == low + 1:
            break
        (_, middle), _ = bins(low, high - 1, 2)
        found = sorted((*found, middle + 1))
    while len(found) > number + 1:
        low, _ = min(zip(found, found[2:], strict=False), key=modes)
        del found[found.index(low) + 1]
    return [(low, high - 1) for low, high in pairwise(found)]


def scales(lmax: int) -> list[tuple[int, int]]:
    """Return ranges of degrees for steep spectra: each starts at about four times the one before."""
    edges = [low for low in (2, 13, 49) if low < lmax] + [lmax + 1]
    return [(a, b - 1) for a, b in pairwise(edges)]


def of_map(model: Model, part: int) -> Element:
    """Describe what the elements of a map have in common; maps of a channel are in fold 0 and 1 alternately."""
    own = model.parts[part]
    members = model.of(own.channel)
    fold = members.index(part) % 2 if len(members) > 1 else None
    return Element(own.name, "map", (model.channels[own.channel],), own.split, fold, frame=model.frame)


def sine_of_latitude(frame: str, to: str, nside: int) -> Map:
    """Return the sine of the latitude, in another frame, of every pixel in RING order, shape (npix,)."""
    return np.asarray(rotation_matrix(frame, to)[2] @ healpix.centres(nside))


def _beam_block(model: Model, part: int) -> Block:
    """Project D_s(l) on B_l l^s, the change of a beam at order s, in few bins."""
    whole, own, settings = of_map(model, part), model.parts[part], model.settings
    ell = np.arange(model.lmax + 1)
    beam = model.survey.channels[own.channel].site.beam
    top = settings.beam_orders if part == model.of(own.channel)[0] else settings.split_beam_orders
    kernels, elements = [], []
    shown = model.last_shown(own.channel)
    for s in range(min(top, own.moments.smax, model.lmax) + 1):
        shape = beam.blm[0, : model.lmax + 1].real * (ell / model.lmax) ** max(s, 1)
        # Above these orders the channel's sum is measured, in the place of its first map.
        alike = whole if s <= settings.split_beam_orders else replace(whole, split=None, fold=None)
        alike = replace(alike, L=s, M=0, parity="even", kind="beam")
        end = min(int(model.last_degrees[own.channel, s]) if s else model.lmax, shown)
        for low, high in bins(2, end, settings.beam_bins[s]):
            kernel = np.where((ell >= low) & (ell <= high), shape, 0.0)
            for short, component in (("re", "real" if s else None), ("im", "imaginary"))[: 2 if s else 1]:
                kernels.append((s, short, kernel))
                name = f"beam/{own.name}/m{s}{short}/{low}-{high}"
                elements.append(replace(alike, name=name, ell=(low, high), component=component))

    def values(filtered: FilteredMaps) -> Vector:
        orders = {"re": filtered.orders[part].real, "im": filtered.orders[part].imag}
        return np.array([np.dot(kernel, orders[short][s]) for s, short, kernel in kernels])

    return Block(tuple(elements), values)


def _lowest_block(model: Model, part: int) -> Block:
    """Measure the mean of the residual, and its dipole: x, y, z."""
    one, two = alm_.start(model.lmax, 0) + 1, alm_.start(model.lmax, 1) + 1

    def values(filtered: FilteredMaps) -> Vector:
        alm = filtered.adjoint[part]
        return np.array([alm[0].real, -alm[two].real, alm[two].imag, alm[one].real])

    return Block(_lowest(of_map(model, part)), values)


def _lowest(whole: Element) -> tuple[Element, ...]:
    """Return the elements of the mean and of the dipole of what is described as a whole."""
    mean = replace(whole, name=f"monopole/{whole.name}", ell=(0, 0), L=0, M=0, parity="even", kind="monopole")
    alike = replace(whole, ell=(1, 1), L=1, kind="dipole")
    return (mean, *(replace(alike, name=f"dipole/{alike.name}/{axis}", component=axis) for axis in "xyz"))


def _mean_block(model: Model) -> Block:
    """Measure what is left of the mean of pooled maps: its lowest degrees, the Galactic plane, its power by latitude.

    The power is that of the sky beyond the filter, of which no other element knows.
    """
    name, end = "mean of maps", model.survey.config.sky.lmax
    whole = Element(name, "map", model.channels, frame=model.frame)
    profile, plane = _plane(model, whole)
    forms = np.stack([np.ones(profile.size), *healpix.centres(model.nside), profile])
    power = replace(whole, statistic="cl", ell=(model.lmax + 1, end), L=0, frame="galactic", kind="fine")
    seen = np.any([part.precision > 0 for part in model.parts], axis=0)
    height = np.abs(sine_of_latitude(model.frame, "galactic", model.nside))
    rows, elements = [], []
    for fold, which, words, band in _bands(model, height, seen):
        rows.append(band)
        elements.append(replace(power, name=f"fine/{which}", fold=fold, component=f"|sin b| {words}"))
    bands = np.stack(rows).astype(float)

    def values(filtered: FilteredMaps) -> Vector:
        assert filtered.mean is not None  # of pooled maps
        return np.concatenate([forms @ filtered.mean, bands @ filtered.mean**2])

    return Block((*_lowest(whole), plane, *elements), values)


def _bands(model: Model, height: Map, seen: NDArray[np.bool_]) -> Iterator[tuple[int, str, str, NDArray[np.bool_]]]:
    """Yield fold, name, words and pixels of bands of a height, alternate pixels apart, where something is seen."""
    for half, (low, high) in product((0, 1), pairwise(model.settings.latitude_edges)):
        band = seen & (height >= low) & (height <= high) & (np.arange(height.size) % 2 == half)
        if band.any():
            words = f"{low:g}–{high:g}, {'odd' if half else 'even'} pixels"
            yield half, f"{low:g}-{high:g}/pixels{half}", words, band


def _plane_block(model: Model, part: int) -> Block:
    """Measure the residual along the Galactic plane, against its mean over the sky."""
    profile, element = _plane(model, of_map(model, part))
    return Block((element,), lambda filtered: float(filtered.residual[part] @ profile))


def _plane(model: Model, whole: Element) -> tuple[Map, Element]:
    """Return the profile of the Galactic plane, of mean zero, and its element of what is described as a whole."""
    profile = 1.0 / (1.0 + (sine_of_latitude(model.frame, "galactic", model.nside) / model.settings.plane_width) ** 2)
    ends = 2, min(model.settings.large_scales, model.lmax)
    element = replace(whole, name=f"plane/{whole.name}", ell=ends, L=2, M=0, parity="even")
    return profile - profile.mean(), replace(element, frame="galactic", kind="plane")


def _noise_block(model: Model, channel: int) -> Block:
    """Measure variance over expectation in bands of ecliptic latitude, alternate pixels apart."""
    parts, name = model.of(channel), model.channels[channel]
    height = np.abs(sine_of_latitude(model.frame, "ecliptic", model.nside))
    seen = np.all([model.parts[i].precision > 0 for i in parts[:2]], axis=0)
    rows, elements = [], []
    for fold, which, words, band in _bands(model, height, seen):
        rows.append(band.astype(float))
        own = Element(f"noise/{name}/{which}", "noise", (name,), fold=fold, L=0, kind="noise")
        elements.append(replace(own, frame="ecliptic", component=f"|sin β| {words}"))
    bands = np.reshape(rows, (-1, height.size))  # none, if two maps have no pixel in common
    return Block(tuple(elements), lambda filtered: np.asarray(bands @ filtered.difference[channel]))


def _linearity_block(model: Model, channel: int) -> Block:
    """Correlate the residual with the square of the sky: a gain that depends on the signal.

    In units of what noise makes of it on the sky that is observed: squares of few bright modes differ from sky to sky,
    and the product as it stands has a few values that are far off.
    """
    parts, name = model.of(channel), model.channels[channel]

    def value(filtered: FilteredMaps) -> float:
        product = variance = 0.0
        for i in parts:
            square = filtered.expected[i] ** 2
            product += np.dot(filtered.residual[i], square)
            variance += np.dot(model.parts[i].precision, square**2)
        return float(divided(product, np.sqrt(variance)))

    return Block((Element(f"square/{name}", "map", (name,), kind="square"),), value)


def _repeated_block(model: Model, channel: int) -> Block:
    """Measure the residual power common to the channel's first two maps, and that of their difference."""
    (first, second), name = model.of(channel)[:2], model.channels[channel]
    ranges = scales(model.lmax)
    elements = tuple(
        Element(f"{kind}/{name}/{low}-{high}", "cl", (name,), ell=(low, high), L=0, kind=kind)
        for kind, (low, high) in product(("common", "difference"), ranges)
    )

    def values(filtered: FilteredMaps) -> Vector:
        a, b = filtered.adjoint[first], filtered.adjoint[second]
        common, apart = by_degree(a, b, model.lmax), by_degree(a - b, a - b, model.lmax)
        return np.array([power[low : high + 1].sum() for power in (common, apart) for low, high in ranges])

    return Block(elements, values)


def _contrast_blocks(model: Model) -> list[Block]:
    """Measure the power of the contrast of lowest and highest frequency, common to two splits, by Galactic latitude."""
    sites = [channel.site for channel in model.survey.channels]
    frequencies = [site.frequency_ghz if site.foregrounds else None for site in sites]
    known = sorted({f for f in frequencies if f is not None})
    if len(known) < 2 or any(len(model.of(c)) < 2 for c in range(len(frequencies))):
        return []
    groups = [[c for c, f in enumerate(frequencies) if f == end] for end in (known[0], known[-1])]
    top = min(model.settings.large_scales, model.lmax)
    nside = 2 << max(top // 3, 1).bit_length() - 1
    height = np.abs(sine_of_latitude(model.frame, "galactic", nside))
    each = [((low, high), (height >= low) & (height <= high)) for low, high in pairwise(model.settings.latitude_edges)]
    if not (seen := [(ends, band) for ends, band in each if band.any()]):
        return []
    ranges, bands = [ends for ends, _ in seen], np.stack([band for _, band in seen]).astype(float)
    names = tuple(model.channels[c] for group in groups for c in group)
    alike = Element("contrast", "map", names, ell=(2, top), L=0, frame="galactic", kind="contrast")
    elements = tuple(
        replace(alike, name=f"contrast/{low:g}-{high:g}", component=f"|sin b| {low:g}–{high:g}") for low, high in ranges
    )

    def smoothed(filtered: FilteredMaps, split: int) -> Map:
        total = np.zeros(alm_.size(model.lmax), dtype=np.complex128)
        for group, sign in zip(groups, (1.0, -1.0), strict=True):
            for c in group:
                part = model.of(c)[split]
                weight = np.mean(model.parts[part].precision) * healpy.nside2npix(model.nside)
                total += sign / len(group) / weight * filtered.adjoint[part]
        low = alm_.resize(total, model.lmax, top)
        low[: min(2, top + 1)] = 0.0
        low[top + 1] = 0.0
        return np.asarray(healpix.synthesis(low[None], nside, top)[0])

    return [Block(elements, lambda filtered: np.asarray(bands @ (smoothed(filtered, 0) * smoothed(filtered, 1))))]


def _sky_block(model: Model) -> Block:
    """Measure the spectrum of the sky over its expectation, minus one, odd and even degrees apart."""
    lmax = model.lmax
    ell = np.arange(lmax + 1)
    # The change of a band of the effect "spectrum" would be diluted in a range that reaches beyond it.
    inner = [
        *band_edges(model.survey.config.sky.lmax).tolist(),
        *((12, 41) if lmax > model.settings.large_scales else ()),
    ]
    ranges = ranges_within([2, *(edge for edge in inner if 2 < edge <= lmax), lmax + 1], model.settings.sky_bins)
    rows, elements = [], []
    for (fold, parity), (low, high) in product(enumerate(("even", "odd")), ranges):
        weight = np.where((ell >= low) & (ell <= high) & (ell % 2 == fold), (2.0 * ell + 1.0) * model.sky_power, 0.0)
        if weight.any():
            rows.append(weight / weight.sum())
            own = Element(f"sky/{low}-{high}/{parity}", "cl", model.channels, fold=fold, ell=(low, high), L=0)
            elements.append(replace(own, kind="sky", component=f"{parity} degrees"))
    means, expected = np.stack(rows), model.cl * model.sky_power

    def values(filtered: FilteredMaps) -> Vector:
        power = by_degree(filtered.sky, filtered.sky, lmax) / (2 * ell + 1)
        ratio = divided(power, expected, 1.0)
        return np.asarray(means @ (ratio - 1.0))

    return Block(tuple(elements), values)


_FORMS = {"x": (1, 1), "y": (1, 1), "z": (1, 0), "zz": (2, 0), "xz": (2, 1), "yz": (2, 1), "xx": (2, 2), "xy": (2, 2)}
"""L and M of real forms; "zz" is 3z² − 1 and "xx" is x² − y²."""


def _isotropy_block(model: Model) -> Block:
    """Measure the modulation of the shared sky, real L = 1 and L = 2: the integral of (S^-1 s^) s^ times a form.

    S^-1 s^ is cut to two ranges of degrees, one for each fold.
    """
    lmax, nside, ell = model.lmax, model.nside, np.arange(model.lmax + 1)
    x, y, z = healpix.centres(nside)
    forms = np.stack([x, y, z, 1.5 * z**2 - 0.5, x * z, y * z, x**2 - y**2, x * y])
    filters, elements = [], []
    for fold, (low, high) in enumerate(bins(2, model.last_shown(), 2)):
        filters.append(np.where((ell >= low) & (ell <= high), model.inverse_cl, 0.0))
        alike = Element("isotropy", "biposh", model.channels, None, fold, (low, high), frame=model.frame)
        for form, (L, M) in _FORMS.items():
            own = replace(alike, name=f"isotropy/{form}/{low}-{high}", L=L, M=M, parity="even")
            elements.append(replace(own, kind="isotropy", component={"zz": "3z² − 1", "xx": "x² − y²"}.get(form, form)))

    def values(filtered: FilteredMaps) -> Vector:
        sky = healpix.synthesis(filtered.sky[None], nside, lmax)[0]
        weighted = [healpix.synthesis(alm_.multiply(filtered.sky, f, lmax)[None], nside, lmax)[0] for f in filters]
        return np.concatenate([forms @ (sky * field) for field in weighted])

    return Block(tuple(elements), values)
