"""Files of a run: environment variables, relative paths, and {channel}, {split}, {realization}."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

from mcsim.config.messages import label
from mcsim.config.schema import RunConfig
from mcsim.errors import InputError
from mcsim.support import resources

DESCRIPTION = "scan.toml"
"""Name of the file beside moments that describes the survey's pointing."""

_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_NUMBER_FORMAT = re.compile(r"(0?[1-9]?d)?")


class _Rule(NamedTuple):
    """Rules of a key: the kind of packaged name, the words and the placeholders that it may contain."""

    packaged: str | None = None
    words: tuple[str, ...] = ()
    placeholders: tuple[str, ...] = ()


_RULES = {
    "sky.spectrum": _Rule(packaged="data"),
    "sky.alm": _Rule(placeholders=("realization",)),
    "sky.map": _Rule(placeholders=("realization",)),
    "map.mask": _Rule(placeholders=("channel", "split")),
    "map.pixel_window": _Rule(words=("computed", "none")),
    "beam.path": _Rule(placeholders=("channel",)),
    "beam_b.path": _Rule(placeholders=("channel",)),
    "scan.path": _Rule(placeholders=("channel", "split")),
    "scan.model": _Rule(packaged="scan_models", placeholders=("channel", "split")),
    "effect.template": _Rule(),
    "preparation.mask": _Rule(placeholders=("channel", "split")),
    "preparation.window": _Rule(placeholders=("channel",)),
    "preparation.own_window": _Rule(placeholders=("channel",)),
    "preparation.templates": _Rule(placeholders=("channel",)),
}


class Entry(NamedTuple):
    """One key that names a file (or a family of files) in the plain dict of a run."""

    key: str  # as in messages: channel[W1].beam.path
    holder: Any  # the table, or list, that contains it
    field: str | int  # its name or place there
    rule: _Rule
    channels: tuple[str, ...]  # channels that it applies to

    @property
    def template(self) -> str:
        """Value of the key."""
        return str(self.holder[self.field])


def channel_path(template: str, channel: str, split: str | None = None) -> Path:
    """Fill {channel} and {split} in a path of a run; a packaged name is returned unchanged."""
    return Path(template.format(channel=channel, split=split))


def sky_path(template: str, realization: int) -> Path:
    """Fill {realization}, or with leading zeros {realization:05d}, in ``sky.alm`` or ``sky.map``."""
    return Path(template.format(realization=realization))


def entries(plain: dict[str, Any]) -> Iterator[Entry]:
    """Yield every key of the plain dict (as in TOML) that names files; the schema checks the types."""
    channels = plain.get("channel")
    tables = [channel for channel in channels if isinstance(channel, dict)] if isinstance(channels, list) else []
    every = tuple(str(table.get("name")) for table in tables)
    sections: list[tuple[str, str, Any, tuple[str, ...]]] = [
        (name, name, plain.get(name), every) for name in ("sky", "map")
    ]
    for number, table in enumerate(tables):
        key = f"channel[{label(table, number)}]"
        sections += [(part, f"{key}.{part}", table.get(part), (every[number],)) for part in ("beam", "beam_b", "scan")]
    effects = plain.get("effect")
    for number, table in enumerate(effects if isinstance(effects, list) else []):
        sections.append(("effect", f"effect[{number}]", table, every))
    steps = plain.get("preparation")
    for number, table in enumerate(steps if isinstance(steps, list) else []):
        own = table.get("channels") if isinstance(table, dict) else None
        names = tuple(map(str, own)) if isinstance(own, list) and own else every
        sections.append(("preparation", f"preparation[{number}]", table, names))
    for section, where, holder, speaks_of in sections:
        for path, rule in _RULES.items():
            table_name, field = path.split(".")
            if table_name == section and isinstance(holder, dict):
                value = holder.get(field)
                if isinstance(value, str) and value.strip() and value not in rule.words:
                    yield Entry(f"{where}.{field}", holder, field, rule, speaks_of)
                for place, item in enumerate(value if isinstance(value, list) else []):
                    if isinstance(item, str) and item.strip():
                        yield Entry(f"{where}.{field}[{place}]", value, place, rule, speaks_of)


def make_absolute(plain: dict[str, Any], base: Path, where: str) -> None:
    """Expand ${VAR} and make relative paths start from ``base``, in place; keep packaged names."""
    for entry in entries(plain):
        if _is_packaged(entry):
            continue

        def expand(match: re.Match[str], entry: Entry = entry) -> str:
            try:
                return _literal(os.environ[match[1]], entry.rule)
            except KeyError:
                raise InputError(
                    f"{where}: {entry.key} = {entry.template!r} uses the environment variable {match[1]}, which is "
                    "not set; set it or write the folder out."
                ) from None

        path = _VARIABLE.sub(expand, entry.template)
        entry.holder[entry.field] = os.path.normpath(os.path.join(_literal(str(base.absolute()), entry.rule), path))


def find_descriptions(plain: dict[str, Any]) -> None:
    """Set, in place, the model of channels without one to the ``scan.toml`` beside their moments."""
    channels = plain.get("channel")
    for channel in channels if isinstance(channels, list) else []:
        scan = channel.get("scan") if isinstance(channel, dict) else None
        if not isinstance(scan, dict) or scan.get("kind") != "moments" or scan.get("model") is not None:
            continue
        beside = Path(str(scan.get("path"))).parent / DESCRIPTION
        try:
            if beside.is_file():
                scan["model"] = str(beside)
        except (OSError, ValueError):  # a name that no file system takes
            continue


def files(entry: Entry, splits: Sequence[str], where: str, realization: int = 0) -> dict[str, Path]:
    """Return the files of an entry, by the values of its placeholders ("W1,half1"; "" without any).

    Raises
    ------
    InputError
        For an unknown or malformed placeholder, {split} without splits, or a missing file.
    """
    used = _placeholders(entry, where)
    if "split" in used and not splits:
        raise InputError(
            f"{where}: {entry.key} = {entry.template!r} contains {{split}}, but map.splits is empty; "
            "name the splits there."
        )
    found = {}
    for channel in entry.channels if "channel" in used else [""]:
        for split in splits if "split" in used else [""]:
            found[",".join(value for value in (channel, split) if value)] = _existing(
                entry, {"channel": channel, "split": split, "realization": realization}, where
            )
    return found


def check_files(config: RunConfig, plain: dict[str, Any], where: str, realizations: range | None = None) -> None:
    """Raise InputError unless all files of a run exist, with the skies of all these realizations."""
    for entry in entries(plain):
        files(entry, config.map.splits, where)
        if "realization" in _placeholders(entry, where):
            for realization in range(config.ensemble.realizations) if realizations is None else realizations:
                files(entry, (), where, realization)


def template_tail(template: str) -> str:
    """Return the part of a template from the first folder or file name that has a placeholder."""
    parts = Path(template).parts
    first = next((number for number, part in enumerate(parts) if "{" in part.replace("{{", "")), len(parts))
    return "/".join(parts[first:])


def _literal(text: str, rule: _Rule) -> str:
    """Escape the braces of a folder's name: they are not placeholders."""
    return text.replace("{", "{{").replace("}", "}}") if rule.placeholders else text


def _is_packaged(entry: Entry) -> bool:
    return entry.rule.packaged is not None and entry.template in resources.names(entry.rule.packaged)


def _placeholders(entry: Entry, where: str) -> set[str]:
    rule = entry.rule
    if not rule.placeholders:
        return set()
    allowed = ", ".join(f"{{{name}}}" for name in rule.placeholders)
    wrong = InputError(
        f"{where}: {entry.key} = {entry.template!r} has a placeholder that is not understood here; use {allowed} only, "
        "and double a brace that is part of a name."
    )
    try:
        parts = [part for part in Formatter().parse(entry.template) if part[1] is not None]
    except ValueError:
        raise wrong from None
    for _, name, spec, conversion in parts:
        if (
            name not in rule.placeholders
            or conversion
            or (spec and not (name == "realization" and _NUMBER_FORMAT.fullmatch(spec)))
        ):
            raise wrong
    return {str(part[1]) for part in parts}


def _existing(entry: Entry, values: dict[str, Any], where: str) -> Path:
    if entry.rule.packaged is not None and _is_packaged(entry):
        return {"data": resources.spectrum, "scan_models": resources.scan_model}[entry.rule.packaged](entry.template)
    path = Path(entry.template.format(**values) if entry.rule.placeholders else entry.template)
    try:
        if path.is_file():
            return path
    except (OSError, ValueError):  # a name that no file system takes
        pass
    packaged = (
        f" or one of the packaged names {', '.join(resources.names(entry.rule.packaged))}"
        if entry.rule.packaged
        else ""
    )
    raise InputError(
        f"{where}: {entry.key} names the file {str(path)!r}, which does not exist; give an existing one{packaged}."
    )
