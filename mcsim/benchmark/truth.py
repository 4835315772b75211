"""What a challenge withholds, and how it is sealed: the hash of a key is public, the key is opened for the score."""

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mcsim import config
from mcsim.errors import InputError

Kind = Literal["none", "one", "two", "left_out", "invented"]
Identity = tuple[str, str | None]
"""Name of an effect and of its channel; None: all channels."""

NONCE_BYTES = 32
MAPS, KEYS, SEAL = "cases", "keys", "SEAL"


@dataclass(frozen=True)
class Member:
    """One effect that is there.

    Attributes
    ----------
    name, channel, parameters
        As in ``[[effect]]`` of a run, amplitude included.
    coordinates
        In the linear components of the effect.
    strength
        White length of its response in the evidence of this very sky; of what draws, of the mean response.
    candidate
        Which proposal of the full library it is; None: an invention.
    response
        Of an invention, its response in the evidence: the library has no template of it.
    """

    name: str
    channel: str | None
    parameters: Mapping[str, Any]
    coordinates: tuple[float, ...]
    strength: float
    candidate: int | None = None
    response: tuple[float, ...] = ()

    @property
    def identity(self) -> Identity:
        """Name and channel."""
        return self.name, self.channel

    def table(self) -> config.Effect:
        """As ``[[effect]]`` of a run."""
        return config.Effect(name=self.name, channel=self.channel, parameters=dict(self.parameters))


@dataclass(frozen=True)
class Truth:
    """Content of a key.

    Attributes
    ----------
    kind
        "none", "one" or "two" effects of the library, "left_out": one that is taken out of the library before the case
        is diagnosed, "invented": one that no library has.
    members
        Effects that are there.
    without
        Effects that the diagnosis must not propose.
    seed
        Of the data's run.
    sampled
        Made sample by sample.
    nonce
        256 random bits, in hexadecimal: without them a short list of keys could be tried.
    """

    case: str
    kind: Kind
    members: tuple[Member, ...]
    without: tuple[str, ...]
    seed: int
    sampled: bool
    nonce: str

    @property
    def identities(self) -> frozenset[Identity]:
        """Names and channels of what is there."""
        return frozenset(member.identity for member in self.members)

    def text(self) -> str:
        """JSON of the key."""
        return json.dumps({"schema": 1, **asdict(self)}, indent=1) + "\n"

    @classmethod
    def read(cls, path: Path) -> "Truth":
        """Read what :meth:`text` wrote; InputError where it cannot be one."""
        try:
            plain = json.loads(path.read_text())
            del plain["schema"]
            members = tuple(
                Member(**{**row, "coordinates": tuple(row["coordinates"]), "response": tuple(row["response"])})
                for row in plain.pop("members")
            )
            return cls(members=members, without=tuple(plain.pop("without")), **plain)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} cannot be read as a key ({error}); make the challenge again.") from error


def new_nonce() -> str:
    """256 bits that nobody knows."""
    return secrets.token_hex(NONCE_BYTES)


def write_whole(path: Path, text: str) -> None:
    """Write a file that appears complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    scratch.write_text(text)
    os.replace(scratch, path)


def key_path(folder: Path, case: str) -> Path:
    """Key of a case."""
    return folder / KEYS / f"{case}.json"


def sealed(key: Path) -> str:
    """SHA-256 of a key, in hexadecimal."""
    return hashlib.sha256(key.read_bytes()).hexdigest()


def open_key(folder: Path, case: str) -> Truth:
    """The key of a case, if it is the one that was sealed.

    Raises
    ------
    InputError
        A key that is missing, unreadable, or whose hash is not the one published with the maps.
    """
    path = key_path(folder, case)
    truth = Truth.read(path)
    seal = (folder / MAPS / case / SEAL).read_text().split()[0]
    if sealed(path) != seal:
        raise InputError(
            f"{path} is not the key that was sealed: its SHA-256 is not that of {case}/{SEAL}; restore it."
        )
    return truth


def finished_cases(folder: Path) -> list[str]:
    """Cases whose maps are complete, in order."""
    cases = folder / MAPS
    if not cases.is_dir():
        raise InputError(f"{folder} holds no challenge; make one with mcsim challenge make.")
    return sorted(path.name for path in cases.iterdir() if (path / SEAL).is_file() and not path.name.startswith("."))
