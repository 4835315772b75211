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
from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.result import Reconstructed
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.search import Search
from mcsim.reconstruction.simulated_effects import Reconstruction
from mcsim.reconstruction.simulated_scores import scene_for, scores_of_maps, search_of, with_peaks
from mcsim.reconstruction.structure import Structure
from mcsim.stats.empirical_bayes import shrunk
from mcsim.stats.excess import HeldOut
from mcsim.stats.gaussian import Fit
from mcsim.support.arrays import Matrix, Vector

LARGEST = 2.0  #: amplitude in a part of the data over that in all scores, at most; the least is none
SHAPES = 12  #: draws of the error of a pattern that a part of the data tells

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
    put down to them, and powers grow faster than in proportion. A shape that is fitted to one fold has an error there:
    what half a year hardly tells from the sky, the other half and the two together may. Of a pattern on the sky such
    coefficients are taken for small.
    """
    _, plugins, rest = made.fitted(chosen)
    acting = [(made.search.grammar[k], one) for k, one in zip(chosen, plugins, strict=True) if one is not None]
    if plugins[0] is None:  # the others are what it leaves
        return None
    folds = [view.split % 2 for view in made.scene.views]
    first, known = list[Plugin](), list[tuple[Structure, Matrix] | None]()
    for structure, effect in acting:
        shape = None
        by_map = structure.views and not structure.by_coordinate and structure.stage != "noise"
        if by_map and len(made.scene.splits) > 1:
            if not len((half := structure.within(0, folds)).weights):
                return None
            own = made.x if len(chosen) == 1 else rest + made.made([effect])
            ((theta, covariance),) = made.search.fit([half], own)
            if structure.frame == "sky" and structure.size > 1:  # coefficients of one pattern, which are of one size
                theta, covariance = shrunk(theta, covariance)
            if (own_effect := plugin(effect.name, structure, theta, made.scene)) is not None:
                effect, shape = own_effect, (structure, covariance) if structure.size > 1 else None
        first.append(effect)
        known.append(shape)
    t = np.stack([made.simulated([one], tested=True).x - made.before.x for one in first], axis=1)
    if (apart := data.in_halves(t.sum(axis=1))) is None:
        return None
    halves, matrix, words = apart

    def respond(frozen: Fit) -> Vector:
        scaled = [one.scaled(float(a)) for one, a in zip(first, frozen.amplitudes, strict=True)]
        return np.asarray(matrix @ (made.simulated(scaled, tested=True).x - made.before.x))

    none = np.zeros((len(t), SHAPES))
    errors = [none if own is None else _errors(made, one.name, *own) for one, own in zip(first, known, strict=True)]
    shapes = [matrix @ one for one in errors] if any(known) else []
    return replace(halves, largest=LARGEST).reduction(matrix @ t, respond, (), words, shapes=shapes)


def _errors(made: Reconstruction, name: str, structure: Structure, covariance: Matrix) -> Matrix:
    """Return what draws of the error of a pattern's coordinates make of the data vector, shape (p, SHAPES)."""
    sizes, axes = np.linalg.eigh(covariance)
    normal = np.random.default_rng(0).normal(size=(SHAPES, len(sizes)))
    drawn = normal @ (axes * np.sqrt(np.maximum(sizes, 0.0))).T
    plugins = [effect for one in drawn if (effect := plugin(name, structure, one, made.scene)) is not None]
    before = made.simulated([], tested=True, skies=1).x
    return np.stack([made.simulated([one], tested=True, skies=1).x - before for one in plugins], axis=1)
