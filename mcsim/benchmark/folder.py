"""Read and write the folder of a challenge; the SHA-256 of each key is published with the maps."""

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mcsim import config, systematics
from mcsim.benchmark.case import Member, Prior, Truth
from mcsim.datavector.out_of_library import load
from mcsim.errors import InputError
from mcsim.support.folders import not_a_file, read_json, write_once
from mcsim.support.numbers import some

NO_KEY = "restore it, or make another challenge in a new folder"
SETTINGS, MAPS, KEYS, SEAL, VERDICTS = "challenge.json", "cases", "keys", "SEAL", "verdicts"
MODEL, QUESTION, ANSWER = "model.toml", "question.json", "answer.json"


@dataclass(frozen=True)
class Settings:
    """Settings that all cases of a challenge share.

    ``model`` is the run that the diagnosis takes for a description of the data. ``sampled_share`` of the maps, and all
    with out-of-library effects, are made sample by sample, by another route than that which the diagnosis simulates
    with. ``out_of_library`` is a Python file with classes of effects that no library has; None: there are none, or they
    are not known because the challenge was read from its folder. ``simulations`` is the number for the covariance of
    the data vector; default: three for each element, shrunk. ``including`` names effects that are proposed on request
    alone.
    """

    model: config.RunConfig
    prior: Prior = field(default_factory=Prior)
    sampled_share: float = 0.5
    out_of_library: str | None = None
    simulations: int | None = None
    including: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError for a share or number that cannot be, or an effect that is unknown, or in and out of it."""
        proposed = {systematics.get(name).name for name in self.including}
        own = set() if self.out_of_library is None else set(load(self.out_of_library))
        if both := sorted(proposed & own):
            raise InputError(
                f"effect {both[0]} of {self.out_of_library} is proposed on request, and so not out of the library; "
                "leave it out of --with, or out of the file."
            )
        if not 0.0 <= self.sampled_share <= 1.0:
            raise InputError(f"a share of {self.sampled_share:g} made sample by sample is none; give 0 to 1.")
        count: object = self.simulations  # of a file, whatever is in it
        if count is not None and (isinstance(count, bool) or not isinstance(count, int)):
            raise InputError(f"simulations = {count!r} is no whole number; give one, or none.")

    def write(self, folder: Path, seed: int) -> None:
        """Write the settings, and the seed among the keys; InputError, with what differs, if the folder has others."""
        for path, text in self._files(folder, seed):
            write_once(path, text)
        self.check(folder, seed)

    def check(self, folder: Path, seed: int) -> None:
        """Raise InputError, with what differs, if the folder has other settings, or another seed."""
        for path, text in self._files(folder, seed):
            if path.exists() and (changes := _changes(read_json(path, "restore it, or use another folder"), text)):
                raise InputError(
                    f"{path} is of a challenge with other settings ({'; '.join(changes)}); use those again, or another "
                    "folder."
                )

    def _files(self, folder: Path, seed: int) -> list[tuple[Path, str]]:
        """Return the files of the settings and of the seed, with what they hold."""
        plain = {
            "schema": 1,
            "model": config.to_dict(self.model),
            "prior": asdict(self.prior),
            "sampled_share": self.sampled_share,
            "inventions": None if self.out_of_library is None else sorted(load(self.out_of_library)),
            "simulations": self.simulations,
        }
        plain |= {"including": list(self.including)} if self.including else {}
        both = ((folder / SETTINGS, plain), (folder / KEYS / SETTINGS, {"seed": seed}))
        return [(path, json.dumps(content, indent=1, sort_keys=True) + "\n") for path, content in both]

    @classmethod
    def read(cls, folder: Path) -> "Settings":
        """Read what :meth:`write` wrote; InputError, which names the file, if that is not possible."""
        path = folder / SETTINGS
        plain = read_json(path, "make the challenge with mcsim challenge make")
        try:
            prior, share = Prior(**plain["prior"]), plain["sampled_share"]
            including = tuple(plain.get("including", ()))
            return cls(config.load(plain["model"]), prior, share, None, plain["simulations"], including)
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path} lacks what a challenge needs ({error}); make it again.") from error
        except InputError as error:
            raise InputError(f"{path}: {error} Restore the file, or make it again.") from error


def _changes(old: Any, text: str) -> list[str]:
    """Return what differs in settings: not ``[compute]``, which changes no result; a seed, a secret, without values."""
    new: dict[str, Any] = json.loads(text)
    if new.keys() == {"seed"}:
        return [] if old == new else ["seed"]
    kept = [dict(one) if isinstance(one, dict) else {} for one in (old, new)]
    for plain in kept:
        if isinstance(model := plain.get("model"), dict):
            plain["model"] = {key: value for key, value in model.items() if key != "compute"}
    return config.differences(*kept)


def key_path(folder: Path, case: str) -> Path:
    """Return the path of the key of a case."""
    return folder / KEYS / f"{case}.json"


def write_key(folder: Path, truth: Truth) -> Truth:
    """Write the key of a case, unless it has one; return the one that it has: nobody else's seal is broken."""
    write_once(key_path(folder, truth.case), json.dumps({"schema": 1, **asdict(truth)}, indent=1) + "\n")
    return read_key(folder, truth.case)


def read_key(folder: Path, case: str) -> Truth:
    """Read what :func:`write_key` wrote; InputError if it is no key."""
    path = key_path(folder, case)
    plain = read_json(path, NO_KEY)
    try:
        del plain["schema"]
        for member in plain["members"]:
            member |= {"coordinates": tuple(member["coordinates"]), "response": tuple(member["response"])}
            # JSON knows no tuples, and an effect takes no lists.
            parameters = member["parameters"].items()
            member["parameters"] = {name: tuple(one) if isinstance(one, list) else one for name, one in parameters}
        members = tuple(Member(**member) for member in plain.pop("members"))
        return Truth(members=members, without=tuple(plain.pop("without")), **plain)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} cannot be read as a key ({error}); {NO_KEY}.") from error


def key_hash(folder: Path, case: str) -> str:
    """Return the SHA-256 of the key of a case, in hexadecimal."""
    return hashlib.sha256(key_path(folder, case).read_bytes()).hexdigest()


def open_key(folder: Path, case: str) -> Truth:
    """Read the key of a case; InputError if it has changed since its hash was published with the maps."""
    truth = read_key(folder, case)
    if seal(folder, case) != key_hash(folder, case):
        raise InputError(
            f"{key_path(folder, case)} is not the key that was sealed: its SHA-256 is not that of {case}/{SEAL}; "
            "restore it."
        )
    return truth


def names_of_effects(settings: Settings) -> set[str]:
    """Return the names of the effects that a verdict can have."""
    return {*systematics.catalogue(), *(systematics.get(name).name for name in settings.including)}


def question(settings: Settings, folder: Path, case: str) -> tuple[str, ...]:
    """Return the effects that the diagnosis of a case must not propose; InputError if the folder does not say so."""
    path = folder / MAPS / case / QUESTION
    plain = read_json(path, "restore it")
    names = plain.get("without") if isinstance(plain, dict) else None
    known = names_of_effects(settings)
    if not isinstance(names, list) or not all(isinstance(name, str) and name in known for name in names):
        raise InputError(f'{path} must have a list "without" of names of effects, not {names!r}; restore it.')
    return tuple(names)


def finished_cases(folder: Path) -> list[str]:
    """Return the cases whose maps are complete, in order; InputError if the folder holds no challenge."""
    cases = folder / MAPS
    if not cases.is_dir():
        raise InputError(f"{folder} holds no challenge; make one with mcsim challenge make.")
    return sorted(path.name for path in cases.iterdir() if is_finished(folder, path.name) and path.name[:1] != ".")


def is_finished(folder: Path, case: str) -> bool:
    """Return True if the maps of a case are complete: the seal is written last."""
    return (folder / MAPS / case / SEAL).is_file()


def is_whole(folder: Path, case: str, names: Iterable[str]) -> bool:
    """Return True if a case is finished, and none of its files, the maps of these names among them, is lost."""
    own = folder / MAPS / case
    return is_finished(folder, case) and all((own / name).is_file() for name in (*names, MODEL, QUESTION))


def is_answered(folder: Path, case: str) -> bool:
    """Return True if a case has a verdict; InputError for a file in the place of its folder."""
    path = folder / VERDICTS / case
    not_a_file(path)
    return path.is_dir()


def check_answer(folder: Path, case: str) -> None:
    """Raise InputError for a verdict on other data than those of the case, whose answer has another seal."""
    path, remedy = folder / VERDICTS / case, "and give mcsim challenge run again"
    if not (path / ANSWER).exists():
        return
    answer = read_json(path / ANSWER, f"delete {path}, {remedy}")
    told = answer.get("seal") if isinstance(answer, dict) else None
    if told is not None and told != seal(folder, case):
        raise InputError(f"{path} is of other data than {folder / MAPS / case}; delete it, {remedy}.")


def seal(folder: Path, case: str) -> str:
    """Return the SHA-256 that was published with the maps of a case, in hexadecimal; InputError if it is none."""
    path = folder / MAPS / case / SEAL
    found = path.read_bytes().split()[:1]
    if not found or re.fullmatch(rb"[0-9a-f]{64}", found[0]) is None:
        raise InputError(f"{path} does not begin with a SHA-256 of 64 hexadecimal digits; restore it.")
    return found[0].decode()


def all_cases(folder: Path) -> list[str]:
    """Return :func:`finished_cases`; InputError that names cases with key or verdict whose maps or seal are lost."""
    found = finished_cases(folder)
    known = {path.stem for path in (folder / KEYS).glob("case-*.json")}
    known |= {path.name for path in (folder / VERDICTS).glob("case-*")}
    if lost := sorted(known - set(found)):
        raise InputError(
            f"{folder / MAPS} lacks {some(lost, 5)}, maps or {SEAL}, and a score without them would be of chosen "
            "cases; restore them, or give mcsim challenge make again."
        )
    return found


def check_keys(folder: Path, cases: Iterable[str]) -> None:
    """Raise InputError if finished cases have no key: one with another nonce would not be the sealed one."""
    if lost := [case for case in cases if is_finished(folder, case) and not key_path(folder, case).is_file()]:
        raise InputError(
            f"{folder / KEYS} lacks the keys of {some(lost, 5)}, which cannot be made again; restore them, or make "
            "another challenge in a new folder."
        )
