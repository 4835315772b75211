"""Identity of a run: the hash of what defines its result, and the differences of two runs."""

import hashlib
import json
from pathlib import Path
from typing import Any

from mcsim.config import paths
from mcsim.config.arrays import sha256_of
from mcsim.config.load import to_dict
from mcsim.config.schema import RunConfig, analysis_lmax, pixel_window


def science(config: RunConfig, *others: str) -> dict[str, Any]:
    """Return the part of a run that defines its numbers, with file names replaced by hashes of contents.

    It has sky, map, channels, effects, preparation, biposh, seed and pairing; not name, compute, the number of
    realizations, keep_maps or the bins of the summary, nor sections such as "nuisance" that are not named in
    ``others``. A file is represented by the SHA-256 of its contents, a template by those of its files. Skies given one
    file per realization are represented by the part of their template with the placeholder and by the contents of
    realization 0; the others are not read.
    """
    plain = to_dict(config)
    for entry in paths.entries(plain):
        if not entry.rule.checked:
            continue
        named = paths.files(entry, config.map.splits, config.name)
        found = {label: f"sha256:{_contents_of(path)}" for label, path in named.items()}
        contents: Any = found[""] if list(found) == [""] else found
        if "realization" in entry.rule.placeholders:
            contents = {"template": paths.template_tail(entry.template), "first": contents}
        entry.holder[entry.field] = contents
    _leave_out_what_says_nothing(plain)
    plain["biposh"]["lmax"] = analysis_lmax(config)
    if config.biposh.filtered:
        plain["biposh"]["bin"] = plain["biposh"]["summary_bin"]  # its bins are part of the estimates
    del plain["biposh"]["summary_bin"]
    window = plain["map"].pop("pixel_window")
    for table, channel in zip(plain["channel"], config.channels, strict=True):
        table["pixel_window"] = pixel_window(config, channel) if window is None else window
    return {
        "schema": plain["schema"],
        **{
            section: plain[section]
            for section in ("sky", "map", "channel", "effect", "preparation", "biposh", *others)
            if section in plain
        },
        "ensemble": {key: plain["ensemble"][key] for key in ("seed", "paired")},
    }


def _contents_of(path: Path) -> str:
    if path.suffix != ".py":
        return sha256_of(path)
    from mcsim.support.code import file_digest  # loads slowly

    return file_digest(path)


_MAP = {"grid": "healpix", "nside": None, "mask_frame": None, "mask_apodisation_deg": 0.0, "split_by": "time"}
_OF_KIND: dict[str, dict[str, Any]] = {
    "moments": {"model": None, "line_of_sight": None},
    "map": {"angle_deg": 0.0},
    "blm": {"angle_deg": 0.0},
    "white": {"kind": "white", "hits": None},
}
"""Defaults of the keys of a scan, beam or noise that are younger than its kind."""


def _leave_out_what_says_nothing(plain: dict[str, Any]) -> None:
    """Drop keys at their defaults, and the limit of iterations, on which no finished map depends.

    A run that does not use a key thus keeps its hash from before the key existed.
    """
    _drop(plain, {"effect": [], "preparation": []})
    _drop(plain["map"], _MAP)
    if plain["map"].get("offset_order") == 1:
        del plain["map"]["offset_order"]
    _drop(plain["sky"], {"dipole_uk": None})
    if (plain["sky"]["dipole_lon_deg"], plain["sky"]["dipole_lat_deg"]) == (264.0, 48.24):
        del plain["sky"]["dipole_lon_deg"], plain["sky"]["dipole_lat_deg"]
    for channel in plain["channel"]:
        channel["scan"].pop("max_iterations", None)
        noises = (channel["noise"], *channel["split_noise"].values())
        _drop(channel, {"beam_b": None, "split_noise": {}, "mask": None, "foregrounds": True})
        for table in (channel["scan"], channel["beam"], channel.get("beam_b", {"kind": "none"}), *noises):
            _drop(table, _OF_KIND.get(table["kind"], {}))


def _drop(table: dict[str, Any], defaults: dict[str, Any]) -> None:
    for key, value in defaults.items():
        if table[key] == value:
            del table[key]


def digest(config: RunConfig, *others: str) -> str:
    """Return the SHA-256 of the canonical JSON of :func:`science`, in hexadecimal."""
    return digest_of(science(config, *others))


def digest_of(found: dict[str, Any]) -> str:
    """Return the digest of a run from what :func:`science` returned."""
    canonical = json.dumps(found, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return the differences between two results of :func:`science`, as ``key: old -> new``, sorted by key."""
    before, after = dict(_leaves(old, "")), dict(_leaves(new, ""))
    return [
        f"{key}: {before.get(key, 'absent')} -> {after.get(key, 'absent')}"
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key)
    ]


def _leaves(value: Any, key: str) -> list[tuple[str, str]]:
    if isinstance(value, dict):
        return [leaf for name, item in value.items() for leaf in _leaves(item, f"{key}.{name}" if key else name)]
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        names = [str(item.get("name", number)) for number, item in enumerate(value)]
        names = [str(number) if name.startswith("sha256:") else name for number, name in enumerate(names)]
        names = [name if names.count(name) == 1 else f"{name} {number}" for number, name in enumerate(names)]
        inner = [leaf for name, item in zip(names, value, strict=True) for leaf in _leaves(item, f"{key}[{name}]")]
        return [(f"{key} (order)", ", ".join(names)), *inner]
    if isinstance(value, str) and value.startswith("sha256:"):
        return [(key, f"contents {value[:19]}")]
    return [(key, json.dumps(value))]
