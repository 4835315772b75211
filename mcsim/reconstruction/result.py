"""What a reconstruction says of one structure: typed, for reports, ``verdict.json`` and the command line."""

from dataclasses import asdict, dataclass
from typing import Any

from mcsim.support.numbers import measured, p_equals

NSIDE = 16  #: of the pictures

HEAD = "Written by mcsim diagnose from the data: no physics."  #: in the file of every effect

WORDS = ("stage", "acts_on", "frame", "kind", "channel", "split", "index", "says")  #: what a structure says


@dataclass(frozen=True)
class Reconstructed:
    """A structure that no effect of the library makes."""

    #: stage, acts_on, frame, kind, channel, split, index: what it is, in the words of the grammar
    #: (:class:`mcsim.reconstruction.structure.Structure`)
    stage: str
    acts_on: str
    frame: str
    kind: str
    channel: str | None
    split: str
    index: float | None
    says: str  #: the same in plain words
    #: pvalue, delta_chi2: global p-value, all of the grammar charged, and unbiased fall of chi^2
    pvalue: float
    delta_chi2: float
    coordinates: int  #: number of numbers that describe it
    #: of what it adds to the maps that it acts in, uK, of a foreground by its power; None if no effect can be like it
    rms_uk: float | None
    relative_error: float  #: of its amplitude, which for noise and for added power is that of a variance
    cause: str  #: A known effect that makes such structures, with its reference; "" if none
    alternatives: tuple[str, ...]  #: structures that are less probable by a factor of 20 at most, in plain words
    rival: dict[str, Any] | None  #: WORDS of another description, less probable by a factor of 4 at most
    #: first and last degree, size and error of its profile in l; empty without one
    profile: tuple[tuple[int, int, float, float], ...]
    #: what it adds to one map, uK, RING, nside 16, and the name of that map; empty if not known
    picture: tuple[float, ...]
    picture_of: str
    #: name, file: of the effect, and the text of the Python file that defines it; None if no effect can be like it
    name: str | None
    file: str | None

    @property
    def sentence(self) -> str:
        """Return what is missing, how large it is and how significant."""
        text = self.says[:1].upper() + self.says[1:]
        size = ""
        if self.rms_uk is not None:
            variance = self.stage == "noise" or (self.stage, self.kind) == ("added", "power")
            root = 0.5 if variance else 1.0  # of the error of a variance
            size = f": {measured(self.rms_uk, root * self.rms_uk * self.relative_error, ' µK')} rms"
        other = "" if self.rival is None else f"; or, as probable within a factor of 4, it {self.rival['says']}"
        return f"{text}{other}{size} ({p_equals(self.pvalue)})."

    def to_json(self) -> dict[str, Any]:
        """Return its entry of ``verdict.json``."""
        left_out = ("picture", "picture_of", "file", "says")
        plain = {key: value for key, value in asdict(self).items() if key not in left_out}
        keys = ("ell_min", "ell_max", "size", "sigma")
        profile = [dict(zip(keys, row, strict=True)) for row in self.profile]
        file = None if self.file is None else f"{self.name}.py"
        return {
            "sentence": self.sentence,
            **plain,
            "alternatives": list(self.alternatives),
            "profile": profile,
            "file": file,
        }
