"""Hold a covariance from few simulations against the sample covariance of many: p-values and power on held-out skies.

STORE is a model that mcsim diagnose has learned, $MCSIM_CACHE/diagnose/KEY.zarr. Its simulations, full skies that went
through maps and filter, are divided at random: few to learn from, the others, or eight of them, to be tested. With
--drawn both are Gaussian draws from the covariance that all of them give: is the reference distribution right? With
--disjoint each set of as few as that is learned from once, and all others are tested: what do data of one model share?
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import kstest

from mcsim.datavector.null_ensemble import load
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.datavector.summaries import pair_classes
from mcsim.stats.gaussian import SimulatedGaussian
from mcsim.stats.look_elsewhere import calibrate, calibrate_in_folds

TESTED, STRENGTH = 8, 4.5

DRAWN = 100
"""Data of each ensemble that is drawn."""


class Judge:
    """Test data against simulations: gap p-value with all candidates."""

    def __init__(self, simulations, templates, groups, floor, classes=None):
        shrink = classes is not None
        self.null = SimulatedGaussian.from_simulations(simulations, floor=floor, shrink=shrink, classes=classes)
        self.groups = self.null.whiten_groups(templates, groups)
        self.calibration = calibrate(self.null, self.groups, draws=4000)
        if shrink:
            self.calibration = calibrate_in_folds(self.calibration, self.null, self.groups)

    def pvalues(self, data):
        """Return the p-values of chi^2 and of the gap, shape (tests,) each."""
        white = self.null.whiten(data)
        chi2 = np.sum(white**2, axis=1)
        scores = self.null.nested_test(self.groups.delta_chi2(white), chi2[:, None], self.groups.sizes)
        omnibus = self.null.residual_test(chi2)
        return omnibus, self.calibration.combine(omnibus, scores.min(axis=1))

    def kept(self, templates, covariance, ideal):
        """Return the squared signal-to-noise ratio with these weights over that with the best ones."""
        weights = self.null.whitening.T @ (self.null.whitening @ templates)
        signal = np.sum(weights * templates, axis=0) ** 2
        return signal / np.einsum("ik,ij,jk->k", weights, covariance, weights) / ideal


def uniform(found):
    """Print how uniform p-values are, each kind of them a list."""
    for name, values in found.items():
        each = np.array(values)
        below = ", ".join(f"{np.sum(each <= level)} at {level}" for level in (0.05, 0.01))
        test = kstest(each, "uniform")
        distance = f"distance {test.statistic:.3f}, Kolmogorov-Smirnov {test.pvalue:.2g}"
        print(f"p-values, {name}: {len(each)}, {distance}; {below}")


def drawn(ensemble, templates, groups, few, rounds):
    """Print p-values of data and simulations that are drawn from one covariance."""
    spread, rng = ensemble.spread, np.random.default_rng(2)
    root = spread[:, None] * np.linalg.pinv(ensemble.gaussian.whitening * spread)
    found, powers = {"omnibus": [], "gap": []}, []
    for _ in range(rounds):
        simulations, tested = (rng.standard_normal((count, root.shape[1])) @ root.T for count in (few, DRAWN))
        judge = Judge(simulations, templates, groups, ensemble.redundant, pair_classes(ensemble.elements))
        powers.append(judge.calibration.power)
        for name, values in zip(found, judge.pvalues(tested), strict=True):
            found[name] += values.tolist()
    print(f"{rounds} ensembles of {few}, {DRAWN} data each; power {np.mean(powers):.3f} +- {np.std(powers):.3f}")
    uniform(found)


def disjoint(ensemble, templates, groups, few):
    """Print p-values of all other simulations for every set of few."""
    found, x = {"omnibus": [], "gap": []}, ensemble.simulations
    for first in range(0, len(x) - few + 1, few):
        own = slice(first, first + few)
        judge = Judge(x[own], templates, groups, ensemble.redundant, pair_classes(ensemble.elements))
        others = np.delete(x, own, axis=0)
        null, each = judge.null, dict(zip(found, judge.pvalues(others), strict=True))
        ratio = np.mean(np.sum(null.whiten(others) ** 2, axis=1)) * null.hartlap_factor / null.dimension
        print(f"from {first}: worth {null.dof + 1}; chi^2 of the others is {ratio:.4f} of what the tests take")
        uniform(each)
        for name, values in each.items():
            found[name] += values.tolist()
    print("all sets together, whose others are the same:")
    uniform(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("--rounds", type=int, default=130)
    parser.add_argument("--each", type=float, default=3, help="simulations per element")
    parser.add_argument("--drawn", action="store_true", help="Gaussian draws in place of simulations")
    parser.add_argument("--disjoint", action="store_true", help="every set of as few once, all others tested")
    given = parser.parse_args()
    ensemble, bank = load(given.store)
    x, floor = ensemble.simulations, ensemble.redundant
    templates = bank.significant(ensemble.spread, DiagnosisSettings())
    alike = {}
    for column, label in enumerate(bank.labels):
        if templates[:, column].any():
            alike.setdefault(label[:3], []).append(column)
    groups = list(alike.values())
    columns = [column for group in groups for column in group]
    whole = SimulatedGaussian.from_simulations(x, floor=floor)
    p, rng = whole.dimension, np.random.default_rng(1)
    few, classes = round(given.each * p), pair_classes(ensemble.elements)
    if given.drawn:
        drawn(ensemble, templates, groups, few, given.rounds)
        return
    if given.disjoint:
        disjoint(ensemble, templates, groups, few)
        return
    print(f"{len(x)} simulations, {p} independent elements, {len(groups)} candidates; {few} to learn from")
    size = np.sqrt(whole.hartlap_factor) * np.linalg.norm(whole.whiten_templates(templates), axis=0)
    found, worth, kept = {"omnibus": [], "gap": []}, [], []
    power = {"shrunk": [], "sample covariance of all others": []}
    for _ in range(given.rounds):
        order = rng.permutation(len(x))
        tested, rest = x[order[:TESTED]], x[order[TESTED:]]
        shrunk = Judge(rest[:few], templates, groups, floor, classes)
        sample = Judge(rest, templates, groups, floor)
        for name, values in zip(found, shrunk.pvalues(tested), strict=True):
            found[name] += values.tolist()
        column = rng.choice(columns, TESTED)
        changed = tested + STRENGTH * (templates[:, column] / size[column]).T
        for name, judge in zip(power, (shrunk, sample), strict=True):
            power[name] += (judge.pvalues(changed)[1] <= 0.05).tolist()
        worth.append(shrunk.null.dof + 1)
        others = rest[few:]
        covariance = np.cov(others.T)
        inner = whole.whitening @ covariance @ whole.whitening.T
        white = whole.whitening @ templates[:, columns]
        ideal = np.sum(white * np.linalg.solve(inner, white), axis=0) * (1.0 - (p + 1.0) / (len(others) - 1.0))
        kept.append(shrunk.kept(templates[:, columns], covariance, ideal))
    print(f"worth {np.mean(worth):.0f} +- {np.std(worth):.0f} simulations of a sample covariance")
    mean = np.mean(kept, axis=0)
    print(f"share of (S/N)^2 that is kept: {mean.mean():.3f}, of the worst template {mean.min():.3f};", end=" ")
    print(f"sample covariance of ten per element: {1.0 - 1.0 / 10.0:.3f}, of as few {1.0 - p / (few - 1.0):.3f}")
    uniform(found)
    for name, values in power.items():
        print(f"detected at S/N {STRENGTH} (p <= 0.05), {name}: {np.sum(values)} of {len(values)}")


if __name__ == "__main__":
    main()
