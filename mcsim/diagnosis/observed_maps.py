"""Observed maps: read them, refuse what the model cannot describe, and prepare them for a diagnosis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import healpy
import numpy as np

from mcsim import config
from mcsim.datavector.bad_pixels import BadPixels, bad_pixels, residual_maps, standing_out
from mcsim.datavector.candidate import Candidate
from mcsim.datavector.localisation import Place, places
from mcsim.datavector.map_checks import exchanges, share_left_out
from mcsim.datavector.nuisances import half_given_other
from mcsim.datavector.same_skies import SameSkies, Skies
from mcsim.diagnosis.context import DataSet, over_steps
from mcsim.diagnosis.noise_of_splits import NoiseOfSplits, noise_of_splits
from mcsim.diagnosis.output import DIGEST, digest
from mcsim.diagnosis.shared_noise import shared_noise
from mcsim.support.arrays import Map, Matrix, Vector
from mcsim.support.numbers import p_equals
from mcsim.systematics import if_possible


@dataclass(frozen=True, eq=False)
class ObservedMaps(DataSet[Sequence[Map]]):
    """Offer observed maps, as :mod:`mcsim.datavector.map_checks` reads them, as a data set.

    Responses to effects are simulated in skies that the filtered maps constrain.
    """

    given: Sequence[Map] = ()  # with pixels that were left out since; (): all are there

    @cached_property
    def _measured(self) -> tuple[Vector, Vector, Map, Vector]:
        """Return data vector, bipolar scan, coarse residuals, shape (map, npix), and the numbers beside them."""
        analysis, ensemble = self.context.analysis, self.context.ensemble
        sizes = [len(analysis.elements), len(analysis.slices), ensemble.bipolar_scan.shape[1]]
        found = analysis.data_vector(self.data, bipolar_scan=True, slices=True)
        x, beside, scan, coarse = np.split(found, np.cumsum(sizes))
        return x, scan, coarse.reshape(ensemble.residual_mean.shape), beside

    @property
    def x(self) -> Vector:
        """Return the data vector, shape (p,)."""
        return self._measured[0]

    @property
    def extended(self) -> Vector:
        """Return the data vector with the numbers beside it behind it, shape (p + E,)."""
        return np.concatenate([self.x, self._measured[3]])

    @cached_property
    def same_skies(self) -> SameSkies:
        """Return what simulates responses."""
        return SameSkies(self.context.analysis, self.ask, self.data, self.context.noise)

    def respond_extended(self, found: Sequence[config.Effect], skies: int) -> Matrix:
        """Return the changes of :meth:`respond` with those of the numbers beside the data vector, (rows, p + E)."""
        kinds: dict[Skies, list[config.Effect]] = {}
        for effect in found:
            kinds.setdefault(self.same_skies.skies_of(effect), []).append(effect)
        pairs = {kind: self.pair_extended(own, skies) for kind, own in kinds.items()}
        changes = {kind: after - before for kind, (before, after) in pairs.items()}
        if len(changes) > 1 and "reference" in changes:
            changes["reference"] = changes["reference"].mean(axis=0, keepdims=True)
        return np.asarray(sum(changes.values()))

    def pair_extended(self, found: Sequence[config.Effect], skies: int) -> tuple[Matrix, Matrix]:
        """Return data without and with effects of one kind of skies, those of the first, shape (skies, p + E) each."""
        if (kind := self.same_skies.skies_of(found[0])) == "reference":
            return self.of_reference(found)
        return self.same_skies.pair(found, skies, kind == "constrained")

    def typical(self, found: Sequence[config.Effect], skies: int, acting: Sequence[config.Effect]) -> Matrix:
        """Return the changes by effects in skies that nothing constrains, shape (skies, p + E).

        They are those of another program only if it can add all that are ``acting``.
        """
        before, after = self.same_skies.pair(found, skies, constrained=False, acting=acting)
        return after - before

    def of_reference(self, found: Sequence[config.Effect]) -> tuple[Matrix, Matrix]:
        """Return data of the skies of reference without effects and with them, shape (skies, p + E) each.

        What the dipole that effects leave in the only channel makes by products with the sky is known of the observed
        one, unlike what they do to its power: it is that of skies that the maps constrain.
        """
        before, after = self.context.extended_reference(found), self.same_skies.of_reference(found)
        if left := self.same_skies.dipole_left(found):
            apart, together = self.same_skies.pair(left, self.context.settings.constrained_skies, constrained=True)
            typical = self.same_skies.of_reference(left) - self.context.extended_reference(left)
            after = after - typical + np.resize(together - apart, typical.shape)
        return before, after

    def responses(self, candidates: Sequence[Candidate], skies: int) -> Iterator[tuple[Candidate, Matrix]]:
        """Yield candidates with their responses, all of which are simulated at once if all can be."""
        with if_possible():
            self.same_skies.ahead([one.table(effect) for one in candidates for effect in one.basis], skies)
        yield from super().responses(candidates, skies)

    def pair(self, found: Sequence[config.Effect], skies: int | None = None) -> tuple[Matrix, Matrix]:
        """Return data vectors of the same skies without effects and with them; for noise alone of all of reference."""
        size, library = len(self.x), dict(self.context.analysis.library)
        noise = all(library[effect.name].parametrization.noise_alone for effect in found)
        if noise or any(self.same_skies.skies_of(effect) == "reference" for effect in found):
            before, after = self.of_reference(found)
        else:
            before, after = self.same_skies.pair(found, skies or self.context.settings.constrained_skies, True)
        return before[:, :size], after[:, :size]

    def in_same_skies(self, found: Sequence[config.Effect]) -> list[list[config.Effect]]:
        """Return effects of reference skies, since the observed sky has their power already, apart from all others."""
        groups: tuple[list[config.Effect], list[config.Effect]] = ([], [])
        for effect in found:
            groups[self.same_skies.skies_of(effect) == "reference"].append(effect)
        return [own for own in groups if own]

    def changes_sky(self, found: Sequence[config.Effect]) -> bool:
        """Return True if the observed sky has to be found as effects let the channels see it, or is not isotropic."""
        return any(self.same_skies.seen(found)) or any(map(self.same_skies.is_pattern, found))

    def dipole_snr(self, found: Sequence[config.Effect]) -> float:
        """Return the S/N of the dipole that effects leave in the only channel, 0 with several, by noise alone."""
        model = self.context.analysis.model
        noise = model.colours[0, 1] / sum(1.0 / part.noise_power for part in model.parts)  # of a_1m, uK^2 sr
        left = np.linalg.norm(self.same_skies.dipole_left_uk(found))
        return float(left / np.sqrt(3.0 / (4.0 * np.pi) * noise))

    def templates(self) -> Matrix:
        """Return the templates; those that depend on the very sky are measured on the observed one if it departs.

        Of a modulation this holds for what of the response has the sign of the sky alone. In a part of the sky it is in
        part a gain, and products of two maps of one sky respond as they fluctuate: behind a mask every sky looks like
        its own modulation.
        """
        context, t, settings = self.context, self.context.templates.copy(), self.context.settings
        if self.gap.pvalue > settings.alpha:
            return t
        fixed = [c.random_response or c.nuisance or c.parametrization.mean_response for c in context.candidates]
        depends = ~np.array(fixed) & (context.sky_scatter >= settings.sky_scatter)
        own = [context.candidates[index] for index in np.flatnonzero(depends)]
        modulations = [one for one in own if self.same_skies.is_pattern(one.table(one.basis[0]))]
        others, skies = [one for one in own if one not in modulations], settings.constrained_skies
        for candidate, response in self.responses(others, skies):
            columns = list(candidate.columns)
            t[:, columns] = response[: len(t)] - context.bank.curvature[:, columns] * candidate.steps
        with if_possible():
            self.same_skies.ahead([one.table(effect) for one in modulations for effect in one.basis], skies, odd=True)
        for candidate, response in over_steps(modulations, lambda table: self.same_skies.odd([table], skies)):
            t[:, list(candidate.columns)] += response[: len(t)]
        return t

    @cached_property
    def exchanged(self) -> list[str]:
        """Return sentences on orders of maps or pixels in which the model fits, if it hardly does as they are."""
        context, settings, level = self.context, self.context.settings, self.context.settings.exchanged_pvalue
        if self.gap.omnibus > level or self.gap.pvalue > settings.alpha:
            return []
        parts, null, notes = context.analysis.model.parts, context.of_model.null, []
        # Maps that are alike have nearly the same chi^2 in any order.
        needed = float(null.log_likelihood(self.gap.chi2)) + np.log(settings.odds_cut)

        def pvalue(maps: Sequence[Map]) -> float:
            # What is left out is filled, and departs from no model.
            if max(map(share_left_out, parts, maps)) > settings.missing_share:
                return 0.0
            chi2 = null.chi2(context.analysis.data_vector(maps))
            return float(null.residual_test(chi2)) if null.log_likelihood(chi2) > needed else 0.0

        if (p := pvalue([healpy.reorder(one, n2r=True) for one in self.data])) > level:
            notes.append(f"The model fits ({p_equals(p)}) with maps read in the order NESTED; say so in their headers.")
        for order in exchanges(parts):
            p = pvalue([self.data[i] for i in order])
            if p > level:
                moved = [f"{parts[i].name} as {part.name}" for part, i in zip(parts, order, strict=True)]
                pairs = ", ".join(words for k, words in enumerate(moved) if order[k] != k)
                notes.append(f"The model fits ({p_equals(p)}) with maps exchanged: {pairs}.")
        return notes

    @cached_property
    def noise_in_common(self) -> list[str]:
        """Return a sentence on noise that maps have in common, if the model fits with it."""
        known = self.context.of_model
        level = known.settings.residual_level
        sentence = shared_noise(known.cross_powers, known.null, level, self.x, self._measured[1])
        return [] if sentence is None else [sentence]

    @cached_property
    def noise_of_splits(self) -> list[NoiseOfSplits]:
        """Return the noise of the splits of each channel over that of the model, where it is measured."""
        return noise_of_splits(self.context.of_model.cross_powers, self._measured[1])

    @property
    def folds(self) -> tuple[str, str]:
        """Return the names of the splits of each fold; without splits the folds are degrees and pixels."""
        if len(splits := self.context.run.map.splits) > 1:
            return " and ".join(splits[::2]), " and ".join(splits[1::2])
        return "even degrees and pixels", "odd degrees and pixels"

    def halves(self) -> tuple[Matrix, str]:
        """Return the identity, since only nuisances make the folds depend on each other, and the folds in words."""
        words = "odd degrees, alternate pixels"
        if len(self.context.run.map.splits) > 1:
            words = "{1} (frozen on {0})".format(*self.folds)
        return half_given_other(self.context.ensemble), words

    def places(self) -> list[Place]:
        """Rank the bipolar scan, and those elements of the data vector that are no matched filters."""
        ensemble, analysis = self.context.of_model.ensemble, self.context.analysis
        own = [i for i, element in enumerate(analysis.elements) if element.statistic != "score"]
        count = len(ensemble.bipolar_scan)
        drawn = np.concatenate([ensemble.bipolar_scan, ensemble.simulations[:count][:, own]], axis=1)
        shifted = self.x[own] - ensemble.offset[own]
        elements = (*analysis.bipolar_scan.elements, *(analysis.elements[i] for i in own))
        return places(np.concatenate([self._measured[1], shifted]), drawn, elements, self.context.settings.place_pvalue)

    def residual_maps(self) -> Matrix:
        """Return the residual maps over the scatter of those of simulations, shape (map, npix); NaN without data."""
        maps = residual_maps(self.context.ensemble, self._measured[2])
        there = [(one != healpy.UNSEEN).astype(float) for one in self.data]
        share = np.reshape(healpy.ud_grade(there, healpy.npix2nside(maps.shape[1])), maps.shape)
        return np.where(share > 0.0, maps, np.nan)

    def bad_pixels(self, found: Sequence[config.Effect]) -> BadPixels | None:
        """Return places of the maps that stand out beside what effects add to them: nothing if they cannot act."""
        model, ensemble, less = self.context.analysis.model, self.context.ensemble, list(self.data)
        with if_possible():
            less = self.same_skies.less_added(found)
        as_they_are = all(one is other for one, other in zip(less, self.data, strict=True))
        if as_they_are and not standing_out(model, ensemble, self._measured[2])[0]:
            return None
        return bad_pixels(model, ensemble, less)

    def without(self, bad: BadPixels) -> "ObservedMaps | None":
        """Return the maps without bad pixels; None if these are more than may be left out."""
        left, model = bad.without(self.data, self.context.analysis.model.nside), self.context.analysis.model
        many = max(map(share_left_out, model.parts, left)) > self.context.settings.missing_share
        return None if many else replace(self, data=left, given=self.given or self.data)

    def provenance(self) -> dict[str, str | int]:
        """Return the hash of the maps as they were given."""
        return {DIGEST: digest(self.given or self.data)}
