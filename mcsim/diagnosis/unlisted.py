"""After an unknown gap: search the scores of the grammar, and say what is missing and what it removes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mcsim.datavector.campaign import Ask
from mcsim.datavector.nuisances import NuisanceResult
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.words import refuted
from mcsim.reconstruction.fitted_nuisances import FittedNuisances
from mcsim.reconstruction.plugin import plugin
from mcsim.reconstruction.result import Reconstructed
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.search import Search
from mcsim.reconstruction.simulated_effects import Reconstruction
from mcsim.reconstruction.simulated_scores import scene_for, scores_of_maps, search_of, with_peaks
from mcsim.stats.excess import HeldOut
from mcsim.stats.gaussian import Fit
from mcsim.support.arrays import Vector

LARGEST = 2.0  #: amplitude in a part of the data over that in all scores, at most; the least is none

HIDDEN = (
    "What is missing was looked for in maps in which {} may have any of the values that the model allows: only what is "
    "much larger than what that makes is described."
)
"""Note where nothing is found, beside nuisances that cannot be taken from maps."""


def reconstructed(result: DiagnosisResult, data: ObservedMaps, ask: Ask) -> DiagnosisResult:
    """Return the result with what is missing in the words of the grammar; ``ask`` simulates with :func:`scores`."""
    analysis = data.context.analysis
    scene = scene_for(analysis.job(analysis.run))
    found, reduction = structures_of(data, scene, search_of(analysis, scene, ask), ask, result.nuisances)
    settings = analysis.settings
    if not found and (hiding := [one.title for one in analysis.nuisances if not one.subtractable]):
        result = replace(result, notes=(*result.notes, HIDDEN.format(" and ".join(hiding))))
    if reduction is not None and reduction.refutes(settings.reduction_sigma, settings.unexplained_pvalue):
        what = " and ".join(one.says for one in found)
        note = f"What {what} fits best, and is not what is missing: {refuted(reduction)}."
        return replace(result, unlisted=(), notes=(*result.notes, note))
    return replace(result, unlisted=found, unlisted_held_out=reduction)


def structures_of(
    data: ObservedMaps, scene: Scene, search: Search, ask: Ask, nuisances: Sequence[NuisanceResult] = ()
) -> tuple[tuple[Reconstructed, ...], HeldOut | None]:
    """Return the structures that are found in maps, and how far they reduce the excess on held-out data.

    ``nuisances``: what the data say of each component of those of the model.
    """
    analysis, skies = data.context.analysis, data.same_skies
    known = FittedNuisances.of(skies, [(one.amplitude, one.sigma) for one in nuisances])
    clean = known.clean
    scene, search = with_peaks(analysis, scene, search, clean.maps, ask)
    x = scores_of_maps(analysis.model, scene, clean.maps)
    marginal = known.marginal(search, scene)
    search, x = known.marginalised(search, marginal), marginal.of(x, known.z)
    made = Reconstruction(clean, scene, search, x, marginal)
    if not (found := search.run(x, made)):
        return (), None
    indices = [one.structure for one in found]
    return tuple(made.described(found)), reduction_of(data, made, indices)


def reduction_of(data: ObservedMaps, made: Reconstruction, chosen: Sequence[int]) -> HeldOut | None:
    """Return how far effects that are fitted to one half of the data reduce the excess of the other half.

    A structure that is measured map by map is fitted to those of the first fold alone, with the others taken out: in
    one half structures look alike that do not in both. Of others, and of patterns that act on few modes, the shape is
    that of all data. The amplitudes are those that fit the elements of the first fold of the data vector, up to
    :data:`LARGEST` times that of the scores: what else these elements hold, as a pattern's finer structure, would be
    put down to them, and powers grow faster than in proportion.
    """
    _, plugins, rest = made.fitted(chosen)
    acting = [(made.search.grammar[k], one) for k, one in zip(chosen, plugins, strict=True) if one is not None]
    if plugins[0] is None:  # the others are what it leaves
        return None
    folds = [view.split % 2 for view in made.scene.views]
    first = []
    for structure, effect in acting:
        by_map = structure.views and not structure.by_coordinate and structure.stage != "noise"
        if by_map and len(made.scene.splits) > 1:
            if not len((half := structure.within(0, folds)).weights):
                return None
            own = made.x if len(chosen) == 1 else rest + made.made([effect])
            ((theta, _),) = made.search.fit([half], own)
            effect = plugin(effect.name, structure, theta, made.scene) or effect
        first.append(effect)
    t = np.stack([made.simulated([one], tested=True).x - made.before.x for one in first], axis=1)
    if (apart := data.in_halves(t.sum(axis=1))) is None:
        return None
    halves, matrix, words = apart

    def respond(frozen: Fit) -> Vector:
        scaled = [one.scaled(float(a)) for one, a in zip(first, frozen.amplitudes, strict=True)]
        return np.asarray(matrix @ (made.simulated(scaled, tested=True).x - made.before.x))

    return replace(halves, largest=LARGEST).reduction(matrix @ t, respond, (), words)
