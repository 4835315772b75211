"""Effects that push a data vector along directions of their own, bent and beside each other, and their diagnosis."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from mcsim.datavector.candidate import Candidate
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.refine import Refiner
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate, global_test
from mcsim.systematics import Effect

P = 50


@dataclass(frozen=True, kw_only=True)
class Push(Effect):
    """A response along a direction of its own."""

    name = "push"
    scope = "channel"
    unit = "push"
    cause = signature = ""
    step = 1.0


class Instrument:
    """Three effects on evidence of unit normals, with a response that is no straight line."""

    def __init__(self, bend: float, cross: float, noise: float | None = None) -> None:
        self.noise, self.crossed = noise, ""
        rng = np.random.default_rng(21)
        directions = np.linalg.qr(rng.normal(size=(P, 5)))[0].T
        self.t, self.sideways = directions[:3].T, directions[3:]
        self.bend, self.cross = bend, cross
        self.null = SimulatedGaussian.from_simulations(rng.normal(size=(900, P)))
        self.candidates = [Candidate(Push, name, (k,)) for k, name in enumerate("ABC")]
        self.calibration = calibrate(self.null, self.null.whiten_groups(self.t, [(0,), (1,), (2,)]))
        self.curvature = np.outer(bend * self.sideways[0], [1.0, 0.0, 0.0])
        self.analysis: list[dict[str | None, float]] = []
        self.settings = DiagnosisSettings()

    def response(self, a: float, b: float) -> np.ndarray:
        return self.t[:, :2] @ [a, b] + self.bend * a**2 * self.sideways[0] + self.cross * a * b * self.sideways[1]

    def respond(self, tables, skies: int) -> np.ndarray:
        amplitudes = {table.channel: float(table.parameters["amplitude"]) for table in tables}
        self.analysis.append(amplitudes)
        return np.tile(self.response(amplitudes.get("A", 0.0), amplitudes.get("B", 0.0)), (skies, 1))

    def pair(self, tables) -> tuple[np.ndarray, np.ndarray] | None:
        """Noise grows by a factor, if there is one."""
        if self.noise is None:
            return None
        before = np.random.default_rng(22).normal(size=(8, P))
        return before, self.noise * before + self.respond(tables, 8)

    def changes_sky(self, tables) -> bool:
        return False

    def scatter(self, changes: np.ndarray) -> np.ndarray:
        return (changes - changes.mean(axis=0)).T / np.sqrt(len(changes) - 1.0)

    @property
    def context(self) -> SimpleNamespace:
        bank = SimpleNamespace(curvature=self.curvature)
        known = {"null": self.null, "templates": self.t, "calibration": self.calibration, "settings": self.settings}
        return SimpleNamespace(bank=bank, knows=lambda table: False, **known)

    def refined(self, x: np.ndarray, sets=(), t: np.ndarray | None = None):
        own = {"respond": self.respond, "pair": self.pair, "scatter": self.scatter, "changes_sky": self.changes_sky}
        own["typical"] = lambda tables, skies, acting: sum(self.respond([table], skies) for table in tables)
        own["dipole_snr"] = lambda tables: float(tables[0].channel in self.crossed)
        groups = self.null.whiten_groups(self.t, [one.columns for one in self.candidates])
        gap = global_test(self.null, x, groups, self.calibration)
        data = SimpleNamespace(context=self.context, x=x, realizations=1, gap=gap, **own)
        return Refiner(data).run(self.t if t is None else t, self.candidates, sets)
