"""Effects whose pattern on the sky is drawn: what an amplitude over the full sky makes in the pixels that are seen."""

from collections.abc import Iterator, Sequence

import numpy as np

from mcsim.datavector.campaign import with_effects
from mcsim.datavector.candidate import Candidate, parts_of
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.gaussian import Fit
from mcsim.support.numbers import measured
from mcsim.systematics import if_possible

PATTERNS = 12  #: patterns that are drawn to measure it


def is_drawn(candidate: Candidate) -> bool:
    """Return True if an effect draws its pattern on the sky, so that no mean response describes it."""
    return candidate.parametrization.stochastic and not candidate.parametrization.mean_response


def as_seen(context: DiagnosisContext, members: Sequence[int], found: Fit) -> Iterator[str]:
    """Yield a sentence on each member of a fit that is drawn: its rms in the pixels that each channel sees.

    None where all pixels are seen, or an external simulator makes the maps.
    """
    analysis, model = context.analysis, context.analysis.model
    seen = [part.precision > 0.0 for part in model.parts]
    if analysis.source is not None or all(pixels.all() for pixels in seen):
        return
    for member, theta, covariance in parts_of(context.candidates, members, found):
        candidate = context.candidates[member]
        if not is_drawn(candidate):
            continue
        table = None
        with if_possible():
            table = candidate.table(candidate.detected(theta, covariance))
        if table is None:
            continue
        runs = (with_effects(analysis.run, [table]), analysis.run)
        with_it, without = (survey(run, library=dict(analysis.library)) for run in runs)
        changes = (simulate.maps(with_it, number) - simulate.maps(without, number) for number in range(PATTERNS))
        rms = np.sqrt([[np.mean(own[pixels] ** 2) for own, pixels in zip(one, seen, strict=True)] for one in changes])
        channels = [model.channels[part.channel] for part in model.parts]
        first = {channel: channels.index(channel) for channel in channels}
        each = [
            f"{measured(float(rms[:, place].mean()), float(rms[:, place].std(ddof=1)), ' µK')} in {channel}"
            for channel, place in first.items()
            if rms[:, place].any()
        ]
        yield (
            f"The amplitude of {candidate.title} is the rms over the full sky, most of it in the Galactic plane, of "
            f"patterns that are drawn; in the pixels that are seen these have an rms of {' and '.join(each)}."
        )
