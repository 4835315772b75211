"""Read a run from TOML or a dict, and write it as TOML, or as JSON for a worker."""

import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from pydantic import TypeAdapter, ValidationError

from mcsim.config import arrays, paths
from mcsim.config.consistency import warn_of_units
from mcsim.config.messages import read_from, sentence, shown
from mcsim.config.noise import check_own_files
from mcsim.config.preparation import grid_after
from mcsim.config.schema import RunConfig, analysis_lmax, pixel_window
from mcsim.errors import InputError
from mcsim.support import resources
from mcsim.support.folders import user_path

_ADAPTER = TypeAdapter(RunConfig)


def load(source: str | Path | Mapping[str, Any] | RunConfig, base: str | Path | None = None) -> RunConfig:
    """Read and check a run.

    Parameters
    ----------
    source
        Path of a TOML file of schema 1; or the name of a packaged workflow (``"quickstart"``), used where no such
        file exists; or a dict of the same structure. In a dict an array may stand in place of a file (``sky.spectrum``,
        ``sky.alm``, ``sky.map``, masks, ``map.pixel_window``, the ``path`` of a beam, the maps of ``noise``), a
        :class:`mcsim.Beam` in place of a beam, and :class:`mcsim.Moments` or a :class:`mcsim.ScanModel` in place of a
        scan. A configuration that is loaded already is returned as it is.
    base
        Folder that the relative paths of a dict start from; default: the working folder. Relative paths in a file start
        from its folder.

    Returns
    -------
    RunConfig
        Its paths are absolute, and all its files exist; :func:`mcsim.config.channel_path` and
        :func:`mcsim.config.sky_path` fill {channel}, {split} and {realization}.

    Raises
    ------
    InputError
        For any error, with file, key, value, limit and remedy.

    Notes
    -----
    Arrays and objects are written once into the cache ($MCSIM_CACHE, or ~/.cache/mcsim), and the run names these files;
    its hash is over their contents.

    Examples
    --------
    >>> import numpy as np
    >>> import mcsim
    >>> run = mcsim.load_config("quickstart")
    >>> run.name, run.map.nside
    ('quickstart', 128)
    >>> channel = {
    ...     "name": "W1",
    ...     "beam": mcsim.Beam.elliptical(300.0, 250.0, lmax=32),
    ...     "scan": mcsim.Moments.parallel_transport(nside=16),
    ... }
    >>> sky = {"spectrum": 1.0 / (1.0 + np.arange(33)) ** 2, "lmax": 32}
    >>> run = mcsim.load_config({"name": "mine", "sky": sky, "map": {"nside": 16}, "channel": [channel]})
    >>> run.channels[0].scan.kind
    'moments'
    """
    if isinstance(source, RunConfig):
        return source
    if isinstance(source, Mapping):
        where, file, folder = "configuration", None, user_path(base or ".")
        plain = _plain(arrays.in_files(source), where)
    else:
        path = user_path(source)
        where = file = str(source)
        plain, folder = _read(path if os.path.isfile(path) else resources.workflow(source))
    paths.make_absolute(plain, folder, where)
    paths.find_descriptions(plain)
    config = _validate(plain, where)
    paths.check_files(config, plain, where)
    check_own_files(config, where)
    warn_of_units(config)
    return config if file is None else read_from(config, file)


def check_skies(config: RunConfig, realizations: range) -> None:
    """Raise InputError unless the sky files of all these realizations exist."""
    paths.check_files(config, to_dict(config), config.name, realizations)


def to_dict(config: RunConfig) -> dict[str, Any]:
    """Return a plain dict as in TOML: ``load(to_dict(config)) == config``; omitted keys are None."""
    plain: dict[str, Any] = _ADAPTER.dump_python(config, mode="json", by_alias=True)
    for effect in plain["effect"]:
        effect |= effect.pop("parameters")
    for table, key in ((plain, "simulator"), (plain["ensemble"], "maps"), (plain["map"], "offset_order")):
        if table[key] is None:  # as in stores of runs without it
            del table[key]
    if not config.biposh.filtered:
        del plain["biposh"]["filter"], plain["biposh"]["probes"]
    return plain


def resolved(config: RunConfig) -> dict[str, Any]:
    """Return a plain dict with the defaults filled in, for stores and people; it loads as the same run.

    ``map.pixel_window`` stays None if channels differ in it.
    """
    plain = to_dict(config)
    plain["biposh"]["lmax"] = analysis_lmax(config)
    windows = {pixel_window(config, channel) for channel in config.channels}
    plain["map"]["pixel_window"] = windows.pop() if len(windows) == 1 else None
    return plain


def complete(config: RunConfig) -> dict[str, Any]:
    """Return :func:`resolved` for people, with the defaults too that stores of runs without them leave out."""
    plain, every = resolved(config), _ADAPTER.dump_python(config, mode="json", by_alias=True)
    for table in ("map", "biposh", "ensemble"):
        plain[table] = every[table] | plain[table]
    if config.map.offset_order is None:
        plain["map"]["offset_order"] = 1
    return every | plain


def prepared_grid(config: RunConfig) -> tuple[int, str]:
    """Return nside (0 without pixels) and frame of the maps after their preparation."""
    return grid_after(config.preparation, config.map.resolution, config.map.frame)


def to_toml(config: RunConfig) -> str:
    """Return TOML that :func:`load` reads; it has neither what is None nor empty lists."""
    return tomli_w.dumps(_filled(to_dict(config)))


def _filled(value: Any) -> Any:
    """Return nested tables without what is None or an empty list."""
    if isinstance(value, dict):
        return {key: _filled(one) for key, one in value.items() if one is not None and one != []}
    return [_filled(one) for one in value] if isinstance(value, list) else value


def to_json(config: RunConfig) -> str:
    """Return JSON from which :func:`from_json` rebuilds the configuration."""
    return json.dumps(to_dict(config))


def from_json(text: str) -> RunConfig:
    """Rebuild a configuration, for instance on a worker, without checking that files exist."""
    return _validate(json.loads(text), "configuration")


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the TOML file, for editors."""
    schema = _ADAPTER.json_schema(by_alias=True)
    effect = schema["$defs"]["Effect"]
    # In TOML the parameters of an effect stand beside its name, and each effect has its own.
    effect["additionalProperties"] = effect["properties"].pop("parameters")["additionalProperties"]
    return schema


def _read(path: Path) -> tuple[dict[str, Any], Path]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text in UTF-8; give a TOML file.") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}; correct it there.") from None
    return _plain(table, str(path)), path.parent


def _plain(source: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a copy in JSON's types, with numpy's scalars and pathlib's paths converted."""

    def convert(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, Path):
            return str(value)
        remedy = "a number, text, true or false"
        if isinstance(value, type) and hasattr(value, "amplitude"):
            remedy = "the path of the .py file that has the effect's class"
        raise InputError(f"{where}: the value {shown(str(value))} is a {type(value).__name__}; give {remedy}.")

    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(source), default=convert))
    except InputError:
        raise
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"{where} cannot be read ({error}); give a dict with the structure of the TOML file."
        ) from None
    return plain


def _validate(plain: dict[str, Any], where: str) -> RunConfig:
    plain = _with_parameters(plain)
    # JSON mode is strict about numbers and text, yet takes TOML's lists for tuples; Python's strict mode refuses them.
    try:
        return _ADAPTER.validate_json(json.dumps(plain), by_alias=True, by_name=False)
    except ValidationError as error:
        raise InputError(sentence(error, plain, where)) from None


def _with_parameters(plain: dict[str, Any]) -> dict[str, Any]:
    """Return the run with the parameters of effects in separate tables, as in the schema."""
    tables = plain.get("effect")
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        return plain
    folded = []
    for table in tables:
        own = {key: table[key] for key in ("name", "channel") if key in table}
        folded.append({**own, "parameters": {key: table[key] for key in table if key not in own}})
    return {**plain, "effect": folded}
