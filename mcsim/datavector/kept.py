"""Results of simulations, kept until a model is learned: what is killed goes on where it stopped."""

import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

import numpy as np

from mcsim.datavector.analysis import Job
from mcsim.support import folders
from mcsim.support.arrays import Matrix, Vector
from mcsim.support.npy import write_npy

NSIDE = 128  #: up to this resolution a piece has as many realizations as a task, beyond it fewer, as each takes longer
LEAST = 2  #: realizations of a piece at any resolution: a worker prepares the survey of each effect anew


@dataclass(frozen=True)
class Kept:
    """Keep the rows of jobs in files, one for each piece of a job; whoever wants the same realization reads it.

    ``folder`` identifies model, candidates and code; ``size`` is the largest number of realizations of a piece.
    """

    folder: Path
    size: int

    @classmethod
    def of(cls, folder: Path, nside: int, most: int) -> "Kept":
        """Choose the size of pieces for maps of a resolution: what is lost by a kill is about a minute."""
        return cls(folder, max(LEAST, most * NSIDE**2 // max(nside, NSIDE) ** 2))

    def found(self, job: Job) -> dict[int, Vector]:
        """Return the rows of a job that are there as they were written, by realization."""
        rows: dict[int, Vector] = {}
        for path in self._stream(job).glob("*-*-*.npy"):
            first, stop, check = path.stem.split("-")
            if int(first) < job.first + job.count and int(stop) > job.first:
                with suppress(OSError):  # another process has learned the model and removed it
                    content = path.read_bytes()
                    if crc32(content) == int(check, 16):
                        rows.update(zip(range(int(first), int(stop)), np.load(io.BytesIO(content)), strict=True))
        return rows

    def missing(self, job: Job, found: Mapping[int, Vector]) -> Iterator[Job]:
        """Yield the pieces of a job that have not been simulated."""
        wanted = [number for number in range(job.first, job.first + job.count) if number not in found]
        while wanted:
            first, count = wanted[0], 1
            while count < min(self.size, len(wanted)) and wanted[count] == first + count:
                count += 1
            yield replace(job, first=first, count=count)
            wanted = wanted[count:]

    def keep(self, piece: Job, rows: Matrix) -> None:
        """Write the rows of a piece to a file that appears complete or not at all, with its CRC-32 in its name.

        It is not kept if another process, which has learned the model, removes the folder right then.
        """
        folder = self._stream(piece)
        with folders.unwritable(folder, "make room there, or set MCSIM_CACHE to another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError), tempfile.TemporaryDirectory(dir=folder) as scratch:
                write_npy(whole := Path(scratch) / "rows.npy", rows)
                check = crc32(whole.read_bytes())
                os.replace(whole, folder / f"{piece.first}-{piece.first + piece.count}-{check:08x}.npy")

    def _stream(self, job: Job) -> Path:
        """Return the folder of all realizations of one kind."""
        run = json.loads(job.simulated)
        kind: list[bool | str] = [
            job.sample_by_sample,
            job.bipolar_scan,
            job.slices,
            job.nuisances,
            job.source is not None,
        ]
        if job.observed is not None:
            # Skies that the data constrain are those of no other data.
            kind.append(hashlib.sha256(job.given).hexdigest())
        text = json.dumps([run["effect"], run["channel"], run["ensemble"]["seed"], kind])
        return self.folder / hashlib.sha256(text.encode()).hexdigest()[:32]
