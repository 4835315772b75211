"""Compare the responses of the data vector to effects: default route against time-ordered reference.

    python workflows/effects/templates.py MODEL.toml [--channel W1] [--effects NAME ...] [--simulations N]

A sky that made no template, without noise, is seen by both routes with each basis effect, up and down; what it changes
in the data vector of `mcsim diagnose` is compared in the metric of its covariance. Simulations of MODEL are those
that `mcsim diagnose` with the same number has made and kept, or are made first.
"""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mcsim import config
from mcsim.datavector.analysis import Job, analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch, seeded, with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import prepared
from mcsim.systematics import Effect

SEED = 20121026
STEPS = 4.0
"""Steps at which templates are measured, to be well above the interpolation error of the time-ordered reference."""


def main() -> None:
    """Print cosine, ratio of amplitudes and length of every response."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="TOML file of the fiducial model")
    parser.add_argument("--channel", help="of the effects of a channel; default: the model's last one")
    parser.add_argument("--effects", nargs="*", help="default: all that are not stochastic; none of noise")
    parser.add_argument("--simulations", type=int, help="as given to mcsim diagnose")
    arguments = parser.parse_args()
    run = config.load(arguments.model)
    settings = DiagnosisSettings(simulations=arguments.simulations)
    analysis = analysis_of(run, nthreads=os.cpu_count() or 1, settings=settings)
    with batch(run.compute.workers) as call, asking(call, quiet=False) as ask:
        null = prepared(run, analysis, ask).null
    plain = seeded(run, SEED)
    quiet = replace(plain, channels=tuple(replace(channel, noise=config.Noise()) for channel in plain.channels))
    fiducial = config.to_json(run)

    def seen(found: Sequence[config.Effect], samples: bool) -> NDArray[np.float64]:
        answer: NDArray[np.float64] = data_vectors(
            Job(fiducial, config.to_json(with_effects(quiet, found)), 0, 1, samples, settings=settings)
        )[0]
        return answer

    without = {samples: seen([], samples) for samples in (False, True)}
    channel = arguments.channel or run.channels[-1].name
    for candidate in analysis.candidates:
        kind = candidate.effect
        wanted = kind.name in arguments.effects if arguments.effects else not kind.parametrization.stochastic
        if not wanted or kind.noise is not Effect.noise or candidate.channel not in (None, channel):
            continue
        for number, basis in enumerate(candidate.basis):
            # An effect of one sign is the whole of it, as pixelization is.
            effect = basis.scaled(STEPS) if kind.parametrization.sign == 0 and STEPS * basis.amplitude < 1.0 else basis
            changes = []
            for samples in (False, True):
                up = seen([candidate.table(effect)], samples)
                down = seen([candidate.table(effect.scaled(-1.0))], samples) if kind.parametrization.sign == 0 else None
                change = up - without[samples] if down is None else 0.5 * (up - down)
                changes.append(null.whiten_templates(change[:, None])[:, 0])
            default, time_ordered = changes
            size = float(np.linalg.norm(default))
            cosine = float(default @ time_ordered) / size / float(np.linalg.norm(time_ordered))
            ratio = float(default @ time_ordered) / size**2
            print(
                f"{candidate.label}/{number}: cosine {cosine:.4f}, sampled over default {ratio:.4f}, {size:.1f} sigma"
            )


if __name__ == "__main__":
    main()
