"""Elements of the data vector whose answers to a change of the maps are known."""

import warnings
from dataclasses import replace

import healpy
import numpy as np
import pytest

from instruments import two_channels
from mcsim import config
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.filter_model import model_of
from mcsim.datavector.map_checks import (
    check_pixels,
    check_splits_differ,
    check_subtracted,
    checked_map,
    warn_of_parts_of_pixels,
)
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import Element, bins, blocks_of, pair_classes, ranges_within
from mcsim.datavector.wiener_filter import wiener_filter
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.systematics import catalogue
from refusals import refused, unnamed

EDGES = (2, 12, 23, 33, 44, 54, 65)


@pytest.fixture(scope="module")
def analysis():
    settings = DiagnosisSettings(beam_orders=1, split_beam_orders=1)
    return analysis_of(config.load(two_channels("mean")), without=tuple(catalogue()), settings=settings)


def test_a_mean_is_weighted_with_the_inverse_variance_of_its_own_map_alone(analysis) -> None:
    """The sky that the filter finds has no monopole: all of a constant is left in the residual, times 1 / N.

    Sums over pixels are integrals to some 1e-6 of the constant: degrees above 1 have as much.
    """
    maps = list(simulate.maps(survey(analysis.run), 0))
    shifted = [maps[0], maps[1] + 5.0, *maps[2:]]
    change = analysis.data_vector(shifted) - analysis.data_vector(maps)
    found = [value for one, value in zip(analysis.elements, change, strict=True) if one.kind == "monopole"]
    expected = 5.0 * analysis.model.parts[1].precision.sum() / np.sqrt(4.0 * np.pi)
    np.testing.assert_allclose(found, [0.0, expected, 0.0, 0.0], rtol=1e-5, atol=1e-5 * expected)


def test_channels_whose_descriptions_have_other_dipoles_are_refused(analysis) -> None:
    """The dipole of the first channel stood for all: without one a gain of the other's had no name."""
    known = analysis.model.survey
    first, second = known.channels
    none = replace(first, site=replace(first.site, dipole_uk=np.zeros(3)))
    size = f"{np.linalg.norm(second.site.dipole_uk):g}"
    for channels in ((none, second), (second, none)):
        with refused("V1", "W1", size, "sky.dipole_uk"):
            model_of(replace(known, channels=channels), DiagnosisSettings())


def test_no_element_names_degrees_that_the_filters_do_not_have(analysis) -> None:
    """The Galactic plane was one of degrees 2 to 64 in a model that ends at 40."""
    elements = (*analysis.elements, *analysis.slices, *analysis.bipolar_scan.elements)
    ends = {element.kind: element.ell for element in elements if element.ell is not None}
    assert max(last for _, last in ends.values()) == analysis.model.lmax
    assert ends["plane"] == (2, analysis.model.lmax)


def test_bands_of_latitude_without_a_pixel_are_no_elements() -> None:
    """Their contrast of frequencies was 0 in all simulations: "element 154 ... has no finite variance; omit it"."""
    settings = DiagnosisSettings(latitude_edges=(0.0, 0.03, 0.95, 1.0), large_scales=5)
    few = analysis_of(config.load(two_channels("bands")), without=tuple(catalogue()), settings=settings)
    assert [one.component for one in few.elements if one.kind == "contrast"] == ["|sin b| 0.03–0.95", "|sin b| 0.95–1"]
    vectors = [few.data_vector(list(simulate.maps(survey(few.run), number))) for number in range(3)]
    assert np.std(vectors, axis=0).min() > 0.0
    settings = DiagnosisSettings(latitude_edges=(0.99, 1.0), large_scales=3)
    none = analysis_of(config.load(two_channels("bands")), without=tuple(catalogue()), settings=settings)
    assert "contrast" not in {one.kind for one in none.elements}


def test_elements_are_of_degrees_that_the_maps_show() -> None:
    """Bins of a beam where a step in harmonics, or the spectrum, has ended were zero in all simulations: a refusal."""
    rotated = {"preparation": [{"kind": "rotate", "frame": "galactic"}]}
    cl = np.append(1000.0 / (1.0 + np.arange(16.0)) ** 2, np.zeros(7))
    shorter = {"sky": {"spectrum": cl, "lmax": 22}}
    for changes, last in ((rotated, 16), (shorter, 15)):
        run = config.load(two_channels("short", lmax=22, nside=8, fwhm_arcmin=500.0) | changes)
        short = analysis_of(run, without=tuple(catalogue()))
        ends = [element.ell[1] for element in short.elements if element.kind == "beam"]
        assert (short.model.lmax, max(ends)) == (22, last)
        vectors = [short.data_vector(list(simulate.maps(survey(run), number))) for number in range(3)]
        assert np.std(vectors, axis=0).min() > 0.0


@pytest.mark.parametrize(("high", "number", "expected"), [(2, 3, [(2, 2)]), (3, 3, [(2, 2), (3, 3)])])
def test_few_degrees_make_few_bins(high, number, expected) -> None:
    """Empty ones made every p-value of a scan of degree 2 alone 1."""
    assert bins(2, high, number) == expected


def test_elements_scale_as_their_units_say(analysis) -> None:
    """A sky, a dipole, noise and maps of twice the temperature: 2 to the power of µK in the unit."""
    factor, maps = 2.0, list(simulate.maps(survey(analysis.run), 0))
    table = two_channels("scaled", sigma0_uk=factor * 30.0)
    cl = survey(analysis.run).cl
    table["sky"] = {**table["sky"], "spectrum": factor**2 * cl, "dipole_uk": factor * 3364.5}
    scaled = analysis_of(config.load(table), without=tuple(catalogue()), settings=analysis.settings)
    power = {"uK^-2": -2, "uK^-1": -1, "1": 0, "uK": 1, "uK^2": 2}
    for one, other, elements in (
        (analysis.data_vector(maps), scaled.data_vector([factor * m for m in maps]), analysis.elements),
        (
            analysis.data_vector(maps, slices=True)[len(analysis.elements) :],
            scaled.data_vector([factor * m for m in maps], slices=True)[len(analysis.elements) :],
            analysis.slices,
        ),
    ):
        expected = np.array([factor ** power[element.unit] for element in elements])
        np.testing.assert_allclose(other, expected * one, rtol=1e-6, atol=1e-9)


def test_the_product_of_residual_and_squared_sky_scatters_alike_on_every_sky(analysis) -> None:
    """As it stood a sky four times as bright made it sixteen times as large, and few bright modes a tail."""
    block = next(one for one in blocks_of(analysis.model) if one.elements[0].kind == "square")
    filtered = wiener_filter(analysis.model, list(simulate.maps(survey(analysis.run), 0)))
    brighter = replace(filtered, expected=4.0 * filtered.expected)
    assert block.values(brighter) == pytest.approx(block.values(filtered))
    draw, precision = np.random.default_rng(0), np.stack([part.precision for part in analysis.model.parts])
    noise = (replace(filtered, residual=np.sqrt(precision) * draw.standard_normal(precision.shape)) for _ in range(300))
    assert np.std([block.values(one) for one in noise]) == pytest.approx(1.0, abs=4.0 / np.sqrt(600.0))


def test_ranges_end_at_the_edges_and_the_widest_are_halved() -> None:
    found = ranges_within(EDGES, 8)
    assert len(found) == 8
    assert {low for low, _ in found} >= set(EDGES[:-1])
    assert [low for low, _ in found[1:]] == [high + 1 for _, high in found[:-1]]
    assert found[-1] == (59, 64)


def test_of_more_ranges_than_asked_for_those_of_the_fewest_modes_are_joined() -> None:
    assert ranges_within(EDGES, 4) == [(2, 32), (33, 43), (44, 53), (54, 64)]
    assert ranges_within(EDGES, 1) == [(2, 64)]


def test_no_range_is_less_than_a_degree() -> None:
    assert ranges_within((2, 4), 9) == [(2, 2), (3, 3)]


def test_pairs_are_of_one_class_whichever_channels_and_splits_they_are_of():
    def of(channel, split, order, low):
        name = f"{channel}{split}{order}{low}"
        return Element(name, "map", (channel,), split, ell=(low, low + 9), L=order, kind="beam")

    maps = [(channel, split) for channel in ("V1", "W1", "W2") for split in ("half1", "half2")]
    elements = [of(*one, order, low) for one in maps for order in (0, 1) for low in (2, 12)]
    # Two numbers of one channel that have all but their names in common: the first of each map is like the first.
    both = [(channel, letter) for channel in ("V1", "W1") for letter in "ab"]
    elements += [Element(one + letter, "score", (one,), candidate="gain", kind="matched") for one, letter in both]
    elements.append(Element("sky", "cl", ("V1", "W1", "W2"), kind="sky"))
    place = {element.name: number for number, element in enumerate(elements)}
    classes = pair_classes(elements)

    def same(*pairs):
        return len({int(classes[place[one], place[other]]) for one, other in pairs}) == 1

    assert np.array_equal(classes, classes.T)
    assert same(("V1half102", "W1half112"), ("W1half102", "V1half112"), ("W2half212", "W1half202"))  # orders 0 and 1
    assert same(("V1half102", "V1half112"), ("W2half202", "W2half212"))
    assert same(("V1half102", "V1half202"), ("W1half102", "W1half202"))
    assert same(("V1half102", "sky"), ("W2half202", "sky"))
    assert same(("V1a", "W1b"), ("V1b", "W1a"))
    for one, other in (
        ("V1half112", "W1half112"),  # the same channel or another one
        ("W1half202", "V1half112"),  # the same map or another one
        ("V1half102", "V1half212"),  # the same split or another one
        ("W1half1012", "V1half112"),  # another range of degrees
        ("W1half102", "W1half202"),  # another order
    ):
        assert not same(("V1half102", "V1half112"), (one, other))
    assert not same(("V1a", "W1a"), ("V1a", "W1b"))


def test_maps_without_a_pixel_in_common_have_no_noise_of_their_difference(analysis) -> None:
    """Such as those of two masks: in the place of the numbers there are none."""
    north = np.arange(12 * 16**2) < 6 * 16**2
    parts = [
        replace(part, precision=np.where(north == (number % 2 == 0), part.precision, 0.0))
        for number, part in enumerate(analysis.model.parts)
    ]
    model = replace(analysis.model, parts=tuple(parts), inverse=None)
    maps = list(simulate.maps(survey(analysis.run), 0))
    blocks, filtered = blocks_of(model), wiener_filter(model, maps)
    assert "noise" not in {element.kind for block in blocks for element in block.elements}
    for block in blocks:
        assert np.size(block.values(filtered)) == len(block.elements)


@pytest.mark.parametrize(("unseen", "factor", "named"), [(43, 1.0, (1.4, 1)), (0, 100.0, (20, "factor", "TUNIT1"))])
def test_a_map_that_is_refused_is_told_by_how_much(analysis, unseen, factor, named) -> None:
    """1.4 % are more than 1 %, and both of a ratio's limits are one number."""
    map_uk = factor * next(iter(simulate.maps(survey(analysis.run), 0)))
    map_uk[:unseen] = healpy.UNSEEN
    with refused("W1", *named):
        checked_map(analysis.model, analysis.model.parts[0], map_uk, "the map of W1")


def test_a_map_of_fewer_pixels_than_numbers_are_measured_of_it_is_refused(analysis) -> None:
    model, elements = analysis.model, analysis.elements
    own = sum(one.channels == ("V1",) and one.split in (None, "half1") for one in elements)
    first = model.parts[0]
    for seen in (own, own - 1):
        few = np.where(np.arange(first.precision.size) < seen, first.precision[0], 0.0)
        masked = replace(model, parts=(replace(first, precision=few), *model.parts[1:]))
        if seen == own:
            check_pixels(masked, elements)
        else:
            with refused(own - 1, own, "V1:half1", "map.mask"):
                check_pixels(masked, elements)


def test_a_map_without_noise_needs_a_floor_of_it() -> None:
    run = config.load(two_channels("quiet"))
    quiet = survey(replace(run, channels=tuple(channel.without_noise() for channel in run.channels)))
    with refused("noise_floor", 0, quiet.map_names[0]):
        model_of(quiet, DiagnosisSettings(noise_floor=0.0))
    model_of(survey(run), DiagnosisSettings(noise_floor=0.0))


def test_a_sky_without_power_is_refused() -> None:
    """No number of the sky is left to measure: that ended in a traceback."""
    table = two_channels("empty")
    power = np.where(np.arange(table["sky"]["lmax"] + 1) < 2, 1.0, 0.0)
    shared = survey(config.load(table | {"sky": {**table["sky"], "spectrum": power}}))
    with refused("sky.spectrum", "l = 2"):
        model_of(shared, DiagnosisSettings())


def parallel(lmax: int, *noise: dict[str, float] | None) -> config.RunConfig:
    """Return a run of parallel transport with two splits, a channel for each noise."""
    table = two_channels("parallel", lmax=lmax)
    channels = [
        {"name": f"C{number}", "frequency_ghz": 94.0, "beam": {"kind": "gaussian", "fwhm_arcmin": 350.0}}
        | {"scan": {"kind": "parallel_transport"}, **({} if own is None else {"noise": {"kind": "depth", **own}})}
        for number, own in enumerate(noise)
    ]
    return config.load(table | {"channel": channels})


@pytest.mark.parametrize("lmax", [2, 3])
def test_orders_of_a_beam_end_with_the_degrees(lmax) -> None:
    """Order 3 of degrees 0 to 2 ended in a failed assertion of the transforms, after the first simulations."""
    found = analysis_of(parallel(lmax, {"depth_uk_arcmin": 2000.0}))
    vector = found.data_vector(list(simulate.maps(found.model.survey, 0)))
    assert np.isfinite(vector).all()
    assert max(one.L for one in found.elements if one.kind == "beam") == lmax


@pytest.mark.parametrize("noise", [None, {"depth_uk_arcmin": 1e-6}])
def test_splits_that_are_the_same_map_are_refused(noise) -> None:
    """Their difference is round-off: perfect data had p = 3e-35, or were refused for element 87 once all was done."""
    loud = {"depth_uk_arcmin": 2000.0}
    with refused("C1:half1", "C1:half2", "map.splits", "noise.depth_uk_arcmin"):
        check_splits_differ(analysis_of(parallel(40, loud, noise)).model)
    check_splits_differ(analysis_of(parallel(40, loud, {"depth_uk_arcmin": 1e-2})).model)
    quiet = two_channels("halves", sigma0_uk=0.0)  # whose halves have samples of their own
    check_splits_differ(analysis_of(config.load(quiet)).model)


def test_maps_of_the_whole_temperature_are_refused(analysis) -> None:
    """2.7255 K is beyond the bound of a monopole: verdicts were "unknown", with a noise level that is not there."""
    npix = 12 * analysis.model.nside**2
    given = {part.name: np.random.default_rng(2).normal(0.0, 80.0, npix) for part in analysis.model.parts}
    check_subtracted(analysis.model, {name: one + 1e6 for name, one in given.items()})
    given["W1:half1"] += 2.7255e6
    given["W1:half1"][:9] = healpy.UNSEEN
    with refused("W1:half1", f"{np.mean(given['W1:half1'][9:]):.4g}", "2.7255e+06"):
        check_subtracted(analysis.model, given)


def test_maps_with_the_dipole_of_the_sky_are_refused(analysis) -> None:
    """A noisy map had no odd rms with it, and a dipole of 3364 uK is beyond its bound: the verdict was "unknown"."""
    model = analysis.model
    dipole = model.survey.channels[0].site.dipole_uk @ healpy.pix2vec(model.nside, np.arange(12 * model.nside**2))
    given = dict(zip([part.name for part in model.parts], simulate.maps(survey(analysis.run), 0), strict=True))
    check_subtracted(model, {name: one + 0.1 * dipole for name, one in given.items()})
    given["W1:half2"] = given["W1:half2"] + dipole
    # The sky of many more degrees, of 100 uK and more, looks no more like a dipole.
    for one in (model, replace(model, cl=9.0 * model.cl)):
        with refused("W1:half2", 3364.5, "subtract_dipole"):
            check_subtracted(one, given)


def test_masks_that_hide_a_part_of_pixels_are_told_of(tmp_path) -> None:
    """Light of the Galaxy that a fine mask hides was diagnosed, in pixels at its edge, without a word."""

    def of_mask(nside: int, weights: tuple[float, float], given: bool = False) -> list[str]:
        z, path = healpy.pix2vec(nside, np.arange(12 * nside**2))[2], tmp_path / f"mask_{nside}.fits"
        healpy.write_map(path, mask := np.where(np.abs(z) > 0.21, *weights), dtype=np.float64, overwrite=True)
        table = two_channels("hidden", lmax=16, period_s=997.0)
        run = config.load(table | {"map": table["map"] | {"mask": mask if given else str(path)}})
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            warn_of_parts_of_pixels(model_of(survey(run), DiagnosisSettings()))
        return [str(one.message) for one in said]

    z = healpy.pix2vec(64, np.arange(12 * 64**2))[2]
    share = healpy.ud_grade((np.abs(z) > 0.21).astype(float), 16)
    [sentence] = of_mask(64, (1.0, 0.0))
    assert not unnamed(sentence, "mask_64.fits", 64, 16, int(np.sum((share > 0.0) & (share < 1.0))))
    [other] = of_mask(64, (1.0, 0.0), given=True)
    assert other == sentence.replace(str(tmp_path / "mask_64.fits"), "the given mask")
    assert not of_mask(16, (1.0, 0.0)) + of_mask(8, (1.0, 0.0)) + of_mask(64, (1.0, 0.5))
