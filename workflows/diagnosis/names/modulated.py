"""Measure how often a modulation of the sky is named in simulated maps, and how well its amplitude is found.

python modulated.py [CASES]   skies of each modulation and amplitude, in any direction
"""

import os
import sys

import numpy as np
from names import MODEL, ask, learned

from mcsim.datavector.campaign import seeded, with_effects
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey

AMPLITUDES = (0.05, 0.15)


def main(number):
    """Diagnose maps, and print how often the modulation is in the set, or alone, and pulls of its amplitude."""
    run, context = learned(MODEL)
    for own in (one for one in context.candidates if one.name in ("dipole_modulation", "quadrupole_modulation")):
        for amplitude in AMPLITUDES:
            alone, pulls = 0, []
            for case in range(number):
                direction = np.random.default_rng([31, case]).normal(size=len(own.columns))
                size = amplitude / np.linalg.norm(direction)
                effect = own.with_coordinates(size * direction, np.eye(len(direction)))
                shared = survey(with_effects(seeded(run, 8000), [own.table(effect)]))
                maps_uk = list(simulate.maps(shared, case))
                sets = diagnose_data(ObservedMaps(context, maps_uk, ask), f"{own.name}-{case}").sets
                found = [one.effects[0] for one in sets if [e.name for e in one.effects] == [own.name]]
                alone += len(found) == len(sets) == 1
                pulls += [(one.amplitude - amplitude) / one.sigma for one in found]
            rms = np.sqrt(np.mean(np.square(pulls)))
            print(f"{own.name} {amplitude}: {len(pulls)} of {number} are in the set, {alone} alone")
            print(f"    pulls {np.mean(pulls):.2f} in the mean, rms {rms:.2f}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
