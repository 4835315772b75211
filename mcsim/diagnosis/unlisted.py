"""After an unknown gap: search the scores of the grammar, and say what is missing and what it removes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, islice, pairwise
from pathlib import Path

import healpy
import numpy as np

from mcsim import config
from mcsim.datavector.analysis import simulated_maps
from mcsim.datavector.campaign import Ask, constrained_jobs
from mcsim.datavector.halves import Halves
from mcsim.datavector.wiener_filter import sky_variance
from mcsim.diagnosis.fitted_nuisances import SKIES, FittedNuisances, Marginal
from mcsim.diagnosis.nuisance import NuisanceResult
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.result import DiagnosisResult
from mcsim.diagnosis.words import refuted
from mcsim.reconstruction import words
from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.result import NSIDE, WORDS, Reconstructed
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.search import MOST, Response, Search
from mcsim.reconstruction.simulated_scores import filtered, scene_for, scores_of_maps, search_of, with_peaks
from mcsim.reconstruction.structure import ALIKE, Structure
from mcsim.stats.excess import HeldOut
from mcsim.stats.gaussian import Fit
from mcsim.support.arrays import Map, Matrix, Vector

ALTERNATIVES = 3  #: structures that are told beside the best at most
RESPONSES, LEFT = 6, 1.0
"""Responses of which that of a structure of several coordinates is made, at most, and chi^2 that they need not fit."""

LARGEST = 2.0  #: amplitude in a part of the data over that in all scores, at most; the least is none

HIDDEN = (
    "What is missing was looked for in maps in which {} may have any of the values that the model allows: only what is "
    "much larger than what that makes is described."
)
"""Note where nothing is found, beside nuisances that cannot be taken from maps."""

FEW = 0.1  #: share of the largest rms below which a map does not have an effect


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
    analysis, known = data.context.analysis, FittedNuisances.of(data, nuisances)
    clean = known.maps
    scene, search = with_peaks(analysis, scene, search, clean.data, ask)
    x = scores_of_maps(analysis.model, scene, clean.data)
    marginal = known.marginal(search, scene)
    search, x = known.marginalised(search, marginal), marginal.of(x, known.z)
    made = Reconstruction(data, clean, scene, search, x, marginal)
    found = search.run(x, made)
    if not found:
        return (), None
    chosen = [search.grammar[one.structure] for one in found]
    fits, plugins, _ = made.fitted([one.structure for one in found])
    rows = []
    for one, structure, (theta, covariance), effect in zip(found, chosen, fits, plugins, strict=True):
        size, where, picture = (None, "", np.zeros(0)) if effect is None else made.picture(structure, effect)
        if structure.of_a_foreground:
            size = rms_of_powers(structure, theta, scene)
        says = words.says(structure, theta, scene)
        others = [search.grammar[k] for k in one.alternatives[:ALTERNATIVES]]
        told = tuple(words.says(other, search.fit([other], x)[0][0], scene) for other in others)
        rival = None if one.rival is None else dict(zip(WORDS, (*others[0].says, told[0]), strict=True))
        rows.append(
            Reconstructed(
                *structure.says,
                says,
                one.pvalue,
                one.delta_chi2,
                structure.size,
                size,
                1.0 / np.sqrt(one.delta_chi2),
                words.cause(structure, dict(analysis.library)),
                told,
                rival,
                words.profile(structure, theta, covariance, scene),
                tuple(map(float, picture)),
                where,
                None if effect is None else effect.name,
                None if effect is None else effect.source(f"{says[:1].upper()}{says[1:]}."),
            )
        )
    return tuple(rows), made.reduction(chosen, plugins)


def rms_of_powers(structure: Structure, theta: Vector, scene: Scene) -> float:
    """Return the rms of a pattern that is known by its power at 94 GHz alone, uK, as the maps see it that have it."""
    cl, scaling = np.zeros(scene.lmax + 1), scene.scalings[structure.index or 0.0]
    for (low, high), power in zip(pairwise(scene.fine), theta, strict=True):
        cl[low:high] = max(float(power), 0.0)
    seen = [f**2 * sky_variance(cl, scene.views[i].response) for i, f in zip(scene.shared, scaling, strict=True)]
    return float(np.sqrt(np.mean(seen)))


@dataclass(frozen=True, eq=False)
class Simulated:
    """Simulated skies: maps of the first, scores of all, shape (skies, P), and their mean data vector, (p,) or (0,)."""

    maps: list[Map]
    scores: Matrix
    x: Vector


Fitted = tuple[list[tuple[Vector, Matrix]], list[Plugin | None], Vector]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Simulate reconstructed effects, to find their size and to measure what they remove."""

    data: ObservedMaps
    clean: ObservedMaps  # without nuisances
    scene: Scene
    search: Search
    x: Vector  # scores
    marginal: Marginal
    _fitted: dict[tuple[int, ...], Fitted] = field(default_factory=dict, repr=False)
    _trial: dict[int, Response] = field(default_factory=dict, repr=False)
    _kept: dict[int, tuple[Vector, Vector]] = field(default_factory=dict, repr=False)

    def simulated(
        self, effects: Sequence[Plugin], share: Vector | None = None, tested: bool = False, skies: int = SKIES
    ) -> Simulated:
        """Return maps and scores of skies that the data constrain, with effects or shares of them.

        ``tested``: the data vectors, too, which cost as much.
        """
        analysis = self.data.context.analysis
        kinds = {one.name: one.kind() for one in effects}
        acting = [(one.name, None if kinds[one.name].scope == "common" else one.channel) for one in effects]
        tables = [config.Effect(name=name, channel=channel, parameters={"amplitude": 1.0}) for name, channel in acting]
        job, plain = (
            constrained_jobs(analysis, t, self.clean.same_skies.observed, range(skies))[0] for t in (tables, [])
        )
        maps = list(simulated_maps(job, {**dict(analysis.library), **kinds}))
        if share is not None:
            pairs = zip(maps, simulated_maps(plain), strict=True)
            maps = [[a + f * (b - a) for f, a, b in zip(share, one, made, strict=True)] for made, one in pairs]
        scores_ = [scores_of_maps(analysis.model, self.scene, one) for one in maps]
        x = np.mean([analysis.data_vector(m) for m in maps], axis=0) if tested else np.zeros(0)
        return Simulated(maps[0], np.stack(scores_), x)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return names of effects that neither the run nor the library has: those of earlier files are in use."""
        analysis = self.data.context.analysis
        taken = {Path(one.name).stem for one in analysis.run.effects} | {name for name, _ in analysis.library}
        return tuple(islice((name for k in count(1) if (name := f"unlisted_{k}") not in taken), MOST))

    @cached_property
    def before(self) -> Simulated:
        """Return the same without effects."""
        return self.simulated([], tested=True)

    def made(self, effects: Sequence[Plugin], share: Vector | None = None, skies: int = SKIES) -> Vector:
        """Return what effects make of all scores on these skies, shape (P,)."""
        change = self.simulated(effects, share, skies=skies).scores - self.before.scores[:skies]
        return self.marginal.without(np.mean(change, axis=0))

    def fitted(self, chosen: Sequence[int]) -> Fitted:
        """Return coordinates and covariance of structures, their effects at amplitudes that fit, and what these leave.

        Coordinates of the last are fitted to what those before it leave, the amplitudes of all to simulated scores.
        """
        if not chosen:
            return [], [], self.x
        if (key := tuple(chosen)) not in self._fitted:
            fits, plugins, rest = self.fitted(chosen[:-1])
            structure = self.search.grammar[chosen[-1]]
            ((theta, covariance),) = self.search.fit([structure], rest)
            fit = self._kept.get(chosen[-1], (theta,))[0], covariance
            made = plugin(self.names[len(chosen) - 1], structure, fit[0], self.scene)
            self._fitted[key] = ([*fits, fit], *self._calibrated(chosen, [*plugins, made]))
        return self._fitted[key]

    def response(self, member: int, rest: Vector) -> Response:
        """Return what the effect of a structure, fitted to scores, makes of all scores; on average where there is none.

        A pattern of few coordinates acts on few modes of this sky: each of them has its own response. Several others
        have those of their fit and of what it leaves of their scores: few simulations tell their covariance.
        """
        structure, average = self.search.grammar[member], self.search.response(member, rest)
        (theta,) = average.coordinates
        if (made := self._made_by(structure, theta)) is None:
            found = average
        elif structure.by_coordinate:
            units = float(np.linalg.norm(theta)) * np.eye(structure.size)
            rows = [row for one in units if (row := self._made_by(structure, one)) is not None]
            found = Response(units, np.stack(rows))
        elif structure.size > 1:
            found = self._fitted_out(member, rest, theta, made)
        else:
            found = Response(theta[None], made[None])
        self._trial[member] = found
        return found

    def _fitted_out(self, member: int, rest: Vector, theta: Vector, made: Vector) -> Response:
        """Return the response to the fit of a structure and that to what it leaves, again until that is nothing."""
        structure = self.search.grammar[member]
        found = Response(theta[None], made[None])
        for number in range(1, RESPONSES):
            _, _, (amplitudes,) = self.search.judged([member], rest, [found])
            theta, made = amplitudes @ found.coordinates, amplitudes @ found.made
            if number > 1 and self.search.fall(structure, rest - made) < LEFT:
                break
            ((more, _),) = self.search.fit([structure], rest - made)
            if not theta.any() or (also := self._made_by(structure, more)) is None:
                break
            found = Response(np.stack([theta, more]), np.stack([made, also]))
        return found

    def _made_by(self, structure: Structure, theta: Vector) -> Vector | None:
        """Return what a structure makes of all scores; None if no effect of the simulator can be like it."""
        if structure.moving:
            return self._moved(structure, theta)
        shape, share = structure, None
        if structure.split != ALIKE and structure.by_map:
            shape, share = replace(structure, split=ALIKE), np.zeros(len(self.scene.views))
            share[list(structure.views)] = np.sign(structure.weights)  # the shape has a power of the frequency
        effect = plugin("unlisted", shape, theta, self.scene)
        own = structure.stage == "added" and self.search.exact  # scores of what is added are the same on every sky
        return None if effect is None else self.made([effect], share, 1 if own else SKIES)

    def _moved(self, structure: Structure, theta: Vector) -> Vector:
        """Return what a beam that follows a wave makes of all scores, on skies that the data constrain."""
        analysis, share = self.data.context.analysis, np.zeros((len(self.scene.views), 1))
        share[list(structure.views), 0] = structure.weights
        plain = constrained_jobs(analysis, [], self.clean.same_skies.observed, range(SKIES))[0]
        found = []
        for maps in simulated_maps(plain):
            sky = filtered(analysis.model, maps).sky
            added = share * self.scene.moved(structure.moving, structure.order, theta, sky)
            found.append(scores_of_maps(analysis.model, self.scene, list(np.add(maps, added))))
        return self.marginal.without(np.mean(found - self.before.scores, axis=0))

    def keep(self, member: int, amplitudes: Vector) -> None:
        """Keep the coordinates that these amplitudes of the responses mean, and what they make of the scores."""
        tried = self._trial[member]
        self._kept[member] = amplitudes @ tried.coordinates, amplitudes @ tried.made

    def left(self, chosen: list[int]) -> Vector:
        """Return the scores without what the effects of structures make of them on this sky."""
        _, plugins, rest = self.fitted(chosen)
        return self.x - sum(self._kept[k][1] for k in chosen) if None in plugins else rest

    def _calibrated(
        self, chosen: Sequence[int], plugins: Sequence[Plugin | None]
    ) -> tuple[list[Plugin | None], Vector]:
        """Return effects with the amplitudes at which their simulated scores fit best, and what these leave."""
        acting = [k for k, one in enumerate(plugins) if one is not None]
        if not acting:
            return list(plugins), self.x
        responses = np.stack([self.made([one]) for one in plugins if one is not None])
        structures_ = [self.search.grammar[chosen[k]] for k in acting]
        factors = self.search.amplitudes(structures_, self.x, responses)
        scaled = dict(zip(acting, factors, strict=True))
        found = [None if one is None else one.scaled(float(scaled[k])) for k, one in enumerate(plugins)]
        return found, self.x - factors @ responses

    def picture(self, structure: Structure, effect: Plugin) -> tuple[float, str, Map]:
        """Return the rms of what an effect adds, uK, the name of the map that has most of it, and this coarse map."""
        model, after = self.data.context.analysis.model, self.simulated([effect])
        changes = []
        for part, one, before in zip(model.parts, after.maps, self.before.maps, strict=True):
            seen = part.precision > 0
            change = np.where(seen, one - before, np.nan)
            if structure.stage == "noise":  # the same numbers are drawn with another variance
                factor = effect.kind()(amplitude=1.0).noise(model.survey.channels[part.channel].site)
                assert factor is not None
                extra = np.where(seen, (factor - 1.0) / np.where(seen, part.precision, 1.0), np.nan)
                change = np.sign(extra) * np.sqrt(np.abs(extra))
            changes.append(change)
        sizes = np.array([np.sqrt(np.nanmean(one**2)) for one in changes])
        most = int(np.argmax(sizes))
        acting = sizes > FEW * sizes[most]
        shown = np.where(np.isfinite(changes[most]), changes[most], healpy.UNSEEN)
        coarse = healpy.ud_grade(shown, min(NSIDE, model.nside))
        return float(np.sqrt(np.mean(sizes[acting] ** 2))), model.parts[most].name, coarse

    def reduction(self, chosen: Sequence[Structure], plugins: Sequence[Plugin | None]) -> HeldOut | None:
        """Return how far effects that are fitted to one half of the data reduce the excess of the other half.

        A structure that is measured map by map is fitted to those of the first fold alone; of others, and of patterns
        that act on few modes, the shape is that of all data. The amplitudes are those that fit the elements of the
        first fold of the data vector, up to :data:`LARGEST` times that of the scores: what else these elements hold,
        as a pattern's finer structure, would be put down to them, and powers grow faster than in proportion.
        """
        acting = [(w, one) for w, one in zip(chosen, plugins, strict=True) if one is not None]
        if plugins[0] is None:  # the others are what it leaves
            return None
        context, settings = self.data.context, self.data.context.settings
        folds = [view.split % 2 for view in self.scene.views]
        first = []
        for structure, effect in acting:
            by_map = structure.views and not structure.by_coordinate and structure.stage != "noise"
            if by_map and len(self.scene.splits) > 1:
                if not len((half := structure.within(0, folds)).weights):
                    return None
                ((theta, _),) = self.search.fit([half], self.x)
                effect = plugin(effect.name, structure, theta, self.scene) or effect
            first.append(effect)
        matrix, told = self.data.halves()
        if (halves := Halves.of(context.ensemble.remix(matrix), matrix @ self.data.x)) is None:
            return None
        t = np.stack([matrix @ (self.simulated([one], tested=True).x - self.before.x) for one in first], axis=1)
        if halves.expected_snr(t.sum(axis=1)) < settings.half_snr_share * context.null.expected_snr(t.sum(axis=1)):
            return None

        def respond(frozen: Fit) -> Vector:
            scaled = [one.scaled(float(a)) for one, a in zip(first, frozen.amplitudes, strict=True)]
            return np.asarray(matrix @ (self.simulated(scaled, tested=True).x - self.before.x))

        return replace(halves, largest=LARGEST).reduction(t, respond, (), told)
