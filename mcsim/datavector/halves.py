"""Fit one half of the data vector, and measure in the other how far chi^2 falls with the effect in the simulator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from mcsim.datavector.null_ensemble import NullEnsemble
from mcsim.stats.excess import Frozen, HeldOut, excess, expected_fall, expected_fall_of_draw, held_out, scatter_chi2
from mcsim.stats.gaussian import Fit, SimulatedGaussian
from mcsim.support.arrays import Matrix, Vector

BENT = 0.5
"""Share by which a simulated response may be above what was fitted: else the fit says nothing of the amplitude."""


@dataclass(frozen=True)
class Halves:
    """Split the data vector x, shape (p,), into two parts with independent noise: one is fitted, the other one judges.

    ``used`` and ``fresh`` are the null distributions of the elements of fold 0, which are fitted, and of fold 1;
    ``first`` and ``second`` are these elements. Amplitudes are from 0 to ``largest`` if that is given;
    ``data`` tells them where one is the largest.
    """

    x: Vector
    used: SimulatedGaussian
    fresh: SimulatedGaussian
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    largest: float | None = None

    @classmethod
    def of(cls, ensemble: NullEnsemble, x: Vector) -> "Halves | None":
        """Split by the folds of the elements; None if one has no element."""
        first, second = ensemble.folds
        if not len(first) or not len(second):
            return None
        return cls(x, ensemble.restrict(first).gaussian, ensemble.restrict(second).gaussian, first, second)

    def expected_snr(self, change: Vector) -> float:
        """Return the smaller one of the signal-to-noise ratios of a change in the two parts."""
        return min(self.used.expected_snr(change[self.first]), self.fresh.expected_snr(change[self.second]))

    def exceeds(self, response: Vector, fitted: Vector, sigma: float) -> bool:
        """Return True if a response is larger than what was fitted to the first part, shape (p,) both.

        It is so by more than ``sigma`` standard deviations, and by more than the share :data:`BENT`.
        """
        size, expected = (self.used.expected_snr(one[self.first]) for one in (response, fitted))
        return size - expected > max(sigma, BENT * expected)

    def reduction(
        self,
        t: Matrix,
        respond: Callable[[Fit], Vector],
        scatters: Sequence[Matrix] = (),
        data: str = "",
        skies: Callable[[Fit], tuple[Matrix, Matrix] | None] | None = None,
        shapes: Sequence[Matrix] = (),
    ) -> HeldOut:
        """Fit templates, shape (p, K), to one part, freeze the amplitudes, and measure the reduction in the other.

        ``respond`` returns the response of the data vector to the frozen fit, shape (p,); ``scatters`` are deviations
        of stochastic responses from their mean, shape (p, draws) each; ``data`` names the part that judges. ``skies``
        returns data vectors of the same skies without the frozen effects and with them, shape (skies, p), where these
        scatter the data more: noise of which there is more adds to chi^2 of data that it describes rightly. ``shapes``
        are draws of the error of what each template is, shape (p, draws): that of a pattern which a part of the data
        tells. They cost some of the fall, and what remains may have that much.
        """
        t_used, t_fresh = t[self.first], t[self.second]
        x_used, x_fresh = self.x[self.first], self.x[self.second]
        used = self.used.with_extra_covariance(*(one[self.first] for one in scatters))
        frozen = used.fit(x_used, t_used)
        if self.largest is not None:
            nearest = lsq_linear(used.whiten_templates(t_used), used.whiten(x_used), (0.0, self.largest))
            frozen = replace(frozen, amplitudes=nearest.x)
            if max(nearest.x) > 0.99 * self.largest:
                data += f", with {' and '.join(f'{a:.1f}' for a in nearest.x)} times its size, as the other half asks"
        after = self.fresh.shift(self.fresh.mean + respond(frozen)[self.second])
        after = after.with_extra_covariance(*(one[self.second] for one in scatters))
        if scatters:
            draws = (t @ frozen.amplitudes)[:, None] + sum(np.sqrt(one.shape[1]) * one for one in scatters)
            shares = _squares(self.fresh, draws[self.second]) / _squares(self.used, draws[self.first])
            noise = self.used.fit(x_used, t_used).covariance
            fall = expected_fall_of_draw(after, t_fresh, noise, excess(self.used, x_used), shares)
        else:
            fall = expected_fall(self.fresh, t_fresh, frozen.amplitudes, frozen.covariance)
        pair = None if skies is None else skies(frozen)
        widened = (0.0, 0.0) if pair is None else self._scatter(*pair)
        if shapes:
            errors = sum(a * one[self.second] for a, one in zip(frozen.amplitudes, shapes, strict=True))
            own = Frozen.of(self.fresh, t_fresh @ frozen.amplitudes, np.asarray(errors))
            fall, widened = own.less(fall), (own.trace, own.square)
        return held_out(self.fresh, after, x_fresh, fall, data, widened)

    def _scatter(self, before: Matrix, after: Matrix) -> tuple[float, float]:
        """Return the traces of the covariance that effects add to the part that judges, and of its square."""
        nothing = np.zeros((len(self.second), 0))
        return scatter_chi2(self.fresh, nothing, before[:, self.second], after[:, self.second])


def _squares(null: SimulatedGaussian, draws: Matrix) -> Vector:
    """Return the squared signal-to-noise ratios of draws of a response, shape (p, draws) to (draws,)."""
    return np.asarray(null.hartlap_factor * np.sum(null.whiten_templates(draws) ** 2, axis=0))
