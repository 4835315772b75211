"""Many calls, in this process or on a cluster of this machine."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Job, data_vectors
from mcsim.ensemble import runner
from mcsim.support.progress import reporting

Batch = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""From a function and tuples of its arguments to (index, result), in the order of completion."""


@contextmanager
def batch(workers: int) -> Iterator[Batch]:
    """Calls on a cluster of ``workers`` processes that starts with the first; with 0 in this process."""
    opened: list[Any] = []

    def call(function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        if workers == 0:
            yield from ((index, function(*each)) for index, each in enumerate(arguments))
            return
        if not opened:
            manager = runner.local_client(workers)
            opened.extend((manager, manager.__enter__()))
        yield from runner.completed(opened[1], function, arguments)

    try:
        yield call
    finally:
        if opened:
            opened[0].__exit__(None, None, None)


def asking(
    call: Batch, quiet: bool, task: Callable[[Job], NDArray[np.float64]] = data_vectors
) -> Callable[[Sequence[Job]], list[NDArray[np.float64]]]:
    """Answers of jobs in their order."""

    def ask(jobs: Sequence[Job]) -> list[NDArray[np.float64]]:
        answers: list[NDArray[np.float64]] = [np.empty(0)] * len(jobs)
        done = 0
        with reporting("simulations", float(sum(job.count for job in jobs)), "skies", quiet) as report:
            for index, answer in call(task, ((job,) for job in jobs)):
                answers[index] = answer
                done += jobs[index].count
                report(float(done))
        return answers

    return ask
