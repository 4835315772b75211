"""Search of the grammar: which structures are there, how significant they are, and with which coordinates.

Scores u of a structure of K coordinates have under the model the covariance C that is also their response to the
coordinates, so that a fit needs no templates: theta = C^-1 u, and the fall of chi^2 is T = u' C^-1 u. C is estimated
from simulations; the tests are exact for their number (:mod:`mcsim.stats.gaussian`).
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mcsim.reconstruction.grammar import LOWEST
from mcsim.reconstruction.scores import INDICES
from mcsim.reconstruction.structure import ALIKE, MEANS, OPPOSITE, Structure
from mcsim.sphere import healpix, real
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.support.arrays import Matrix, Vector, divided

LEVEL = 0.01  #: global p-value, all of the grammar charged, up to which a structure is there
MOST = 3  #: largest number of structures

SECOND, AGAINST = 0.1, 4.0
"""Least fall of chi^2 of a further structure over that of the first: below it may be the square of the first. And that
of what is left over the largest of what was there: fits of two structures add up to twice the larger one at most."""

FINALISTS, NEAR, SPARE = 20, 5.0, 2
"""Structures that are compared by their responses on the sky of the data: how many at most, within which difference of
the evidence those of one stage and frame, and simulations for each of their scores if all of them judge."""

RARE = 3.0
"""Odds against a structure that differs between splits, acts on sky or dipole alone, a cube, a halo, a signal from
elsewhere (the dipole of the opposite direction is a gain's), and of a function of time beside its constant, of which
there are several."""

TAIL = 0.1  #: share of the simulations by which the tail of the largest evidence is described
COARSE, TINY, LARGEST_FALL = 4, 1e-3, -0.9
"""nside by which a pattern of variances is known, its departure from 1 that is none, and how far it may fall."""

LEAST = 0.01  #: information, relative to the largest, of a combination of responses that is fitted
SMALL = 1e-6  #: variance, relative to the largest, of a direction in which scores are not inverted
ALTERNATIVES = 20.0  #: odds up to which other structures are told beside the best
RIVAL = 4.0  #: odds up to which the next one, if it is of other words, is as good a description as the best


class Response(NamedTuple):
    """Hold what a structure makes of all scores."""

    coordinates: Matrix  #: shape (k, coordinates)
    made: Matrix  #: by each row of these, shape (k, P)
    number: float = np.inf  #: of simulations of which it is the average; infinite: it is that on this sky


class Sky(Protocol):
    """What structures do on the sky of the data."""

    def response(self, member: int, rest: Vector) -> Response:
        """Return coordinates of a structure, fitted to scores, and what they make of all scores.

        Of a pattern that acts on few modes of this sky the coordinates are one by one.
        """

    def keep(self, member: int, amplitudes: Vector) -> None:
        """Take the amplitudes of the responses of a structure for its own."""

    def left(self, chosen: list[int]) -> Vector:
        """Return the scores without what is made of them by structures, shape (P,)."""


@dataclass(frozen=True)
class Found:
    """A structure that is there."""

    structure: int  #: index in the grammar
    #: global p-value: probability that the best of all structures has as large an evidence in data of the model
    pvalue: float
    delta_chi2: float  #: fall of chi^2, unbiased
    #: indices of structures less probable by ALTERNATIVES at most, the rival and then the most probable first
    alternatives: tuple[int, ...]
    rival: int | None  #: the most probable of other words than the best, if less so by RIVAL at most


@dataclass(frozen=True, eq=False)
class Search:
    """Search scores for structures; ``simulations`` are scores of the model, shape (N, P)."""

    grammar: tuple[Structure, ...]
    simulations: Matrix
    #: evidences of structures that data choose from a continuum, in each simulation, shape (N, n)
    peaks: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    exact: bool = True  #: what a structure makes of its own scores is their variance, as by the inverse covariance

    @cached_property
    def nulls(self) -> tuple[SimulatedGaussian | None, ...]:
        """Return the null distribution of every structure; None for one that the maps do not measure."""
        return tuple(self._null(one) for one in self.grammar)

    def _null(self, structure: Structure) -> SimulatedGaussian | None:
        rows = structure.of(self.simulations)
        spread = rows.std(axis=0)
        if not np.all(spread > 1e-12 * max(float(np.abs(rows).max()), 1e-300)) or rows.shape[1] + 10 > len(rows):
            return None
        mean = rows.mean(axis=0)  # not by from_simulations, which tests the covariance, too, at 20 times the cost
        _, size, axes = np.linalg.svd((rows - mean) / spread, full_matrices=False)
        kept = size > 1e-4 * size[0]
        whitening = np.sqrt(len(rows) - 1.0) * axes[kept] / size[kept, None] / spread
        return SimulatedGaussian(mean, whitening, len(rows))

    @cached_property
    def largest(self) -> Vector:
        """Return the largest evidence over the grammar of every simulation against all others, shape (N,)."""
        falls = np.full((len(self.grammar), len(self.simulations)), np.nan)
        for row, (structure, null) in enumerate(zip(self.grammar, self.nulls, strict=True)):
            if null is not None:
                square, n = null.held_out(structure.of(self.simulations))
                falls[row] = square * (n - null.dimension - 1) / n
        found = self._evidences(falls, range(len(self.grammar))).max(axis=0)
        return np.asarray(np.maximum(found, self.peaks.max(axis=1, initial=-np.inf)) if self.peaks.size else found)

    def pvalue(self, value: float) -> float:
        """Return the global p-value of an evidence: by rank, beyond the last TAIL of simulations exponential.

        Notes
        -----
        The mean excess over a high quantile is the scale of an exponential tail (Pickands, Ann. Stat. 3, 119, 1975,
        with shape 0); odds against none have such a tail, of scale 1 at most in theory (Markov's inequality).
        """
        null = np.sort(self.largest)
        edge = float(np.quantile(null, 1.0 - TAIL))
        if value <= edge:
            return float((1 + np.sum(null >= value)) / (1 + len(null)))
        scale = max(float(np.mean(null[null > edge] - edge)), 1.0)
        return TAIL * float(np.exp(-(value - edge) / scale))

    def run(self, scores: Vector, sky: "Sky | None" = None) -> list[Found]:
        """Return the structures that are there, the most evident first.

        ``sky`` knows what structures do on the sky of the data, whose patterns make scores correlated that are
        independent on average over skies. It judges between the finalists, and takes out what is found before the rest
        is searched; None: by averages over skies. What a structure leaves for one that is like it is its shape, and no
        further structure. One that leaves more than AGAINST is refuted by other scores, and ends the search.
        """
        found: list[Found] = []
        rest, most = scores, float(self._falls(scores).max())
        for _ in range(MOST):
            values = self.evidences(rest)
            values[[any(one.like(self.grammar[k.structure]) for k in found) for one in self.grammar]] = -np.inf
            if (p := self.pvalue(float(values.max()))) > LEVEL:
                break
            members = self.finalists(values)
            responses = [(self if sky is None else sky).response(k, rest) for k in members]
            judged, falls, amplitudes = self.judged(members, rest, responses)
            best, *others = map(int, np.argsort(-judged))
            if judged[best] <= 0.0 or (found and falls[best] < SECOND * found[0].delta_chi2):
                break
            less = {members[k]: judged[best] - judged[k] for k in others}
            near = [k for k, one in less.items() if one < np.log(ALTERNATIVES)]
            own = self.grammar[members[best]]
            rival = next((k for k in near if less[k] < np.log(RIVAL) and not own.like(self.grammar[k])), None)
            near.sort(key=lambda k: k != rival)  # it is told first
            found.append(Found(members[best], p, float(falls[best]), tuple(near), rival))
            # Nobody knows what such a pattern leaves in other scores; with more noise they scatter more.
            if own.stage == "noise" or (own.stage, own.kind) == ("added", "power"):
                break
            chosen = [one.structure for one in found]
            if sky is not None:
                sky.keep(members[best], amplitudes[best])
            rest = rest - amplitudes[best] @ responses[best].made if sky is None else sky.left(chosen)
            if self._falls(rest).max() > AGAINST * max(most, *(one.delta_chi2 for one in found)):
                return found[:-1]
        return found

    def evidences(self, scores: Vector) -> Vector:
        """Return the evidence of every structure by itself, less the logarithm of the odds against such ones."""
        return self._evidences(self._falls(scores)[:, None], range(len(self.grammar)))[:, 0]

    @cached_property
    def constants(self) -> dict[int, int]:
        """Return the structure that is the constant of a function of time, which is measured by itself.

        A constant that was subtracted from the maps is not.
        """
        means = {k: one for k, one in enumerate(self.grammar) if one.kind in MEANS and self.nulls[k] is not None}
        found = {}
        for k, structure in enumerate(self.grammar):
            mean = next((j for j, one in means.items() if structure.extends(one)), None)
            if mean is not None and self.nulls[k] is not None and _holds(structure, self.grammar[mean]):
                found[k] = mean
        return found

    @cached_property
    def finer(self) -> dict[int, int]:
        """Return the power at higher degrees that a foreground has besides, of its pattern to the highest degree."""
        light = [k for k, one in enumerate(self.grammar) if one.is_light and self.nulls[k] is not None]
        powers = {self.grammar[k].index: k for k in light if self.grammar[k].of_a_foreground}
        tops = {self.grammar[k].index: k for k in light if self.grammar[k].kind.startswith("degrees 0-")}
        return {k: powers[index] for index, k in tops.items() if index in powers}

    def _evidences(
        self, falls: NDArray[np.float64], members: Sequence[int], numbers: Sequence[float] = ()
    ) -> NDArray[np.float64]:
        """Return evidences from the falls of chi^2 of members, shape (members, n); not measured: NaN, and -inf.

        What a function of time is beyond its constant has a size of its own: most of a pulse is its mean, a monopole.
        A covariance that N simulations tell makes a fall beside a larger one, T, larger by 1 + T/N on average (Rao,
        Linear Statistical Inference, 8c.4); ``numbers``: N of each member, (): all. Light that channels share by their
        frequencies is a pattern and a power at higher degrees: the more evident of the two has the evidence of both.
        """
        place, found = {k: row for row, k in enumerate(members)}, np.full(falls.shape, -np.inf)
        for row, k in enumerate(members):
            structure, constant = self.grammar[k], place.get(self.constants.get(k, -1))
            if self.nulls[k] is None:
                continue
            odds = evidence(falls[row], structure.size)
            if constant is not None:
                number = numbers[row] if numbers and not structure.of_variances else len(self.simulations)
                more = (falls[row] - falls[constant]) / (1.0 + np.maximum(falls[constant], 0.0) / number)
                odds = evidence(falls[constant], 1) + evidence(more, structure.size - 1) - np.log(RARE)
            found[row] = odds - _rarity(structure)
        for pair in self.finer.items():
            if all(k in place for k in pair):
                both = found[[place[k] for k in pair]]
                joint = np.where(both.min(axis=0) > 0.0, both.sum(axis=0), both)
                found[[place[k] for k in pair]] = np.where(both == both.max(axis=0), joint, both)
        return found

    def finalists(self, values: Vector) -> list[int]:
        """Return structures to compare: the most evident one, and those that may be it on this sky.

        These are the best of every other stage, the same in other channels, splits or profiles, the same function of
        something else and with fewer harmonics, those near it, and the best of every frame, without a constant and with
        one. Of many among which the data choose it is the best. Its parts stand with each.
        """
        order = [k for k in map(int, np.argsort(-values)) if values[k] > 0.0]
        each = [self.grammar[k] for k in order]
        if not order:
            return [int(np.argmax(values))]
        wanted = order[:1]
        if each[0].stage == "power":  # a monopole or dipole may be made of the rest of the sky
            wanted += [k for k, null in enumerate(self.nulls) if null and self.grammar[k].stage == "modulation"]
        wanted += _firsts(order, [one.stage for one in each])
        wanted += [k for k in order if each[0].elsewhere(self.grammar[k]) or each[0].like(self.grammar[k])]
        beside = [k for k in order if each[0].beside(self.grammar[k])]
        wanted += _firsts(beside, [(self.grammar[k].acts_on, self.grammar[k].in_any_way) for k in beside])
        wanted += [k for k in order if values[order[0]] - values[k] < NEAR]
        labels = [(one.stage, one.acts_on, one.frame, k in self.constants) for k, one in zip(order, each, strict=True)]
        wanted += _firsts(order, labels)
        chosen = _firsts(wanted, [self.grammar[k].choice or k for k in wanted])
        chosen = (chosen if self.exact else self._measurable(chosen))[:FINALISTS]
        parts = [part[k] for part in (self.constants, self.finer) for k in chosen if k in part]
        return list(dict.fromkeys(chosen + parts))

    def _measurable(self, chosen: Sequence[int]) -> list[int]:
        """Return the first of some structures of whose scores there are SPARE simulations each."""
        kept, left = list[int](), len(self.simulations) // SPARE
        for k in chosen:
            if self.grammar[k].size <= left:
                kept.append(k)
                left -= self.grammar[k].size
        return kept

    def judged(
        self, members: Sequence[int], scores: Vector, responses: Sequence[Response]
    ) -> tuple[Vector, Vector, list[Vector]]:
        """Return evidence, fall of chi^2 and amplitudes of structures.

        Each is judged in its own scores, which say all that maps tell of it. Those of a pattern that multiplies the sky
        leave out the monopoles and dipoles of the product, which count besides. By the isotropic filter the scores of
        others tell more, and all are judged in those of all.
        """
        if self.exact:
            fits = [self._fit_on_sky(k, scores, one) for k, one in zip(members, responses, strict=True)]
        else:
            fits = self._fits_in_all(members, scores, [one.made for one in responses])
        falls = np.array([fall for fall, _ in fits])
        numbers = [one.number for one in responses] if self.exact else ()
        return self._evidences(falls[:, None], members, numbers)[:, 0], falls, [amplitudes for _, amplitudes in fits]

    def _fit_on_sky(self, member: int, scores: Vector, response: Response) -> tuple[float, Vector]:
        """Return fall of chi^2 and amplitudes of a structure, of whose coordinates it is known what they make.

        What it makes of its own scores on this sky is their variance there, which that of all skies is not where few
        modes are bright.
        """
        structure, null, (coordinates, made, _) = self.grammar[member], self.nulls[member], response
        x, t = structure.of(scores), structure.of(made)
        if null is not None and structure.of_variances:
            fit = null.fit(x, t.T)
            return null.hartlap_factor * fit.delta_chi2 * self._share(member, scores), fit.amplitudes
        rows = structure.of(self.simulations)
        known, information = coordinates @ (x - rows.mean(axis=0)), coordinates @ t.T
        if structure.leaves_low and self._low_null is not None:
            white = np.sqrt(self._low_null.hartlap_factor) * self._low_null.whiten_templates(made[:, self._low].T)
            known = known + white.T @ self._low_null.whiten(scores[self._low])
            information = information + white.T @ white
        scale = divided(1.0, np.sqrt(np.maximum(np.diag(information), 0.0)))
        sizes, axes = np.linalg.eigh(0.5 * scale[:, None] * (information + information.T) * scale)
        kept = sizes > LEAST * sizes[-1]
        along = axes[:, kept].T @ (scale * known)
        fall, amplitudes = float(np.sum(along**2 / sizes[kept])), scale * (axes[:, kept] @ (along / sizes[kept]))
        if fall > 0.0 and not structure.acts_on:
            # It is the same on every sky: more scatter than that is not of the filter's model.
            scatter = float(np.var(rows @ (amplitudes @ coordinates), ddof=1))
            fall *= min(1.0, fall / scatter * (1.0 + 4.0 * np.sqrt(2.0 / len(rows))))
        return fall, amplitudes

    def _fits_in_all(
        self, members: Sequence[int], scores: Vector, responses: Sequence[Matrix]
    ) -> list[tuple[float, Vector]]:
        """Return falls of chi^2 and amplitudes of structures in the scores of all of them."""
        simulations, x, *made = (
            np.concatenate([self.grammar[k].of(one) for k in members], axis=-1)
            for one in (self.simulations, scores, *responses)
        )
        null = SimulatedGaussian.from_simulations(simulations, floor=SMALL)
        fits = [null.fit(x, one.T) for one in made]
        shares = [self._share(k, scores) for k in members]
        falls = [null.hartlap_factor * one.delta_chi2 * share for one, share in zip(fits, shares, strict=True)]
        return list(zip(falls, [one.amplitudes for one in fits], strict=True))

    @cached_property
    def _low(self) -> NDArray[np.int64]:
        """Return the places of the scores of monopoles and dipoles that are added to maps."""
        rows = [one.rows.ravel() for one in self.grammar if one.says[:4] == ("added", "", "sky", LOWEST)]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *rows]))

    @cached_property
    def _low_null(self) -> SimulatedGaussian | None:
        """Return their null distribution."""
        low = self.simulations[:, self._low]
        return SimulatedGaussian.from_simulations(low, floor=SMALL) if low.size else None

    def response(self, member: int, scores: Vector) -> Response:
        """Return coordinates of a structure, fitted to scores, and what they make of all, on average over skies."""
        ((theta, _),) = self.fit([self.grammar[member]], scores)
        centred = self.simulations - self.simulations.mean(axis=0)
        own = self.grammar[member].of(centred) @ theta
        return Response(theta[None], (own @ centred / (len(centred) - 1.0))[None], len(centred))

    def fall(self, structure: Structure, scores: Vector) -> float:
        """Return the unbiased fall of chi^2 of any structure by itself; 0 of one that the maps do not measure."""
        null = self._null(structure)
        return 0.0 if null is None else null.hartlap_factor * null.chi2(structure.of(scores))

    def _falls(self, scores: Vector) -> Vector:
        """Return the unbiased fall of chi^2 of every structure by itself."""
        found = np.zeros(len(self.grammar))
        for k, (structure, null) in enumerate(zip(self.grammar, self.nulls, strict=True)):
            if null is not None:
                found[k] = null.hartlap_factor * null.chi2(structure.of(scores)) * self._share(k, scores)
        return found

    def _share(self, member: int, scores: Vector) -> float:
        """Return how much of the fall of chi^2 that the scores of a variance promise is real.

        Where numbers have 1 + a times the variance of the model, 2 ln L rises by a - ln(1 + a) for each of them, for
        which their score says a^2/2: a bright pattern, which raises the variance too, would be noise first.
        """
        structure = self.grammar[member]
        if not structure.of_variances:
            return 1.0
        modes = np.ones(1)
        if structure.kind in ("power", "spectrum"):
            rows, x = (self._squares(structure, one) for one in (self.simulations, scores))
            a, modes = x / rows.mean(axis=0) - 1.0, rows.mean(axis=0) ** 2 / rows.var(axis=0)
            if structure.stage == "added" and np.sum(modes * a) < 0.0:  # what is added has no power below zero
                return 0.0
        else:
            ((theta, _),) = self.fit([structure], scores)
            pattern = theta if structure.mix is None else structure.mix.T @ theta
            a = real.field(np.asarray(pattern), *healpix.centres(COARSE))
        a = np.maximum(np.abs(a) if structure.split == OPPOSITE else a, LARGEST_FALL)  # whichever split has more
        if not np.any(np.abs(a) > TINY):
            return 1.0
        return float(2.0 * np.sum(modes * (a - np.log1p(a))) / np.sum(modes * a**2))

    def _squares(self, structure: Structure, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums of squares whose relative change powers are, from scores (..., P).

        What two splits of a channel have in common is a b = |(a + b)/2|^2 - |(a - b)/2|^2, below zero on average where
        the filter has taken the sky out of their sum; more of it is in the first part alone. So it is of n, over pairs.
        """
        found = structure.of(scores)
        if structure.stage != "added" or structure.channel is None:
            return found
        own = (one for one in self.grammar if (one.kind, one.channel) == ("spectrum", structure.channel))
        return found + 0.25 * next(own).of(scores)

    def fit(self, chosen: Sequence[Structure], scores: Vector) -> list[tuple[Vector, Matrix]]:
        """Return the coordinates of structures, fitted together, and the covariance of each.

        Directions that the scores hardly measure stay at zero.
        """
        rows = np.concatenate([one.of(self.simulations) for one in chosen], axis=1)
        null = SimulatedGaussian.from_simulations(rows, floor=SMALL)
        covariance = null.hartlap_factor * null.whitening.T @ null.whitening
        theta = covariance @ (np.concatenate([one.of(scores) for one in chosen]) - null.mean)
        ends = np.cumsum([0] + [one.size for one in chosen])
        return [(theta[a:b], covariance[a:b, a:b]) for a, b in pairwise(ends)]

    def amplitudes(self, chosen: Sequence[Structure], scores: Vector, responses: Matrix) -> Vector:
        """Return the factors of simulated responses, shape (count, P), with which they describe the scores best."""
        low = self._low if any(one.leaves_low for one in chosen) else self._low[:0]
        simulations, x, t = (
            np.concatenate([*(w.of(one) for w in chosen), one[..., low]], axis=-1)
            for one in (self.simulations, scores, responses)
        )
        return SimulatedGaussian.from_simulations(simulations, floor=SMALL).fit(x, t.T).amplitudes


def _firsts(order: Sequence[int], labels: Sequence[Hashable]) -> list[int]:
    """Return the first of every label."""
    found: dict[Hashable, int] = {}
    for k, label in zip(order, labels, strict=True):
        found.setdefault(label, k)
    return list(found.values())


def _holds(structure: Structure, mean: Structure) -> bool:
    """Return False for a structure of which a mean is no coordinate any more, since it was subtracted from the maps."""
    own = np.all(structure.rows == mean.rows, axis=1)
    kept = structure.mix is None or not own.any() or bool(structure.mix[:, own].any())
    return kept and structure.size > 1


def _rarity(structure: Structure) -> float:
    """Return the logarithm of the prior odds against a structure, beside one of the common kind."""
    part = structure.stage in ("gain", "square", "elsewhere") and structure.acts_on != "sky and dipole"
    halo = structure.stage == "beam" and structure.kind.endswith("low l")
    odd = part or structure.stage == "cube" or halo
    rare = (structure.split != ALIKE) + odd + (structure.stage == "elsewhere")
    tried = structure.tried * (1.0 if structure.index is None else len(INDICES))
    return rare * float(np.log(RARE)) + float(np.log(tried))


def evidence(fall: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return the logarithm of the odds of K coordinates, of unknown size but alike in all directions, against none.

    Notes
    -----
    With a Gaussian prior of variance tau^2 in white coordinates the odds are (1 + tau^2)^(-K/2) exp(T/2 tau^2 /
    (1 + tau^2)), T the fall of chi^2; at their largest, 1 + tau^2 = T/K, their logarithm is (T - K - K log(T/K))/2
    (George & Foster, Biometrika 87, 731, 2000, with its local empirical Bayes choice).
    """
    ratio = np.maximum(fall / size, 1.0)
    return 0.5 * size * (ratio - 1.0 - np.log(ratio))
