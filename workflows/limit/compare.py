"""Hold what a diagnosis achieves against the limit of the maps: sigma and detectable amplitude of every effect.

    python workflows/limit/compare.py demo-model -o limits

``sigma`` of the data vector is that with its covariance known (Hartlap's factor taken out of the simulated one) and the
mean response over skies; the amplitudes are those of verdict.json, ``detectable``, which allow for the number of
simulations too, over those of limit.json with the same number of tests.
"""

import argparse
from pathlib import Path

import numpy as np

import mcsim
from mcsim import config
from mcsim.benchmark.folder import Settings
from mcsim.benchmark.models import learned_model, workers_of
from mcsim.stats.detection import detectable


def main() -> None:
    """Print a row for every effect: the limit, what the data vector has, and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model")
    parser.add_argument("-o", "--output", type=Path, default=None, help="folder for limit.json and its picture")
    parser.add_argument("--probes", type=int, default=128)
    parser.add_argument("--unknown-dipole-uk", type=float, default=0.0)
    arguments = parser.parse_args()
    run = config.load(arguments.model)
    chosen = mcsim.LimitSettings(probes=arguments.probes, unknown_dipole_uk=arguments.unknown_dipole_uk)
    limits = mcsim.limit(run, arguments.output, settings=chosen, quiet=False)
    settings = Settings(run)
    with workers_of(settings, None, quiet=False):
        pass
    model = learned_model(settings)
    known, null = model.context, model.null
    print(f"{null.dimension} independent elements, {null.n_sims} simulations; {limits.tests} effects")
    print("| effect | sigma of the maps | error | sigma of the data vector | ratio | amplitude_90 ratio |")
    print("|---|---|---|---|---|---|")
    for candidate, limit in zip(known.candidates, limits.effects, strict=True):
        assert candidate.label == limit.label
        columns = list(candidate.columns)
        t, error, typical = model.templates[:, columns], known.bank.error[:, columns], candidate.typical
        noise = np.sum(null.whitening**2 @ error**2 @ typical**2)
        size = null.hartlap_factor * (np.sum((null.whiten_templates(t) @ typical) ** 2) - noise) / typical.shape[1]
        sigma = 1.0 / np.sqrt(size) if size > 0.0 else np.inf
        found = detectable(null, t, len(known.candidates), typical)
        ratios = f"{limit.sigma / sigma:.2f} | {limit.amplitude_90 / found:.2f}"
        print(f"| {limit.label} | {limit.sigma:.3g} | {100 * limit.error:.1f} % | {sigma:.3g} | {ratios} |")


if __name__ == "__main__":
    main()
