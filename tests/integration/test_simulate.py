"""One realization from the configuration: routes, noise, masks, splits, skies of the user."""

from pathlib import Path

import healpy
import numpy as np
import pytest

from mcsim import bipolar, config
from mcsim.ensemble.detectability import sky_fraction
from mcsim.instrument import beams, scan
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere import alm as alm_
from mcsim.sphere import healpix, mask
from refusals import refused

from .conftest import ensemble, table

BEAM = {"kind": "elliptical_gaussian", "fwhm_major_arcmin": 300.0, "fwhm_minor_arcmin": 250.0}
PT = {"kind": "parallel_transport", "psi0_deg": 20.0}


def channel(name: str = "W1", **changes) -> dict:
    return {"name": name, "beam": BEAM, "scan": PT} | changes


def realize(r: int = 0, **changes) -> dict[str, np.ndarray]:
    return simulate.realize(survey(config.load(table(**changes))), r)


def test_known_and_analysed_control_agree() -> None:
    """Without noise and mask the control's a_lm are not analysed but known; a trace of noise takes the other route."""
    iterated = {"iterations": 6, "summary_bin": 10}
    exact = realize(biposh=iterated)
    analysed = realize(channel=[channel(noise={"sigma0_uk": 1e-9})], biposh=iterated)
    for name in ("cl", "cl_circular"):
        # The highest degrees, near 2 nside, are the last that iterations bring in.
        np.testing.assert_allclose(analysed[name][0, 2:28], exact[name][0, 2:28], rtol=1e-4)
    difference = {k: v["biposh"] - v["biposh_circular"] for k, v in {"exact": exact, "analysed": analysed}.items()}
    scale = np.nanmax(np.abs(difference["exact"]))
    np.testing.assert_allclose(difference["analysed"], difference["exact"], atol=1e-4 * scale)


def test_unpaired_run_gives_the_same_spectra_without_controls() -> None:
    paired, single = realize(), realize(**ensemble(paired=False))
    assert set(single) == {"biposh", "cl"}
    np.testing.assert_array_equal(single["biposh"], paired["biposh"])


def test_control_of_a_circular_beam_is_the_beam_itself() -> None:
    values = realize(channel=[channel(beam={"kind": "gaussian", "fwhm_arcmin": 275.0})])
    np.testing.assert_array_equal(values["biposh"], values["biposh_circular"])
    assert np.all(values["cl"][0, 2:] > 0)


def test_noise_has_the_level_of_the_hits_and_none_in_the_cross_spectra(tmp_path: Path) -> None:
    """White noise of sigma0^2 / hits per pixel: C_l = sigma0^2 <1 / hits> 4 pi / npix, autos only."""
    nside, sigma0, n = 16, 1e5, 20
    hits = np.random.default_rng(1).integers(1, 9, 12 * nside**2).astype(float)
    moments = scan.Moments(nside, "ecliptic", hits, np.zeros((2, hits.size), complex))
    scan.write_moments_fits(tmp_path / "m.fits", moments)
    noisy = channel(noise={"sigma0_uk": sigma0}, scan={"kind": "moments", "path": str(tmp_path / "m.fits")})
    shared = survey(
        config.load(
            table(
                map={"nside": nside, "splits": ["a", "b"], "split_by": "sets", "pixel_window": "none"}, channel=[noisy]
            )
        )
    )
    assert shared.pair_names == ("W1:a,W1:a", "W1:a,W1:b", "W1:b,W1:b")
    cl = np.mean([simulate.realize(shared, r)["cl"] for r in range(n)], axis=0)[:, 2:]
    ell = np.arange(2, 33)
    expected = sigma0**2 * np.mean(1 / hits) * 4 * np.pi / hits.size
    weight = 2 * ell + 1
    level = (weight * cl).sum(axis=1) / weight.sum()
    sigma = expected * np.sqrt(2.0 / (n * weight.sum()))
    assert abs(level[0] - expected) < 5 * sigma
    assert abs(level[2] - expected) < 5 * sigma
    # The sky and its beam hold a 1e-5 of the noise; the cross spectrum scatters by 1 / sqrt 2 of the autos.
    assert abs(level[1]) < 5 * sigma / np.sqrt(2)


def test_noise_of_a_map_does_not_depend_on_the_other_maps() -> None:
    alone = realize(channel=[channel("W1", noise={"sigma0_uk": 50.0})])
    both = realize(channel=[channel("V1"), channel("W1", noise={"sigma0_uk": 50.0})])
    np.testing.assert_array_equal(both["cl"][2], alone["cl"][0])


def test_pixel_window_is_in_the_map_and_taken_out_of_the_coefficients() -> None:
    off = realize(map={"nside": 16, "pixel_window": "none"}, **ensemble(keep_maps=True))
    on = realize(map={"nside": 16, "pixel_window": "computed"}, **ensemble(keep_maps=True))
    window = healpix.pixel_window(16, 32)
    np.testing.assert_allclose(on["cl_circular"], off["cl_circular"], rtol=1e-12)
    maps = [healpix.analysis(values["observed_map"][0], 32, iterations=8) for values in (on, off)]
    power = [bipolar.power_spectrum(a, a, 32) for a in maps]
    np.testing.assert_allclose(power[0][2:] / power[1][2:], window[2:] ** 2, rtol=1e-3)


def test_mask_keeps_the_power_spectrum_in_the_mean(tmp_path: Path) -> None:
    """Spectra are divided by <w^2>: white noise through a mask keeps its level within its sampling error."""
    nside, n = 16, 30
    mask = np.zeros(12 * nside**2)
    mask[: mask.size // 3] = 1.0
    healpy.write_map(tmp_path / "mask.fits", mask, dtype=np.float64)
    shared = survey(
        config.load(
            table(
                map={"nside": nside, "mask": str(tmp_path / "mask.fits")},
                channel=[channel(noise={"sigma0_uk": 1e5})],
            )
        )
    )
    cl = np.mean([simulate.realize(shared, r)["cl"] for r in range(n)], axis=0)[0, 8:]
    expected = 1e10 * 4 * np.pi / mask.size
    weight = 2 * np.arange(8, 33) + 1
    # A third of the sky has a third of the modes.
    assert abs((weight * cl).sum() / weight.sum() / expected - 1) < 5 * np.sqrt(2.0 / (n * weight.sum() / 3))


def test_mask_of_another_frame_and_resolution_with_a_soft_edge(tmp_path: Path) -> None:
    path = tmp_path / "mask.fits"
    theta, _ = healpy.pix2ang(8, np.arange(768))
    healpy.write_map(path, (np.abs(theta - np.pi / 2) > 0.3).astype(float), dtype=np.float64)
    soft = {"nside": 16, "mask": str(path), "mask_frame": "galactic", "mask_apodisation_deg": 20.0}
    shared = survey(config.load(table(map=soft)))
    expected = mask.read_mask(path, 16, "ecliptic", "galactic", 20.0)
    weight = shared.channels[0].maps[0].weight
    assert weight is not None
    np.testing.assert_allclose(weight, expected / np.sqrt(np.mean(expected**2)), rtol=1e-12)
    fraction = np.mean(expected**2) ** 2 / np.mean(expected**4)
    assert sky_fraction(shared, (0, 0)) == pytest.approx(fraction, rel=1e-12)
    # Spectra are divided by <W^2>: the control has the power of the whole sky within the sampling of what is left.
    cl = [np.mean([realize(r, map=m)["cl_circular"][0, 10:] for r in range(8)], axis=0) for m in (soft, {"nside": 16})]
    modes = fraction * 8 * np.sum(2 * np.arange(10, 33) + 1)
    assert abs(np.mean(cl[0] / cl[1]) - 1.0) < 5 * np.sqrt(2.0 / modes)


def test_files_of_b_lm_may_be_turned(tmp_path: Path) -> None:
    ellipse = beams.Beam.elliptical(300.0, 250.0, angle_deg=10.0, lmax=32, mmax=4)
    packed = np.concatenate([ellipse.blm[m, m:] for m in range(5)])
    healpy.write_alm(tmp_path / "b.fits", packed, lmax=32, mmax=4, mmax_in=4, out_dtype=np.float64)
    turned = {"kind": "blm", "path": str(tmp_path / "b.fits"), "m_max": 4, "angle_deg": 25.0}
    (loaded,) = survey(config.load(table(channel=[channel(beam=turned)]))).channels
    expected = beams.Beam.elliptical(300.0, 250.0, angle_deg=35.0, lmax=32, mmax=4).blm
    np.testing.assert_allclose(loaded.beam.blm, expected, atol=1e-12)


def test_hits_weighting_changes_the_weights_of_uneven_hits_only(tmp_path: Path) -> None:
    nside = 16
    hits = np.linspace(1, 5, 12 * nside**2)
    moments = scan.Moments(nside, "ecliptic", hits, np.full((2, hits.size), 0.5 + 0j))
    scan.write_moments_fits(tmp_path / "m.fits", moments)
    uneven = [channel(scan={"kind": "moments", "path": str(tmp_path / "m.fits")})]
    hits_weighted = {"weighting": "hits", "summary_bin": 10}
    assert np.array_equal(realize()["cl"], realize(biposh=hits_weighted)["cl"])
    uniform, weighted = realize(channel=uneven), realize(channel=uneven, biposh=hits_weighted)
    assert not np.allclose(uniform["cl"][0, 2:], weighted["cl"][0, 2:], rtol=1e-3)
    shared = survey(config.load(table(channel=uneven, biposh=hits_weighted)))
    weight = shared.channels[0].maps[0].weight
    assert weight is not None
    np.testing.assert_allclose(weight, hits / np.sqrt(np.mean(hits**2)), rtol=1e-12)


def test_skies_of_the_user(tmp_path: Path) -> None:
    """The a_lm, and the maps, of a run's own skies give that run again."""
    shared = survey(config.load(table()))
    skies = [simulate.draw_sky(shared, r) for r in range(2)]
    for r, sky in enumerate(skies):
        healpy.write_alm(tmp_path / f"alm_{r:03d}.fits", alm_.resize(sky, 32, 40))
        map_ = healpix.synthesis(sky[None], 64, 32)[0]
        healpy.write_map(tmp_path / f"map_{r}.fits", map_, dtype=np.float64)
    for source, tolerance in (
        ({"alm": str(tmp_path / "alm_{realization:03d}.fits")}, 1e-12),
        ({"map": str(tmp_path / "map_{realization}.fits")}, 1e-6),
    ):
        for r in range(2):
            found, expected = realize(r, sky={"lmax": 32, **source}, **ensemble(2)), simulate.realize(shared, r)
            np.testing.assert_allclose(found["cl"][0, 2:], expected["cl"][0, 2:], rtol=tolerance)


def test_bad_skies(tmp_path: Path) -> None:
    sky = str(tmp_path / "sky_{realization}.fits")
    healpy.write_alm(tmp_path / "sky_0.fits", np.ones(alm_.size(20), complex))
    with refused("sky_0.fits", "l = 20", "m = 20", 32):
        realize(sky={"lmax": 32, "alm": sky}, **ensemble(1))
    healpy.write_map(tmp_path / "sky_0.fits", np.full(192, healpy.UNSEEN), overwrite=True, dtype=np.float64)
    with refused("sky_0.fits", "finite", "unseen"):
        realize(sky={"lmax": 32, "map": sky}, **ensemble(1))
    healpy.write_map(tmp_path / "sky_0.fits", np.ones(192), overwrite=True, dtype=np.float64)
    with refused("sky_0.fits", "nside 4", "l = 11", 32):
        realize(sky={"lmax": 32, "map": sky}, **ensemble(1))
    healpy.write_alm(tmp_path / "sky_0.fits", np.full(alm_.size(32), 1e200 + 0j), overwrite=True)
    with refused("sky_0.fits", "1e+200 uK", "1e+07 uK"):
        realize(sky={"lmax": 32, "alm": sky}, **ensemble(1))
    healpy.write_map(tmp_path / "sky_0.fits", np.full(12 * 16**2, 2e7), overwrite=True, dtype=np.float64)
    with refused("sky_0.fits", "2e+07 uK", "1e+07 uK"):
        realize(sky={"lmax": 32, "map": sky}, **ensemble(1))
    (tmp_path / "sky_0.fits").write_text("nothing")
    with refused("sky_0.fits"):
        realize(sky={"lmax": 32, "map": sky}, **ensemble(1))


@pytest.mark.parametrize(
    ("mask", "named"),
    [
        (np.full(3072, 2.0), ("mask.fits", "0 ... 1")),
        (np.zeros(3072), ("W1", "pixel")),
    ],
)
def test_bad_masks(mask: np.ndarray, named: tuple[str, ...], tmp_path: Path) -> None:
    healpy.write_map(tmp_path / "mask.fits", mask, dtype=np.float64)
    with refused(*named):
        realize(map={"nside": 16, "mask": str(tmp_path / "mask.fits")})
