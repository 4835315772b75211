"""Digests of code follow the code, and nothing else."""

import importlib
import subprocess
import sys

import pytest

from mcsim.support.code import class_digest, package_digest

SOURCE = """
class Base:
    pass


class Thing(Base):
    \"\"\"Add one.\"\"\"

    def __call__(self, x):
        return x + 1
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    (tmp_path / "plugin_of_a_user").mkdir()
    path = tmp_path / "plugin_of_a_user" / "__init__.py"
    path.write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield path
    sys.modules.pop("plugin_of_a_user", None)


def test_a_class_is_known_by_its_code(plugin):
    kind = importlib.import_module("plugin_of_a_user").Thing
    before = class_digest(kind)
    assert class_digest(kind) == before
    plugin.write_text(SOURCE.replace("x + 1", "x + 22"))
    assert class_digest(kind) == before  # what is loaded does not change
    assert class_digest(importlib.reload(sys.modules["plugin_of_a_user"]).Thing) != before


def test_a_module_beside_it_counts(plugin):
    kind = importlib.import_module("plugin_of_a_user").Thing
    before = class_digest(kind)
    (plugin.parent / "constants.py").write_text("E = 0.1\n")
    assert class_digest(importlib.reload(sys.modules["plugin_of_a_user"]).Thing) != before


def test_what_a_module_imports_from_its_folder_counts(tmp_path, monkeypatch):
    """Directly, through another, or from a package there, and nothing else that lies there."""
    files = {
        "single_module_of_a_user": "import numpy\nfrom first_of_a_user import E\n" + SOURCE,
        "first_of_a_user": "def f():\n    import second_of_a_user.inner\nE = 0.1\n",
        "second_of_a_user/inner": "E = 0.1\n",
        "unused_of_a_user": "E = 0.1\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    kind = importlib.import_module("single_module_of_a_user").Thing
    digests = [class_digest(kind)]
    for name, text in files.items():
        (tmp_path / f"{name}.py").write_text(text + "F = 1\n")
        digests.append(class_digest(importlib.reload(sys.modules["single_module_of_a_user"]).Thing))
    for name in files:
        sys.modules.pop(name, None)
    assert len(set(digests)) == 4
    assert digests[4] == digests[3], "a file that is not imported"


SCRIPT = """
from dataclasses import dataclass
from mcsim.support.code import class_digest

FACTOR = 2.0

def helper(x):
    return FACTOR * x

@dataclass
class Thing:
    amplitude: float = 1.0

    def __call__(self, x):
        return helper(x) + self.amplitude

def made(offset):
    class Own:
        def __call__(self, x):
            return x + offset
    return Own

print(class_digest(Thing), class_digest(made(1.0)), class_digest(made(2.0)))
"""


def test_of_a_script_what_a_class_uses_counts(tmp_path):
    """Constants, and functions that it calls, directly or not; and what a function gives to a class that it makes."""

    def digests(text):
        (tmp_path / "script.py").write_text(text)
        return subprocess.run(
            [sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=True
        ).stdout.split()

    thing, one, two = digests(SCRIPT)
    assert digests(SCRIPT) == [thing, one, two]
    assert one != two
    assert digests(SCRIPT.replace("FACTOR = 2.0", "FACTOR = 3.0"))[0] != thing
    assert digests(SCRIPT.replace("FACTOR * x", "FACTOR * x**2"))[0] != thing
    assert digests(SCRIPT + "OTHER = 1\n") == [thing, one, two]


HELD = """
import functools
import threading
from dataclasses import dataclass, field
from mcsim.support.code import class_digest, value_digest

K = 1.0

def scaled(factor):
    def deco(function):
        @functools.wraps(function)
        def wrapped(*given):
            return factor * function(*given)
        return wrapped
    return deco

class Attribute:
    level, lock = K, threading.Lock()

class Method:
    @scaled(K)
    def simulate(self, seed):
        return 1.0

class Cached:
    @functools.lru_cache
    def simulate(self, seed):
        return K

@dataclass(frozen=True)
class Fields:
    amplitude: float = K

@dataclass
class Factory:
    amplitudes: list = field(default_factory=lambda: [K])

class Property:
    level = property(lambda self: K)

@functools.lru_cache
def cached(seed):
    return K

def listed(seed):
    return [K * x for x in range(3) if x in {1, 2, 3}]

def within(seed):
    return list(map(lambda x: K * x, range(3)))

kinds = (Attribute, Method, Cached, Fields, Factory, Property)
print(*map(class_digest, kinds), *map(value_digest, (Attribute(), scaled(2.0)(listed), cached, listed, within)))
"""


@pytest.mark.parametrize("source", [True, False])
def test_everything_that_a_script_uses_counts(tmp_path, source):
    """In attributes, decorators, functions with a cache, comprehensions and functions within functions.

    Without source it is the compiled code that counts: the same in every session, so that simulations are found again.
    """

    def digests(text):
        (tmp_path / "script.py").write_text(text)
        command = [sys.executable, *([str(tmp_path / "script.py")] if source else ["-c", text])]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    first = digests(HELD)
    assert digests(HELD) == first
    assert len(set(first)) == 11
    assert not set(digests(HELD.replace("K = 1.0", "K = 1.5"))) & set(first)
    for old, new, where in (("factor * function", "factor + function", {1, 7}), ("K * x", "K + x", {7, 9, 10})):
        changed = digests(HELD.replace(old, new))
        assert {k for k, (one, other) in enumerate(zip(first, changed, strict=True)) if one != other} == where


def test_versions_count():
    assert package_digest(["mcsim.stats"], ["numpy"]) != package_digest(["mcsim.stats"])
    assert package_digest(["mcsim.stats"]) != package_digest(["mcsim.stats.gaussian"])


def test_a_class_without_source_is_never_the_same():
    space = {"__name__": "no_such_module"}
    exec("class Typed: pass", space)
    assert class_digest(space["Typed"]) != class_digest(space["Typed"])


SIMULATORS = """
import sys
from functools import partial

import mcsim
from mcsim import config
from mcsim.ensemble.external import source_of
from helper_of_a_user import SIZE, noise

LEVEL = 1.0

class Mine:
    def __init__(self):
        self.names, self.level = {"a", "bb", "ccc", "dddd"}, LEVEL

    def simulate(self, seed):
        return {"demo": self.level * noise(seed)}

def plain(seed):
    from helper_of_a_user import noise as drawn
    return {"demo": LEVEL * drawn(seed)}

def closure(level):
    def simulate(seed, size=SIZE):
        return {"demo": level * noise(seed)}
    return simulate

given = (Mine(), Mine, plain, closure(LEVEL), lambda seed: plain(seed), partial(plain))
print(*(source_of(config.load("tiny"), one).identity() for one in given))
"""
HELPER = "import numpy as np\nSIZE = 3072\ndef noise(seed):\n    return np.random.default_rng(seed).normal(size=SIZE)\n"


def test_simulators_of_a_script_are_known_by_their_code_and_what_they_hold(tmp_path):
    """In every process alike, so that the same script finds what it has simulated; other code is other simulations."""

    def identities(script=SIMULATORS, helper=HELPER):
        (tmp_path / "helper_of_a_user.py").write_text(helper)
        (tmp_path / "script.py").write_text(script)
        command = [sys.executable, "-B", str(tmp_path / "script.py")]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    first = identities()
    assert len(set(first)) == 6
    assert identities() == first
    assert identities(SIMULATORS + "OTHER = 1\n") == first
    for changed in (
        identities(SIMULATORS.replace("LEVEL = 1.0", "LEVEL = 2.0")),
        identities(helper=HELPER.replace("normal(size", "normal(scale=2.0, size")),
    ):
        assert not set(changed) & set(first)
