"""Identity of a run: the hash of what defines its result, and the differences of two runs."""

import hashlib
import json
from pathlib import Path
from typing import Any

from mcsim.config import paths
from mcsim.config.load import to_dict
from mcsim.config.schema import RunConfig, analysis_lmax, pixel_window


def science(config: RunConfig) -> dict[str, Any]:
    """Return the part of a run that defines its numbers, with file names replaced by hashes of contents.

    It has sky, map, channels, effects, preparation, biposh, seed and pairing; not name, compute, the number of
    realizations, keep_maps or the bins of the summary. A file is represented by the SHA-256 of its contents, a
    template by those of its files. Skies given one file per realization are represented by the part of their template
    with the placeholder and by the contents of realization 0; the others are not read.

    Raises
    ------
    InputError
        If a file does not exist.
    """
    plain = to_dict(config)
    for entry in paths.entries(plain):
        found = {label: _sha256(path) for label, path in paths.files(entry, config.map.splits, config.name).items()}
        contents: Any = found[""] if list(found) == [""] else found
        if "realization" in entry.rule.placeholders:
            contents = {"template": paths.template_tail(entry.template), "first": contents}
        entry.holder[entry.field] = contents
    _leave_out_what_says_nothing(plain)
    plain["biposh"]["lmax"] = analysis_lmax(config)
    del plain["biposh"]["summary_bin"]
    window = plain["map"].pop("pixel_window")
    for table, channel in zip(plain["channel"], config.channels, strict=True):
        table["pixel_window"] = pixel_window(config, channel) if window is None else window
    return {
        "schema": plain["schema"],
        **{
            section: plain[section]
            for section in ("sky", "map", "channel", "effect", "preparation", "biposh")
            if section in plain
        },
        "ensemble": {key: plain["ensemble"][key] for key in ("seed", "paired")},
    }


def _leave_out_what_says_nothing(plain: dict[str, Any]) -> None:
    """Drop keys at their defaults, and the limit of iterations, on which no finished map depends.

    A run that does not use a key thus keeps its hash from before the key existed.
    """
    section = plain["map"]
    if section["grid"] == "healpix":
        del section["grid"]
    if section["nside"] is None:
        del section["nside"]
    if section["mask_frame"] is None:
        del section["mask_frame"]
    if section["mask_apodisation_deg"] == 0.0:
        del section["mask_apodisation_deg"]
    for name in ("effect", "preparation"):
        if not plain[name]:
            del plain[name]
    if plain["sky"]["dipole_uk"] is None:
        del plain["sky"]["dipole_uk"]
    if (plain["sky"]["dipole_lon_deg"], plain["sky"]["dipole_lat_deg"]) == (264.0, 48.24):
        del plain["sky"]["dipole_lon_deg"], plain["sky"]["dipole_lat_deg"]
    for channel in plain["channel"]:
        channel["scan"].pop("max_iterations", None)
        if channel["scan"]["kind"] == "moments":
            for key in ("model", "line_of_sight"):
                if channel["scan"][key] is None:
                    del channel["scan"][key]
        if channel["beam_b"] is None:
            del channel["beam_b"]
        for beam in (channel["beam"], channel.get("beam_b")):
            if beam is not None and beam["kind"] in ("map", "blm") and beam["angle_deg"] == 0.0:
                del beam["angle_deg"]


def digest(config: RunConfig) -> str:
    """Return the SHA-256 of the canonical JSON of :func:`science`, in hexadecimal."""
    return hashlib.sha256(
        json.dumps(science(config), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()


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
        inner = [leaf for name, item in zip(names, value, strict=True) for leaf in _leaves(item, f"{key}[{name}]")]
        return [(f"{key} (order)", ", ".join(names)), *inner]
    if isinstance(value, str) and value.startswith("sha256:"):
        return [(key, f"contents {value[:19]}")]
    return [(key, json.dumps(value))]


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"
