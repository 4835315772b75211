"""Comparisons of effects that leave a part of the dipole, which both sides subtract through the beam of side A."""

import pytest

import mcsim
from comparisons import MODEL, names, scaled
from mcsim import config
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

ROUND = {"kind": "gaussian", "fwhm_arcmin": 350.0}
DIPOLE = MODEL | {
    "sky": MODEL["sky"] | {"dipole_uk": 3364.5},
    "channel": [MODEL["channel"][0] | {"beam": ROUND}],
}


@pytest.mark.parametrize(("name", "size"), [("beam_width", 0.03), ("beam_width", -0.03), ("beam_sidelobe", 0.02)])
def test_an_effect_is_named_with_what_it_leaves_of_the_dipole(name, size):
    """A width was named beside a dipole; the ring, whose dipole is ten times the sky, as a calibration."""
    run, acting = (
        config.load(DIPOLE | {"effect": effects})
        for effects in ([], [{"name": name, "channel": "W1", "amplitude": size}])
    )
    side_a, side_b = (list(simulate.maps(survey(one), 0)) for one in (run, acting))
    found = mcsim.compare(side_a, side_b, run)
    assert found.verdict == "difference"
    assert names(found) == [name]
    [difference] = found.channels[0].differences
    assert difference.amplitude == pytest.approx(size, rel=1e-3)
    assert found.channels[0].left < 1e-6
    assert found.channels[0].spread_rms_uk == 0.0


def test_an_effect_is_named_behind_a_unit():
    """Next to nothing is left in K, whatever else differs: the unit alone was named, with 100 %."""
    run, acting = (
        config.load(DIPOLE | {"effect": effects})
        for effects in ([], [{"name": "beam_ellipticity", "channel": "W1", "amplitude": 0.2}])
    )
    side_a, side_b = (list(simulate.maps(survey(one), 0)) for one in (run, acting))
    found = mcsim.compare(side_a, scaled(side_b, 1e-6), run)
    assert names(found) == ["beam_ellipticity", "unit"]
    assert found.channels[0].differences[0].amplitude == pytest.approx(0.2, rel=0.05)
    assert 1e-9 < found.channels[0].left < 1e-4
