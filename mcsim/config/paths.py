"""Files of a run: environment variables, relative paths, and {channel}, {split}, {realization}."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from string import Formatter
from typing import Any, NamedTuple

from mcsim.config.arrays import RULES, Rule, literal
from mcsim.config.messages import label
from mcsim.config.schema import RunConfig
from mcsim.errors import InputError
from mcsim.support import resources

DESCRIPTION = "scan.toml"  #: name of the file beside moments that describes the survey's pointing

_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_NUMBER_FORMAT = re.compile(r"(0?[1-9]?d)?")


class Entry(NamedTuple):
    """One key that names a file (or a family of files) in the plain dict of a run."""

    key: str  # as in messages: channel[W1].beam.path
    holder: Any  # the table, or list, that contains it
    field: str | int  # its name or place there
    rule: Rule
    channels: tuple[str, ...]  # channels that it applies to
    split: str | None = None  # split that it applies to; None: all

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
    channels = _tables(plain, "channel")
    every = tuple(str(table.get("name")) for table in channels)
    sections: list[tuple[str, str, Any, tuple[str, ...], str | None]] = [
        (name, name, plain.get(name), every, None) for name in ("sky", "map", "ensemble")
    ]
    for number, table in enumerate(channels):
        key = f"channel[{label(table, number)}]"
        parts = ("beam", "beam_b", "scan", "noise")
        one = (every[number],)
        sections.append(("channel", key, table, one, None))
        sections += [(part, f"{key}.{part}", table.get(part), one, None) for part in parts]
        of_splits = table.get("split_noise")
        for split, own in of_splits.items() if isinstance(of_splits, dict) else ():
            sections.append(("noise", f"{key}.split_noise.{split}", own, one, split))
    for n, table in enumerate(_tables(plain, "effect")):
        of_effects = ("effect", f"effect {table.get('name')}")
        sections += [(section, f"effect[{n}]", table, every, None) for section in of_effects]
    for n, table in enumerate(_tables(plain, "nuisance")):
        of_effects, own = ("effect", f"effect {table.get('effect')}"), table.get("parameters")
        sections += [(section, f"nuisance[{n}].parameters", own, every, None) for section in of_effects]
    for number, table in enumerate(_tables(plain, "preparation")):
        own = table.get("channels")
        names = tuple(map(str, own)) if isinstance(own, list) and own else every
        sections.append(("preparation", f"preparation[{number}]", table, names, None))
    for section, where, holder, speaks_of, split in sections:
        for path, rule in RULES.items():
            table_name, field = path.split(".")
            if table_name == section and isinstance(holder, dict):
                value = holder.get(field)
                if isinstance(value, str) and value.strip() and value not in rule.words:
                    yield Entry(f"{where}.{field}", holder, field, rule, speaks_of, split)
                for place, item in enumerate(value if isinstance(value, list) else []):
                    if isinstance(item, str) and item.strip():
                        yield Entry(f"{where}.{field}[{place}]", value, place, rule, speaks_of, split)
    for kind, field in (("effect", "name"), ("nuisance", "effect")):
        for number, table in enumerate(_tables(plain, kind)):
            if str(table.get(field)).endswith(".py"):
                yield Entry(f"{kind}[{number}].{field}", table, field, Rule(), every)
    if ".py:" in str(plain.get("simulator")):
        yield Entry("simulator", plain, "simulator", Rule(checked=False), every)


def _tables(plain: dict[str, Any], key: str) -> list[dict[str, Any]]:
    given = plain.get(key)
    return [table for table in given if isinstance(table, dict)] if isinstance(given, list) else []


def make_absolute(plain: dict[str, Any], base: Path, where: str) -> None:
    """Expand ${VAR} and ~ and make relative paths start from ``base``, in place; keep packaged names."""
    for entry in entries(plain):
        if not _is_packaged(entry):
            entry.holder[entry.field] = _absolute(entry, base, where)


def _absolute(entry: Entry, base: Path, where: str) -> str:
    for name in _VARIABLE.findall(entry.template):
        if name not in os.environ:
            raise InputError(
                f"{where}: {entry.key} = {entry.template!r} uses the environment variable {name}, which is not set; "
                "set it or write the folder out."
            )
    escaped = literal if entry.rule.placeholders else str
    path = _VARIABLE.sub(lambda match: escaped(os.environ[match[1]]), entry.template)
    return os.path.normpath(os.path.join(escaped(str(base.absolute())), os.path.expanduser(path)))


def find_descriptions(plain: dict[str, Any]) -> None:
    """Set, in place, the model of channels without one to the ``scan.toml`` beside their moments."""
    for channel in _tables(plain, "channel"):
        scan = channel.get("scan")
        if not isinstance(scan, dict) or scan.get("kind") != "moments" or scan.get("model") is not None:
            continue
        with suppress(ValueError, LookupError):  # of placeholders that are refused afterwards
            beside = channel_path(str(Path(str(scan.get("path"))).parent / DESCRIPTION), str(channel.get("name")))
            if os.path.isfile(beside):  # False also for a name that no file system takes
                scan["model"] = literal(str(beside))


def files(entry: Entry, splits: Sequence[str], where: str, realization: int = 0) -> dict[str, Path]:
    """Return the files of an entry, by the values of its placeholders ("W1,half1"; "" without any).

    Unknown or malformed placeholders, {split} without splits, and missing files are refused.
    """
    used = _placeholders(entry, where)
    if "split" in used and not splits:
        raise InputError(
            f"{where}: {entry.key} = {entry.template!r} contains {{split}}, but map.splits is empty; "
            "name the splits there."
        )
    found = {}
    for channel in entry.channels if "channel" in used else [""]:
        of = splits if entry.split is None else [entry.split]
        for split in of if "split" in used else [""]:
            values = {"channel": channel, "split": split, "realization": realization}
            found[",".join(value for value in (channel, split) if value)] = _existing(entry, values, where)
    return found


def check_files(config: RunConfig, plain: dict[str, Any], where: str, realizations: range | None = None) -> None:
    """Raise InputError unless all files of a run exist, with the skies of all these realizations."""
    for entry in entries(plain):
        placeholders = _placeholders(entry, where)
        if not entry.rule.checked:
            continue
        files(entry, config.map.splits, where)
        if "realization" in placeholders:
            wanted = range(config.ensemble.realizations) if realizations is None else realizations
            for realization in wanted:
                try:
                    files(entry, config.map.splits, where, realization)
                except InputError as error:
                    raise InputError(
                        f"{str(error).rstrip('.')}; realizations {wanted.start} to {wanted.stop - 1} need a file each, "
                        f"{len(wanted)} in all."
                    ) from None


def template_tail(template: str) -> str:
    """Return the part of a template from the first folder or file name that has a placeholder."""
    parts = Path(template).parts
    first = next((number for number, part in enumerate(parts) if "{" in part.replace("{{", "")), len(parts))
    return "/".join(parts[first:])


def _is_packaged(entry: Entry) -> bool:
    return entry.rule.packaged is not None and entry.template in resources.names(entry.rule.packaged)


def _placeholders(entry: Entry, where: str) -> set[str]:
    known = entry.rule.placeholders
    if not known:
        return set()
    try:
        parts = [part for part in Formatter().parse(entry.template) if part[1] is not None]
        for _, name, spec, conversion in parts:
            number = name == "realization" and _NUMBER_FORMAT.fullmatch(spec or "")
            if name not in known or conversion or (spec and not number):
                raise ValueError(name)
    except ValueError:
        allowed = ", ".join(f"{{{name}}}" for name in known)
        raise InputError(
            f"{where}: {entry.key} = {entry.template!r} has a placeholder that is not understood here; use {allowed} "
            "only, and double a brace that is part of a name."
        ) from None
    return {str(part[1]) for part in parts}


def _existing(entry: Entry, values: dict[str, Any], where: str) -> Path:
    if entry.rule.packaged is not None and _is_packaged(entry):
        return {"data": resources.spectrum, "scan_models": resources.scan_model}[entry.rule.packaged](entry.template)
    path = Path(entry.template.format(**values) if entry.rule.placeholders else entry.template)
    if os.path.isfile(path):
        return path
    names = resources.names(entry.rule.packaged) if entry.rule.packaged else ()
    packaged = f" or one of the packaged names {', '.join(names)}" if names else ""
    what = "is a folder" if os.path.isdir(path) else "does not exist"
    raise InputError(
        f"{where}: {entry.key} names the file {str(path)!r}, which {what}; give an existing one{packaged}."
    )
