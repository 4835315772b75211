"""Candidates on a data vector of unit normals, for tests of attribution."""

from dataclasses import replace

import numpy as np

from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.selection import Attribution, Selection, attribute
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate
from mcsim.systematics import Effect, Parametrization

P, N = 60, 800  #: elements and simulations


def candidate(name: str, channel: str | None, columns: tuple[int, ...], settings=None, sign=0, largest=np.inf, **more):
    """Return a candidate of an effect that does nothing."""
    fitted = Parametrization(sign=sign, max_amplitude=largest)
    attributes = {"name": name, "unit": "", "scope": "channel", "step": 1.0, "parametrization": fitted}
    return Candidate(type(name, (Effect,), attributes), channel, columns, settings or {}, **more)


class Bench:
    """Candidates on a data vector of 60 unit normals with a fiducial ensemble of 800 simulations."""

    def __init__(self, t: np.ndarray, candidates: list[Candidate]) -> None:
        self.null = SimulatedGaussian.from_simulations(np.random.default_rng(7).normal(size=(N, P)))
        self.t, self.candidates = t, candidates
        self.whitened_templates = self.null.whiten_groups(t, [candidate.columns for candidate in candidates])
        self.calibration = calibrate(self.null, self.whitened_templates)

    def diagnose_maps(self, signal: np.ndarray, seed: int, **options) -> Attribution:
        x = signal + np.random.default_rng(seed).normal(size=P)
        settings = replace(DiagnosisSettings(), **options)
        return attribute(Selection(self.null, x, self.t, self.candidates, self.calibration, settings))


def directions(count: int, seed: int) -> np.ndarray:
    t = np.random.default_rng(seed).normal(size=(P, count))
    return t / np.linalg.norm(t, axis=0)


def singles(count: int) -> list[Candidate]:
    return [candidate(f"effect{i}", None, (i,)) for i in range(count)]


def twelve_and_two() -> Bench:
    """Twelve single templates, then a pair and a triple of columns."""
    candidates = [*singles(12), candidate("pair", "W1", (12, 13)), candidate("triple", "W2", (14, 15, 16))]
    return Bench(directions(17, 8), candidates)
