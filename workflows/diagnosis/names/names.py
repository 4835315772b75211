"""Measure how often names are wrong for systematics of no library, and how often true names are refused.

python names.py maps [CASES]       systematics that no library has, added to simulated maps
python names.py true [NUMBER]      one effect of the library, added to data vectors: how often is it named alone?
python names.py further [NUMBER]   beside a strong effect: how often is another one found that is not there?
python names.py bent [CASES]       an ellipticity whose response bends, in simulated maps: pulls of its amplitudes
python names.py noisy [CASES]      20 to 100 % more noise in one channel, in simulated maps: is that named?
python names.py draws [NUMBER]     effects of the library, added to data vectors of simulations
python names.py several [NUMBER]   one to five effects of the library at once, added to data vectors
python names.py pairs [CASES]      two effects of the library at once, in simulated maps
python names.py null [NUMBER]      data vectors of simulations without any effect: how often p-values are small
"""

import json
import os
import sys
from dataclasses import replace
from typing import Any

import healpy
import numpy as np

from mcsim import config, systematics
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import seeded, with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.sphere.rotation import rotation_matrix

NSIDE = 32
MODEL: dict[str, Any] = {
    "schema": 1,
    "name": "two-channels",
    "sky": {"spectrum": "wmap7", "lmax": 64, "dipole_uk": 3364.5},
    "map": {"nside": NSIDE, "splits": ["half1", "half2"]},
    "biposh": {"L_max": 2},
    "channel": [
        {
            "name": name,
            "frequency_ghz": frequency,
            "beam": {"kind": "gaussian", "fwhm_arcmin": 210.0},
            "noise": {"sigma0_uk": 30.0},
            "scan": {"kind": "hit_averaged", "model": "wmap", "sample_period_s": 31.0, "line_of_sight": line},
        }
        for name, frequency, line in (("V1", 61.0, "A"), ("W1", 94.0, "B"))
    ],
}
ONE = {**MODEL, "name": "one-channel", "channel": MODEL["channel"][1:]}
WIDE = {"beam": {"kind": "gaussian", "fwhm_arcmin": 350.0}}
SMALL = {
    **MODEL,
    "name": "two-channels-16",
    "sky": {**MODEL["sky"], "lmax": 40},
    "map": {**MODEL["map"], "nside": 16},
    "channel": [one | WIDE for one in MODEL["channel"]],
}
STRENGTHS = (10.0, 20.0, 40.0)


def ask(jobs):
    """Run jobs in this process."""
    return [data_vectors(job) for job in jobs]


def learned(model):
    """Return the run, and what every data set is tested with."""
    run = config.load(model)
    return run, prepared(run, analysis_of(run), ask)


def worded(found):
    """Return a share and its 95 % interval in words."""
    return f"{found.name}: {found.value:.4f} [{found.low:.4f}, {found.high:.4f}] of {found.count}"


def patterns(draw):
    """Return patterns on the sky of rms 1, shape (npix,), by name."""
    n = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    ecliptic, galactic = (rotation_matrix("ecliptic", to)[2] @ n for to in ("ecliptic", "galactic"))
    alm = draw.normal(size=(healpy.Alm.getsize(6), 2)) @ [1.0, 1j]
    low = [np.where(np.arange(7) <= top, 1.0, 0.0) for top in (2, 6)]
    spot = n.T @ healpy.ang2vec(np.arccos(draw.uniform(-1, 1)), draw.uniform(0, 2 * np.pi))
    found = {
        "l <= 2": healpy.alm2map(healpy.almxfl(alm, low[0]), NSIDE),
        "l <= 6": healpy.alm2map(healpy.almxfl(alm, low[1]), NSIDE),
        "spot": np.exp((spot - 1.0) / 0.1),
        "ecliptic band": np.exp(-0.5 * (ecliptic / 0.2) ** 2),
        "galactic cap": (galactic > 0.6).astype(float),
    }
    return {name: one / np.sqrt(np.mean(one**2)) for name, one in found.items()}


def systematic(kind, draw, context, seed):
    """Return a function from strength to maps with a systematic that no library has, (map, npix), and its name."""
    run, parts = context.run, context.analysis.model.parts
    shared = survey(run)
    maps = np.array(list(simulate.maps(shared, seed)))
    channel = int(draw.integers(len(shared.channels)))
    own = [2 * channel, 2 * channel + 1]
    site = shared.channels[channel].site
    n = np.stack(healpy.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    dipole = site.dipole_uk @ n
    name, pattern = list(patterns(draw).items())[int(draw.integers(5))]
    one = own[int(draw.integers(2))]
    change = np.zeros_like(maps)
    if kind == "additive, fixed to the sky":
        change[own] = pattern
    elif kind == "additive, one split":
        change[one] = pattern
    elif kind == "additive, fixed to the spacecraft":
        # A pick-up that follows the orientation of the beam.
        s, phase = int(draw.integers(1, 3)), draw.uniform(0, 2 * np.pi)
        name = f"order {s}"
        for row in own:
            change[row] = np.real(np.exp(1j * phase) * parts[row].moments.w[s])
    elif kind == "gain, fixed to the sky":
        change[own] = pattern * (maps[own] + dipole) * 1e-3
    elif kind == "gain, one split":
        name = "constant"
        change[one] = (maps[one] + dipole) * 1e-3
    elif kind == "beam, one split":
        name = str(draw.choice(["beam_ellipticity", "beam_coma", "pointing_offset", "beam_width"]))
        step = systematics.get(name).step
        owner = shared.channels[channel].site.channel
        table = config.Effect(name=name, channel=owner, parameters={"amplitude": 2.0 * step})
        changed = survey(with_effects(run, [table]))
        change[one] = np.array(list(simulate.maps(changed, seed)))[one] - maps[one]
    elif kind == "square of the signal":
        name = "T^2"
        change[own] = (maps[own] + dipole) ** 2 * 1e-6
    return (lambda factor: list(maps + factor * change)), f"{kind}: {name}"


KINDS = (
    "additive, fixed to the sky",
    "additive, one split",
    "additive, fixed to the spacecraft",
    "gain, fixed to the sky",
    "gain, one split",
    "beam, one split",
    "square of the signal",
)


def maps(number):
    """Diagnose cases, and print the verdicts and the number of single names, all of which are wrong."""
    models = [learned(one) for one in (ONE, MODEL)]
    verdicts = []
    for case in range(number):
        run, context = models[case // len(KINDS) % 2]
        draw = np.random.default_rng([2026, case])
        make, name = systematic(KINDS[case % len(KINDS)], draw, context, 900 + case)
        wanted, null, factor = STRENGTHS[case % len(STRENGTHS)], context.null, 1.0
        before = context.analysis.data_vector(make(0.0))
        for _ in range(4):
            snr = null.expected_snr(context.analysis.data_vector(make(factor)) - before)
            factor *= wanted / snr
        found = diagnose_data(ObservedMaps(context, make(factor), ask), f"case-{case}").to_json()
        named = [(e["name"], e["channel"]) for e in found["effects"]]
        verdicts.append(found["verdict"])
        row = [case, run.name, name, wanted, f"{found['gap']['p_value']:.1e}", found["verdict"], named, found["notes"]]
        print(json.dumps(row, ensure_ascii=False), flush=True)
    print({verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))})


def draws(number):
    """Test the true effects of draws in parts of the data, and print the share that is refused."""
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.models import linear_model
    from mcsim.benchmark.sampler import CaseSampler
    from mcsim.datavector.candidate import columns_of, parts_of
    from mcsim.diagnosis.consistency import Action, Slices
    from mcsim.stats.intervals import share

    refused, unmeasured, by_test, strengths = [], [], {}, []
    for model in (ONE, MODEL):
        run, context = learned(model)
        linear = linear_model(context)
        prior = Prior(none=0.0, one=0.7, two=0.3, left_out=0.0, invented=0.0, weakest=5.0, strongest=50.0)
        sampler = CaseSampler(prior, linear)
        kinds = sampler.kinds(7, number)
        ensemble = context.ensemble.extended
        kept = len(ensemble.simulations) - len(linear.data)
        seen = replace(ensemble, simulations=ensemble.simulations[:kept])
        data = ensemble.simulations[kept:] + ensemble.offset
        whole = np.concatenate([linear.templates, context.bank.slice_matrix])
        beside = len(context.bank.slice_matrix)
        slices = Slices(seen, data[0], beside, run.map.splits, context.analysis.model.lmax, context.settings)
        for case in range(number // 2):
            drawn = sampler.draw(kinds, 7, case)
            members = [one.candidate for one in drawn.members]
            candidates = [linear.candidates[member] for member in members]
            if any(
                one.effect.parametrization.stochastic and not one.effect.parametrization.mean_response
                for one in candidates
            ):
                continue
            t = whole[:, columns_of(linear.candidates, members)]
            z = data[case % len(data)] + t @ np.concatenate([one.coordinates for one in drawn.members])
            fit = linear.null.fit(z[: len(z) - beside], t[: len(z) - beside])
            actions = []
            for member, theta, covariance in parts_of(linear.candidates, members, fit):
                own = whole[:, list(linear.candidates[member].columns)]
                actions.append(Action.of(own @ theta, own, theta, covariance))
            found = replace(slices, z=z).findings(candidates, actions)
            refused.append(found.contradict(context.settings))
            unmeasured.append(len(members) == 1 and not found.measured)
            strengths.append(drawn.members[0].strength)
            for own in found.comparisons:
                for one in own:
                    by_test.setdefault(one.kind, []).append(
                        (one.pvalue <= 0.05, one.odds >= context.settings.absence_odds)
                    )
            for one in found.maps:
                by_test.setdefault("left in the maps", []).append((one.pvalue <= 0.05, False))
            if refused[-1]:
                print(
                    "refused",
                    run.name,
                    [c.label for c in candidates],
                    [round(m.strength, 1) for m in drawn.members],
                    f"{found.pvalue:.1e} {found.odds:.1f}",
                    [
                        (o.kind, o.slices, np.round(o.amplitudes, 2), np.round(o.errors, 2), f"{o.pvalue:.1e}")
                        for own in found.comparisons
                        for o in own
                        if o.pvalue < 1e-3 or o.odds > 20
                    ],
                    flush=True,
                )
    print(worded(share("true names refused", refused)))
    print(worded(share("single ones that no two parts measure", unmeasured)))
    for kind, rows in by_test.items():
        low, absent = np.mean(rows, axis=0)
        print(f"{kind}: {len(rows)} tests, p <= 0.05 in {low:.3f}, odds of absence in {absent:.4f}")


def true(number):
    """Attribute draws of one effect, S/N 5 to 20, without and with effects on request as rivals of a single name."""
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.models import linear_model
    from mcsim.benchmark.sampler import CaseSampler
    from mcsim.datavector.analysis import on_request
    from mcsim.datavector.candidate import numbered
    from mcsim.diagnosis.refine import Refined
    from mcsim.diagnosis.rivals import in_place, with_candidates
    from mcsim.diagnosis.selection import Selection, attribute
    from mcsim.stats.detection import cosines
    from mcsim.stats.intervals import share

    for model in (ONE, MODEL):
        run, context = learned(model)
        sky = ObservedMaps(context, list(simulate.maps(survey(run), 0)), ask)
        asked = [one for one in on_request(context.analysis) if not one.random_response]
        rivals = list(sky.responses(asked, context.settings.channel_skies))
        linear = linear_model(context)
        own = {"null": linear.null, "calibration": linear.calibration, "templates": linear.templates}
        known = replace(context, candidates=linear.candidates, **own)
        kept = len(context.ensemble.simulations) - len(linear.data)
        every, wide = context.ensemble.extended, context.ensemble.first(kept).extended.gaussian
        data, whole = (
            every.simulations[kept:] + every.offset,
            np.concatenate([known.templates, context.bank.slice_matrix]),
        )
        for null, t in ((known.null, known.templates), (wide, whole)):
            for rival, response in rivals:
                groups = [one.columns for one in numbered([*known.candidates, rival])]
                together = np.concatenate([t, response[: len(t)]], axis=1)
                like = cosines(null.whiten_groups(together, groups))[-1, :-1]
                near = {c.label: round(r, 3) for c, r in zip(known.candidates, like, strict=True) if r > 0.7}
                print(run.name, f"{len(t)} numbers, cosines with {rival.label}:", near)
        sampler, rows = CaseSampler(Prior(weakest=5.0, strongest=20.0), linear), []
        for case in range(number // 2):
            (member,) = sampler.members(np.random.default_rng([1, case]), 1)
            z = data[case % len(data)] + whole[:, list(known.candidates[member.candidate].columns)] @ member.coordinates
            x = z[: len(linear.null.mean)]
            found = attribute(Selection(known.null, x, known.templates, known.candidates, known.calibration)).if_named(
                known.settings
            )
            row, counted = said(found, known, member.identity), []
            for null, seen, t in ((known.null, x, known.templates), (wide, z, whole)):
                named, counted = found, [*counted, *row]
                if len(found.explanations) == 1:
                    refined = Refined(found, t, known.candidates, t)
                    members = found.explanations[0].members
                    places = in_place(null, seen, refined, members, rivals, known.settings)
                    if near := [rivals[index] for index, _ in places]:
                        more = with_candidates(known, near)
                        named = attribute(Selection(more.null, x, more.templates, more.candidates, more.calibration))
                        counted[-4:] = said(named.if_named(more.settings), more, member.identity)
                if named is not found and counted[-4:] != row:
                    print(run.name, member.identity, round(member.strength, 1), len(seen), [c.label for c, _ in near])
            rows.append([*row, *counted])
        words = ("the right name alone", "the truth in the set", "a wrong name alone", "no name")
        rows_of = ("without rivals", "rivals by the data vector", "rivals by the numbers beside it too")
        for place, what in enumerate(f"{one}, {how}" for how in rows_of for one in words):
            print(run.name, worded(share(what, [row[place] for row in rows])), flush=True)


def said(found, context, identity):
    """Return whether the truth is named alone, or in a set, whether another name is given alone, or none."""
    sets = [{context.candidates[index].identity for index in one.members} for one in found.explanations]
    return [sets == [{identity}], {identity} in sets, len(sets) == 1 and sets != [{identity}], not sets]


def further(number):
    """Look beside a strong effect that acts alone: how often is the global p-value of another small?

    Print the pulls of its amplitudes, too.
    """
    from mcsim.datavector.candidate import columns_of
    from mcsim.diagnosis.subsets import Subsets
    from mcsim.stats.intervals import share
    from mcsim.stats.scattered import Acting

    run, context = learned(SMALL)
    null, settings, skies = context.null, context.settings, context.settings.constrained_skies
    tables = [("noise_level", "V1", 0.3), ("noise_level", "V1", 0.6), ("beam_ellipticity", "W1", 0.25)]
    for name, channel, amplitude in (*tables, ("beam_ellipticity", "W1", 0.5), ("beam_ellipticity", "W1", 1.0)):
        table = config.Effect(name=name, channel=channel, parameters={"amplitude": amplitude})
        jobs = [context.analysis.job(seeded(one, 2028)) for one in (run, with_effects(run, [table]))]
        before, after = (np.concatenate(ask([replace(one, count=number)])) for one in jobs)
        change, t = (after - before).mean(axis=0), context.templates.copy()
        (member,) = [k for k, one in enumerate(context.candidates) if one.identity == (name, channel)]
        columns = columns_of(context.candidates, [member])
        # Exact at this amplitude, as the template of an effect that was simulated at it.
        theta = null.fit(null.mean + change, t[:, columns]).amplitudes
        t[:, columns] += np.outer(change - t[:, columns] @ theta, theta / (theta @ theta))
        every, charged = [one.columns for one in context.candidates], [*context.candidates]
        groups = null.whiten_groups(t, every)
        acting = Acting.of(null, t, every, member, (before[:skies], after[:skies]))
        charged[member] = replace(charged[member], acting=acting)
        rows = []
        offset = context.ensemble.offset
        for x in after[skies:] + offset:
            y = null.whiten(x)
            searches = (
                Subsets(null, y, groups, c, context.calibration, settings) for c in (context.candidates, charged)
            )
            rows.append([one.beside(np.array([[member]])).min() for one in searches])
        print(f"{name} of {channel}, {amplitude}: S/N {null.expected_snr(change):.0f}")
        pulls = pulls_of(null, t[:, columns], before + offset, after + offset, skies)
        print("    pulls of the amplitudes: mean", pulls.mean(axis=0).round(2), "width", pulls.std(axis=0).round(2))
        for place, what in enumerate(("its scatter ignored", "its scatter charged")):
            for level in (0.05, 0.005):
                small = [row[place] <= level for row in rows]
                print("   ", worded(share(f"{what}, p <= {level}", small)), flush=True)


def pulls_of(null, t, before, after, skies):
    """Return pulls of the amplitudes of an effect, shape (data, K); every ``skies`` pairs tell those of the next."""
    from mcsim.stats.scattered import with_scatter

    change, found = (after - before).mean(axis=0), []
    theta = null.fit(null.mean + change, t).amplitudes
    for first in range(0, len(after) - 2 * skies + 1, skies):
        own = slice(first, first + skies)
        response = (after - before)[own].mean(axis=0)
        exact = t + np.outer(response - change, theta / (theta @ theta))
        for x in after[first + skies : first + 2 * skies]:
            fit = with_scatter(null, exact, null.fit(x, exact), before[own], after[own])
            found.append((fit.amplitudes - theta) / fit.errors)
    return np.array(found)


def bent(number):
    """Diagnose maps with an ellipticity of 0.25, S/N 22, and print the pulls of its two amplitudes."""
    run, context = learned(SMALL)
    table = config.Effect(name="beam_ellipticity", channel="W1", parameters={"amplitude": 0.25})
    shared, found = survey(with_effects(seeded(run, 5000), [table])), []
    for case in range(number):
        maps_uk = list(simulate.maps(shared, case))
        verdict = diagnose_data(ObservedMaps(context, maps_uk, ask), f"bent-{case}")
        for one in verdict.sets[:1]:
            if [(c.name, c.channel) for c in map(verdict.candidates.__getitem__, one.candidates)] == [
                ("beam_ellipticity", "W1")
            ]:
                found.append((np.array(one.coordinates) - [0.25, 0.0]) / one.errors)
    width = np.sqrt(np.mean(np.square(found)))
    error = width / np.sqrt(4 * len(found))
    print(f"{len(found)} of {number} are named first; rms of the pulls {width:.2f} +- {error:.2f}")
    print("mean", np.mean(found, axis=0).round(2), "width", np.std(found, axis=0, ddof=1).round(2))


def noisy(number):
    """Diagnose maps with more noise in one channel; print how often that is named, pulls, and p-values of the rest."""
    run, context = learned(SMALL)
    for amplitude in (0.2, 0.5, 1.0):
        table = config.Effect(name="noise_level", channel="W1", parameters={"amplitude": amplitude})
        shared, found = survey(with_effects(seeded(run, 6000), [table])), []
        for case in range(number):
            verdict = diagnose_data(ObservedMaps(context, list(simulate.maps(shared, case)), ask), f"noisy-{case}")
            if verdict.kind == "effect" and verdict.effects[0].name == "noise_level":
                one = verdict.sets[0]
                found.append((one.pvalue, (one.coordinates[0] - amplitude) / one.errors[0]))
        p, pulls = np.array(found).reshape(-1, 2).T
        print(f"{amplitude}: {len(found)} of {number} are named; p-values of the rest {np.sort(p).round(3).tolist()}")
        print(f"    pulls {np.mean(pulls):.2f} in the mean, rms {np.sqrt(np.mean(pulls**2)):.2f}", flush=True)


def pairs(number):
    """Diagnose maps with two effects, each at S/N 5 to 20, and print how often both are named."""
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.models import linear_model
    from mcsim.benchmark.sampler import CaseSampler
    from mcsim.stats.intervals import share

    run, context = learned(MODEL)
    sampler = CaseSampler(Prior(weakest=5.0, strongest=20.0), linear_model(context))
    rows = []
    for case in range(number):
        members = sampler.members(np.random.default_rng([22, case]), 2)
        tables = [config.Effect(name=m.name, channel=m.channel, parameters=m.parameters) for m in members]
        found = list(simulate.maps(survey(with_effects(run, tables)), 7000 + case))
        verdict = diagnose_data(ObservedMaps(context, found, ask), f"pair-{case}").to_json()
        sets = [verdict["effects"], *verdict["alternatives"]]
        answers = [{(e["name"], e["channel"]) for e in one} for one in sets if one]
        truth = {one.identity for one in members}
        wrong = verdict["verdict"] in ("effect", "mixture") and not answers[0] <= truth
        rows.append((truth in answers, truth in answers[:1], verdict["verdict"] == "unknown", wrong))
        strengths = {f"{m.name} {m.channel or ''}": round(m.strength, 1) for m in members}
        row = [case, strengths, verdict["verdict"], [sorted(map(str, one)) for one in answers], verdict["notes"]]
        print(json.dumps(row, ensure_ascii=False), flush=True)
    for place, what in enumerate(("truth in the set", "truth first", "unknown", "a wrong name alone")):
        print("   ", worded(share(what, [row[place] for row in rows])))


def several(number):
    """Attribute draws of one to five effects, each at S/N 5 to 20, and print how often all of them are named."""
    from mcsim.benchmark.case import Prior
    from mcsim.benchmark.models import linear_model
    from mcsim.benchmark.sampler import CaseSampler
    from mcsim.diagnosis.selection import Selection, attribute
    from mcsim.stats.intervals import share

    linear = linear_model(learned(MODEL)[1])
    sampler, settings = CaseSampler(Prior(weakest=5.0, strongest=20.0), linear), DiagnosisSettings()
    for size in range(1, 6):
        rows = []
        for case in range(number):
            members = sampler.members(np.random.default_rng([size, case]), size)
            truth = {one.identity for one in members}
            responses = [linear.response([one]) for one in members]
            rivals = np.array([identity not in truth for identity in linear.identities])
            alike = 0.0
            for one, response in zip(members, responses, strict=True):
                others = rivals | np.isin(np.arange(len(rivals)), [o.candidate for o in members if o is not one])
                alike = max(alike, float(linear.cosines(response)[others].max()))
            x = linear.data[case % len(linear.data)] + sum(responses)
            found = attribute(Selection(linear.null, x, linear.templates, linear.candidates, linear.calibration))
            said = found.if_named(settings)
            answers = [{linear.identities[member] for member in one.members} for one in said.explanations]
            wrong = said.verdict in ("effect", "mixture") and not answers[0] <= truth
            rows.append((alike, truth in answers, truth in answers[:1], said.verdict == "unknown", wrong))
        for which, top in (("all", 1.1), ("|rho| <= 0.7", 0.7)):
            kept = [row for row in rows if row[0] <= top]
            print(f"{size} effects, {which}: {len(kept)} draws")
            for place, what in enumerate(("truth in the set", "truth first", "unknown", "a wrong name alone"), 1):
                print("   ", worded(share(what, [row[place] for row in kept])))


def null(number):
    """Test simulations of three models against others, and print how often p-values are small."""
    from mcsim.stats.gaussian import residual_pvalue
    from mcsim.stats.intervals import share
    from mcsim.stats.look_elsewhere import global_test

    for model in (SMALL, ONE, MODEL):
        run, context = learned(model)
        known, fresh = context.null, context.analysis.job(seeded(run, 2027))
        jobs = [replace(fresh, first=first, count=100) for first in range(0, number, 100)]
        data = np.concatenate(ask(jobs)) + context.ensemble.offset
        tests = [global_test(known, x, context.always, context.calibration) for x in data]
        plain = residual_pvalue([one.chi2 for one in tests], known.dimension, known.dof)
        print(f"{run.name}: p = {known.dimension}, {known.n_sims} simulations, Var u = {known.scale_variance:.4f}")
        for level in (0.05, 0.02, 0.001):
            print("   ", worded(share(f"gap, p <= {level}", [one.pvalue <= level for one in tests])))
            print("   ", worded(share(f"chi^2, p <= {level}", [one.omnibus <= level for one in tests])))
            print("   ", worded(share(f"chi^2 for Var u = 0, p <= {level}", plain <= level)), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    commands = (maps, true, further, bent, noisy, draws, pairs, several, null)
    {one.__name__: one for one in commands}[sys.argv[1]](int(sys.argv[2]) if len(sys.argv) > 2 else 42)
