"""Test maps of a model in which nothing is wrong: their p-values should be uniform.

python workflows/limit/perfect.py workflows/limit/masked-small.toml --maps 300 --sampled 60
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mcsim import config
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.simulation import sampled, simulate
from mcsim.simulation.survey import survey
from mcsim.stats.look_elsewhere import global_test

SEED = 20261125  #: of these maps; those that the model is learned from have others


def main() -> None:
    """Print how many p-values are small, and the test of Kolmogorov and Smirnov."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model")
    parser.add_argument("--maps", type=int, default=300, help="realizations by the default route")
    parser.add_argument("--sampled", type=int, default=60, help="realizations made sample by sample")
    arguments = parser.parse_args()
    run = config.load(arguments.model)
    analysis = analysis_of(run)
    with batch(0) as call, asking(call, False, data_vectors, "simulations of the model and of each effect") as ask:
        known = prepared(run, analysis, ask)
    own = survey(replace(run, ensemble=replace(run.ensemble, seed=SEED)))

    def tell(how: str, count: int, context: DiagnosisContext, maps: Callable[[int], list[NDArray[np.float64]]]) -> None:
        found = []
        for k in range(count):
            x = analysis.data_vector(maps(k))
            found.append(global_test(context.null, x, context.always, context.calibration).pvalue)
        p = np.array(found)
        low, ks = [int(np.sum(p <= level)) for level in (0.05, 0.01)], stats.kstest(p, "uniform").pvalue
        print(f"{how}: {low[0]} of {count} with p <= 0.05, {low[1]} with p <= 0.01; KS {ks:.2g}", flush=True)

    tell("default route", arguments.maps, known.of_pixel_means, lambda k: list(simulate.maps(own, k)))
    tell("sample by sample", arguments.sampled, known, lambda k: [map_uk for _, map_uk in sampled.maps(own, k)])


if __name__ == "__main__":
    main()
