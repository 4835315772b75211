"""Fitted effects, sets of them and candidates, as the result of a diagnosis has them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mcsim.diagnosis.consistency import Comparison, MapCheck
from mcsim.stats.excess import Measured


@dataclass(frozen=True)
class EffectResult:
    """One fitted effect: amplitude, standard error and parameters; ``label`` and ``words`` as people read them.

    ``errors`` are those of fitted parameters. ``consistency`` are its amplitudes in parts of the data, over the fitted
    one, and ``parts`` the same in words.
    """

    name: str
    channel: str | None
    amplitude: float
    sigma: float
    unit: str
    parameters: dict[str, Any]
    label: str
    words: str
    consistency: tuple[Comparison, ...] = ()
    parts: tuple[str, ...] = ()
    errors: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class EffectSet:
    """A smallest set of effects that describes the data."""

    #: effects, candidates: the effects, and their indices among the candidates
    effects: tuple[EffectResult, ...]
    candidates: tuple[int, ...]
    #: coordinates, errors: fitted linear coordinates, those of one effect after the other, and standard errors
    coordinates: tuple[float, ...]
    errors: tuple[float, ...]
    odds: float  #: posterior odds against the best set
    #: pvalue, excess: of the residual that the fit leaves: p-value, and excess chi^2
    pvalue: float
    further: float  #: p-value of the most significant further candidate, with the look-elsewhere effect
    excess: Measured
    maps: tuple[MapCheck, ...] = ()  #: largest scales of the maps before and after the effects are taken out
    #: p-value of the residual if neither an error of the responses nor the scatter that the effects add is tolerated;
    #: None in results of earlier versions
    pvalue_alone: float | None = None

    @property
    def label(self) -> str:
        """Return the names of the effects."""
        return " and ".join(effect.label for effect in self.effects)


@dataclass(frozen=True)
class CandidateResult:
    """A candidate effect: its fit alone, the amplitude that would be detected, and the candidate most like it."""

    #: name, channel, settings, unit, label, columns: of the effect; ``channel`` None: acts in all; and its columns of
    #: the templates
    name: str
    channel: str | None
    settings: dict[str, Any]
    unit: str
    label: str
    columns: tuple[int, ...]
    #: amplitude, sigma, words: fitted alone, NaN where no effect has such an amplitude; and as people read it
    amplitude: float
    sigma: float
    words: str
    #: delta_chi2, pvalue: unbiased fall of chi^2, and its p-value over all candidates (Bonferroni)
    delta_chi2: float
    pvalue: float
    #: detectable, detectable_words: amplitude that is found with 90 % power at 5 % false alarms; None where the data
    #: vector does not respond. fixed: other fitted parameters, which have these values there
    detectable: float | None
    detectable_words: str
    fixed: dict[str, float]
    #: similar, correlation: index of the other effect with the most similar response, None without one, and their
    #: canonical correlation
    similar: int | None
    correlation: float
    #: strength, separable, separable_words: amplitude over its error, and amplitude, at which the right one of the two
    #: is chosen in 95 cases of 100
    strength: float
    separable: float
    separable_words: str
    largest: float = np.inf  #: largest absolute amplitude that the effect can have; infinite in earlier results

    @property
    def components(self) -> list[str]:
        """Return the labels of its columns."""
        count = len(self.columns)
        return [self.label] if count == 1 else [f"{self.label}, component {k + 1}" for k in range(count)]

    @property
    def significance(self) -> float:
        """Return the square root of the fall of chi^2."""
        return float(np.sqrt(max(self.delta_chi2, 0.0)))
