import tomllib
from pathlib import Path

import pytest

from mcsim.instrument.scan.model import LineOfSight, ScanModel, read_described
from refusals import refused

MODELS = Path(__file__).parents[2] / "scan_models"
GOOD = """
schema = 1
name = "toy"
spin_period_s = 100.0
precession_period_s = -5000.0
precession_angle_deg = 30.0
orbit_period_s = 31557600.0
sample_period_s = 0.5
duration_days = 10.0
[[line_of_sight]]
name = "left"
boresight_angle_deg = 60.0
[[line_of_sight]]
name = "right"
boresight_angle_deg = 61.0
azimuth_deg = 180.0
sample_period_s = 0.25
[pairs]
both = ["left", "right"]
[source]
spin_period_s = "made up"
"""


@pytest.fixture
def write(tmp_path):
    def write_text(text):
        path = tmp_path / "model.toml"
        path.write_text(text)
        return path

    return write_text


def test_reads_every_key(write):
    model = ScanModel.load(write(GOOD))
    assert (model.name, model.spin_period_s, model.precession_period_s) == ("toy", 100.0, -5000.0)
    assert model.default_lines == ("left", "right")
    assert model.pair("both") == (LineOfSight("left", 60.0), LineOfSight("right", 61.0, 180.0, 0.25))
    assert [model.samples(line) for line in model.lines_of_sight] == [1728000, 3456000]
    assert model.source == {"spin_period_s": "made up"}


def test_other_sampling_holds_for_every_line(write):
    model = ScanModel.load(write(GOOD)).with_sampling(2.0)
    assert [model.period_of_samples(line) for line in model.lines_of_sight] == [2.0, 2.0]
    with refused("sample_period_s", -1):
        model.with_sampling(-1.0)


def test_last_sample_survives_rounding():
    # 365.25 days / 0.0512 s = 616359375 exactly; the quotient of the doubles may fall just below.
    line = LineOfSight("A", 70.5)
    assert ScanModel("w", 129.3, -3600.0, 22.5, 31557600.0, 0.0512, 365.25, (line,), ("A",)).samples(line) == 616359375


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("schema = 1", "schema = 2", ("schema", 2)),
        ('name = "toy"', "", ("'name'",)),
        ("spin_period_s = 100.0", "spin_period = 100.0", ("'spin_period'", "orbit_period_s")),
        ("spin_period_s = 100.0", "", ("'spin_period_s'",)),
        ("spin_period_s = 100.0", "spin_period_s = 0.0", ("spin_period_s", 0)),
        ("spin_period_s = 100.0", 'spin_period_s = "100"', ("spin_period_s", "'100'")),
        ("spin_period_s = 100.0", "spin_period_s = true", ("spin_period_s", "True")),
        ("spin_period_s = 100.0", "spin_period_s = nan", ("spin_period_s", "nan")),
        ("precession_period_s = -5000.0", "precession_period_s = 0.0", ("precession_period_s", 0)),
        ("precession_angle_deg = 30.0", "precession_angle_deg = 91.0", ("precession_angle_deg", 91, 90)),
        ("orbit_period_s = 31557600.0", "orbit_period_s = 365.25", ("orbit_period_s", 365.25)),
        ("duration_days = 10.0", "duration_days = 864000.0", ("duration_days", 864000)),
        ("sample_period_s = 0.5", "sample_period_s = -0.5", ("sample_period_s", -0.5)),
        ("duration_days = 10.0", "duration_days = 1e-6", ("1e-06 days", "0.5 s", "duration_days")),
        ("boresight_angle_deg = 60.0", "boresight_angle_deg = 180.0", ("boresight_angle_deg", 180)),
        ("boresight_angle_deg = 60.0", "", ("'left'", "'boresight_angle_deg'")),
        (
            "boresight_angle_deg = 60.0",
            "boresight_angle_deg = 60.0\npsi = 1.0",
            ("[[line_of_sight]]", "'psi'", "azimuth_deg"),
        ),
        ('name = "right"', 'name = "left"', ("'left'",)),
        ('name = "right"', "", ("[[line_of_sight]]", "name")),
        ('both = ["left", "right"]', 'both = ["left"]', ("pairs.both", 1, 2)),
        ('both = ["left", "right"]', 'both = ["left", "left"]', ("both", "left, left")),
        ("schema = 1", 'schema = 1\ndefault_lines = ["right", "right"]', ("default_lines", "right, right")),
        ('both = ["left", "right"]', 'both = ["left", "middle"]', ("pairs.both", "middle", "left, right")),
        ('both = ["left", "right"]', 'both = "left"', ("pairs.both", "'left'")),
        ('spin_period_s = "made up"', 'spin = "made up"', ("[source]", "'spin'", "duration_days")),
        ("schema = 1", "schema = 1\ndefault_lines = []", ("default_lines", "[]")),
        ("schema = 1", "schema = ", ("TOML", "line 2")),
    ],
)
def test_bad_models_say_what_is_wrong(write, old, new, named):
    assert old in GOOD
    path = write(GOOD.replace(old, new, 1))
    with refused(*named) as caught:
        ScanModel.load(path)
    assert str(path) in str(caught.value)


def test_missing_file_and_missing_lines(tmp_path, write):
    with refused("none.toml"):
        ScanModel.load(tmp_path / "none.toml")
    with refused("[[line_of_sight]]", "boresight_angle_deg"):
        ScanModel.load(write(GOOD.split("[[line_of_sight]]")[0]))


DESCRIBED = """
spin_period_s = 100.0
precession_period_s = -5000.0
precession_angle_deg = 30.0
orbit_period_s = 31557600.0
spin_phase_deg = 40.0
orbit_phase_deg = 100.0
boresight_angle_deg = 60.0
sample_period_s = 0.5
samples = 1000
beam_x_axis = "spin axis x boresight"
spin_azimuth_rad = { W1 = 0.5 }
"""


def test_a_short_description_has_its_phases(write):
    """They were dropped: effects that know of the spin acted 40 degrees off."""
    model, dipole_uk = read_described(write(DESCRIBED))
    assert (model.spin_phase_deg, model.precession_phase_deg, model.orbit_phase_deg) == (40.0, 0.0, 100.0)
    assert dipole_uk is None


@pytest.mark.parametrize("key", ["dipole_mk", "spin_phase_rad", "boresight_angle"])
def test_a_short_description_has_no_numbers_that_nobody_reads(write, key):
    with refused(key, "dipole_uk", "spin_phase_deg"):
        read_described(write(f"{key} = 3.3\n{DESCRIBED}"))


def test_unknown_names(write):
    model = ScanModel.load(write(GOOD))
    with refused("'up'", "left, right"):
        model.line_of_sight("up")
    with refused("'W1'", "both"):
        model.pair("W1")


@pytest.mark.parametrize("path", sorted(MODELS.glob("*.toml")), ids=lambda path: path.stem)
def test_packaged_models_cite_every_number(path):
    model = ScanModel.load(path)
    with path.open("rb") as stream:
        keys = {key for key, value in tomllib.load(stream).items() if isinstance(value, float)}
    assert keys == set(model.source)
    assert all(model.source.values())
    assert all(line.source for line in model.lines_of_sight)


def test_wmap_focal_plane_has_both_sides_of_every_assembly():
    model = ScanModel.load(MODELS / "wmap_focal_plane.toml")
    assert list(model.pairs) == ["K1", "Ka1", "Q1", "Q2", "V1", "V2", "W1", "W2", "W3", "W4"]
    for name in model.pairs:
        side_a, side_b = model.pair(name)
        assert (side_a.name, side_b.name) == (f"{name}A", f"{name}B")
        assert side_a.sample_period_s == side_b.sample_period_s
        # The sides face each other: within the focal plane's 2.5 degrees of azimuth 0 and 180.
        assert abs((side_a.azimuth_deg + 180.0) % 360.0 - 180.0) < 2.5
        assert abs(side_b.azimuth_deg - 180.0) < 2.5
        assert 67.0 < side_a.boresight_angle_deg < 73.0
