"""Scan BipoSH coefficients of residuals and sky, of the sky itself, and power spectra, to localise a departure.

There are too many numbers for a covariance: each is compared with its own scatter, and corrected for looking at all.
Cosmic variance cancels between a residual and the sky, so that noise limits the coefficients of one channel.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim import bipolar
from mcsim.diagnosis.summaries import Element, bins, scales
from mcsim.diagnosis.wiener_filter import FilteredMaps, Model, by_degree
from mcsim.sphere import alm as alm_
from mcsim.sphere.rotation import FRAMES, rotate_biposh

Vector = NDArray[np.float64]

Pick = tuple[Any, ...]


@dataclass(frozen=True)
class BipolarScan:
    """Compute the bipolar scan of one model."""

    model: Model

    @cached_property
    def tables(self) -> bipolar.Estimator:
        """Return the estimator with its Clebsch-Gordan coefficients."""
        return bipolar.estimator(self.L_max, self.model.lmax, both_orders=True)

    @property
    def L_max(self) -> int:
        """Return the highest L: that of the settings, or of the configuration if that is less."""
        return min(max(self.model.survey.config.biposh.L_max, 1), self.model.settings.scan_L_max, self.model.lmax)

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """Return the description of each number, in the order of :meth:`values`."""
        return tuple(element for element, _ in self._layout)

    def values(self, filtered: FilteredMaps) -> Vector:
        """Return all numbers of a set of maps, shape (numbers,)."""
        arrays = self._coefficients(filtered)
        own = self._powers(filtered)
        return np.array(
            [own[pick[1]] if pick[0] == "power" else _binned(arrays[pick[0]], pick) for _, pick in self._layout]
        )

    @cached_property
    def _layout(self) -> tuple[tuple[Element, Pick], ...]:
        """Return the numbers, each with the array, row, range and part that it is taken from."""
        frame = self.model.survey.frame
        found: list[tuple[Element, Pick]] = []
        for key, element in self._sources:
            for view in FRAMES:
                for row, mode in enumerate(self.tables.modes):
                    if mode.L == 0 or (view != frame and mode.M > 0) or (key == "sky" and not mode.in_auto):
                        continue
                    parts = ("re", "im") if mode.M else (("re",) if mode.parity == "even" else ("im",))
                    for low, high in bins(2, self.model.lmax, self.model.settings.scan_bins):
                        for part in parts:
                            where = replace(
                                element,
                                name=f"biposh/{element.name}/{view}/{mode.name}{part}/{low}-{high}",
                                ell=(low, high),
                                L=mode.L,
                                M=mode.M,
                                parity=mode.parity,
                                frame=view,
                            )
                            found.append((where, ((key, view), row, (low, high), part)))
        found += [(element, ("power", number)) for number, element in enumerate(self._power_elements)]
        return tuple(found)

    @cached_property
    def _sources(self) -> tuple[tuple[str, Element], ...]:
        names = [channel.name for channel in self.model.survey.channels]
        found = [("sky", Element("sky", "biposh", tuple(names), kind="biposh"))]
        for number, name in enumerate(names):
            found.append((f"{number}+", Element(name, "biposh", (name,), kind="biposh")))
            if len(self.model.of(number)) > 1:
                own = Element(f"{name} difference", "biposh", (name,), "difference", kind="biposh")
                found.append((f"{number}-", own))
        return tuple(found)

    def _coefficients(self, filtered: FilteredMaps) -> dict[tuple[str, str], NDArray[np.complex128]]:
        lmax, frame = self.model.lmax, self.model.survey.frame
        inverse = np.divide(1.0, self.model.cl, out=np.zeros(lmax + 1), where=self.model.cl > 0)
        modes = [(mode.L, mode.M, mode.d) for mode in self.tables.modes]
        found = {}
        for key, _ in self._sources:
            if key == "sky":
                left = alm_.multiply(filtered.sky, inverse, lmax)
            else:
                members = self.model.of(int(key[:-1]))
                signs = [1.0 if key[-1] == "+" else (-1.0) ** place for place in range(len(members))]
                total = sum(sign * filtered.adjoint[i] for sign, i in zip(signs, members, strict=True))
                # A dipole beside the sky's quadrupole would look like L = 3; it has a place of its own.
                response = np.where(np.arange(lmax + 1) >= 2, self.model.response[int(key[:-1])][: lmax + 1], 0.0)
                left = alm_.multiply(total, response, lmax)
            coefficients = np.nan_to_num(bipolar.estimate(self.tables, left, filtered.sky))
            for view in FRAMES:
                found[key, view] = coefficients if view == frame else rotate_biposh(coefficients, modes, frame, view)
        return found

    @cached_property
    def _power_elements(self) -> tuple[Element, ...]:
        frame = self.model.survey.frame
        elements = []
        for a, b in combinations_with_replacement(range(len(self.model.parts)), 2):
            names = [self.model.parts[i].name.partition(":") for i in (a, b)]
            splits = {name[2] for name in names if name[2]}
            for low, high in scales(self.model.lmax):
                elements.append(
                    Element(
                        f"cl/{self.model.parts[a].name},{self.model.parts[b].name}/{low}-{high}",
                        "cl",
                        tuple(dict.fromkeys(name[0] for name in names)),
                        splits.pop() if len(splits) == 1 else None,
                        None,
                        (low, high),
                        L=0,
                        M=0,
                        parity="even",
                        frame=frame,
                        kind="cross",
                    )
                )
        return tuple(elements)

    def _powers(self, filtered: FilteredMaps) -> Vector:
        """Return the cross power of residuals."""
        found = []
        for a, b in combinations_with_replacement(range(len(self.model.parts)), 2):
            power = by_degree(filtered.adjoint[a], filtered.adjoint[b], self.model.lmax)
            found += [float(power[low : high + 1].sum()) for low, high in scales(self.model.lmax)]
        return np.array(found)


def _binned(coefficients: NDArray[np.complex128], pick: Pick) -> float:
    _, row, (low, high), part = pick
    total = coefficients[row, low : high + 1].sum()
    return float(total.real if part == "re" else total.imag)
