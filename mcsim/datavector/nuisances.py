"""Nuisances in a data vector: what it says of each, and what one half of it says of the other through them.

The simulations of the model draw the nuisances, so that mean and covariance contain them and every test marginalises
them. The drawn coordinates are known: their regression on the data vectors is the posterior.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mcsim.datavector.candidate import Candidate
from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.simulation.nuisance import Nuisance
from mcsim.stats.gaussian import Fit, SimulatedGaussian, orthonormal
from mcsim.support.arrays import Matrix, Vector, divided

MEASURED = 0.04
"""Share of the prior variance that the data leave at most of a nuisance whose response is that of the regression."""

LEAST = 0.1  #: share of the prior variance that the data have to remove for a pull to be given


@dataclass(frozen=True)
class NuisanceResult:
    """One linear component of a nuisance: its prior, and what the data make of it."""

    #: name, channel, component, parameters, unit, label: of the effect; ``channel`` None: all; ``component`` counts
    #: from 1, None for an effect of one
    name: str
    channel: str | None
    component: int | None
    parameters: dict[str, float | str | tuple[float, ...]]
    unit: str
    label: str
    #: prior_mean, prior_width, amplitude, sigma: mean and standard deviation before and after the data
    prior_mean: float
    prior_width: float
    amplitude: float
    sigma: float
    #: shift of the mean over the standard deviation that it has if the prior is right; None if the data do not
    #: constrain the component
    pull: float | None
    words: str  #: posterior and prior as people read them


@dataclass(frozen=True)
class Regression:
    """Regress nuisances on data vectors in white coordinates, but for the directions of templates that are fitted.

    Notes
    -----
    If data vector and nuisances are Gaussian together, E(nu | x) = mu + cov(nu, x) C^-1 (x - m): for a linear response
    generalised least squares with the prior. From N simulations, (nu - estimate)/(s sqrt(1 + 1/N + x'S^-1 x)) follows
    Student's t with N - 1 - q degrees of freedom, q the dimension of x, s^2 the residual variance and S the scatter
    matrix (Rao, Biometrika 46, 49, 1959). Slopes are shrunk by the corrected share of the variance that they explain
    (Copas, JRSS B 45, 311, 1983), without which nuisances that the data do not constrain would follow noise.
    """

    null: SimulatedGaussian
    basis: Matrix  # white directions that are fitted, orthonormal, (p, K)
    slopes: Matrix  # (k, p)
    left: Vector  # residual variance, (k,)
    shrinkage: Vector  # (k,)
    chance: Vector  # mean of the draws, (k,)

    @classmethod
    def of(cls, ensemble: NullEnsemble, null: SimulatedGaussian, t: Matrix | None = None) -> "Regression":
        """Regress the nuisances of an ensemble; ``null`` may have further covariance; templates are (p_raw, K)."""
        assert ensemble.nuisances is not None  # the caller has asked
        chance = ensemble.nuisances.mean(axis=0)
        drawn = ensemble.nuisances - chance
        white = (ensemble.simulations - ensemble.simulations.mean(axis=0)) @ null.whitening.T
        basis = np.zeros((null.dimension, 0)) if t is None else orthonormal(null.whiten_templates(t))[0]
        n, q = null.dof, null.dimension - basis.shape[1]
        slopes = drawn.T @ white / n
        slopes = slopes - slopes @ basis @ basis.T
        total = np.sum(drawn**2, axis=0) / n
        explained = np.sum(slopes**2, axis=1)
        left = np.minimum((total - explained) * n / (n - q), total)
        shrinkage = divided(total - left, explained)
        return cls(null, basis, slopes, left, shrinkage, chance)

    @property
    def matrix(self) -> Matrix:
        """Return the slopes in the elements of the data vector, shape (k, p_raw)."""
        return self.shrinkage[:, None] * self.slopes @ self.null.whitening

    def posterior(self, x: Vector, prior_mean: Vector) -> tuple[Vector, Vector]:
        """Return posterior mean and standard deviation of each nuisance, shape (k,), for data of shape (p_raw,)."""
        null = self.null
        white = null.whiten(x) * np.sqrt(1.0 + 1.0 / null.n_sims)
        white = white - self.basis @ (self.basis.T @ white)
        degrees = null.dof - null.dimension + self.basis.shape[1]
        scale = 1.0 + 1.0 / null.n_sims + self.shrinkage * float(white @ white) / null.dof
        shift = self.shrinkage * (self.slopes @ white + self.chance - prior_mean)
        return prior_mean + shift, np.sqrt(self.left * scale * degrees / (degrees - 2))

    def results(self, nuisances: Sequence[Nuisance], x: Vector) -> Iterator[NuisanceResult]:
        """Yield the components of nuisances with their posterior for data, shape (p_raw,)."""
        found = self.posterior(x, np.concatenate([one.mean for one in nuisances]))
        each = [(one, place) for one in nuisances for place in range(len(one.widths))]
        for (one, place), amplitude, sigma in zip(each, *(values.tolist() for values in found), strict=True):
            mean, width = float(one.mean[place]), float(one.sigma[place])
            gained, before = width**2 - sigma**2, one.effect.format_amplitude(mean, width)
            component = place + 1 if len(one.widths) > 1 else None
            yield NuisanceResult(
                name=one.effect.name,
                channel=one.channel,
                component=component,
                parameters={**one.settings, **{f"{key}_width": value for key, value in one.parameter_widths.items()}},
                unit=one.effect.unit,
                label=one.title + (f", component {component}" if component else ""),
                prior_mean=mean,
                prior_width=width,
                amplitude=amplitude,
                sigma=sigma,
                pull=(amplitude - mean) / float(np.sqrt(gained)) if gained > LEAST * width**2 else None,
                words=f"{one.effect.format_amplitude(amplitude, sigma)} (prior {before})",
            )


def with_nuisances(
    ensemble: NullEnsemble,
    null: SimulatedGaussian,
    nuisances: Sequence[Nuisance],
    candidates: tuple[Candidate, ...],
    templates: Matrix,
) -> tuple[tuple[Candidate, ...], Matrix]:
    """Return candidates and templates, shape (p_raw, K), those of effects that are nuisances as well regressed.

    Such a candidate departs from the model only beyond its prior. Its template must therefore be the very direction in
    which the nuisance scatters the simulations; of a nuisance that the data hardly measure the regression is noise, and
    its scatter small beside that of the data: its prior goes into the error of its amplitude, by :func:`with_priors`.
    Where the data depart along that direction by more than its prior explains, its response is simulated in their very
    sky, like that of any other (:class:`~mcsim.diagnosis.refine.Refiner`), with the prior in the error, too.
    """
    assert ensemble.nuisances is not None  # the caller has asked
    drawn = ensemble.nuisances - ensemble.nuisances.mean(axis=0)
    response = np.linalg.lstsq(drawn, ensemble.simulations, rcond=None)[0]
    clear = Regression.of(ensemble, null).left < MEASURED * np.mean(drawn**2, axis=0)
    found, t, start = list(candidates), templates.copy(), 0
    for one in nuisances:
        own = slice(start, start + len(one.widths))
        start = own.stop
        for place, candidate in enumerate(candidates):
            same = candidate.identity == (one.effect.name, one.channel) and not one.parameter_widths
            if not same or candidate.effect(**candidate.settings) != one.effect(**one.settings):
                continue
            if measured := bool(clear[own].all()):
                t[:, list(candidate.columns)] = response[own].T
            found[place] = replace(candidate, nuisance=measured, known=(response[own].T, one.sigma))
    return tuple(found), t


def with_priors(
    null: SimulatedGaussian,
    t: Matrix,
    found: Fit,
    members: Sequence[Candidate],
    scattered: Callable[[Fit], Fit] = lambda fit: fit,
) -> Fit:
    """Return a fit of templates of members, shape (p_raw, K), with the priors of nuisances among them in its errors.

    ``scattered`` gives the fit the errors that its effects make, which concern the noise alone.

    Notes
    -----
    The data cannot tell an effect from its nuisance: a fit theta = A x, A T = 1, finds the sum of both, and W, the
    variance of the nuisance, is in that of theta whatever the weights are. The covariance of the simulations has
    W r r' of it, r the response of the mean sky, which the weights evade where T differs from r, by noise or in the
    very sky of the data. A W r r' A' is taken from the covariance, and W added: measurement and prior.
    """
    # A template that is the scatter itself has the prior in its error already.
    known = [None if m.nuisance else m.known for m in members]
    sizes = [len(m.columns) for m in members]
    widths = np.concatenate([np.zeros(k) if one is None else one[1] for one, k in zip(known, sizes, strict=True)])
    if not widths.any():
        return scattered(found)
    parts = [np.zeros((len(t), k)) if one is None else one[0] for one, k in zip(known, sizes, strict=True)]
    basis, back = orthonormal(null.whiten_templates(t))
    seen = back @ basis.T @ null.whiten_templates(np.concatenate(parts, axis=1) * widths)
    scale = (null.dof + found.chi2) / (found.dof - 2)
    values, vectors = np.linalg.eigh(found.covariance - scale * seen @ seen.T)
    noise = scattered(replace(found, covariance=(vectors * np.maximum(values, 0.0)) @ vectors.T))
    return replace(noise, covariance=noise.covariance + np.diag(widths**2))


def half_given_other(ensemble: NullEnsemble) -> Matrix:
    """Return the matrix, shape (p, p), that subtracts from elements of fold 1 what fold 0 says of them by nuisances.

    Both folds share the nuisances, and nothing else that is random. It is the identity without nuisances.
    """
    turn = np.eye(len(ensemble.elements))
    used, fresh = ensemble.folds
    if ensemble.nuisances is None or not len(used) or not len(fresh):
        return turn
    half = ensemble.restrict(used)
    drawn = ensemble.nuisances - ensemble.nuisances.mean(axis=0)
    response = np.linalg.lstsq(drawn, ensemble.simulations[:, fresh], rcond=None)[0]
    turn[np.ix_(fresh, used)] = -response.T @ Regression.of(half, half.gaussian).matrix
    return turn
