"""How far a gap shrinks once the simulator has what it lacked: data against a model, before and after.

    python workflows/diagnosis/added.py MODEL.toml FULLER.toml FOLDER --simulations 400

The evidence of FOLDER is held against the simulations of MODEL, whose mean is then moved by what FULLER changes in it:
the mean over skies that both see, simulated by the default route. Simulations of MODEL are those that
`mcsim diagnose` with the same number has made and kept.
"""

import argparse
import os

import numpy as np

from mcsim import config
from mcsim.diagnosis.batch import asking, batch
from mcsim.diagnosis.data import read_maps
from mcsim.diagnosis.evidence import Job, questions
from mcsim.diagnosis.knowledge import CHUNK, seeded
from mcsim.diagnosis.session import prepared

SEED = 20121025


def main() -> None:
    """Print the gap before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="TOML file of what is believed")
    parser.add_argument("fuller", help="TOML file of what is believed, and what it lacked")
    parser.add_argument("folder", help="of the data")
    parser.add_argument("--simulations", type=int, help="as given to mcsim diagnose")
    parser.add_argument("--skies", type=int, default=40)
    arguments = parser.parse_args()
    believed, fuller = config.load(arguments.model), config.load(arguments.fuller)
    asked = questions(believed, nthreads=os.cpu_count() or 1)
    x = asked.answer(read_maps(asked.model, arguments.folder))
    text = config.to_json(believed)
    runs = [config.to_json(seeded(run, SEED)) for run in (believed, fuller)]
    jobs = [Job(text, run, first, CHUNK) for run in runs for first in range(0, arguments.skies, CHUNK)]
    with batch(believed.compute.workers) as call:
        ask = asking(call, quiet=False)
        null = prepared(believed, asked, ask, arguments.simulations).null
        before, after = np.split(np.concatenate(ask(jobs)), 2)
    shift = np.mean(after - before, axis=0)
    for name, evidence in (("before", x), ("after", x - shift)):
        numbers = f"{null.dimension} numbers from {null.count} simulations"
        print(f"{name}: chi^2 {null.square(evidence):.0f} for {numbers}, p = {null.probability(evidence):.2g}")


if __name__ == "__main__":
    main()
