"""Draw many controls of the WMAP-7 model and test each: are p-values uniform, and small ones as rare as they say?

    python workflows/diagnosis/wmap7-maps/controls.py [--count 1000] [--set 34]

They are those of ``mcsim diagnose --controls``, the first ones the same, without the search for effects in those that
depart: 0.2 s each, once the model has been simulated.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy import stats

import mcsim
from mcsim.datavector.analysis import analysis_of
from mcsim.datavector.campaign import asking, batch
from mcsim.datavector.faithful import fidelity
from mcsim.diagnosis.api import kept, prepared
from mcsim.diagnosis.control_result import Control, Controls
from mcsim.simulation import simulate
from mcsim.simulation.nuisance import DisturbedSurvey
from mcsim.stats.look_elsewhere import global_test


def main() -> None:
    """Print the tests of all p-values, and how many sets of controls would fail."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--set", type=int, default=34, help="controls of one diagnosis")
    chosen = parser.parse_args()
    run = mcsim.load_config(Path(__file__).with_name("model.toml"))
    analysis = analysis_of(run)
    with batch(1) as call, asking(call, False, kept=kept(run, analysis)) as ask:
        known = prepared(run, analysis, ask)
    drawn = fidelity(analysis)
    shared, found = DisturbedSurvey.of(drawn.run, dict(analysis.library)), []
    for number in range(chosen.count):
        x = analysis.data_vector(list(simulate.maps(shared.at(number), number)))
        p = global_test(known.null, x, known.always, known.calibration).pvalue
        found.append(Control(p, "none" if p > known.settings.alpha else "unknown", ()))
    known_by = drawn.words, known.settings.alpha, known.null.n_sims
    print(Controls(tuple(found), *known_by).counted)
    pvalues = np.array([one.pvalue for one in found])
    for level in (0.1, 0.05, 0.01, 0.005, 0.001):
        low, high = stats.binom.interval(0.95, chosen.count, level)
        print(f"p <= {level:g}: {int(np.sum(pvalues <= level))}; 95 % interval of uniform ones {low:.0f} to {high:.0f}")
    starts = range(0, chosen.count - chosen.set + 1, chosen.set)
    sets = [Controls(tuple(found[k : k + chosen.set]), *known_by) for k in starts]
    print(f"{sum(one.failed for one in sets)} of {len(sets)} sets of {chosen.set} controls fail")


if __name__ == "__main__":
    main()
