"""The folder of a challenge: settings, keys, seals, and what is refused of them."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcsim import config
from mcsim.benchmark import challenge
from mcsim.benchmark.case import Member, Truth
from mcsim.benchmark.challenge import make, make_case, maps_of, run
from mcsim.benchmark.folder import (
    MAPS,
    SEAL,
    SETTINGS,
    VERDICTS,
    Settings,
    finished_cases,
    key_hash,
    key_path,
    open_key,
    question,
    read_key,
    write_key,
)
from mcsim.benchmark.score import score, score_draws
from mcsim.config.load import to_toml
from mcsim.errors import InputError
from mcsim.support.folders import write_whole
from refusals import refused

ACTING = Member("beam_width", "A", {"amplitude": 0.01}, (0.01,), 6.0, 0)


def truth(case="case-000", **changes):
    values = {"kind": "one", "members": (ACTING,), "without": (), "seed": 5, "sampled": True, "nonce": "ab" * 32}
    return Truth(case=case, **(values | changes))


@pytest.fixture
def folder(tmp_path):
    """A challenge of one case, without maps."""
    Settings(config.load("quickstart")).write(tmp_path, 3)
    write_key(tmp_path, truth())
    seal(tmp_path, key_hash(tmp_path, "case-000"))
    return tmp_path


def seal(folder, text):
    (folder / MAPS / "case-000").mkdir(parents=True, exist_ok=True)
    (folder / MAPS / "case-000" / SEAL).write_text(f"{text}  keys/case-000.json\n")


numbers = st.lists(st.floats(allow_nan=False)).map(tuple)
effects = st.builds(
    Member,
    st.text(),
    st.none() | st.text(),
    st.dictionaries(st.text(), st.floats(allow_nan=False) | st.booleans() | st.text() | numbers),
    numbers,
    st.floats(0, 100),
    st.none() | st.integers(0, 99),
    numbers,
)


@given(st.lists(effects, max_size=2), st.lists(st.text(), max_size=2), st.integers(2**40, 2**62), st.booleans())
def test_a_key_is_read_as_it_was_written(tmp_path_factory, members, without, seed, by_sample):
    folder = tmp_path_factory.mktemp("keys")
    written = truth(members=tuple(members), without=tuple(without), seed=seed, sampled=by_sample)
    write_key(folder, written)
    seal(folder, key_hash(folder, "case-000"))
    assert read_key(folder, "case-000") == open_key(folder, "case-000") == written


def test_a_key_that_was_read_makes_maps_of_a_spectrum_with_bands(tmp_path):
    small = config.load("quickstart", ["sky.lmax=24", "biposh.lmax=16", "map.nside=8"])
    bands = (1.0, 0.5, 0.0, 0.0, 0.0, 0.0)
    member = Member("spectrum", None, {"amplitude": 0.1, "bands": bands}, bands, 6.0, 0)
    known = write_key(tmp_path, truth(members=(member,), sampled=False))
    changed, plain = (dict(maps_of(small, one)) for one in (known, truth(members=(), sampled=False)))
    assert all(np.std(changed[name] - plain[name]) > 1.0 for name in plain)


def test_effects_on_request_are_settings_of_a_challenge(tmp_path):
    asked = Settings(config.load("quickstart"), including=("gain_spin",))
    asked.write(tmp_path, 3)
    assert Settings.read(tmp_path) == asked
    with pytest.raises(InputError):
        Settings(config.load("quickstart")).write(tmp_path, 3)
    with refused("gain_spinn", "gain_spin"):
        replace(asked, including=("gain_spinn",))


def test_an_effect_on_request_is_not_out_of_the_library():
    """The right answer to it would be its name, and not that it is unknown."""
    file = str(Path(__file__).parents[2] / "docs" / "howto" / "gain_step.py")
    with refused("gain_step", file, "--with"):
        Settings(config.load("quickstart"), out_of_library=file, including=(file,))
    assert Settings(config.load("quickstart"), out_of_library=file).out_of_library == file


def test_settings_are_read_as_they_were_written(folder):
    found = Settings.read(folder)
    assert found == Settings(config.load("quickstart"))
    found.write(folder, 3)
    other_sky = replace(found.model, sky=replace(found.model.sky, lmax=100))
    for other, seed, named in (
        (found, 4, ("keys/challenge.json", "seed")),
        (replace(found, sampled_share=0.1), 3, (f"{SETTINGS}", "sampled_share: 0.5 -> 0.1")),
        (replace(found, model=other_sky), 3, (f"model.sky.lmax: {found.model.sky.lmax} -> 100",)),
        (replace(found, including=("gain_spin",)), 3, ("including", "gain_spin")),
    ):
        with refused(*named) as caught:
            other.write(folder, seed)
        assert str(caught.value).count("->") == (named[-1] != "seed")
    for damaged in ("5", "{", "[]", '{"model": 3}'):
        write_whole(folder / SETTINGS, damaged)
        with refused(SETTINGS):
            found.write(folder, 3)


def test_a_challenge_goes_on_with_other_workers(folder):
    found = Settings.read(folder)
    before = (folder / SETTINGS).read_text()
    replace(found, model=replace(found.model, compute=replace(found.model.compute, workers=7))).write(folder, 3)
    assert (folder / SETTINGS).read_text() == before


def test_a_key_that_was_changed_is_found(folder):
    assert finished_cases(folder) == ["case-000"]
    assert open_key(folder, "case-000") == truth()
    key_path(folder, "case-000").unlink()
    write_key(folder, truth(kind="none", members=()))
    with refused("case-000.json", "SHA-256"):
        open_key(folder, "case-000")
    seal(folder, "ab" * 32)
    with refused("case-000.json", "SHA-256"):
        open_key(folder, "case-000")
    for damage in (b"\xff\xfe\x00", b"", key_hash(folder, "case-000")[:63].encode()):
        (folder / MAPS / "case-000" / SEAL).write_bytes(damage)
        with refused("case-000/SEAL", 64):
            open_key(folder, "case-000")
    for text in ("{}", "[1]", "no key", '{"schema": 1, "members": [{"name": "beam_width"}], "without": []}'):
        key_path(folder, "case-000").write_text(text)
        with pytest.raises(InputError):
            open_key(folder, "case-000")
    key_path(folder, "case-000").unlink()
    with pytest.raises(InputError):
        open_key(folder, "case-000")


def test_a_key_is_written_once(tmp_path):
    """Of two makers of a case the later one takes the key of the earlier: its seal is that of the one key there is."""
    assert write_key(tmp_path, truth(nonce="ab" * 32)) == truth(nonce="ab" * 32)
    assert write_key(tmp_path, truth(nonce="cd" * 32)) == truth(nonce="ab" * 32)
    assert [path.name for path in key_path(tmp_path, "case-000").parent.iterdir()] == ["case-000.json"]


def test_a_case_that_two_make_at_once_has_the_seal_of_its_key(tmp_path, monkeypatch):
    settings, drawn = Settings(config.load("tiny")), truth(members=(), sampled=False)

    def slow(bits):
        monkeypatch.setattr(challenge.secrets, "token_hex", lambda bits: "ab" * 32)
        make_case(settings, tmp_path, drawn)
        return "cd" * 32

    monkeypatch.setattr(challenge.secrets, "token_hex", slow)
    make_case(settings, tmp_path, drawn)
    assert open_key(tmp_path, "case-000").nonce == "ab" * 32


@pytest.mark.parametrize(
    "said", ['"beam_width"', '["nonsense"]', "[[1]]", "[1]", "{}", "null", '["effect.py"]', '{"beam_width": 1}']
)
def test_a_question_is_a_list_of_known_effects(said, folder):
    path = folder / MAPS / "case-000" / "question.json"
    for text in (f'{{"without": {said}}}', said):
        path.write_text(text)
        with refused(path):
            run(folder, workers=0)
    path.write_text('{"without": ["beam_width", "gain_spin"]}')
    asked = Settings(config.load("quickstart"), including=("gain_spin",))
    assert question(asked, folder, "case-000") == ("beam_width", "gain_spin")


def test_a_folder_that_is_no_challenge_is_refused(folder, tmp_path):
    for task in (run, score):
        with refused(tmp_path / "nothing"):
            task(tmp_path / "nothing", workers=0)
    with refused(tmp_path, "verdicts"):
        score(folder, workers=0)
    with refused("question.json"):
        run(folder, workers=0)
    (folder / VERDICTS / "case-000").mkdir(parents=True)
    for text in ("{}", "no settings", '{"model": 3, "prior": {}, "sampled_share": 0.5, "simulations": null}'):
        write_whole(folder / SETTINGS, text)
        for task in (run, score):
            with refused(folder / SETTINGS):
                task(folder, workers=0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("model", {"schema": 1}),
        ("prior", {"none": "x"}),
        ("prior", []),
        ("including", ["gain_spni"]),
        ("sampled_share", 7),
        ("simulations", "many"),
    ],
)
def test_damaged_settings_name_their_file(folder, key, value):
    path = folder / SETTINGS
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with refused(path):
        Settings.read(folder)


@pytest.mark.parametrize(
    ("place", "task"),
    [("verdicts/case-000", run), ("verdicts", run), ("verdicts/case-000", score), ("score", score)],
)
def test_a_file_in_the_place_of_a_folder_is_named(folder, place, task):
    """Before a case is diagnosed; and no score leaves out the case whose verdict has become a file."""
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_text("")
    with refused(folder / place):
        task(folder, workers=0)


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_is_from_nothing_to_all(share):
    with refused(share):
        Settings(config.load("quickstart"), sampled_share=share)


def test_a_model_without_pointing_is_told_to_make_no_map_by_sample(tmp_path):
    """It was told to take another scan alone."""
    with refused("demo", "hit_averaged", "--sampled-share 0"):
        make(Settings(config.load("tiny")), tmp_path / "made", 1, 0, workers=0)


@pytest.mark.parametrize("number", [0, -3])
def test_a_number_of_cases_is_positive(number, tmp_path):
    settings = Settings(config.load("quickstart"), sampled_share=0.0)
    with refused(number):
        make(settings, tmp_path / "made", number, 0, workers=0)
    with refused(number):
        score_draws(settings, tmp_path / "made", number, 0, workers=0)
    assert not (tmp_path / "made").exists()


def test_a_score_of_draws_is_written_over_nothing(tmp_path):
    (tmp_path / "score.json").write_text("of a challenge")
    with refused(tmp_path, "-o"):
        score_draws(Settings(config.load("quickstart"), sampled_share=0.0), tmp_path, 2, 0, workers=0)
    assert [path.name for path in tmp_path.iterdir()] == ["score.json"]


@pytest.mark.parametrize("name", ["plain", 'quotes " and #', "beam \N{TELESCOPE}"])
def test_a_run_in_toml_loads_as_the_same_run(name):
    run = config.load("quickstart")
    effect = config.Effect(name="beam_width", channel=run.channels[0].name, parameters={"amplitude": 0.01})
    run = replace(run, name=name, effects=(effect,))
    assert config.load(tomllib.loads(to_toml(run))) == run


def test_a_folder_in_the_home_is_found_there(folder, monkeypatch):
    monkeypatch.setenv("HOME", str(folder))
    (folder / "file").write_text("")
    settings = Settings(config.load("quickstart"))
    with refused(folder / "file"):
        make(settings, "~/file/of/mine", 1, 3)
    (folder / VERDICTS / "case-000").mkdir(parents=True)
    assert run("~") == 0
    with refused(folder / MAPS / "case-000"):
        score("~", workers=0)
