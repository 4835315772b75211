"""Values of differences, fitted beside what single samples change."""

from types import SimpleNamespace

import healpy
import numpy as np
import pytest

import mcsim
from mcsim.comparison import time_differences
from mcsim.comparison.effects import EffectDifference
from mcsim.comparison.map_differences import Calibration, ChannelExchanged, Dipole, FrameReversed, Monopole, Unit
from mcsim.comparison.pairs import ChannelPair
from mcsim.comparison.prediction import Prediction, Set
from mcsim.comparison.scene_differences import Smoothing, TimeShift
from mcsim.comparison.search import Problem, _in_turn
from mcsim.comparison.time_differences import Interpolation
from mcsim.ensemble.maps import write_map
from mcsim.systematics.registry import catalogue


class Slow(Prediction):
    """A difference of value 1; what single samples change lets each fit come nine tenths of the way."""

    _pointing = "known"
    enough = 1e-6

    def _measured(self, found: Set) -> Set:
        return Set(found.members, float(found.members[0][1][0] - 1.0) ** 2)

    def fitted(self, found: Set) -> Set:
        ((difference, value),) = found.members
        return Set(((difference, value + 0.9 * (1.0 - value)),), 0.0)


def test_values_are_fitted_until_they_leave_nothing_that_others_could_take_up():
    problem = Slow(SimpleNamespace(scene="known"), (), 0.0)
    found = problem.corrected(Set(((TimeShift(), np.zeros(1)),), 1.0))
    assert problem.complete(found)
    assert found.members[0][1] == pytest.approx(0.9999, abs=1e-6)


def test_no_smoothing_makes_the_sky_vanish():
    """Without an end a smoothing explains maps in another unit, which are next to nothing in this one."""
    assert Smoothing().amplitude(Smoothing().within(np.array([1e6]))) == pytest.approx(9.0)


@pytest.mark.parametrize("value", [1.0, -0.5, 0.2])
def test_a_smoothing_of_the_other_side_undoes_it(value):
    """Variances of the Gaussian are over that of the beam of the side that is smoothed."""
    back = Smoothing().inverse(np.array([value]))[0]
    assert (1.0 + value) * (1.0 + back) == pytest.approx(1.0)


def test_no_response_to_an_effect_is_larger_than_the_sky():
    """Two effects that make nearly the same maps may cancel each other at any amplitude but for this."""
    run, sky = mcsim.load_config("tiny"), np.zeros(healpy.Alm.getsize(47), complex)
    sky[2] = np.sqrt(4.0 * np.pi)
    lag = EffectDifference(catalogue()["time_constant"], np.full((1, 1, 12), 0.5), run, sky)
    assert lag.within(np.array([1.0])) == pytest.approx(1.0)
    assert lag.within(np.array([-1e6])) == pytest.approx(-2.0)
    dipole = EffectDifference(catalogue()["dipole_residual"], np.ones((3, 1, 12)), run, sky)
    assert np.linalg.norm(dipole.within(np.array([0.0, 3e6, 4e6]))) == pytest.approx(340.0)


def test_a_mirrored_sky_is_not_taken_for_mirrored_pixels():
    """They have one name, and side B of single samples may tell what orientation moments do not."""
    of_sky, of_pixels = ((FrameReversed(), np.array([0.0, level])) for level in (1.0, 0.0))
    scale, other = ((Calibration(), np.array([value, 0.0])) for value in (0.01, 0.02))
    sets = [Set((of_pixels, scale), 0.1), Set((of_sky, scale), 0.2), Set((other, of_sky), 0.3)]
    assert _in_turn([sets], 3) == sets[:2]


def test_a_member_that_adds_nothing_to_the_others_is_taken_out():
    """A factor that came first leaves the set if a dipole and a monopole, found beside it, explain as much alone."""
    draw = np.random.default_rng(1)
    a, axis = draw.standard_normal((1, 768)), np.array(healpy.pix2vec(8, np.arange(768)))[2]
    b = a + 2.0 * axis + 1.0 + 1e-3 * draw.standard_normal(a.shape)
    problem = Problem(ChannelPair("T", ("T",), a, b, np.ones(a.shape, bool)), (), 1e-3)
    dipole, mean = (Dipole(), np.array([0.0, 0.0, 1.9])), (Monopole(), np.array([0.9]))
    found = problem.pruned(Set(((Calibration(), np.array([0.1, 0.0])), dipole, mean), 1e-2))
    assert found.names == {"dipole", "monopole"}
    assert found.left < 1e-5
    whole = Set(((Calibration(), np.array([0.5, 0.0])), dipole, mean), 0.0)
    other = Problem(ChannelPair("T", ("T",), a, b + 0.5 * a, np.ones(a.shape, bool)), (), 1e-3)
    assert other.pruned(other.fitted(whole)).names == whole.names


def test_a_pixel_gone_wrong_is_no_unit():
    """Any small factor takes it to next to nothing, whatever the other side is."""
    sky = np.random.default_rng(1).normal(size=(1, 12 * 4**2))
    wrong = np.where(np.arange(sky.size) == 5, 1e9, sky)
    member, seen = (Unit(), np.array([1e-6])), np.ones(sky.shape, bool)
    for a, b, suffices in ((wrong, sky, False), (sky, 1e-6 * sky, True)):
        problem = Problem(ChannelPair("T", ("T",), a, b, seen), (), 1e-3)
        found = Set((member,), problem.left((member,)))
        assert found.left < 1e-10
        assert problem.suffices(found) is suffices


def test_a_factor_beyond_ten_is_a_unit_and_no_calibration():
    assert Unit().equivalent(np.array([1e-6])) == []
    assert Unit().equivalent(np.array([0.8]))[0][1] == pytest.approx(-0.2)


def test_no_calibration_makes_the_sky_vanish():
    """Without an end one explains maps in K, which are next to nothing in uK."""
    assert Calibration().within(np.array([-0.9999, 0.0])) == pytest.approx([-0.9, 0.0])
    assert Calibration().within(np.array([0.2, 1.0])) == pytest.approx([0.2, 1.0])


@pytest.mark.parametrize(("noise", "verdict"), [(0.1, "difference"), (0.6, "unknown")])
def test_what_a_unit_leaves_is_in_the_larger_one(tmp_path, noise, verdict):
    """In K next to nothing is left of uK, whatever else differs."""
    draw = np.random.default_rng(4)
    sky, white = 50.0 * draw.standard_normal((2, 12 * 8**2))
    for side, values in (("a", sky), ("b", 1e-6 * (sky + noise * white))):
        (tmp_path / side).mkdir()
        write_map(tmp_path / side / "V.fits", values, "ecliptic")
    found = mcsim.compare(tmp_path / "a", tmp_path / "b")
    assert found.verdict == verdict
    if verdict == "difference":
        assert found.channels[0].left_rms_uk == pytest.approx(50.0 * noise, rel=0.1)
        assert found.channels[0].left == pytest.approx(noise**2, rel=0.2)
    else:
        assert found.channels[0].nearest_explains == pytest.approx(1.0 - noise**2, abs=0.1)


def test_what_a_grid_makes_is_the_same_whatever_side_b_has_observed(monkeypatch):
    """Pixels that were exchanged afterwards have what it made where they were, and holes may have been elsewhere."""
    monkeypatch.setattr(time_differences, "looked_up", lambda *_: "a grid")
    scene = SimpleNamespace(
        preparations=(), nside=1, sky=np.zeros(1), window=np.ones(1),
        sampled=lambda pointing, window, signal=None: np.full((1, 12), 3.0 if signal else 1.0),
    )  # fmt: skip
    seen, difference = np.arange(12)[None] < 6, Interpolation()
    for here in (seen, ~seen):
        pair = SimpleNamespace(scene=scene, pointing=lambda longest: "known", seen=here)
        np.testing.assert_array_equal(difference._response(np.array([2.0, 1.0]), pair)[here], 2.0)


def test_maps_without_data_where_a_channel_is_compared_are_not_its_own():
    """An exchange with a channel of another part of the sky left nothing, whatever the difference was."""
    draw, north = np.random.default_rng(3), np.arange(12 * 8**2) < 6 * 8**2

    def cut(name: str, seen: np.ndarray) -> ChannelPair:
        a = np.where(seen, draw.standard_normal((1, seen.size)), healpy.UNSEEN)
        return ChannelPair(name, (name,), a, np.where(seen, 1.2 * a, healpy.UNSEEN), seen[None])

    one, other = cut("V", north), cut("W", ~north)
    found = Problem(one, (other,), 0.0, library=[ChannelExchanged(), Calibration()]).best()
    assert found[0].names == {"calibration"}
    assert found[0].left == pytest.approx(0.0, abs=1e-12)
