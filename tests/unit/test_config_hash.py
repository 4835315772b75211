"""The configuration: what its hash covers, and how differences are named."""

from pathlib import Path

import pytest

from instruments import two_channels
from mcsim import config
from mcsim.config import arrays
from mcsim.support import resources
from refusals import refused

from .conftest import DIFFERENCING, changed

UNIMPORTANT = [
    ("name", "other"),
    ("ensemble.realizations", 3),
    ("ensemble.keep_maps", True),
    ("compute.workers", 9),
    ("compute.chunk", 8),
    ("schema", 1),
    ("biposh.lmax", 128),
    ("biposh.summary_bin", 10),
    ("map.frame", "ecliptic"),
    ("channel.0.beam.angle_deg", 0.0),
    ("channel.0.beam.fwhm_major_arcmin", 60),
]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("channel.0.scan.max_iterations", 9),
        ("map.mask_frame", None),
        ("map.mask_apodisation_deg", 0.0),
        ("channel.1.beam.angle_deg", 0.0),
    ],
)
def test_neither_do_these_of_two_beams_and_a_mask(plain, folder, key, value):
    run = with_two_beams_and_mask(plain)
    assert config.digest(config.load(changed(run, key, value))) == config.digest(config.load(run))


def with_two_beams_and_mask(plain: dict) -> dict:
    run = changed(
        changed(plain, "channel.0.scan", DIFFERENCING), "channel.1.beam", {"kind": "blm", "path": "beam.fits"}
    )
    return changed(run, "map.mask", "mask.fits")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("channel.0.scan.pair", "W2", 'channel[W1].scan.pair: "W1" -> "W2"'),
        ("channel.0.scan.tolerance", 1e-6, "channel[W1].scan.tolerance: 1e-08 -> 1e-06"),
        ("channel.0.scan.transmission_imbalance", 0.01, "channel[W1].scan.transmission_imbalance: 0.0 -> 0.01"),
        ("channel.0.scan.model", "scan.toml", "channel[W1].scan.model: contents sha256:"),
        ("channel.1.beam.angle_deg", 5.0, "channel[V1].beam.angle_deg: absent -> 5.0"),
        ("map.mask_frame", "galactic", 'map.mask_frame: absent -> "galactic"'),
        ("map.mask_apodisation_deg", 3.0, "map.mask_apodisation_deg: absent -> 3.0"),
    ],
)
def test_but_these_of_two_beams_and_a_mask_do(plain, folder, key, value, expected):
    run = with_two_beams_and_mask(plain)
    old, new = config.science(config.load(run)), config.science(config.load(changed(run, key, value)))
    (found,) = config.differences(old, new)
    assert found.startswith(expected)


@pytest.mark.parametrize(("key", "value"), UNIMPORTANT)
def test_what_does_not_change_a_result_does_not_change_the_hash(plain, folder, key, value):
    assert config.digest(config.load(changed(plain, key, value))) == config.digest(config.load(plain))


def test_bins_of_filtered_maps_are_part_of_the_estimates():
    """Those of a summary are made anew from what is stored."""
    for filtered in (True, False):
        biposh = {"L_max": 2} | ({"filter": "inverse_covariance"} if filtered else {})
        runs = [config.load(two_channels("bins") | {"biposh": biposh | {"summary_bin": n}}) for n in (10, 20)]
        changes = config.differences(*map(config.science, runs))
        assert changes == (["biposh.bin: 10 -> 20"] if filtered else [])
        assert (config.digest(runs[0]) == config.digest(runs[1])) != filtered


def test_a_step_names_files_of_its_own_channels_alone(tmp_path):
    """The other channel has no such file, and needs none."""
    (tmp_path / "V1.fits").write_text("mask")
    step = {"kind": "mask", "mask": str(tmp_path / "{channel}.fits"), "channels": ["V1"]}
    run = config.load(two_channels("steps") | {"preparation": [step]})
    assert list(config.science(run)["preparation"][0]["mask"]) == ["V1"]
    with refused("preparation[0].mask", tmp_path / "W1.fits"):
        config.load(two_channels("steps") | {"preparation": [step | {"channels": []}]})


IMPORTANT = [
    ("sky.lmax", 100, ["biposh.lmax: 128 -> 100", "sky.lmax: 128 -> 100"]),
    ("sky.spectrum", "planck2018", [r"sky.spectrum: contents sha256:"]),
    ("map.nside", 128, ["map.nside: 64 -> 128"]),
    ("map.frame", "galactic", ['map.frame: "ecliptic" -> "galactic"']),
    ("map.mask", "mask.fits", ["map.mask: null -> contents sha256:"]),
    ("map.splits", ["a"], ["map.splits: [] -> "]),
    ("map.pixel_window", "none", ['channel[V1].pixel_window: "computed" -> "none"']),
    ("channel.0.beam.angle_deg", 1.0, ["channel[W1].beam.angle_deg: 0.0 -> 1.0"]),
    ("channel.0.noise.sigma0_uk", 2.0, ["channel[W1].noise.sigma0_uk: 0.0 -> 2.0"]),
    ("channel.1.scan.model", "mask.fits", ["channel[V1].scan.model: contents sha256:"]),
    ("biposh.L_max", 3, ["biposh.L_max: 2 -> 3"]),
    ("biposh.weighting", "hits", ['biposh.weighting: "uniform" -> "hits"']),
    ("ensemble.seed", 2, ["ensemble.seed: 1 -> 2"]),
    ("ensemble.paired", False, ["ensemble.paired: true -> false"]),
]


@pytest.mark.parametrize(("key", "value", "expected"), IMPORTANT)
def test_what_changes_a_result_changes_the_hash_and_is_named(plain, folder, key, value, expected):
    old, new = config.load(plain), config.load(changed(plain, key, value))
    assert config.digest(old) != config.digest(new)
    found = config.differences(config.science(old), config.science(new))
    assert len(found) == len(expected)
    for sentence, start in zip(found, expected, strict=True):
        assert sentence.startswith(start)
    assert config.differences(config.science(old), config.science(old)) == []


def test_order_and_number_of_channels(plain, folder):
    old = config.science(config.load(plain))
    plain["channel"].reverse()
    assert config.differences(old, config.science(config.load(plain))) == ["channel (order): W1, V1 -> V1, W1"]
    del plain["channel"][0]
    found = config.differences(old, config.science(config.load(plain)))
    assert found[0] == "channel (order): W1, V1 -> W1"
    assert 'channel[V1].beam.kind: "gaussian" -> absent' in found


@pytest.mark.parametrize("changes", [(0,), (1,), (0, 1)])
def test_all_effects_of_one_name_count(plain, folder, changes):
    plain["effect"] = [{"name": "calibration", "channel": name, "amplitude": 0.01} for name in ("W1", "V1")]
    old = config.science(config.load(plain))
    for number in changes:
        plain["effect"][number]["amplitude"] = 0.5
    assert config.differences(old, config.science(config.load(plain))) == [
        f"effect[calibration {number}].amplitude: 0.01 -> 0.5" for number in changes
    ]


def test_hash_covers_contents_of_files_and_not_their_place(plain, folder):
    digest = config.digest(config.load(plain))
    moved = folder / "elsewhere" / "renamed.toml"
    moved.parent.mkdir()
    moved.write_bytes(Path("scan.toml").read_bytes())
    assert config.digest(config.load(changed(plain, "channel.1.scan.model", str(moved)))) == digest
    copied = folder / "cl.txt"
    copied.write_bytes(resources.spectrum("wmap7").read_bytes())
    assert config.digest(config.load(changed(plain, "sky.spectrum", "cl.txt"))) == digest
    Path("scan.toml").write_text("other contents")
    assert config.digest(config.load(plain)) != digest


@pytest.mark.parametrize("key", ["effect", "nuisance"])
def test_hash_covers_the_scan_model_that_an_effect_names(plain, folder, key):
    """A path from the folder of the run; a packaged model is its name, as in the hashes of earlier versions."""
    (folder / "real.toml").write_text("contents")

    def science(model):
        own = {"name": "orientation_averaging", "channel": "W1", "amplitude": 1.0, "model": model}
        if key == "nuisance":
            own = {"effect": own["name"], "channel": "W1", "width": 0.1, "parameters": {"model": model}}
        run = config.load({**plain, key: [own]}, base=folder)
        found = config.science(run, "nuisance")[key][0]
        return run, found.get("parameters", found)["model"]

    run, before = science("real.toml")
    assert before.startswith("sha256:")
    assert str(folder / "real.toml") in config.to_json(run)
    (folder / "real.toml").write_text("other contents")
    assert science("real.toml")[1] != before
    assert science("wmap")[1] == "wmap"
    with refused("real.tom", "planck"):
        science("real.tom")


def test_hash_covers_what_an_effect_of_ones_own_imports_from_its_folder(plain, folder):
    plain["effect"] = [{"name": "mine.py", "amplitude": 0.01}]
    Path("mine.py").write_text("import alone")
    alone = config.science(config.load(plain))["effect"][0]["name"]
    assert alone == f"sha256:{arrays.sha256_of(Path('mine.py'))}"
    Path("mine.py").write_text("from factor import FACTOR")
    Path("factor.py").write_text("FACTOR = 1.0")
    before = config.science(config.load(plain))
    Path("factor.py").write_text("FACTOR = 10.0")
    (difference,) = config.differences(before, config.science(config.load(plain)))
    assert difference.startswith("effect[0].name: contents sha256:")
    Path("mine.py").write_text("no Python")
    assert config.digest(config.load(plain))


def test_hash_covers_every_file_of_a_template(plain, folder):
    run = config.load(changed(plain, "map.mask", "mask_{channel}.fits"))
    before = config.science(run)
    assert set(before["map"]["mask"]) == {"W1", "V1"}
    Path("mask_V1.fits").write_text("other contents")
    (difference,) = config.differences(before, config.science(run))
    assert difference.startswith("map.mask.V1: contents sha256:")


def test_given_skies_are_hashed_by_template_and_first_file(plain, folder):
    run = config.load(changed(plain, "sky", {"lmax": 128, "map": "sky_{realization:03d}.fits"}))
    before = config.science(run)
    assert before["sky"]["map"]["template"] == "sky_{realization:03d}.fits"
    Path("sky_003.fits").write_text("not read")
    assert config.science(run) == before
    Path("sky_000.fits").write_text("read")
    assert config.science(run) != before


def test_given_skies_may_be_moved(plain, folder):
    """Only the part of the template with the placeholder counts, whatever the folders above it are called."""
    digests = set()
    for name in ("here", "a{b}", "deep/there"):
        (folder / name / "sims").mkdir(parents=True)
        for number in range(4):
            (folder / name / "sims" / f"{number}.fits").write_text(str(number))
        run = changed(plain, "sky", {"lmax": 128, "alm": "sims/{realization}.fits"})
        digests.add(
            config.digest(
                config.load(changed(run, "channel.1.scan", {"kind": "parallel_transport"}), base=folder / name)
            )
        )
    assert len(digests) == 1


def test_what_the_hash_covers():
    """Whatever changes here refuses to continue every store of earlier versions: it must be meant."""
    run = config.RunConfig(
        name="x",
        sky=config.Sky(spectrum="wmap7", lmax=8),
        map=config.Map(nside=4),
        channels=(
            config.Channel(name="A", beam=config.BeamGaussian(fwhm_arcmin=600.0), scan=config.ScanParallelTransport()),
        ),
        ensemble=config.Ensemble(realizations=1, seed=0),
    )
    science = config.science(run)
    science["sky"]["spectrum"] = "sha256:0"
    assert science == {
        "schema": 1,
        "sky": {"spectrum": "sha256:0", "lmax": 8, "alm": None, "map": None},
        "map": {"nside": 4, "frame": "ecliptic", "mask": None, "splits": []},
        "channel": [
            {
                "name": "A",
                "frequency_ghz": None,
                "beam": {"kind": "gaussian", "fwhm_arcmin": 600.0},
                "noise": {"sigma0_uk": 0.0},
                "scan": {"kind": "parallel_transport", "psi0_deg": 0.0},
                "pixel_window": "none",
            }
        ],
        "biposh": {"L_max": 2, "lmax": 8, "weighting": "uniform", "iterations": 0, "pairs": "all"},
        "ensemble": {"seed": 0, "paired": True},
    }
