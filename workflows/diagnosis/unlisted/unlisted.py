"""Measure how often a reconstruction says what an effect is that the library lacks, and how often it is fooled.

python unlisted.py null MAPS         maps of the model: nothing is there
python unlisted.py library EACH      every effect of the library, as if it were not there, at S/N 8, 12 and 20
python unlisted.py foreign A:B [yes] systematics of no library (../names/names.py), cases A to B - 1; yes: diagnosed too
python unlisted.py summary FILE...   the figures and the picture of what these have printed
"""

import json
import os
import sys
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parent.parent / "names"))

from names import KINDS, MODEL, ONE, STRENGTHS, ask, learned, systematic

from mcsim.datavector.campaign import with_effects
from mcsim.datavector.candidate import Candidate
from mcsim.diagnosis import unlisted
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.reconstruction import simulated_scores
from mcsim.simulation import simulate
from mcsim.simulation.survey import survey
from mcsim.stats.intervals import removed, share
from mcsim.stats.look_elsewhere import global_test
from mcsim.systematics import catalogue

PICTURE = Path(__file__).parents[2] / "pictures" / "unlisted.png"
ANY = None
TRUTH = {
    "beam_coma": ("beam", "scan", ("order 1", "order 3")),
    "beam_ellipticity": ("beam", "scan", ("order 2",)),
    "beam_sidelobe": ("beam", "scan", ("order 0",)),
    "beam_width": ("beam", "scan", ("order 0",)),
    "pixelization": ("beam", "scan", ("order 0", "order 1")),
    "pointing_jitter": ("beam", "scan", ("order 0",)),
    "pointing_offset": ("beam", "scan", ("order 1",)),
    "time_constant": ("beam", "scan", ("order 1",)),
    "bandpass_mismatch": ("added", "sky", ANY),
    "dipole_residual": ("added", "sky", ("dipole",)),
    "foreground_residual": ("added", "sky", ANY),
    "monopole_residual": ("added", "sky", ("monopole",)),
    "orbital_dipole": ("added", "Sun", ("dipole",)),
    "sidelobe_pickup": ("added", "spacecraft", ANY),
    "spin_synchronous_offset": ("added", "time", ("spin 1",)),
    "calibration": ("gain", "", ("constant",)),
    "gain_drift": ("gain", "time", ("year",)),
    "gain_spin": ("gain", "time", ("spin 1",)),
    "nonlinearity": ("square", "", ANY),
    "excess_noise": ("noise", "", ANY),
    "noise_anisotropy": ("noise", "", ("latitude ecliptic",)),
    "noise_level": ("noise", "", ("level",)),
    "lensing": ("power", "", ANY),
    "point_sources": ("power", "", ANY),
    "spectrum": ("power", "", ANY),
    "boost": ("modulation", "sky", ("degree 1",)),
    "dipole_modulation": ("modulation", "sky", ("degree 1",)),
    "quadrupole_modulation": ("modulation", "sky", ("degree 2",)),
}
"""Stage, frame and kinds that are right for each effect of the library."""

FOREIGN = {
    "additive, fixed to the sky": ("added", "sky", ANY),
    "additive, one split": ("added", "sky", ANY),
    "additive, fixed to the spacecraft": ("added", "spacecraft", ANY),
    "gain, fixed to the sky": ("gain", "sky", ANY),
    "gain, one split": ("gain", "", ("constant",)),
    "beam, one split": ("beam", "scan", ANY),
    "square of the signal": ("square", "", ANY),
}


@cache
def known(which):
    """Return run, context, scene and search of a model."""
    run, context = learned({"one": ONE, "two": MODEL}[which])
    scene = simulated_scores.scene_of(context.analysis.model)
    return run, context, scene, simulated_scores.search_of(context.analysis, scene, scored)


def scored(jobs):
    """Return the scores of jobs, computed in this process."""
    return [simulated_scores.scores(job) for job in jobs]


def scored_by(told, truth, channel):
    """Return which words of a description are right, of what is true: stage, frame, kinds and splits, or ANY."""
    stage, frame, kinds, splits = truth
    return {
        "stage": told["stage"] == stage,
        "frame": told["frame"] == frame,
        "kind": kinds is ANY or told["kind"].startswith(kinds),
        "channel": told["channel"] == channel,
        "split": splits is ANY or told["split"] in splits,
    }


def row(kind, name, truths, channel, strength, verdict, found, reduction):
    """Print what is found beside what is there, as a line of JSON.

    Of several truths each description is scored with that with which most of its words are right.
    """
    right = []
    for told in [asdict(found[0]), found[0].rival] if found else []:
        if told is not None:
            each = [scored_by(told, truth, channel) for truth in truths]
            right.append(max(each, key=lambda words: sum(words.values())))
    shown = [
        [one.says, one.pvalue, one.rms_uk, one.rival and one.rival["says"], list(one.alternatives)] for one in found
    ]
    held = None
    if reduction is not None:
        held = [reduction.achieved.value, reduction.achieved.sigma, reduction.before.value, reduction.before.sigma]
    print(json.dumps([kind, name, channel, strength, verdict, right, shown, held], ensure_ascii=False), flush=True)


def null(number):
    """Reconstruct maps of the model, whose gap is tested too."""
    for which in ("two", "one"):
        run, context, scene, search = known(which)
        shared, model = survey(run), context.analysis.model
        for case in range(int(number) // 2):
            maps = list(simulate.maps(shared, 50_000 + case))
            more, wider = simulated_scores.with_peaks(context.analysis, scene, search, maps, scored)
            found = wider.run(simulated_scores.scores_of_maps(model, more, maps))
            x = context.analysis.data_vector(maps)
            p = global_test(context.null, x, context.always, context.calibration).pvalue
            print(json.dumps(["null", which, p, [one.pvalue for one in found]]), flush=True)


def scaled(context, candidate, basis, strength):
    """Return an effect with the amplitude at which the data vector has an expected S/N."""
    null, run = context.null, context.run
    for one in context.candidates:  # the mean response is known
        if one.label == candidate.label:
            place = candidate.basis.index(basis)
            step = basis.parametrization.coordinates(basis)[place]
            return basis.scaled(strength / null.expected_snr(context.bank.matrix[:, one.columns[place]] * step))

    def vectors(runs):
        return np.mean([context.analysis.data_vector(list(simulate.maps(survey(runs), k))) for k in range(4)], axis=0)

    factor, before = 1.0, vectors(run)
    for _ in range(3):
        after = vectors(with_effects(run, [candidate.table(basis.scaled(factor))]))
        factor *= strength / null.expected_snr(after - before)
    return basis.scaled(factor)


def library(each, span="0:99"):
    """Reconstruct maps with an effect of the library; amplitudes give an S/N in the data vector."""
    run, context, scene, search = known("two")
    model = context.analysis.model
    for turn in range(int(each)):
        for number in list(range(len(TRUTH)))[slice(*map(int, span.split(":")))]:
            name, truth = list(TRUTH.items())[number]
            kind = catalogue()[name]
            draw = np.random.default_rng([2027, number, turn])
            strength = (8.0, 12.0, 20.0)[turn % 3]
            owner = None if kind.scope == "common" else str(draw.choice(model.channels))
            candidate = Candidate(kind, owner, tuple(range(len(kind.parametrization.basis()))))
            basis = candidate.basis[int(draw.integers(len(candidate.basis)))]
            seed = 70_000 + turn
            try:
                acting = survey(with_effects(run, [candidate.table(scaled(context, candidate, basis, strength))]))
            except Exception as error:
                print(json.dumps(["left out", name, str(error)]), flush=True)
                continue
            maps = list(simulate.maps(acting, seed))
            found, reduction = unlisted.structures_of(ObservedMaps(context, maps, ask), scene, search, scored)
            row("library", name, [(*truth, ("alike",))], owner, strength, "", found, reduction)


def foreign(cases, diagnosed="no"):
    """Reconstruct maps with systematics of no library; diagnose them first if that is wanted."""
    for case in range(*map(int, cases.split(":"))):
        which = ("one", "two")[case // len(KINDS) % 2]
        run, context, scene, search = known(which)
        draw = np.random.default_rng([2026, case])
        kind = KINDS[case % len(KINDS)]
        state = np.random.default_rng([2026, case])
        channel = int(state.integers(len(run.channels)))
        make, name = systematic(kind, draw, context, 900 + case)
        wanted, factor = STRENGTHS[case % len(STRENGTHS)], 1.0
        before = context.analysis.data_vector(make(0.0))
        for _ in range(4):
            factor *= wanted / context.null.expected_snr(context.analysis.data_vector(make(factor)) - before)
        maps = make(factor)
        change = [float(np.std(a - b)) for a, b in zip(maps, make(0.0), strict=True)]
        own = change[2 * channel : 2 * channel + 2]
        split = "alike" if min(own) > 0.0 else run.map.splits[int(np.argmax(own))]
        truths = [(*FOREIGN[kind], (split,))]
        owner = run.channels[channel].name
        data = ObservedMaps(context, maps, ask)
        verdict = diagnose_data(data, f"case-{case}").kind if diagnosed == "yes" else ""
        found, reduction = unlisted.structures_of(data, scene, search, scored)
        row("foreign", name, truths, owner, wanted, verdict, found, reduction)


def told(metric):
    """Return a share with its interval."""
    return f"{metric.name}: {metric.value:.3f} [{metric.low:.3f}, {metric.high:.3f}] of {metric.count}"


WORDS = ("stage", "frame", "kind", "channel", "split")


def right(one, word="all", place=0):
    """Return True if the first description of a case, or another one, is right in a word, or in all of them."""
    said = one[5][place] if place < len(one[5]) else {}
    return bool(said) and (all(said.values()) if word == "all" else said[word])


def credit(own):
    """Print what descriptions are worth: one of a pair counts half, so that saying two gains nothing by itself."""
    worth = np.array([sum(right(one, place=k) for k in range(2)) / max(len(one[5]), 1) for one in own])
    error = np.std(worth) / np.sqrt(len(worth))
    print(f"   all right, one of a pair half: {worth.mean():.3f} +- {error:.3f} of {len(worth)}")
    print("  ", told(share("all right in one of what is said", [right(one) or right(one, place=1) for one in own])))
    print("  ", told(share("a pair", [len(one[5]) > 1 for one in own])))


def summary(files):
    """Print the figures of lines, and draw them."""
    rows = [json.loads(line) for file in files for line in Path(file).read_text().splitlines() if line[:1] == "["]
    nulls = [one for one in rows if one[0] == "null"]
    if nulls:
        print(told(share("maps of the model with a structure", [bool(one[3]) for one in nulls])))
        gaps = [one for one in nulls if one[2] <= 0.05]
        both = [one[2] <= 0.05 and bool(one[3]) for one in nulls]
        print(told(share("maps of the model with a gap and a structure", both)))
        print(told(share("of those with a gap, with a structure", [bool(one[3]) for one in gaps])))
    titles = {
        "library": "effects of the library, left out",
        "foreign": "systematics of no library",
        "further": "of published error budgets",
    }
    drawn = {group: own for group in titles if (own := [one for one in rows if one[0] == group])}
    if not drawn:
        return
    figure = Figure(figsize=(4.0 * len(drawn), 3.2), layout="constrained")
    panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
    for axes, (group, own) in zip(panels, drawn.items(), strict=True):
        strengths = sorted({one[3] for one in own})
        for place, strength in enumerate(strengths):
            cases = [one for one in own if one[3] == strength]
            shares = [share(word, [right(one, word) for one in cases]) for word in (*WORDS, "all")]
            values = np.array([[one.value, one.value - one.low, one.high - one.value] for one in shares]).T
            where = np.arange(len(shares)) + 0.2 * (place - 0.5 * (len(strengths) - 1))
            label = f"S/N {strength:.0f}, {len(cases)} cases"
            axes.errorbar(where, values[0], np.maximum(values[1:], 0.0), fmt="o", markersize=4, capsize=2, label=label)
            print(group, f"S/N {strength:.0f}", *map(told, shares), sep="\n    ")
        axes.axhline(0.8, color="black", linestyle=":", linewidth=0.8)
        axes.set_xticks(range(len(WORDS) + 1), [*WORDS, "all"])
        axes.set_ylim(0.0, 1.03)
        axes.set_title(titles[group], fontsize=10)
        axes.legend(frameon=False, fontsize=8, loc="lower left")
        report(group, own)
    panels[0].set_ylabel("share of cases that are right")
    figure.savefig(PICTURE, dpi=120)


def report(group, own):
    """Print the figures of a group."""
    print(group)
    shares = [share("a structure", [bool(one[6]) for one in own])]
    shares += [share(f"right {word}", [right(one, word) for one in own]) for word in (*WORDS, "all")]
    held = [one[7] for one in own if one[7] is not None and one[7][2] > 0.0]
    if len(held) > 2:
        pairs = [(one[2], one[2] * (1.0 - one[0])) for one in held]
        shares.append(removed(f"excess removed from held-out data, {len(held)} of {len(own)} measured", pairs))
        precise = [one[0] >= 0.7 for one in held if one[1] < 0.3]
        shares.append(share("reduction of 0.7 or more, where its error is below 0.3", precise))
    for one in shares:
        print("  ", told(one))
    credit(own)
    for one in own:
        if not right(one):
            print("   not right:", one[1], one[2], one[3], one[5], [row[0] for row in one[6]])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if sys.argv[1] == "summary":
        summary(sys.argv[2:])
    else:
        {"null": null, "library": library, "foreign": foreign}[sys.argv[1]](*sys.argv[2:])
