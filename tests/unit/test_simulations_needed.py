"""How many simulations of a model, and skies of a response, are made."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mcsim import config
from mcsim.datavector import campaign, responses
from mcsim.datavector.analysis import Analysis, Job, analysis_of
from mcsim.datavector.settings import DiagnosisSettings
from refusals import refused


@pytest.fixture(scope="module")
def four() -> Analysis:
    channels = [
        {
            "name": f"W{number}",
            "beam": {"kind": "gaussian", "fwhm_arcmin": 900.0},
            "noise": {"sigma0_uk": 50.0},
            "scan": {"kind": "parallel_transport", "psi0_deg": 20.0},
        }
        for number in range(4)
    ]
    sections = {"sky": {"spectrum": "wmap7", "lmax": 16}, "map": {"nside": 8, "splits": ["half1", "half2"]}}
    run = config.load({"schema": 1, "name": "four", "channel": channels, "ensemble": {"seed": 3}, **sections})
    return analysis_of(run, settings=DiagnosisSettings(redundant=1e-12))


def counted(analysis: Analysis, draw: Callable[[int], NDArray[np.float64]]) -> int:
    """Return how many simulations of the model are asked for, one after the other, if they are drawn like this."""
    asked = []

    def ask(jobs: Sequence[Job]) -> list[NDArray[np.float64]]:
        asked.extend(job.first for job in jobs if campaign.is_of_the_model(job))
        return [draw(job.count) for job in jobs]

    found = campaign._results(analysis, campaign.plan(analysis, time_ordered=False), ask, True)
    assert sorted(asked) == list(range(0, 10 * len(asked), campaign.PER_TASK))
    return sum(len(rows) for purpose, rows in found.items() if purpose.kind == "null")


def test_simulations_end_when_their_covariance_is_worth_enough(four: Analysis) -> None:
    """Of elements that are not correlated few tell it; of those that all are, three for each element are made."""
    size, rng = len(four.elements), np.random.default_rng(5)
    assert 2 * size > campaign.LOOKED_AT  # before the end of the pilot
    mixed = rng.standard_normal((size, size))
    few = counted(four, lambda count: rng.standard_normal((count, size)))
    assert few == campaign.LOOKED_AT
    many = counted(four, lambda count: rng.standard_normal((count, size)) @ mixed)
    assert many - 3 * size in range(campaign.PER_TASK)


def test_only_as_many_simulations_follow_as_lack(four: Analysis, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred at once are made where many lack, and otherwise the few that are worth the rest."""
    size, rng = len(four.elements), np.random.default_rng(6)
    for share, expected in ((1.03, 520), (1.001, 510), (1.5, 750)):
        each = four.settings.worth_per_element * size / (share * campaign.LOOKED_AT)
        monkeypatch.setattr(campaign, "_worth", lambda _, drawn, each=each: int(each * len(drawn)) + 1)
        made = counted(four, lambda count: rng.standard_normal((count, size)))
        assert made - expected in range(campaign.PER_TASK), share


def test_skies_of_many_modes_tell_as_much_in_fewer(four: Analysis) -> None:
    """Twice the modes, half of the skies, down to two, with the opposite step in a third of them."""
    one = next(each for each in four.candidates if each.name == "dipole_modulation")
    model = four.model
    assert responses.skies(four, one) == 24  # of a sky with few modes
    for modes, expected in ((1, 12), (2, 6), (3, 4), (40, 2)):
        lmax = 2 * model.lmax
        power = np.full(lmax + 1, 1.001 * modes * responses.MODES / (lmax + 1) ** 2)
        settings = replace(model.settings, response_modes=1)
        own = replace(four, model=replace(model, lmax=lmax, sky_power=power, settings=settings))
        assert responses.skies(own, one) == expected
        assert responses.skies(own, one, -1) == -(-expected // 3)


def test_without_a_share_of_opposite_steps_none_is_simulated(four: Analysis) -> None:
    settings = replace(four.settings, opposite_share=0.0)
    jobs = campaign.plan(replace(four, model=replace(four.model, settings=settings)), 300, time_ordered=False)
    assert all(job.count for job in jobs.values())
    assert {(purpose.number, purpose.sign) for purpose in jobs if purpose.kind == "response"} == {
        (column, one.parametrization.sign or 1) for one in four.candidates for column in one.columns
    }


@pytest.mark.parametrize("workers", [-2, 1.5, True])
def test_workers_that_are_none_are_refused_though_nothing_is_to_be_simulated(workers: float) -> None:
    """They were not looked at where the model was in the cache."""
    with refused("workers", workers), campaign.batch(workers):
        pass


def test_a_response_whose_size_scatters_is_averaged_over_more_skies(four: Analysis) -> None:
    """Of one gain by a third: of all skies that there are. Common effects, whose numbers are their own, are not."""
    few = replace(four, model=replace(four.model, settings=replace(four.settings, response_modes=1)))
    asked, elements = dict[tuple[str, str | None], list[int]](), len(four.elements)
    slope = np.random.default_rng(7).standard_normal(elements)
    scatter = np.random.default_rng(8).standard_normal(four.settings.noisy_skies)

    def respond(job: Job) -> NDArray[np.float64]:
        [effect] = config.from_json(job.simulated).effects
        wide = {"calibration": effect.channel == "W1", "dipole_modulation": True}.get(effect.name, False)
        sizes = 1.0 + (0.3 if wide else 0.01) * scatter[job.first : job.first + job.count]
        return np.asarray(effect.parameters["amplitude"] * sizes[:, None] * slope)

    def ask(jobs: Sequence[Job]) -> list[NDArray[np.float64]]:
        for job in jobs:
            [effect] = config.from_json(job.simulated).effects
            asked.setdefault((effect.name, effect.channel), []).append(job.first)
        return [respond(job) for job in jobs]

    jobs = {purpose: job for purpose, job in campaign.plan(few, 10, False).items() if purpose.kind == "response"}
    results = {purpose: respond(job) for purpose, job in jobs.items()}
    same = {False: np.zeros((four.settings.noisy_skies, elements))}
    found = campaign._measured(few, jobs, ask, results, same, np.eye(elements))
    assert asked == {("calibration", "W1"): [3, 6, 12]}
    for candidate in few.candidates:
        number = 24 if candidate.identity == ("calibration", "W1") else responses.skies(few, candidate)
        assert {len(found[column][0]) for column in candidate.columns} == {number}
