"""Folders that appear complete or not at all."""

import errno
import os
import signal
import socket
import subprocess
import sys

import pytest

from mcsim.config import arrays
from mcsim.errors import InputError, RunError
from mcsim.support.folders import appearing, cached, default_cache_dir, unwritable, user_path
from refusals import refused


def test_a_folder_appears_whole(tmp_path):
    with appearing(tmp_path / "new" / "folder") as scratch:
        (scratch / "file").write_text("all")
        assert not (tmp_path / "new" / "folder").exists()
    assert (tmp_path / "new" / "folder" / "file").read_text() == "all"
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["folder"]


def test_nothing_is_left_of_a_block_that_fails(tmp_path):
    def fail():
        with appearing(tmp_path / "folder") as scratch:
            (scratch / "file").write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_who_was_quicker_stays(tmp_path):
    with appearing(tmp_path / "folder") as scratch:
        (scratch / "file").write_text("second")
        with appearing(tmp_path / "folder") as other:
            (other / "file").write_text("first")
    assert (tmp_path / "folder" / "file").read_text() == "first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    "made",
    ["with folders.appearing(folders.default_cache_dir() / 'one') as path: stop(path)", "arrays.kept(stop, 'map')"],
)
def test_what_a_killed_process_has_left_is_deleted(made, tmp_path):
    """Each killed diagnosis left a folder, pairs of a differencing scan 8 bytes for each sample."""
    code = f"""
import os, signal
from mcsim.config import arrays
from mcsim.support import folders
def stop(folder):
    (folder / "file").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
{made}
"""
    environment = os.environ | {"MCSIM_CACHE": str(tmp_path)}
    assert subprocess.run([sys.executable, "-c", code], env=environment).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    other = left.with_name(left.name.replace(socket.gethostname(), "elsewhere"))  # where it may be alive
    other.mkdir()
    with appearing(tmp_path / "two") as scratch, appearing(tmp_path / "three"):
        assert {*tmp_path.iterdir()} >= {scratch, other}
        assert not left.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted((other.name, "three", "two"))


STEP = """
import os, pathlib, shutil, signal, sys
from mcsim.support.folders import replacing
left, text = map(int, sys.argv[2:])
def killed(real):
    def step(*given, **named):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*given, **named)
    return step
pathlib.Path.unlink, pathlib.Path.rename = killed(pathlib.Path.unlink), killed(pathlib.Path.rename)
shutil.move, shutil.rmtree = killed(shutil.move), killed(shutil.rmtree)
with replacing(pathlib.Path(sys.argv[1]), "last", "former") as scratch:
    (scratch / "store").mkdir()
    for name in ("last", "other", "store/a", "store/b", *(["former"] if text == 1 else [])):
        (scratch / name).write_text(str(text))
"""


def test_files_that_belong_together_are_replaced_together_whenever_the_process_is_killed(tmp_path):
    """An old verdict stood beside a new report."""
    whole = {"last", "other", "store/a", "store/b"}
    for step in range(20):
        folder = tmp_path / str(step)
        for left, text in ((99, 1), (step, 2)):
            ended = subprocess.run([sys.executable, "-c", STEP, folder, str(left), str(text)]).returncode
        names = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
        found = {name: (folder / name).read_text() for name in names if not name.startswith(".")}
        assert len(set(found.values())) <= 1
        assert "last" not in found or whole <= found.keys()
        assert len({"store/a", "store/b"} & found.keys()) != 1
        if ended == 0:
            break
    assert step > 5
    assert found == dict.fromkeys(whole, "2")
    assert sorted(path.name for path in folder.iterdir()) == ["last", "other", "store"]


def test_what_is_made_behind_a_link_is_there(tmp_path):
    (tmp_path / "disk" / "folder").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "folder")
    with appearing(tmp_path / "link") as scratch:
        assert scratch.parent == tmp_path / "disk"  # from where it can be renamed
        (scratch / "file").write_text("all")
    assert (tmp_path / "disk" / "folder" / "file").read_text() == "all"
    assert (tmp_path / "link").is_symlink()


def test_a_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / "folder").write_text("in the way")
    for path in (tmp_path / "folder", tmp_path / "folder" / "own"):
        with refused(tmp_path / "folder"), appearing(path):
            pass
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("said", "number", "kind"),
    [
        *(((one, os.strerror(one)), one, RunError) for one in (errno.ENOSPC, errno.EDQUOT)),
        (("5 requested and 0 written",), errno.ENOSPC, RunError),  # as numpy says it, without a number
        ((errno.EROFS, os.strerror(errno.EROFS)), errno.EROFS, InputError),
    ],
)
def test_a_full_disk_is_no_bad_input(cache, said, number, kind):
    def fail(*given):
        raise OSError(*said)

    for written in (lambda: cached("name", fail), lambda: arrays.kept(fail, "mask")):
        with refused("MCSIM_CACHE", by=kind, errno=number):
            written()
    with refused(cache, by=kind, errno=number) as caught, unwritable(cache, "choose another"):
        fail()
    assert ("choose another" in str(caught.value)) == (kind is InputError)


def test_a_lost_connection_is_not_blamed_on_the_cache(cache):
    def lost(folder):
        raise TimeoutError(7)

    with refused(7, by=TimeoutError):
        cached("name", lost)
    assert list(cache.iterdir()) == []


def flipped(path):
    """Content with a bit of its last byte changed, as disks change it: the size stays."""
    whole = path.read_bytes()
    return whole[:-1] + bytes([whole[-1] ^ 1])


@pytest.mark.parametrize("lost", [[".content.json"], ["a"], ["b/c"], ["a", "b/c", ".content.json"]])
@pytest.mark.parametrize(
    "how",
    [lambda path: path.write_bytes(b""), lambda path: path.unlink(), lambda path: path.write_bytes(flipped(path))],
)
def test_a_cached_folder_that_has_lost_files_is_filled_again(cache, lost, how):
    """Scratch disks delete old files and keep their folders: a learned model without one gave another verdict."""
    filled = []

    def fill(folder):
        filled.append(folder)
        (folder / "a").write_bytes(b"1234")
        (folder / "b").mkdir()
        (folder / "b" / "c").write_bytes(b"5")

    folder = cached("x/name", fill)
    assert cached("x/name", fill) == folder
    assert len(filled) == 1
    for name in lost:
        how(folder / name)
        if (folder / name).exists():
            os.utime(folder / name, (1, 1))  # the clock of a file system may stand still for some ms
    assert cached("x/name", fill) == folder
    assert ((folder / "a").read_bytes(), (folder / "b" / "c").read_bytes()) == (b"1234", b"5")
    assert len(filled) == 2
    assert [path.name for path in (cache / "x").iterdir()] == ["name"]
    (folder / ".content.json").write_text('{"a": 4, "b/c": 1}')  # of an earlier version
    cached("x/name", fill)
    assert len(filled) == 2


def test_home_is_found_in_what_users_give(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_path("~/a b") == tmp_path / "a b"
    assert user_path(tmp_path / "~").name == "~"
    monkeypatch.setenv("MCSIM_CACHE", "~/cache")
    assert default_cache_dir() == tmp_path / "cache"
    for wrong in (None, 5, ["a"]):
        with refused(wrong):
            user_path(wrong)
