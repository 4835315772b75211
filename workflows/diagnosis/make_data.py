"""Maps of a run made sample by sample, as data for a diagnosis.

    python workflows/diagnosis/make_data.py RUN.toml FOLDER [--realization 0] [--seed 20121024]

Writes FOLDER/{channel}_{split}.fits (or {channel}.fits): HEALPix, RING, uK, in the frame of the run. Every sample looks
at its own direction with its own orientation; nothing of the default route is used.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import healpy
import numpy as np

from mcsim import config
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey

FRAMES = {"ecliptic": "E", "galactic": "G", "equatorial": "C"}


def main() -> None:
    """Make the data."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="TOML file")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--realization", type=int, default=0)
    parser.add_argument("--seed", type=int, default=20121024)
    arguments = parser.parse_args()
    run = config.load(arguments.run)
    seeded = replace(run, ensemble=replace(run.ensemble, seed=arguments.seed))
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name, map_uk in sampled.maps(survey(seeded, nthreads=2), arguments.realization, nthreads=2):
        path = arguments.folder / f"{name.replace(':', '_')}.fits"
        coordinates = FRAMES[run.map.frame]
        healpy.write_map(path, map_uk, coord=coordinates, column_units="uK", dtype=np.float32, overwrite=True)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
