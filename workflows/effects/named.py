"""How often a diagnosis names each effect that is proposed on request: draws of the data vector.

    python workflows/effects/named.py MODEL.toml [--effects NAME ...] [--draws N] [--skies N] [--workers N]

All effects of the library are proposed, those on request too. A draw is a data vector of a simulation that the
covariance does not know, plus the response to one effect in a drawn channel and direction, with an expected S/N
uniform in its logarithm from 5 to 20. The first N of them are full skies too, if that is asked for: maps made sample
by sample, diagnosed to the end. What is learned of the model is kept in the cache.
"""

import argparse
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from mcsim import config, systematics
from mcsim.benchmark.case import Drawn, Prior
from mcsim.benchmark.models import LinearModel, linear_model
from mcsim.benchmark.sampler import CaseSampler
from mcsim.datavector.analysis import analysis_of, data_vectors
from mcsim.datavector.campaign import asking, batch, seeded, with_effects
from mcsim.datavector.settings import DiagnosisSettings
from mcsim.diagnosis.api import prepared
from mcsim.diagnosis.context import DiagnosisContext
from mcsim.diagnosis.observed_maps import ObservedMaps
from mcsim.diagnosis.selection import Selection, attribute
from mcsim.diagnosis.verdict import diagnose_data
from mcsim.simulation import sampled
from mcsim.simulation.survey import survey
from mcsim.stats.intervals import share

ONE = Prior(none=0.0, one=1.0, two=0.0, left_out=0.0, invented=0.0, weakest=5.0, strongest=20.0)
UNLIKE, ALIKE = 0.7, 0.9
"""Largest cosine with another candidate up to which the truth is to be named first; from which, to be in the set."""
SEED = 20250101


def main() -> None:
    """Print the shares of draws in which the truth is named first, is in the set, and another effect is named."""
    on_request = sorted(name for name, kind in systematics.catalogue().items() if not kind.proposed)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--effects", nargs="*", choices=on_request, default=on_request)
    parser.add_argument("--draws", type=int, default=200, help="of each effect")
    parser.add_argument("--skies", type=int, default=0, help="of each effect, made sample by sample")
    parser.add_argument("--workers", type=int, default=0)
    arguments = parser.parse_args()
    run, settings = config.load(arguments.model), DiagnosisSettings(including=tuple(on_request))
    analysis = analysis_of(run, settings=settings)
    with batch(arguments.workers) as call, asking(call, quiet=False) as ask:
        known = prepared(run, analysis, ask)
    model = linear_model(known)
    print(f"{len(model.candidates)} candidates, a data vector of {len(model.templates)}")
    print(f"{'effect':24s} {'S/N per step':>12s}  {'cosine':>6s}  nearest other")
    for name in arguments.effects:
        describe(model, name)
    for name in arguments.effects:
        cases = list(itertools.islice(draws(model, name), arguments.draws))
        judge(model, name, cases)
        for case, drawn in cases[: arguments.skies]:
            diagnose(known, case, drawn)


def describe(model: LinearModel, name: str) -> None:
    """Print the expected S/N of a step, and the candidate that looks most alike."""
    for candidate in model.candidates:
        if candidate.name == name:
            response = candidate.effect.step * model.templates[:, candidate.columns[0]]
            cosines = np.where([one.identity == candidate.identity for one in model.candidates], 0.0, 1.0)
            cosines *= model.cosines(response)
            nearest = model.candidates[int(np.argmax(cosines))]
            snr = model.null.expected_snr(response)
            print(f"{candidate.label:28s} {snr:8.2f}  {cosines.max():6.3f}  {nearest.label}")


def draws(model: LinearModel, name: str) -> Iterator[tuple[int, Drawn]]:
    """Yield drawn cases of one effect."""
    sampler = CaseSampler(ONE, model)
    if name not in sampler.names:
        return
    for case in itertools.count():
        drawn = sampler.draw(["one"] * (case + 1), SEED, case)
        if drawn.members[0].name == name:
            yield case, drawn


def diagnose(known: DiagnosisContext, case: int, drawn: Drawn) -> None:
    """Print the verdict on maps that are made sample by sample."""
    (member,) = drawn.members
    effect = config.Effect(name=member.name, channel=member.channel, parameters=dict(member.parameters))
    maps = [map_uk for _, map_uk in sampled.maps(survey(with_effects(seeded(known.run, SEED + case), [effect])), 0)]
    found = diagnose_data(ObservedMaps(known, maps, lambda jobs: [data_vectors(job) for job in jobs]), str(case))
    verdict = found.to_json()
    sets = [verdict["effects"], *verdict["alternatives"]]
    named = [" + ".join(f"{one['name']} ({one['channel']})" for one in members) for members in sets]
    truth = f"{member.name} ({member.channel})"
    first = verdict["effects"][0] if verdict["effects"] else {"amplitude": np.nan, "sigma": np.nan}
    answer = "right" if named[0] == truth else "in the set" if truth in named else "not named"
    print(
        f"{truth} of S/N {member.strength:.1f}: {answer}; {verdict['verdict']}: {' or '.join(named)}; "
        f"amplitude {member.parameters['amplitude']:.3g}, fitted {first['amplitude']:.3g} +- {first['sigma']:.2g}",
        flush=True,
    )


def judge(model: LinearModel, name: str, cases: Sequence[tuple[int, Drawn]]) -> None:
    """Print how often the truth was named."""
    first, within, wrong, unlike, alike, seen = [], [], [], [], [], []
    for case, drawn in cases:
        response = model.response(drawn.members)
        x = model.data[case % len(model.data)] + response
        said = attribute(Selection(model.null, x, model.templates, model.candidates, model.calibration))
        said = said.if_named(DiagnosisSettings())
        answers = [frozenset(model.identities[m] for m in one.members) for one in said.explanations]
        other = [identity not in drawn.identities for identity in model.identities]
        cosine = float(np.max(model.cosines(response)[other]))
        first.append(bool(answers) and answers[0] == drawn.identities)
        within.append(drawn.identities in answers)
        wrong.append(said.verdict == "effect" and not answers[0] <= drawn.identities)
        unlike.append(cosine <= UNLIKE)
        alike.append(cosine >= ALIKE)
        seen.append(said.gap.pvalue <= 0.05)
    rows = [
        ("found (p <= 0.05)", seen),
        ("named first", first),
        (f"named first, cosine <= {UNLIKE:g}", [f for f, u in zip(first, unlike, strict=True) if u]),
        ("in the set", within),
        (f"in the set, cosine >= {ALIKE:g}", [w for w, a in zip(within, alike, strict=True) if a]),
        ("another one named alone", wrong),
    ]
    for what, hits in rows:
        if hits:
            found = share(what, hits)
            print(f"{name:24s} {what:30s} {found.value:.3f} [{found.low:.3f}, {found.high:.3f}] of {found.count}")


if __name__ == "__main__":
    main()
