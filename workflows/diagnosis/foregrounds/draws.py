"""What a covariance from 48 draws of a foreground does to tests and amplitudes, for the survey of pulls.py.

python workflows/diagnosis/foregrounds/draws.py further [TRIALS]           another 48 draws of 1,000 for each trial:
    how often is a further effect found that is not there, and what are the pulls of amplitude and index?
python workflows/diagnosis/foregrounds/draws.py skies [SKIES [AMPLITUDE]]  the same draws in typical skies and in
    skies that the data constrain: what amplitude, and what is left?
"""

import sys
from dataclasses import replace

import numpy as np
from pulls import NAME, PROPOSED, SEED, model
from scipy import stats

import mcsim
from mcsim import config
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import seeded, with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.gaussian import Tolerated
from mcsim.stats.scattered import variance_beside, with_drawn_scatter

INDEX, DRAWS, DATA, LAST, PULLS = 0.4, 48, 1000, 400, 100


def ask(jobs):
    """Run jobs in this process."""
    return [data_vectors(job) for job in jobs]


class Foreground:
    """Hold the survey, what its data are tested with, and the foreground with its coordinates."""

    def __init__(self, amplitude):
        self.run = model()
        without = [name for name in mcsim.effects() if name not in PROPOSED]
        settings = DiagnosisSettings(including=PROPOSED)
        self.known = prepared(self.run, analysis_of(self.run, without, settings=settings), ask)
        names = [candidate.name for candidate in self.known.candidates]
        self.member = names.index(NAME)
        self.candidate = self.known.candidates[self.member]
        parameters = {"amplitude": amplitude, "spectral_index": INDEX}
        self.effect = config.Effect(name=NAME, parameters=parameters)
        self.truth = self.candidate.parametrization.coordinates(mcsim.effects()[NAME](**parameters))

    def simulated(self, seed, effects, count):
        """Return data vectors of the survey with effects, shape (count, p)."""
        job = self.known.analysis.job(with_effects(seeded(self.run, seed), effects))
        return data_vectors(replace(job, count=count))

    def exact(self, response):
        """Return all templates, those of the foreground with this response at its coordinates."""
        t, columns, null = self.known.templates.copy(), list(self.candidate.columns), self.known.null
        parts = t[:, columns] * self.truth
        weights = np.sum(null.whiten_templates(parts) ** 2, axis=0)
        t[:, columns] += np.outer(response - parts.sum(axis=1), weights / (self.truth * weights.sum()))
        return t


def scatter(changes):
    """Return deviations of draws, as a diagnosis takes them, shape (p, draws)."""
    count = len(changes)
    return np.sqrt((1.0 + 1.0 / count) / (count - 1.0)) * (changes - changes.mean(axis=0)).T


def further(trials=400):
    """Fit the foreground and each other candidate beside it, with the scatter of a choice of draws for every trial."""
    own = Foreground(3.0)
    null, candidates, offset = own.known.null, own.known.candidates, own.known.ensemble.offset
    data = own.simulated(2028, [own.effect], DATA) + offset
    changes = own.simulated(2029, [own.effect], DATA) - own.simulated(2029, [], DATA)
    columns, others = [one.columns for one in candidates], [k for k in range(len(candidates)) if k != own.member]
    rng, found, pulls, ratios, left = np.random.default_rng(1), [], [], [], []
    for trial in range(trials + 1):
        # The last trial is that of all draws.
        last = trial == trials
        draws = changes if last else changes[rng.choice(DATA, DRAWS, replace=False)]
        t, known = own.exact(draws.mean(axis=0)), scatter(draws)
        wide, every = null.with_extra_covariance(known), []
        variance = variance_beside(null, t, columns, [own.member], [known])
        for x in data[:LAST] if last else data[[trial % DATA]]:
            alone = wide.fit(x, t[:, list(columns[own.member])])
            fits = [wide.fit(x, t[:, [*columns[own.member], *columns[k]]]) for k in others]
            more = np.array([alone.dimension - fit.dimension for fit in fits])
            falls = np.array([alone.chi2 - fit.chi2 for fit in fits])
            tests = [
                wide.nested_test(falls, alone.chi2, more, null.dimension - alone.dimension, Tolerated(0.0, one))
                for one in (1.0, variance[others])
            ]
            every.append([own.known.calibration.global_pvalue(p).min() for p in tests])
            ratios.append(falls * wide.hartlap_factor / more)
            left.append(alone.pvalue)
        if last:
            print(f"{DATA} draws: p <= 0.05, 0.005 in", *(np.mean(np.array(every)[:, 0] <= p) for p in (0.05, 0.005)))
            break
        found += every
        if trial < PULLS:
            errors = with_drawn_scatter(null, t[:, list(columns[own.member])], alone, [known]).errors
            pulls.append((alone.amplitudes - own.truth) / errors)
    rows, p = np.array(found), np.array(pulls)
    for place, what in enumerate(("scatter as it is", "scatter of held-out draws")):
        print(f"{DRAWS} draws, {what}: p <= 0.05, 0.005 in", *(np.mean(rows[:, place] <= p) for p in (0.05, 0.005)))
    mean = np.mean(ratios[:trials], axis=0)
    print(
        "fall of chi^2 over its expectation:",
        {candidates[k].label: round(r, 2) for k, r in zip(others, mean, strict=True)},
    )
    print("pulls: mean", p.mean(axis=0).round(2), "width", p.std(axis=0).round(2))
    print("what is left: mean p", np.mean(left[:trials]), "KS p", stats.kstest(left[:trials], "uniform").pvalue)


def skies(number=16, amplitude=15.0):
    """Fit the foreground of full skies with its response in typical skies, and in skies that they constrain."""
    own = Foreground(amplitude)
    null, columns = own.known.null, list(own.candidate.columns)
    truth = survey(with_effects(seeded(own.run, SEED), [own.effect]))
    rows = []
    for sky in range(number):
        data = ObservedMaps(own.known, list(simulate.maps(truth, sky)), ask)
        for constrained in (False, True):
            before, after = data.same_skies.pair([own.effect], DRAWS, constrained)
            changes = (after - before)[:, : len(data.x)]
            wide = null.with_extra_covariance(scatter(changes))
            fit = wide.fit(data.x, own.exact(changes.mean(axis=0))[:, columns])
            rows.append([*(fit.amplitudes / own.truth - 1.0), *(fit.errors / own.truth), fit.pvalue])
    for place, what in enumerate(("typical skies", "constrained skies")):
        own_rows = np.array(rows[place::2])
        mean, error = own_rows.mean(axis=0), own_rows.std(axis=0, ddof=1) / np.sqrt(number)
        print(
            f"{amplitude:g} uK, {what}: coordinates over the truth less one",
            mean[:2].round(3),
            "+-",
            error[:2].round(3),
        )
        print("    their errors", mean[2:4].round(3), "what is left: mean p", mean[4].round(2), end=", ")
        print("KS p", stats.kstest(own_rows[:, 4], "uniform").pvalue)


if __name__ == "__main__":
    command, *given = sys.argv[1:]
    {"further": further, "skies": skies}[command](*map(int, given[:1]), *map(float, given[1:]))
