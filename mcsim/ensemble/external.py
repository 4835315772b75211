"""Simulators of other programs: a function, a class or stored maps in place of a run."""

import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import xarray as xr

from mcsim import config
from mcsim.config import arrays
from mcsim.ensemble.external_maps import Part, Source, StoredMaps, fits_maps, hash_of, parts_of, stacked
from mcsim.errors import InputError, RunError
from mcsim.support.arrays import Alm
from mcsim.support.code import class_digest, value_digest

SEEDS = 1 << 20  #: realizations of a stream of seeds

LARGEST = 1 << 16
"""Bytes of a pickled simulator up to which it goes with every task; a larger one is a file in the cache."""

LONGEST = 80  #: characters of what an object says of itself, up to which messages show it

_NO_CHILDREN = "daemonic processes are not allowed to have children"  #: what multiprocessing says (process.py)

_GOLDEN = 2654435769  #: 2^32 over the golden ratio, odd: multiples modulo 2^32 are all different, and far apart


@dataclass(frozen=True)
class Code(Source):
    """A function or class; ``made`` is the pickle of a function that returns it, ``content`` a hash of its code."""

    made: bytes = b""
    content: str = ""  # and of ``state``, or without one of everything that it holds

    def words(self, seed: int, realization: int) -> str:
        return f"{self.label} with seed {seed_of(seed, realization)}"

    def identity(self) -> str:
        return hash_of(self.content, self.effects, self.takes_sky)

    def _given(self, seed: int, realization: int, effects: Sequence[config.Effect], sky: Alm | None) -> Any:
        # A simulator may change what it is given, in place: the next realization is given the same.
        own: dict[str, Any] = {"effects": deepcopy(tuple(effects))} if effects else {}
        if sky is not None:
            own["sky"] = sky.copy()
        try:
            return _loaded(self.made)(seed_of(seed, realization), **own)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # whatever a foreign program does
            reason, remedy = str(error).partition("\n")[0], "mend it"
            if _NO_CHILDREN in reason:  # workers of Dask are such processes, so that none outlives its driver
                remedy = "call it in the process that starts mcsim, with --workers 0 (workers=0 in Python)"
            raise RunError(
                f"{self.words(seed, realization)} fails ({type(error).__name__}: {reason}); {remedy}."
            ) from error


def named_source(run: config.RunConfig) -> tuple[config.RunConfig, str | None]:
    """Return a run without the simulator or stored maps that it names, and these; None: mcsim simulates."""
    bare = replace(run, simulator=None, ensemble=replace(run.ensemble, maps=None))
    return bare, run.simulator or run.ensemble.maps


def source_of(run: config.RunConfig, given: Any) -> Source:
    """Return the source of maps of a survey that ``run`` describes.

    ``run``: description of sky, beams, scans and noise. ``given``: a function ``simulate(seed, effects=())``, or an
    object with such a method, or its class, which is made with the run if it takes an argument; the same as text,
    ``package.module:name`` or ``file.py:name``. Or stored maps: a template of FITS files with {realization}, {channel}
    and {split}; a Zarr store or .npy file; an xarray object or array with the dimension ``realization`` first. Raise
    InputError if it cannot be loaded, has no such method, or lacks a map.
    """
    parts = tuple(parts_of(run))
    if isinstance(given, xr.DataArray | xr.Dataset | np.ndarray):
        return StoredMaps(parts, "the given maps", path=stacked(given, parts))
    if isinstance(given, str | Path):
        text = str(given)
        if "{" in text.replace("{{", ""):
            return fits_maps(parts, text)
        if ":" not in os.path.basename(text):
            if not os.path.exists(text):
                raise InputError(f"{text} does not exist; give stored maps, or a simulator as package.module:name.")
            if text.endswith(".py"):
                raise InputError(f"{text} is a file of code; say which function or class simulates, {text}:NAME.")
            return StoredMaps(parts, Path(text).name, path=os.path.abspath(text))
        made = cloudpickle.dumps(partial(_resolved, text, config.to_json(run), _written(text.rpartition(":")[0])))
        # The run is a part of what tells diagnoses apart already.
        return _code(parts, os.path.basename(text), made, None)
    label = getattr(given, "__name__", type(_whole(given)).__name__)
    if isinstance(given, type):
        return _code(parts, label, _pickled(partial(_of_class, given, config.to_json(run)), given), given)
    made = _pickled(partial(_same, given), given)
    if len(made) > LARGEST:
        kept = arrays.kept(lambda folder: (folder / "simulator").write_bytes(made), "simulator") / "simulator"
        made = cloudpickle.dumps(partial(_read, str(kept)))
    return _code(parts, label, made, given)


def seed_of(seed: int, realization: int) -> int:
    """Return the seed below 2^32 of one realization of a stream: no two are the same, or within a few of each other.

    Simulators add small numbers to a seed (one for each detector), so that neighbours would share noise. Streams of
    different seeds start at random, so that N realizations of two have one in common with a probability of N / 2^31.
    """
    if not 0 <= realization < SEEDS:
        raise InputError(f"realization {realization} has no seed; there are {SEEDS} of a stream.")
    start = int(np.random.SeedSequence(seed).generate_state(1)[0])
    return (start + realization * _GOLDEN) % (1 << 32)


def _pickled(made: Callable[[], Any], given: Any) -> bytes:
    """Return the pickle of a function that returns a simulator; InputError for one that holds what has none."""
    try:
        return cloudpickle.dumps(made)
    except Exception as error:  # of any type, from what the object holds
        raise InputError(f"the simulator {given!r} cannot be sent to workers ({error}); hold no open files.") from error


def _code(parts: tuple[Part, ...], label: str, made: bytes, given: Any) -> Code:
    """Return the source of a simulator, from what it says of itself.

    ``given`` is told from others by its source, and not the copy that ``made`` returns, which has none in a script;
    None: that copy is from a module.
    """
    simulator = _loaded(made).simulator
    method, effects = _method(simulator), _said_by(simulator, "effects", label) or ()
    listed = isinstance(effects, Iterable) and not isinstance(effects, str)
    if not listed or not all(isinstance(name, str) for name in effects):
        raise InputError(f"{label}.effects = {effects!r} is no list of names; give those of effects that it can add.")
    takes = inspect.signature(method).parameters
    if not takes or (effects and "effects" not in takes):
        missing = "effects" if takes else "seed"
        raise InputError(f"simulate of {label} has no argument {missing}; define simulate(seed, effects=()).")
    content = _content(simulator, given, _said_by(simulator, "state", label))
    return Code(parts, label, tuple(dict.fromkeys(effects)), "sky" in takes, made, content)


def _said_by(simulator: Any, name: str, label: str) -> Any:
    """Return an attribute by which a simulator says something of itself; None: it has none."""
    try:
        return getattr(simulator, name)
    except (Exception, SystemExit) as error:  # whatever a foreign property does
        if isinstance(error, AttributeError) and not hasattr(type(simulator), name):
            return None
        raise InputError(f"{label}.{name} fails ({type(error).__name__}: {error}); mend it.") from error


def _content(simulator: Any, given: Any, state: Any) -> str:
    """Return a hash of the source code and of ``state``, or without one of everything that the object holds.

    What a class or module makes with the description holds no more than these: a part of what tells diagnoses apart.
    """
    if state is not None:
        return hash_of(class_digest(_definition(simulator if given is None else given)), repr(state))
    if given is None and not isinstance(simulator, partial):
        return class_digest(_definition(simulator))
    return value_digest(simulator if given is None else given)


def _same(given: Any) -> Any:
    return given


def _read(path: str) -> Any:
    return cloudpickle.loads(Path(path).read_bytes())()


class _Made(NamedTuple):
    """A simulator, with the working folder and the treatment of numerical errors that it chose when it was made."""

    simulator: Any
    folder: str
    errors: Mapping[str, Any]  # of numpy.errstate

    def __call__(self, seed: int, **own: Any) -> Any:
        """Return what it simulates; folder and errors of this process stay its own."""
        with chdir(self.folder), np.errstate(**self.errors):
            return _method(self.simulator)(seed, **own)


@lru_cache(maxsize=2)
def _loaded(made: bytes) -> _Made:
    """Make a simulator once per process: what it keeps serves all its realizations."""
    try:
        with chdir("."), np.errstate():
            return _Made(cloudpickle.loads(made)(), os.getcwd(), np.geterr())
    except ImportError as error:  # of an object from a module that this process does not find
        raise InputError(f"a worker cannot load the simulator ({error}); install its module.") from error


def _method(simulator: Any) -> Callable[..., Any]:
    found = getattr(simulator, "simulate", simulator)
    if not callable(found):
        shown = repr(simulator)
        shown = f"a {type(simulator).__name__}" if " at 0x" in shown or len(shown) > LONGEST else shown
        raise InputError(
            f"{shown} is no simulator; give a function or an object with simulate(seed, effects=()), or maps as an "
            "array of shape (realization, map, pixel)."
        )
    return found


def _whole(simulator: Any) -> Any:
    """Return the function of a partial one."""
    while isinstance(simulator, partial):
        simulator = simulator.func
    return simulator


def _definition(simulator: Any) -> Any:
    """Return the class or function whose source code makes the maps."""
    found = _whole(simulator)
    if inspect.ismethod(found):
        found = found.__self__
    return found if inspect.isfunction(found) or isinstance(found, type) else type(found)


def _resolved(text: str, run: str, written: str) -> Any:
    """Import a simulator; a class is made, with the description if it takes an argument."""
    module, _, name = text.rpartition(":")
    with _refusing(f"simulator = {text!r} cannot be loaded", "mend or install it"):
        found: Any = _of_path(module, written) if module.endswith(".py") else import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        return _instance(found, run)


def _of_class(kind: type, run: str) -> Any:
    """Make a class that is given itself."""
    with _refusing(f"simulator {kind.__name__} cannot be made", "mend it"):
        return _instance(kind, run)


@contextmanager
def _refusing(what: str, remedy: str) -> Iterator[None]:
    """Turn whatever a foreign module or class raises when it is imported or made into an InputError."""
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"{what} ({type(error).__name__}: {reason}); {remedy}.") from error


def _instance(found: Any, run: str) -> Any:
    """Make a class, with the description if it takes an argument; another object stays as it is."""
    if not isinstance(found, type):
        return found
    return found(config.from_json(run)) if inspect.signature(found).parameters else found()


def _written(path: str) -> str:
    """Return a hash of a file, so that one that is changed is loaded again; "" for a module."""
    if not path.endswith(".py"):
        return ""
    if not os.path.isfile(path):
        raise InputError(f"{path} does not exist; give the file of the simulator.")
    return arrays.sha256_of(Path(path))


def _of_path(path: str, written: str) -> Any:
    """Import a file as ``python file.py`` would: what stands beside it can be imported."""
    name = f"{Path(path).stem}_{hash_of(path, written)[:8]}"
    if name not in sys.modules:
        if os.path.dirname(path) not in sys.path:
            sys.path.insert(0, os.path.dirname(path))
        spec = spec_from_file_location(name, path)
        assert spec is not None  # of a name that ends with .py
        assert spec.loader is not None
        sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


@dataclass(frozen=True, eq=False)
class ExternalModel:
    """A model whose maps another program simulates.

    Parameters
    ----------
    description
        Sky, beams, scans and noise of the instrument: a run. With it maps are filtered, and the responses to effects
        that the other program cannot add are simulated.
    simulator
        Where the maps come from. A function ``simulate(seed, effects=())``, or an object with such a method, or its
        class (made with the description if it takes an argument), or ``"package.module:name"`` of these: it returns
        maps, uK, RING order, in the description's frame and after its preparation, as a dict or xarray object by
        channel, or by channel and split. Or stored maps: the template of FITS files with {realization}, {channel} and
        {split}; a Zarr store; an xarray object or array with the dimension ``realization``.

    Notes
    -----
    A simulator has the attribute ``effects``, names of the effects that it can add, if there are any: it is then called
    with a tuple of :class:`mcsim.config.Effect`, each with ``name``, ``channel`` and ``parameters``. With a keyword
    ``sky`` it is given coefficients a_lm, uK, in place of a sky of its own. An attribute ``state`` stands for what it
    depends on besides its source code; default: all that the object holds.

    Examples
    --------
    >>> import healpy, numpy as np
    >>> import mcsim
    >>> def white(seed):
    ...     return {"demo": np.random.default_rng(seed).normal(scale=50.0, size=healpy.nside2npix(16))}
    >>> mcsim.ExternalModel("tiny", white).description
    'tiny'
    """

    description: str | Path | Mapping[str, Any] | config.RunConfig
    simulator: Any


def loaded(
    model: str | Path | Mapping[str, Any] | config.RunConfig | ExternalModel,
) -> tuple[config.RunConfig, Source | None]:
    """Return the run that a model is or that describes it, and its source of maps; None: mcsim itself."""
    given = model.description if isinstance(model, ExternalModel) else model
    run = config.load(given)
    bare, named = named_source(run)
    if isinstance(model, ExternalModel):
        if named is not None:
            raise InputError(f"{run.name} names the simulator {named!r} already; give the run or the simulator alone.")
        return bare, source_of(bare, model.simulator)
    return bare, None if named is None else source_of(bare, named)
