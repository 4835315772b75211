"""Reconstructed effects, simulated: what each makes of the scores, its size, and the words for it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, islice, pairwise
from pathlib import Path

import healpy
import numpy as np

from mcsim import config
from mcsim.datavector.analysis import simulated_maps
from mcsim.datavector.campaign import constrained_jobs
from mcsim.datavector.filter_model import sky_variance
from mcsim.datavector.same_skies import SameSkies
from mcsim.reconstruction import words
from mcsim.reconstruction.fitted_nuisances import SKIES, Marginal
from mcsim.reconstruction.plugin import Plugin, plugin
from mcsim.reconstruction.result import NSIDE, WORDS, Reconstructed
from mcsim.reconstruction.scores import Scene
from mcsim.reconstruction.search import MOST, Found, Response, Search
from mcsim.reconstruction.simulated_scores import filtered, scores_of_maps
from mcsim.reconstruction.structure import ALIKE, Structure
from mcsim.support.arrays import Map, Matrix, Vector

ALTERNATIVES = 3  #: structures that are told beside the best at most
RESPONSES, LEFT = 6, 1.0
"""Responses of which that of a structure of several coordinates is made, at most, and chi^2 that they need not fit."""

FEW = 0.1  #: share of the largest rms below which a map does not have an effect


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

    clean: SameSkies  # of the observed maps without nuisances
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
        analysis = self.clean.analysis
        kinds = {one.name: one.kind() for one in effects}
        acting = [(one.name, None if kinds[one.name].scope == "common" else one.channel) for one in effects]
        tables = [config.Effect(name=name, channel=channel, parameters={"amplitude": 1.0}) for name, channel in acting]
        job, plain = (constrained_jobs(analysis, t, self.clean.observed, range(skies))[0] for t in (tables, []))
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
        analysis = self.clean.analysis
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
        analysis, share = self.clean.analysis, np.zeros((len(self.scene.views), 1))
        share[list(structure.views), 0] = structure.weights
        plain = constrained_jobs(analysis, [], self.clean.observed, range(SKIES))[0]
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

    def described(self, found: Sequence[Found]) -> Iterator[Reconstructed]:
        """Yield what is told of each structure that the search has found."""
        chosen = [self.search.grammar[one.structure] for one in found]
        fits, plugins, _ = self.fitted([one.structure for one in found])
        for one, structure, (theta, covariance), effect in zip(found, chosen, fits, plugins, strict=True):
            size, where, picture = (None, "", np.zeros(0)) if effect is None else self.picture(structure, effect)
            if structure.of_a_foreground:
                size = rms_of_powers(structure, theta, self.scene)
            says = words.says(structure, theta, covariance, self.scene)
            others = [self.search.grammar[k] for k in one.alternatives[:ALTERNATIVES]]
            told = tuple(words.says(other, *self.search.fit([other], self.x)[0], self.scene) for other in others)
            rival = None if one.rival is None else dict(zip(WORDS, (*others[0].says, told[0]), strict=True))
            yield Reconstructed(
                *structure.says,
                says,
                one.pvalue,
                one.delta_chi2,
                structure.size,
                size,
                1.0 / np.sqrt(one.delta_chi2),
                words.cause(structure, dict(self.clean.analysis.library)),
                told,
                rival,
                words.profile(structure, theta, covariance, self.scene),
                tuple(map(float, picture)),
                where,
                None if effect is None else effect.name,
                None if effect is None else effect.source(f"{says[:1].upper()}{says[1:]}."),
            )

    def picture(self, structure: Structure, effect: Plugin) -> tuple[float, str, Map]:
        """Return the rms of what an effect adds, uK, the name of the map that has most of it, and this coarse map."""
        model, after = self.clean.analysis.model, self.simulated([effect])
        changes = []
        for part, one, before in zip(model.parts, after.maps, self.before.maps, strict=True):
            seen = part.precision > 0
            change = np.where(seen, one - before, np.nan)
            if structure.stage == "noise":  # the same numbers are drawn with another variance
                factor = model.noise_factor(effect.kind()(amplitude=1.0), part.channel)
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


def rms_of_powers(structure: Structure, theta: Vector, scene: Scene) -> float:
    """Return the rms of a pattern that is known by its power at 94 GHz alone, uK, as the maps see it that have it."""
    cl, scaling = np.zeros(scene.lmax + 1), scene.scalings[structure.index or 0.0]
    for (low, high), power in zip(pairwise(scene.fine), theta, strict=True):
        cl[low:high] = max(float(power), 0.0)
    seen = [f**2 * sky_variance(cl, scene.views[i].response) for i, f in zip(scene.shared, scaling, strict=True)]
    return float(np.sqrt(np.mean(seen)))
