"""What an effect that draws its pattern does together with another one, and neither does alone."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mcsim import config
from mcsim.datavector.candidate import Candidate, Part
from mcsim.diagnosis.context import DataSet
from mcsim.support.arrays import Matrix
from mcsim.systematics import if_possible

LITTLE = 0.5  #: standard deviations of all that two effects scatter together that is left out
MOVED = 0.1  #: share of coordinates by which they move from which on what they scatter is drawn anew

Crossings = dict[tuple[int, int], list[Part]]  #: amplitudes at which pairs, by their places, were drawn together


def cross(
    data: DataSet, candidates: list[Candidate], drawn: Crossings, parts: Sequence[Part], kept: Sequence[int] = ()
) -> bool:
    """Let candidates that draw their patterns know what these do together with others; return True if anything changed.

    ``parts`` are members of a fit with their amplitudes, at which they are simulated unless they were, as the pairs
    ``drawn`` say, to which they are added. Of two that are ``kept`` nothing changes: another set, at whose amplitudes
    they are drawn, has both.

    Notes
    -----
    Elements are products of maps. Beside the square of each of two signals they have twice the product of both, which
    is zero on average if one of them is drawn, and scatters: a residual dipole of 12 uK is 10 % more or less by the
    dipole of a foreground of 3.5 uK.
    """
    changed = False
    for pair in _pairs(candidates, parts):
        places = pair[0][0], pair[1][0]
        if set(places) <= set(kept) or (places in drawn and not any(map(_has_moved, drawn[places], pair))):
            continue
        drawn[places] = pair
        one, scatter = candidates[places[0]], None
        with if_possible():
            tables = [candidates[place].table(candidates[place].detected(*at)) for place, *at in pair]
            scatter = together(data, *tables)
        if scatter is not None or places[1] in one.crossed:
            rest = {place: own for place, own in one.crossed.items() if place != places[1]}
            own = {} if scatter is None else {places[1]: scatter[: len(data.x)]}
            candidates[places[0]], changed = replace(one, crossed=rest | own), True
    return changed


def together(data: DataSet, drawn: config.Effect, other: config.Effect) -> Matrix | None:
    """Return what two effects change beyond the sum of both, by deviations of :meth:`DataSet.scatter`, (p + E, draws).

    The first one draws its pattern. None if all of it is little, as few skies say.
    """
    null, settings = data.context.null, data.context.settings
    acting = [drawn, other]
    for skies in (settings.constrained_skies, settings.scatter_skies):
        both, *each = (data.typical(own, skies, acting) for own in (acting, [drawn], [other]))
        rows = min(map(len, (both, *each)))
        scatter = data.scatter(both[:rows] - sum(one[:rows] for one in each))
        if np.linalg.norm(null.whiten_templates(scatter[: len(data.x)])) <= LITTLE:
            return None
        if rows != skies:  # there are no others
            break
    return scatter


def _pairs(candidates: Sequence[Candidate], parts: Sequence[Part]) -> Iterator[list[Part]]:
    """Yield those that draw their patterns, whose scatter is known, each with one that does not."""
    draws = [candidates[part[0]].parametrization.stochastic for part in parts]
    for first, one in zip(draws, parts, strict=True):
        for second, other in zip(draws, parts, strict=True):
            if first and not second and candidates[one[0]].scatter is not None:
                yield [one, other]


def _has_moved(before: Part, now: Part) -> bool:
    return bool(np.linalg.norm(now[1] - before[1]) > MOVED * np.linalg.norm(now[1]))
