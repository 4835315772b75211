"""Spin-precession-orbit scan models, read from TOML."""

import json
import math
import tomllib
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcsim.errors import InputError
from mcsim.sphere.checks import check_angle
from mcsim.support import resources

SECONDS_PER_DAY = 86400.0

LONGEST_DAYS = 36525.0  #: of a survey: a century
MOST_SAMPLES = 10**13  #: of a line of sight: a century at 3 kHz


@dataclass(frozen=True)
class LineOfSight:
    """Direction of one beam in the spin frame (z = spin axis), for example ``"W1A"``, and where its numbers come from.

    The boresight angle to the spin axis lies strictly between 0 and 180 degrees, the azimuth about it is that at spin
    phase 0. ``sample_period_s`` is the time between samples, where it differs from the model's.
    """

    name: str
    boresight_angle_deg: float
    azimuth_deg: float = 0.0
    sample_period_s: float | None = None
    source: str = ""


@dataclass(frozen=True)
class ScanModel:
    """A survey by spin, precession and orbit.

    Parameters
    ----------
    name
        Name of the mission or survey.
    spin_period_s
        Spin period; negative turns backwards.
    precession_period_s
        Precession period about the anti-Sun direction; negative turns backwards.
    precession_angle_deg
        Angle between the spin axis and the anti-Sun direction, 0 to 90 degrees.
    orbit_period_s
        Period of the anti-Sun direction along the ecliptic, > 0 (eastwards).
    sample_period_s
        Time between samples, > 0; samples are taken at t = 0, 1, 2, ... times this period.
    duration_days
        Length of the survey, > 0.
    lines_of_sight
        The beams, at least one.
    default_lines
        Names of the lines of sight that are used when none are asked for.
    pairs
        Differencing pairs: name of the assembly and the names of its two lines of sight.
    spin_phase_deg, precession_phase_deg, orbit_phase_deg
        Angles at t = 0.
    description
        In words.
    source
        Citation of each number, by key.

    Notes
    -----
    R_y, R_z rotate by positive angles in right-handed frames. In the spin frame the line of sight is at polar
    angle ``boresight_angle_deg`` and azimuth 2 pi t / spin_period + spin_phase + azimuth; to ecliptic coordinates
    it is turned by R_z(2 pi t / orbit) R_y(90 deg) R_z(2 pi t / precession) R_y(precession_angle), so that the
    anti-Sun direction is at longitude ``orbit_phase_deg`` at t = 0.

    Examples
    --------
    >>> from mcsim import ScanModel
    >>> model = ScanModel.load("planck").with_sampling(7.0)
    >>> model.samples(model.lines_of_sight[0]) > 1_000_000
    True
    """

    name: str
    spin_period_s: float
    precession_period_s: float
    precession_angle_deg: float
    orbit_period_s: float
    sample_period_s: float
    duration_days: float
    lines_of_sight: tuple[LineOfSight, ...]
    default_lines: tuple[str, ...]
    pairs: dict[str, tuple[str, str]] = field(default_factory=dict)
    spin_phase_deg: float = 0.0
    precession_phase_deg: float = 0.0
    orbit_phase_deg: float = 0.0
    description: str = ""
    source: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise InputError if the numbers describe no possible survey."""
        _check(self)

    @classmethod
    def load(cls, name_or_path: str | Path) -> "ScanModel":
        """Read a scan model.

        Parameters
        ----------
        name_or_path
            Name of a packaged model, for example ``"wmap"``, ``"planck"`` or ``"litebird"``; or a TOML file. Its keys
            are the fields of :class:`ScanModel`, with tables ``[[line_of_sight]]`` (fields of :class:`LineOfSight`),
            ``[pairs]`` (assembly = [line, line]) and ``[source]`` (key = citation).

        Raises
        ------
        InputError
            If there is no such model, the file cannot be read, a key is unknown or missing, or a value is not
            physical.

        Examples
        --------
        >>> from mcsim import ScanModel
        >>> model = ScanModel.load("wmap")
        >>> model.spin_period_s, model.precession_angle_deg
        (129.3, 22.5)
        """
        path = resources.scan_model(name_or_path)
        return _from_table(_read_toml(path), str(path))

    def as_table(self, folder: Path) -> dict[str, str]:
        """Write the model as TOML into a folder; return the table that stands for it in a run."""
        own = ("lines_of_sight", "pairs", "source")
        lines = ["schema = 1"]
        lines += [f"{f.name} = {_toml(getattr(self, f.name))}" for f in fields(self) if f.name not in own]
        for key in ("pairs", "source"):
            lines += [f"[{key}]", *(f"{_toml(name)} = {_toml(value)}" for name, value in getattr(self, key).items())]
        for line in self.lines_of_sight:
            given = {f.name: getattr(line, f.name) for f in fields(line)}
            lines += ["[[line_of_sight]]", *(f"{key} = {_toml(v)}" for key, v in given.items() if v is not None)]
        (folder / "scan-model.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return {"kind": "hit_averaged", "model": "scan-model.toml"}

    def line_of_sight(self, name: str) -> LineOfSight:
        """Return the line of sight called ``name``; InputError if there is none."""
        for line in self.lines_of_sight:
            if line.name == name:
                return line
        known = ", ".join(line.name for line in self.lines_of_sight)
        raise InputError(f"scan model {self.name!r} has no line of sight {name!r}: choose from {known}.")

    def pair(self, name: str) -> tuple[LineOfSight, LineOfSight]:
        """Return the two lines of sight of the differencing assembly ``name``; InputError if there is none."""
        if name not in self.pairs:
            known = ", ".join(self.pairs) or "none are defined"
            raise InputError(f"scan model {self.name!r} has no differencing pair {name!r}: choose from {known}.")
        side_a, side_b = self.pairs[name]
        return self.line_of_sight(side_a), self.line_of_sight(side_b)

    def select(self, names: str | list[str] | tuple[str, ...] | None = None) -> tuple[LineOfSight, ...]:
        """Return the lines of sight called ``names``; the model's default ones if None."""
        names = [names] if isinstance(names, str) else names
        return tuple(self.line_of_sight(name) for name in (self.default_lines if names is None else names))

    def period_of_samples(self, line: LineOfSight) -> float:
        """Return the time between samples of a line of sight, in seconds."""
        return self.sample_period_s if line.sample_period_s is None else line.sample_period_s

    def samples(self, line: LineOfSight) -> int:
        """Return the number of samples of a line of sight in the whole survey."""
        # The small number keeps 31557600 / 0.0512 from losing its last sample to rounding.
        return math.floor(self.duration_days * SECONDS_PER_DAY / self.period_of_samples(line) + 1e-6)

    def with_sampling(self, sample_period_s: float) -> "ScanModel":
        """Return the same survey with every line of sight sampled every ``sample_period_s`` seconds."""
        lines = tuple(replace(line, sample_period_s=None) for line in self.lines_of_sight)
        return replace(self, sample_period_s=float(sample_period_s), lines_of_sight=lines)

    def with_lines_of_sight(self, *names: str) -> "ScanModel":
        """Return the same survey with these lines of sight as the default ones; InputError if one is unknown."""
        return replace(self, default_lines=tuple(line.name for line in self.select(names)))

    def ahead(self, seconds: float) -> "ScanModel":
        """Return the same survey, ``seconds`` further on its way at t = 0."""
        phases = {
            f"{way}_phase_deg": getattr(self, f"{way}_phase_deg") + 360.0 * seconds / getattr(self, f"{way}_period_s")
            for way in ("spin", "precession", "orbit")
        }
        return replace(self, **phases)


def read_described(path: Path) -> tuple[ScanModel, float | None]:
    """Return how a survey was pointed, and the amplitude of the dipole that it saw, uK; None if nothing is said of it.

    The file is a scan model, or a survey's short description: TOML with the periods, angles and phases of a scan model,
    one ``boresight_angle_deg``, the number of ``samples``, the azimuth of every channel about the spin axis in a table
    ``spin_azimuth_rad``, and optionally ``dipole_uk``; further keys may hold text. Its lines of sight bear the names of
    the channels. InputError if the file cannot be read, lacks a number, has an unknown one, or is of neither kind.
    """
    table, where = _read_toml(path), str(path)
    if "spin_azimuth_rad" not in table:
        return _from_table(table, where), None
    azimuths = table["spin_azimuth_rad"]
    if not isinstance(azimuths, dict) or not azimuths:
        raise InputError(f"{where}: spin_azimuth_rad is {azimuths!r}; give a table, channel = radians.")
    boresight = _number(table, "boresight_angle_deg", where)
    lines = []
    for name in azimuths:
        azimuth = _number(azimuths, name, where)
        check_angle(azimuth, f"{where}: spin_azimuth_rad of {name}")
        lines.append({"name": name, "boresight_angle_deg": boresight, "azimuth_deg": math.degrees(azimuth)})
    numbers = NUMBERS - {"duration_days"}
    stated = {key: value for key, value in table.items() if not isinstance(value, str)}  # text is for people
    _refuse_unknown(stated, numbers | {"boresight_angle_deg", "dipole_uk", "samples", "spin_azimuth_rad"}, where)
    copied = {key: _number(table, key, where) for key in numbers if key in table or key not in _OPTIONAL}
    days = _number(table, "samples", where) * copied["sample_period_s"] / SECONDS_PER_DAY
    model = {"schema": 1, "name": path.stem, **copied, "duration_days": days, "line_of_sight": lines}
    dipole = _number(table, "dipole_uk", where) if "dipole_uk" in table else None
    return _from_table(model, where), dipole


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return _parsed(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"scan model {str(path)!r} cannot be read: {error.strerror}; give a TOML file.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"scan model {str(path)!r} is not valid TOML: {error}.") from None


@lru_cache(maxsize=16)
def _parsed(text: str) -> dict[str, Any]:
    """Return the table of a text, which nobody changes: surveys of runs with other effects read the same models."""
    return tomllib.loads(text)


def _toml(value: str | float | tuple[str, ...]) -> str:
    """Return a text, number or list of texts as TOML, from which the same value is read, bit for bit."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


_TABLES = {"schema", "line_of_sight", "lines_of_sight", "default_lines", "pairs", "source"}
_TEXT = {"name", "description"}
NUMBERS = {f.name for f in fields(ScanModel)} - _TEXT - _TABLES
_POSITIVE = {"orbit_period_s", "sample_period_s", "duration_days"}
_OPTIONAL = {"spin_phase_deg", "precession_phase_deg", "orbit_phase_deg"}
_LINE_NUMBERS = {"boresight_angle_deg", "azimuth_deg", "sample_period_s"}


def _from_table(table: dict[str, Any], where: str) -> ScanModel:
    """Build a scan model from a parsed TOML table; ``where`` names it in error messages."""
    _refuse_unknown(table, NUMBERS | _TEXT | _TABLES - {"lines_of_sight"}, where)
    if table.get("schema") != 1:
        raise InputError(f"{where}: schema is {table.get('schema')!r}, but this version reads schema = 1.")
    if not isinstance(table.get("name"), str) or not table["name"]:
        raise InputError(f"{where}: key 'name' is missing; give the survey a name.")
    numbers = {key: _number(table, key, where) for key in NUMBERS if key in table or key not in _OPTIONAL}
    lines = _lines(table.get("line_of_sight"), where)
    names = tuple(line.name for line in lines)
    default_lines = _group(table.get("default_lines", list(names)), names, "default_lines", where)
    pairs = {}
    for key, value in _subtable(table, "pairs", where).items():
        pair = _group(value, names, f"pairs.{key}", where)
        if len(pair) != 2:
            raise InputError(f"{where}: pairs.{key} has {len(pair)} lines of sight, but a pair needs 2.")
        pairs[key] = (pair[0], pair[1])
    source = _subtable(table, "source", where)
    _refuse_unknown(source, NUMBERS, f"{where}, [source]")
    try:
        return ScanModel(
            name=table["name"],
            description=str(table.get("description", "")),
            lines_of_sight=lines,
            default_lines=default_lines,
            pairs=pairs,
            source={key: str(value) for key, value in source.items()},
            **numbers,
        )
    except InputError as error:
        raise InputError(f"{where}, {error}") from None


def _refuse_unknown(table: dict[str, Any], known: set[str], where: str) -> None:
    if unknown := sorted(set(table) - known):
        raise InputError(f"{where}: unknown key {unknown[0]!r}; the keys are {', '.join(sorted(known))}.")


def _subtable(table: dict[str, Any], key: str, where: str) -> dict[str, Any]:
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a table [{key}].")
    return value


def _group(value: Any, names: tuple[str, ...], label: str, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise InputError(f"{where}: {label} is {value!r}, but it must be a list of names of lines of sight.")
    if unknown := [name for name in value if name not in names]:
        raise InputError(f"{where}: {label} names {unknown[0]!r}, but the lines of sight are {', '.join(names)}.")
    return tuple(value)


def _number(table: dict[str, Any], key: str, where: str) -> float:
    if key not in table:
        raise InputError(f"{where}: key {key!r} is missing; give a number.")
    value = table[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}, but it must be a finite number.")
    return float(value)


def _lines(tables: Any, where: str) -> tuple[LineOfSight, ...]:
    if not isinstance(tables, list) or not tables:
        raise InputError(f"{where}: no [[line_of_sight]] is given; add one with name and boresight_angle_deg.")
    lines = []
    for table in tables:
        _refuse_unknown(table, _LINE_NUMBERS | {"name", "source"}, f"{where}, [[line_of_sight]]")
        name = table.get("name")
        if not isinstance(name, str) or not name:
            raise InputError(f"{where}: a [[line_of_sight]] has no name; give it one.")
        inside = f"{where}, line of sight {name!r}"
        numbers = {key: _number(table, key, inside) for key in _LINE_NUMBERS if key in table}
        if "boresight_angle_deg" not in numbers:
            raise InputError(f"{inside}: key 'boresight_angle_deg' is missing; give a number.")
        lines.append(LineOfSight(name=name, source=str(table.get("source", "")), **numbers))
        if [line.name for line in lines].count(name) > 1:
            raise InputError(f"{where}: two lines of sight are called {name!r}; names must differ.")
    return tuple(lines)


def _check(model: ScanModel) -> None:
    """Raise InputError if the numbers of a model describe no possible survey."""
    where = f"scan model {model.name!r}"
    for key in NUMBERS:
        if not math.isfinite(getattr(model, key)):
            raise InputError(f"{where}: {key} is {getattr(model, key)}, but it must be a finite number.")
        if key in _POSITIVE and not getattr(model, key) > 0.0:
            raise InputError(f"{where}: {key} is {getattr(model, key):g}, but it must be > 0.")
    if model.orbit_period_s < SECONDS_PER_DAY:
        raise InputError(
            f"{where}: orbit_period_s is {model.orbit_period_s:g}, less than a day; give seconds (a year has 31557600)."
        )
    if model.duration_days > LONGEST_DAYS:
        raise InputError(f"{where}: duration_days is {model.duration_days:g}, more than a century; give days.")
    if model.spin_period_s == 0.0:
        raise InputError(f"{where}: spin_period_s is 0, but a survey spins; give seconds (negative: backwards).")
    if model.precession_period_s == 0.0:
        raise InputError(f"{where}: precession_period_s is 0; for no precession set precession_angle_deg = 0 instead.")
    if not 0.0 <= model.precession_angle_deg <= 90.0:
        raise InputError(
            f"{where}: precession_angle_deg is {model.precession_angle_deg:g}, but it must be between 0 and 90."
        )
    for label, lines in (("default_lines", model.default_lines), *model.pairs.items()):
        if len(set(lines)) < len(lines):
            raise InputError(f"{where}: {label} names a line of sight twice, {', '.join(lines)}; name each once.")
    for line in model.lines_of_sight:
        inside = f"{where}, line of sight {line.name!r}"
        if not 0.0 < line.boresight_angle_deg < 180.0:
            raise InputError(
                f"{inside}: boresight_angle_deg is {line.boresight_angle_deg:g}, but it must lie between 0 and 180."
            )
        if line.sample_period_s is not None and not line.sample_period_s > 0.0:
            raise InputError(f"{inside}: sample_period_s is {line.sample_period_s:g}, but it must be > 0.")
        if model.samples(line) < 1:
            raise InputError(
                f"{inside}: a survey of {model.duration_days:g} days has no sample every "
                f"{model.period_of_samples(line):g} s; lengthen duration_days."
            )
        if model.samples(line) > MOST_SAMPLES:
            raise InputError(
                f"{inside}: a sample every {model.period_of_samples(line):g} s makes {model.samples(line):.3g} of "
                f"them, at most {MOST_SAMPLES:g} may be; raise sample_period_s."
            )
