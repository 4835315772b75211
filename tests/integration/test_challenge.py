"""A challenge from the draw to the score: a small instrument, few effects, both routes, an interruption."""

import json
from pathlib import Path
from types import MappingProxyType

import healpy
import numpy as np
import pytest

from mcsim import config, systematics
from mcsim.benchmark import score
from mcsim.benchmark.case import Prior
from mcsim.benchmark.challenge import make, run
from mcsim.benchmark.folder import Settings, finished_cases, key_path, read_key
from mcsim.benchmark.summary import confusion
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.map_checks import read_maps
from mcsim.datavector.out_of_library import library_with, load
from pictures import quick_pictures
from refusals import refused

OUT_OF_LIBRARY = str(Path(__file__).parents[1] / "out_of_library.py")
LIBRARY = ("beam_ellipticity", "dipole_residual", "noise_level")
MODEL = {
    "schema": 1,
    "name": "tiny",
    "sky": {"spectrum": "wmap7", "lmax": 24, "dipole_uk": 3364.5},
    "map": {"nside": 8, "splits": ["half1", "half2"]},
    "biposh": {"L_max": 2, "lmax": 20},
    "channel": [
        {
            "name": "W1",
            "frequency_ghz": 94.0,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 500.0},
            "noise": {"sigma0_uk": 150.0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 1244.0},
        }
    ],
}
# Of seed 0 the first five cases are one of each kind.
PRIOR = Prior(none=0.2, one=0.3, two=0.1, left_out=0.2, invented=0.2)
CASES = 5
SEED = 0


@pytest.fixture(scope="module", autouse=True)
def small_library():
    """Few effects are learned quickly."""
    few = MappingProxyType({name: systematics.get(name) for name in (*LIBRARY, "beam_width")})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(systematics, "catalogue", lambda: few)
        yield


def made(folder, cases=CASES, **changes):
    values = {"prior": PRIOR, "out_of_library": OUT_OF_LIBRARY, "simulations": 150}
    return make(Settings(config.load(MODEL), **(values | changes)), folder, cases, SEED, workers=0)


@pytest.fixture(scope="module")
def challenge(tmp_path_factory):
    folder = tmp_path_factory.mktemp("challenge")
    made(folder, 2)
    first = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    made(folder)
    return folder, first


def test_what_was_made_stays(challenge):
    folder, first = challenge
    assert finished_cases(folder) == [f"case-{number:03d}" for number in range(CASES)]
    assert all(path.stat().st_mtime_ns == time for path, time in first.items())
    assert not list(folder.glob("cases/.*"))
    with refused("challenge.json"):
        made(folder, sampled_share=0.9)


def test_a_file_with_an_effect_on_request_is_found_from_any_folder(tmp_path, monkeypatch):
    file = Path(__file__).parents[2] / "docs" / "howto" / "gain_step.py"
    monkeypatch.chdir(file.parent)
    made(tmp_path / "made", 1, including=("gain_step.py",))
    monkeypatch.chdir("/")
    assert Settings.read(tmp_path / "made").including == (str(file),)
    made(tmp_path / "made", 1, including=(str(file),))


def test_what_is_refused_after_the_draws_leaves_no_folder(tmp_path):
    """Settings that were left there would refuse the number that the sentence asks for."""
    with refused("20 simulations"):
        made(tmp_path / "made", simulations=20)
    assert not (tmp_path / "made").exists()


def test_a_lost_case_is_made_again_with_the_same_key(challenge, tmp_path):
    folder, _ = challenge
    case = folder / "cases" / "case-001"
    maps = healpy.read_map(case / "W1_half1.fits", dtype=float)
    seal = (case / "SEAL").read_text()
    case.rename(tmp_path / "lost")
    made(folder)
    assert (case / "SEAL").read_text() == seal
    np.testing.assert_array_equal(healpy.read_map(case / "W1_half1.fits", dtype=float), maps)


@pytest.mark.parametrize("lost", ["W1_half2.fits", "model.toml", "question.json"])
def test_a_lost_file_of_a_sealed_case_is_made_again(challenge, lost):
    folder, _ = challenge
    case = folder / "cases" / "case-001"
    before = {name: (case / name).read_bytes() for name in ("SEAL", lost)}
    (case / lost).unlink()
    made(folder)
    assert {name: (case / name).read_bytes() for name in before} == before


def test_a_file_in_the_place_of_a_case_is_named(challenge, tmp_path):
    folder, _ = challenge
    case = folder / "cases" / "case-001"
    case.rename(tmp_path / "lost")
    case.write_text("")
    with refused(case):
        made(folder)
    case.unlink()
    (tmp_path / "lost").rename(case)


def test_cases_are_what_a_diagnosis_reads(challenge):
    folder, _ = challenge
    fiducial = config.load(folder / "cases" / "case-000" / "model.toml")
    assert fiducial.name == "case-000"
    assert fiducial.effects == ()
    assert len(read_maps(analysis_of(fiducial).model, folder / "cases" / "case-000")) == 2
    public = [path.read_text() for path in folder.glob("c*/**/*") if path.suffix in (".json", ".toml")]
    truths = [read_key(folder, case) for case in finished_cases(folder)]
    assert all(str(truth.seed) not in text for truth in truths for text in public)
    assert len({truth.nonce for truth in truths}) == CASES
    assert all(len(truth.nonce) == 64 for truth in truths)
    invented = [truth for truth in truths if truth.kind == "invented"]
    assert invented
    assert all(truth.sampled and truth.members[0].response for truth in invented)


def test_verdicts_are_scored(challenge, tmp_path):
    folder, _ = challenge
    assert run(folder, workers=0) == CASES
    assert run(folder, workers=0) == 0
    for case in finished_cases(folder):
        verdict = json.loads((folder / "verdicts" / case / "verdict.json").read_text())
        assert verdict["case"] == case
    left_out = [read_key(folder, case) for case in finished_cases(folder)]
    for truth in left_out:
        verdict = json.loads((folder / "verdicts" / truth.case / "verdict.json").read_text())
        named = {effect["name"] for one in [verdict["effects"], *verdict["alternatives"]] for effect in one}
        assert not named & set(truth.without)
    found = score.score(folder, workers=0)
    assert confusion(found.records).counts.sum() == CASES
    # Noise, not luck: data without an effect are not far off.
    assert all(record.p_value > 1e-4 for record in found.records if record.kind == "none")
    for name in ("score.json", "report.html", "score.png"):
        assert (folder / "score" / name).stat().st_size > 1000
    key = key_path(folder, "case-000")
    text = key.read_text()
    key.write_text(text.replace('"sampled": ', '"sampled":  '))
    with refused("case-000.json", "SHA-256"):
        score.score(folder, workers=0)
    key.write_text(text)


def test_a_damaged_verdict_is_refused(challenge):
    folder, _ = challenge
    run(folder, workers=0)
    path = folder / "verdicts" / "case-000" / "verdict.json"
    text = path.read_text()
    for wrong in ("{}", "no verdict", None):
        path.unlink() if wrong is None else path.write_text(wrong)
        with refused("case-000"):
            score.score(folder, workers=0)
    path.write_text(text)
    with quick_pictures(empty=True):
        assert score.score(folder, workers=0).title == f"{CASES} full skies"


def test_a_case_without_a_verdict_is_counted(challenge, tmp_path):
    folder, _ = challenge
    run(folder, workers=0)
    (folder / "verdicts" / "case-003").rename(tmp_path / "case-003")
    with quick_pictures():
        found = score.score(folder, workers=0)
    assert found.title.startswith(f"{CASES - 1} full skies of {CASES}")
    assert [record.case for record in found.records] == ["case-000", "case-001", "case-002", "case-004"]
    (tmp_path / "case-003").rename(folder / "verdicts" / "case-003")


def of_another_case(folder, case):
    verdict = json.loads((folder / "verdicts" / case / "verdict.json").read_text())
    return {"verdict.json": verdict | {"case": "case-004"}}


def of_sets(word, *sets):
    def verdict(folder, case):
        found = json.loads((folder / "verdicts" / case / "verdict.json").read_text())
        effects = [[{"name": name, "channel": "W1", "parameters": {}} for name in one] for one in sets]
        return {"verdict.json": found | {"verdict": word, "effects": (effects or [[]])[0], "alternatives": effects[1:]}}

    return verdict


def changed(change):
    def answer(folder, case):
        found = json.loads((folder / "verdicts" / case / "answer.json").read_text())
        return {"answer.json": found | change(found)}

    return answer


@pytest.mark.parametrize(
    "damage",
    [
        of_another_case,
        changed(lambda found: {"evidence": found["evidence"][:-3]}),
        changed(lambda found: {"evidence": [np.nan, *found["evidence"][1:]]}),
        changed(lambda found: {"evidence": [found["evidence"]]}),
        changed(lambda found: {"evidence": "none"}),
        changed(lambda found: {"maximum": np.nan}),
        changed(lambda found: {"maximum": None}),
        changed(lambda found: {"seal": 64 * "0"}),
        of_sets("effect"),
        of_sets("none", ["calibration"]),
        of_sets("effect", ["calibration"], ["beam_width"]),
        of_sets("mixture", ["calibration"]),
        of_sets("degenerate", ["calibration"]),
        of_sets("effect", ["no_such_effect"]),
    ],
)
def test_a_verdict_that_is_not_that_of_the_case_is_refused(challenge, tmp_path, damage):
    folder, _ = challenge
    run(folder, workers=0)
    for name, content in damage(folder, "case-000").items():
        path = folder / "verdicts" / "case-000" / name
        text = path.read_text()
        path.write_text(json.dumps(content))
        with refused("case-000"):
            score.score(folder, workers=0)
        path.write_text(text)


def test_a_verdict_on_other_maps_is_no_answer(challenge):
    """Of a challenge that was made anew over its verdicts, whose cases have the same names."""
    folder, _ = challenge
    run(folder, workers=0)
    path = folder / "cases" / "case-002" / "SEAL"
    text = path.read_text()
    path.write_text(f"{64 * 'a'}  keys/case-002.json\n")
    for task in (run, score.score):
        with refused(folder / "verdicts" / "case-002", folder / "cases" / "case-002"):
            task(folder, workers=0)
    path.write_text(text)


def test_a_verdict_without_other_effects_is_refused(challenge):
    """A left-out effect that another stands for, of as many elements of the data vector, would not show otherwise."""
    folder, _ = challenge
    run(folder, workers=0)
    path = folder / "cases" / "case-000" / "question.json"
    text = path.read_text()
    path.write_text('{"without": ["beam_width", "noise_level"]}')
    with refused("case-000", "beam_width", "noise_level"):
        score.score(folder, workers=0)
    path.write_text(text)


@pytest.mark.parametrize(
    "damage", [lambda path: path.unlink(), lambda path: path.write_bytes(path.read_bytes()[:3000])]
)
def test_damaged_maps_are_a_sentence(challenge, tmp_path, damage):
    folder, _ = challenge
    run(folder, workers=0)
    (folder / "verdicts" / "case-000").rename(tmp_path / "verdict")
    path = folder / "cases" / "case-000" / "W1_half2.fits"
    content = path.read_bytes()
    damage(path)
    with refused(path):
        run(folder, workers=0)
    path.write_bytes(content)
    (tmp_path / "verdict").rename(folder / "verdicts" / "case-000")


@pytest.mark.parametrize("lost", ["case-001/SEAL", "case-001"])
def test_a_lost_case_is_named_and_not_left_out_of_the_score(challenge, tmp_path, lost):
    folder, _ = challenge
    run(folder, workers=0)
    case = folder / "cases" / "case-001"
    before = {path.name: path.read_bytes() for path in case.iterdir() if path.suffix != ".fits"}
    (folder / "cases" / lost).rename(tmp_path / "lost")
    for task in (run, score.score):
        with refused("case-001", "SEAL"):
            task(folder, workers=0)
    made(folder)
    assert {path.name: path.read_bytes() for path in case.iterdir() if path.suffix != ".fits"} == before
    assert len(list(case.glob("*.fits"))) == 2
    assert run(folder, workers=0) == 0


def test_a_lost_key_is_named_and_no_other_made(challenge, tmp_path):
    folder, _ = challenge
    (folder / "keys").rename(tmp_path / "keys")
    with refused(folder / "keys", "case-000", "case-004"):
        made(folder)
    assert not (folder / "keys").exists()
    run(folder, workers=0)  # needs no keys
    with refused("case-000.json") as caught:
        score.score(folder, workers=0)
    assert "new folder" in str(caught.value)
    (tmp_path / "keys").rename(folder / "keys")


def test_the_catalogue_stays_what_it_is():
    assert set(load(OUT_OF_LIBRARY)) == {"invented_square_beam", "invented_nonlinearity", "invented_crosstalk"}
    assert "invented_crosstalk" in library_with(OUT_OF_LIBRARY)
    assert "invented_crosstalk" not in systematics.catalogue()
    with pytest.raises(TypeError):
        systematics.catalogue()["invented_crosstalk"] = systematics.Effect
    with refused("nowhere.py", "mcsim.Effect"):
        load("nowhere.py")
