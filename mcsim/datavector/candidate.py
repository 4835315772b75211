"""Candidates: effects that may be in the data, the response of the data vector to each, and what a fit says of them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from mcsim import config
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.errors import InputError
from mcsim.simulation.channels import table_of
from mcsim.stats.gaussian import Fit
from mcsim.stats.scattered import Acting
from mcsim.support.arrays import Matrix, Vector
from mcsim.systematics import Effect, Parametrization, basis_of

BEYOND = 3.0  #: standard deviations by which fits may be beyond the bounds of parameters: at a bound, half of them are

Part = tuple[int, Vector, Matrix]  #: member of a fit, its amplitudes and their covariance

FAINT_LEVEL = 1e-4
"""p-value of noise alone below which elements are not cut that are faint one by one: a library has 100 columns."""


class Column(NamedTuple):
    """Identify a column of templates: effect, channel (None: all), parameters that are not fitted, and component."""

    effect: str
    channel: str | None
    settings: tuple[tuple[str, Any], ...]
    component: int


@dataclass(frozen=True)
class Candidate:
    """Describe one effect in one channel, or in all of them, with fixed settings."""

    effect: type[Effect]
    channel: str | None  # None: all
    columns: tuple[int, ...]  # in the matrix of templates, one for each of its linear components
    settings: Mapping[str, Any] = field(default_factory=dict)  # parameters that are not fitted
    shape_error: float | None = None  # relative error of its templates in white norm; None: that of the settings
    # Deviations of its response from the mean one if it is stochastic, shape (p, draws), as
    # SimulatedGaussian.with_extra_covariance takes them; None if they are not known.
    scatter: Matrix | None = field(default=None, compare=False)
    # Deviations of what its draws do together with other candidates, by their place, and neither does alone; likewise.
    crossed: Mapping[int, Matrix] = field(default_factory=dict, compare=False)
    # Otherwise by how much its effect scatters the data; None if it is not known.
    acting: Acting | None = field(default=None, compare=False)
    # It is a nuisance as well, within its prior: its templates are those of the scatter that this makes.
    nuisance: bool = False
    # Of any nuisance what one unit of each coordinate adds to the simulations, (p, K), and its prior widths, (K,).
    known: tuple[Matrix, Vector] | None = field(default=None, compare=False)
    step: float | None = None  # amplitude at which its response is measured; None: that of the effect
    fit: Parametrization | None = None  # how these channels let it be fitted; None: as the effect says

    @property
    def name(self) -> str:
        """Return the name of the effect."""
        return self.effect.name

    @property
    def parametrization(self) -> Parametrization:
        """Return how it is fitted."""
        return self.effect.parametrization if self.fit is None else self.fit

    @property
    def identity(self) -> tuple[str, str | None]:
        """Return name and channel: candidates that share them differ only in settings and exclude each other."""
        return self.name, self.channel

    @property
    def claim(self) -> tuple[str, str | None, str | None]:
        """Return name, channel and split: where it acts, of which a verdict has all that are as probable."""
        return *self.identity, self.settings.get("split")

    @property
    def labels(self) -> tuple[Column, ...]:
        """Return the identity of each of its columns."""
        return tuple(Column(*self.identity, tuple(self.settings.items()), k) for k in range(len(self.columns)))

    @property
    def label(self) -> str:
        """Return name, channel and settings as text."""
        settings = (f"{key} = {value}" for key, value in self.settings.items())
        return f"{self.name} ({', '.join((self.channel or 'all', *settings))})"

    @property
    def title(self) -> str:
        """Return the effect in words, with channel and the settings that are not the effect's own."""
        usual = vars(self.effect())
        return self.effect.label(self.channel, {key: own for key, own in self.settings.items() if usual[key] != own})

    @property
    def basis(self) -> tuple[Effect, ...]:
        """Return the effects whose responses span it, one for each column."""
        found = basis_of(self.effect, self.settings, self.parametrization)
        return found if self.step is None else tuple(replace(one, amplitude=self.step) for one in found)

    @property
    def steps(self) -> Vector:
        """Return the coordinate at which the response to each column is measured, shape (K,)."""
        return np.array([self.parametrization.coordinates(one)[place] for place, one in enumerate(self.basis)])

    @property
    def typical(self) -> Matrix:
        """Return coordinates of unit amplitudes, (K, j), over whose responses detectable amplitudes are averaged."""
        return self.parametrization.typical(self.effect(**self.settings))

    @property
    def fixed(self) -> dict[str, float]:
        """Return the parameters with an error at which these amplitudes are, such as the index of a foreground."""
        usual = self.effect(**self.settings)
        return {name: float(getattr(usual, name)) for name in self.parametrization.measured}

    @property
    def largest(self) -> float:
        """Return the largest absolute amplitude that the effect can have; infinite if nothing bounds it."""
        ends = [max(abs(one.low), abs(one.high)) for one in self.effect.bounds if one.parameter == "amplitude"]
        return min([self.parametrization.max_amplitude, *ends])

    @property
    def random_response(self) -> bool:
        """Return True if its templates are measured from random draws, not from an effect that is taken away."""
        return self.parametrization.stochastic and self.parametrization.sign >= 0

    def with_coordinates(self, coordinates: Vector, precision: Matrix) -> Effect:
        """Return the effect nearest to coordinates in the metric ``precision``."""
        return self.effect(**{**self.parametrization.nearest(coordinates, precision), **self.settings})

    def of_strength(self, strength: float, white: Matrix, direction: Vector) -> Effect:
        """Return the effect of an expected S/N in a direction, as far as its parameters reach there.

        ``white`` are its templates in standard deviations, shape (p, K), and ``direction``, shape (K,), is along the
        principal axes of their span.
        """
        gram, fit = white.T @ white, self.parametrization
        values, vectors = np.linalg.eigh(gram)
        constrained = values > 1e-9 * values[-1]
        theta = vectors[:, constrained] @ (direction[constrained] / np.sqrt(values[constrained]))
        effect = self.with_coordinates(np.abs(theta) if fit.sign else theta, gram).within_bounds()
        # The parameters reach only some directions, and coordinates need not be linear in the amplitude.
        for _ in range(30):
            snr = np.linalg.norm(white @ fit.coordinates(effect))
            slope = np.log(np.linalg.norm(white @ fit.coordinates(effect.scaled(1.01))) / snr) / np.log(1.01)
            effect = effect.scaled(float((strength / snr) ** (1.0 / slope)))
            if abs(snr / strength - 1.0) < 1e-9:
                break
        return effect.within_bounds()

    def fitted(self, coordinates: Vector, covariance: Matrix) -> Effect:
        """Return the effect within its bounds nearest to fitted coordinates, as far as the data constrain them."""
        return self._nearest(coordinates, covariance)[0]

    def _nearest(self, coordinates: Vector, covariance: Matrix) -> tuple[Effect, float]:
        """Return the nearest effect within its bounds, and its distance in standard deviations if that matters."""
        precision: Matrix = np.asarray(np.linalg.pinv(covariance), dtype=np.float64)
        fit = self.parametrization
        constrained = fit.constrained(coordinates, precision)
        free = self.with_coordinates(constrained, precision)
        inside = free.within_bounds()
        if inside is free:
            return free, 0.0
        # Coordinates are linear in the amplitude.
        unit = fit.coordinates(replace(inside, amplitude=1.0))
        best = float(unit @ precision @ constrained) / max(float(unit @ precision @ unit), 1e-300)
        inside = replace(inside, amplitude=best).within_bounds()
        beyond = constrained - fit.coordinates(inside)
        return inside, float(np.sqrt(max(float(beyond @ precision @ beyond), 0.0)))

    def detected(self, coordinates: Vector, covariance: Matrix) -> Effect:
        """Return :meth:`fitted`; raise InputError if the data do not constrain the effect at all."""
        effect = self.fitted(coordinates, covariance)
        if effect.amplitude == 0.0:
            raise InputError(f"the data do not constrain {self.label} by itself; leave it out of what is added.")
        return effect

    def table(self, effect: Effect) -> config.Effect:
        """Return the effect as an ``[[effect]]`` of a run."""
        return table_of(effect, self.channel)

    def beyond(self, amplitudes: Vector, covariance: Matrix) -> float:
        """Return how far fitted amplitudes are beyond what the effect can have, in standard deviations.

        It is infinite for another sign, for more than the largest amplitude, and for more than BEYOND.
        """
        fit = self.parametrization
        if (fit.sign and bool(np.any(amplitudes < 0.0))) or float(np.linalg.norm(amplitudes)) > fit.max_amplitude:
            return np.inf
        distance = self._nearest(amplitudes, covariance)[1] if self.effect.bounds else 0.0
        return distance if distance <= BEYOND else np.inf


def numbered(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates with consecutive columns."""
    found, start = [], 0
    for candidate in candidates:
        stop = start + len(candidate.columns)
        found.append(replace(candidate, columns=tuple(range(start, stop))))
        start = stop
    return tuple(found)


def columns_of(candidates: Sequence[Candidate], members: Sequence[int]) -> list[int]:
    """Return the columns of some candidates, one after the other."""
    return [column for member in members for column in candidates[member].columns]


def parts_of(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> Iterator[Part]:
    """Yield each member of a fit of :func:`columns_of`, its amplitudes and their covariance."""
    start = 0
    for member in members:
        own = slice(start, start + len(candidates[member].columns))
        yield member, found.amplitudes[own], found.covariance[own, own]
        start = own.stop


def beyond(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> float:
    """Return how far a fit is beyond the bounds of its effects, in standard deviations; infinite if it is not theirs.

    The nearest effects within their bounds have a chi^2 that is larger by the square of it. Standard deviations are
    those with the effects in the data, as far as it is known what these scatter along their own responses.
    """
    distances = []
    for member, theta, covariance in parts_of(candidates, members, found):
        acting = candidates[member].acting
        grown = 1.0 if acting is None else 1.0 + max(acting.own, 0.0)
        distances.append(candidates[member].beyond(theta, grown * covariance))
    return float(np.linalg.norm(distances))


def lost(candidates: Sequence[Candidate], members: Sequence[int], found: Fit, n: int) -> float:
    """Return by how much less chi^2 falls if the last member has its nearest possible amplitude; inf if none can be.

    ``n`` are the degrees of freedom of the covariance. All of a member that is impossible, or makes others so, is lost.

    Notes
    -----
    At that amplitude chi^2 is larger than at the fitted one by the square of their distance in the metric of the fit,
    without the scale that errors have from what is left: effects may be missing yet. Without the effect the fall that
    stays is distributed as a mixture of chi^2 of up to K degrees of freedom (Chernoff, Ann. Math. Stat. 25, 573, 1954;
    Self & Liang, JASA 82, 605, 1987), and never above that of the free fit: tests for K hold their level.
    """
    distances = [candidates[member].beyond(*part) for member, *part in parts_of(candidates, members, found)]
    scale = (n + found.chi2) / (found.dof - 2.0)
    return scale * distances[-1] ** 2 if np.isfinite(distances).all() else np.inf


def scatters_of(candidates: Sequence[Candidate], members: Sequence[int]) -> list[Matrix]:
    """Return the scatter of the responses of members where it is known, and behind it what they scatter together.

    That of one which draws its pattern with several others is of the same draws, which add up.
    """
    own = [one for one in (candidates[member].scatter for member in members) if one is not None]
    crossed = [candidates[member].crossed for member in members]
    together = [[beside[other] for other in members if other in beside] for beside in crossed]
    return own + [np.sum(parts, axis=0) for parts in together if parts]


def crossed_by(candidates: Sequence[Candidate], members: Iterable[int]) -> list[int]:
    """Return the candidates of which it is known what they scatter together with members; not their own scatter."""
    beside = {other for member in members for other in candidates[member].crossed}
    return [place for place in sorted(beside) if candidates[place].scatter is None]


def coordinates_of(candidates: Sequence[Candidate], members: Sequence[int], effects: Sequence[Effect]) -> Vector:
    """Return the coordinates of effects of some candidates, one after the other."""
    pairs = zip(members, effects, strict=True)
    return np.concatenate([candidates[member].parametrization.coordinates(effect) for member, effect in pairs])


def effects_at(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> list[Effect]:
    """Return the effects nearest to a fit; raise InputError if one cannot have its amplitude."""
    return [candidates[member].detected(*part) for member, *part in parts_of(candidates, members, found)]


def tables_at(candidates: Sequence[Candidate], members: Sequence[int], found: Fit) -> list[config.Effect]:
    """Return :func:`effects_at` as ``[[effect]]`` of a run."""
    effects = effects_at(candidates, members, found)
    return [candidates[member].table(effect) for member, effect in zip(members, effects, strict=True)]


def tables_beside(
    candidates: Sequence[Candidate], members: Sequence[int], found: Fit, bend: Matrix, least: float
) -> Iterator[tuple[float, list[config.Effect] | None]]:
    """Yield a step, and the tables of :func:`tables_at` with each amplitude in turn moved by it.

    A step is the error of the amplitude, back from what would be impossible. ``bend`` are white departures of the
    templates from linear ones, shape (p, K). None is yielded for the amplitudes of a member whose response departs by
    at most ``least``, and for one that its effect cannot follow alone: the four of a coma have two parameters.
    """

    def place(fit: Fit) -> Vector:
        return coordinates_of(candidates, members, effects_at(candidates, members, fit))

    first = 0
    for member in members:
        own = range(first, first := first + len(candidates[member].columns))
        straight = np.linalg.norm(bend[:, own] @ found.amplitudes[own]) <= least
        for error in np.diag(found.errors)[own]:
            ahead, back = (replace(found, amplitudes=found.amplitudes + sign * error) for sign in (1.0, -1.0))
            inside = beyond(candidates, members, ahead) == 0.0
            step = float(error.sum()) if inside else -float(error.sum())
            moved = ahead if inside else back
            follows = not straight and np.allclose(
                place(moved) - place(found), moved.amplitudes - found.amplitudes, 0.0, 1e-3 * abs(step)
            )
            yield step, tables_at(candidates, members, moved) if follows else None


@dataclass(frozen=True)
class TemplateBank:
    """Hold the responses of the data vector to all linear components of all candidates, shape (p, K) each."""

    matrix: Matrix  # per unit of each coordinate
    error: Matrix  # standard error of the matrix
    curvature: Matrix  # half the second derivative
    labels: tuple[Column, ...]  # identity of each column
    faint_share: Vector  # what elements that noise hides keep of the matrix, (K,)
    skies: Vector  # over how many each column is averaged, (K,)
    slice_matrix: Matrix = field(default_factory=lambda: np.zeros((0, 0)))  # of the numbers beside it, (E, K)

    def subset(self, rows: NDArray[np.int64], columns: Sequence[int]) -> "TemplateBank":
        """Return some elements and some columns."""
        cut = np.ix_(rows, np.asarray(columns, dtype=np.int64))
        labels = tuple(self.labels[column] for column in columns)
        beside = self.slice_matrix[:, list(columns)] if len(self.slice_matrix) else self.slice_matrix
        share, skies = self.faint_share[list(columns)], self.skies[list(columns)]
        return TemplateBank(self.matrix[cut], self.error[cut], self.curvature[cut], labels, share, skies, beside)

    def with_columns(self, labels: Sequence[Column], response: Matrix) -> "TemplateBank":
        """Return the bank with further columns: linear responses without error of all elements, shape (p + E, K)."""
        size, exact = len(self.matrix), np.zeros((len(self.matrix), len(labels)))
        return TemplateBank(
            np.concatenate([self.matrix, response[:size]], axis=1),
            np.concatenate([self.error, exact], axis=1),
            np.concatenate([self.curvature, exact], axis=1),
            (*self.labels, *labels),
            np.concatenate([self.faint_share, np.ones(len(labels))]),
            np.concatenate([self.skies, np.ones(len(labels))]),
            np.concatenate([self.slice_matrix, response[size:]], axis=1),
        )

    def _squares(self, spread: Vector) -> tuple[Vector, Vector]:
        """Return the squared norms of error and matrix over the spread of the data vector, shape (K,) each."""
        return np.sum((self.error / spread[:, None]) ** 2, axis=0), np.sum((self.matrix / spread[:, None]) ** 2, axis=0)

    def faint(self, spread: Vector, settings: DiagnosisSettings) -> NDArray[np.bool_]:
        """Return where noise hides the elements of noisy columns, shape (p, K).

        ``spread`` is the standard deviation of the data vector, shape (p,).
        """
        noise, size = self._squares(spread)
        clear = np.abs(self.matrix) > settings.clean_sigma * self.error
        return (noise > settings.noisy_share * size) & ~clear

    def significant(self, spread: Vector, settings: DiagnosisSettings) -> Matrix:
        """Return the matrix; of :meth:`faint` elements the share that is not noise."""
        return np.where(self.faint(spread, settings), self.faint_share * self.matrix, self.matrix)

    def sky_scatter(self, spread: Vector, candidates: Sequence[Candidate]) -> Vector:
        """Return the rms scatter of the response among skies over the mean response, shape (candidates,).

        Norms are of elements over their standard deviation ``spread``, all columns of a candidate together. Infinite if
        all columns are noise.
        """
        noise, size = self._squares(spread)
        found = []
        for candidate in candidates:
            # A column of nothing but noise says nothing of the others.
            rows = [column for column in candidate.columns if size[column] > 2.0 * noise[column]]
            ratio = self.skies[rows] * noise[rows] / (size[rows] - noise[rows])
            found.append(float(np.sqrt(np.mean(ratio))) if rows else np.inf)
        return np.array(found)


def signal_share(each: Matrix, faint: NDArray[np.bool_], whitening: Matrix) -> float:
    """Return the share of some elements of a mean response to keep: none if they are noise, even together.

    ``each``: responses in single skies, shape (skies, p). Distances are those of the covariance of the data vector,
    whose ``whitening`` has shape (q, p).

    Notes
    -----
    With t the mean, z its faint elements, n the noise of t and W the whitening, E|W(t - (1 - a) z - t_true)|^2 is
    smallest for a = 1 - E[(W n)(W n_z)] / E|W z|^2, the shrinkage of James & Stein (1961) of a part. The scatter of
    skies tells n. Zeros in place of elements that are correlated with others are no shorter in this metric: of a coma
    behind a mask they left a template that was orthogonal to the true one. |W z|^2 is held against its noise by an F
    test with (tr G)^2 / tr G^2 independent elements, G being its covariance: of modulations there are two or three.
    """
    skies, mean = len(each), each.mean(axis=0)
    hidden = ((each - mean) * faint) @ whitening.T
    products = hidden @ hidden.T
    pairs, squared = skies * (skies - 1.0), float(np.sum(products**2))
    size, noise = float(np.sum((whitening @ (mean * faint)) ** 2)), float(np.trace(products))
    if squared == 0.0:
        return 1.0
    independent = noise**2 / squared
    if f_distribution.sf(size * pairs / noise, independent, independent * (skies - 1.0)) > FAINT_LEVEL:
        return 0.0
    common = float(np.sum(((each - mean) @ whitening.T) * hidden))
    return float(np.clip(1.0 - common / (pairs * size), 0.0, 1.0))
