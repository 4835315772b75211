"""Strange configurations, damaged files and stores: the fuzzer of workflows/faults in short, always the same inputs."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mcsim.errors import InputError, RunError


@pytest.fixture(autouse=True)
def workflow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "workflows" / "faults")


# healpy leaves a file that it cannot read to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize(("subject", "count"), [("configurations", 80), ("files", 42), ("stores", 6)])
def test_ends_in_a_result_or_a_sentence(subject: str, count: int, tmp_path: Path) -> None:
    from fuzzing import configurations, files, stores

    fuzz = {"configurations": configurations, "files": files, "stores": stores}[subject].fuzz
    outcome = fuzz(count, 1, 60.0, tmp_path)
    assert outcome.faults == []
    assert sum(outcome.ends.values()) >= count
    assert {"result", "a sentence and exit code 2" if subject != "stores" else "a sentence and exit code 1"} <= set(
        outcome.ends
    )


def raising(error: BaseException) -> Callable[[], None]:
    def call() -> None:
        raise error

    return call


@pytest.mark.parametrize(
    ("call", "end", "fault"),
    [
        (dict, "result", None),
        (raising(InputError("Too large; lower it.")), "a sentence and exit code 2", None),
        (raising(RunError("one line\nand another")), "a sentence and exit code 1", "no sentence"),
        (raising(KeyError("x")), "traceback", "KeyError: 'x'"),
        (lambda: [None for _ in iter(time.monotonic, 0)], "slow", "took more than"),
    ],
)
def test_judge(call: Callable[[], object], end: str, fault: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    from fuzzing import judge

    monkeypatch.setattr(judge, "LIMIT_S", 0.05)
    outcome = judge.Outcome()
    judge.judge("input 7", call, outcome)
    assert outcome.ends == {end: 1}
    assert [fault in text and "input 7" in text for text in outcome.faults] == ([] if fault is None else [True])
