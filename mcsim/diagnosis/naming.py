"""Name only what agrees with all parts of the data, and what some part of them can measure by itself."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mcsim import config
from mcsim.datavector.candidate import Candidate, parts_of
from mcsim.diagnosis.consistency import Action, Comparison, Slices, contradiction
from mcsim.diagnosis.context import DataSet, DiagnosisContext
from mcsim.diagnosis.crossed import together
from mcsim.diagnosis.drawn import is_drawn
from mcsim.diagnosis.refine import Refined
from mcsim.diagnosis.selection import Attribution, Explanation
from mcsim.stats.scattered import GROWS
from mcsim.support.arrays import Matrix
from mcsim.systematics import acts_through, if_possible


def probable(context: DiagnosisContext, refined: Refined) -> tuple[Attribution, list[str]]:
    """Return the attribution if it is probable enough for names; if a single effect outweighs it, a sentence."""
    whole = refined.attribution
    found = whole.if_named(context.settings)
    if found.explanations or found.faint or whole.rival is None or not whole.explanations:
        return found, []
    rival = context.candidates[whole.rival].title
    rest = f"all else together has a probability of {1.0 - whole.probability:.2g}"
    why = f"{rival}, which does not suffice by itself, is more probable ({rest})"
    return found, [_doubt(context.candidates, whole.explanations, why)]


def agreeing(data: DataSet, refined: Refined, found: Attribution) -> tuple[Attribution, list[str]]:
    """Return the attribution without sets that the data cannot bear out, and a sentence on each of these.

    The effects of a set are simulated at their amplitudes, and these are compared in parts of the data. An effect whose
    pattern on the sky is drawn has no such response: it is told from other signals on the sky by its frequencies alone.
    Where another set agrees, one that parts contradict is not left out before it is ``odds_cut`` times less probable.
    What is left has to be as probable as ``named_probability`` asks for without what was left out.
    """
    if not found.explanations:
        return found, []
    context, slices = data.context, slices_of(data)
    settings, candidates = context.settings, context.candidates
    frequencies = {channel.frequency_ghz if channel.foregrounds else None for channel in context.run.channels}
    kept: list[Explanation] = []
    refused: list[Explanation] = []
    doubted: list[tuple[Explanation, str]] = []
    sentences: list[str] = []
    for one in found.explanations:
        members = [candidates[member] for member in one.members]
        if any(map(is_drawn, members)):
            if len(frequencies) == 1:
                refused.append(one)
                why = "at a single frequency it looks like any signal that is fixed to the sky"
                sentences.append(_doubt(candidates, [one], why))
                continue
        elif len(kept) < settings.compared_sets:
            findings = slices.findings(members, list(_actions(data, refined, one)))
            one = replace(one, findings=findings.with_further(_of_splits(data, one)))
            if one.findings.contradict(settings):
                effects = [candidates[k].fitted(*part) for k, *part in parts_of(candidates, one.members, one.fit)]
                doubted.append((one, contradiction(one.findings, members, effects, settings.consistency_level)))
                continue
        kept.append(one)
    agreed = tuple(kept)
    whole = sum(one.odds for one in found.explanations)
    for one, doubt in doubted:
        left_out = not _is_as_probable(one, agreed, settings.odds_cut)
        (refused if left_out else kept).append(replace(one, odds=one.odds * one.findings.bound))
        named = "is not named" if left_out else "stays in the set, for it is hardly told from what all parts agree with"
        sentences.append(_doubt(candidates, [one], doubt, named))
    # The weight of what falls away goes to all else.
    own, rest = (found.probability * sum(one.odds for one in each) / whole for each in (kept, refused))
    probability = own / (own + rest + 1.0 - found.probability) if own else 0.0
    left = replace(found.of(kept), probability=probability, contradicted=tuple(refused))
    if kept and probability < settings.named_probability:
        why = f"beside what fell away the probability of all that is left is {probability:.2g}"
        sentences.append(_doubt(candidates, left.explanations, why))
        left = replace(left.unexplained(), contradicted=(*refused, *left.explanations))
    return left, sentences


def _is_as_probable(one: Explanation, agreed: Sequence[Explanation], cut: float) -> bool:
    """Return True if a set that parts of the data contradict cannot be told from one, as small, that agrees.

    Two effects that look alike fit all of the data alike: then it is chance which of them a part contradicts.
    """
    least = max((other.odds for other in agreed), default=np.inf) / cut
    fewest = min((len(other.members) for other in agreed), default=0)
    return len(one.members) <= fewest and one.odds * one.findings.bound >= least


def _doubt(candidates: Sequence[Candidate], sets: Sequence[Explanation], why: str, named: str = "is not named") -> str:
    """Return a sentence on sets that fit the data vector and are not simply named."""
    titles = (" and ".join(candidates[member].title for member in one.members) for one in sets)
    return f"The data vector fits {'; and '.join(titles)}, which {named}: {why}."


def slices_of(data: DataSet) -> Slices:
    """Return the parts of a data set, in which amplitudes are compared."""
    context, z = data.context, data.extended
    beside, lmax = len(z) - len(data.x), context.analysis.model.lmax
    known = {np.arange(len(data.x)).tobytes(): context.null}  # estimated once for all data sets
    return Slices(context.ensemble.extended, z, beside, data.folds, lmax, context.settings, nulls=known)


def unconfirmed(context: DiagnosisContext, found: Attribution, reduced: bool) -> str:
    """Return a sentence if no part of the data can confirm the only effect of an attribution, else nothing.

    ``reduced`` is True if its reduction was measured on held-out data.
    """
    if found.verdict != "effect" or reduced:
        return ""
    (one,) = found.explanations
    if is_drawn(context.candidates[one.members[0]]) or one.findings.measured:
        return ""
    return _doubt(context.candidates, [one], "no two parts of the data measure it")


def _actions(data: DataSet, refined: Refined, one: Explanation) -> Iterator[Action]:
    """Yield what each effect of a set does to the data, simulated at its amplitude if it can be.

    What is drawn, and a map-making that stops early, which leaves noise as well as sky, differ from sky to sky.
    """
    context, bank, settings = data.context, data.context.bank, data.context.settings
    model = context.analysis.model
    whole = np.concatenate([refined.templates, bank.slice_matrix]) if len(bank.slice_matrix) else refined.templates
    for member, theta, covariance in parts_of(context.candidates, one.members, one.fit):
        candidate, tried = context.candidates[member], refined.candidates[member]
        draws = tried.scatter is not None or candidate.parametrization.nonlinear
        added = 0.0 if draws or tried.acting is None else max(tried.acting.own, 0.0)
        few = settings.strong_skies if added > GROWS else settings.constrained_skies
        t, growth, scatters = whole[:, list(candidate.columns)], 1.0, list[Matrix]()
        response, pair = t @ theta, None
        with if_possible():
            effect = candidate.detected(theta, covariance)
            table = candidate.table(effect)
            before, after = data.pair_extended([table], settings.scatter_skies if draws else few)
            known = context.knows(table)  # then its scatter is in the covariance
            if not known:
                own = (i for i, name in enumerate(model.channels) if candidate.channel in (None, name))
                growth = max([1.0, *(model.noise_change([effect], i) for i in own)])
            response, scatters = (after - before).mean(axis=0), [data.scatter(after - before)] if draws else []
            scatters += _beside(data, refined, one, member, table)
            pair = None if draws or known else (before, after)
        action = Action.of(response, t, theta, (1.0 + added) * covariance, scatters)
        yield replace(action, growth=growth, wider=max(growth, float(np.sqrt(1.0 + added))), pair=pair)


def _of_splits(data: DataSet, one: Explanation) -> list[tuple[Comparison, ...]]:
    """Return for each effect of a set its amplitudes in splits, if it alone acts on the noise of a channel, evenly."""
    candidates, model = data.context.candidates, data.context.analysis.model
    splits = {own.channel: own for own in data.noise_of_splits}
    noisy = [candidates[k].channel for k in one.members if acts_through(candidates[k].effect, "noise")]
    found: list[tuple[Comparison, ...]] = [() for _ in one.members]
    for place, (member, *at) in enumerate(parts_of(candidates, one.members, one.fit) if splits else ()):
        candidate = candidates[member]
        if candidate.channel in splits and noisy.count(candidate.channel) == 1:
            with if_possible():
                factor = model.noise_factor(candidate.detected(*at), model.channels.index(candidate.channel))
                if factor is not None and np.ptp(factor) == 0.0 and factor[0] != 1.0:
                    found[place] = (splits[candidate.channel].compared(float(np.sqrt(factor[0]))),)
    return found


def _beside(data: DataSet, refined: Refined, one: Explanation, member: int, table: config.Effect) -> Iterator[Matrix]:
    """Yield what a member that draws its pattern does together with others of a set, at their amplitudes."""
    candidates, found = refined.candidates, list[Matrix]()
    for other, *at in parts_of(candidates, one.members, one.fit):
        if other in candidates[member].crossed:
            beside = candidates[other].table(candidates[other].detected(*at))
            if (scatter := together(data, table, beside)) is not None:
                found.append(scatter)
    if found:  # of the same draws
        yield np.sum(found, axis=0)
