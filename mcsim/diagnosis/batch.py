"""Run simulations in this process or on a cluster of this machine."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcsim.diagnosis.analysis import Job, data_vectors
from mcsim.diagnosis.campaign import Ask
from mcsim.ensemble import runner
from mcsim.support.progress import reporting

Batch = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""Call a function with tuples of arguments; yield (index, result) in the order of completion."""


@contextmanager
def batch(workers: int) -> Iterator[Batch]:
    """Open a cluster of ``workers`` processes at the first call; with 0 call in this process."""
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


@contextmanager
def asking(
    call: Batch, quiet: bool, task: Callable[[Job], NDArray[np.float64]] = data_vectors, stage: str = "simulations"
) -> Iterator[Ask]:
    """Give the function that runs jobs; all that it runs is one stage of the progress."""
    done = 0.0
    with reporting(stage, 0.0, "skies", quiet) as report:

        def ask(jobs: Sequence[Job]) -> list[NDArray[np.float64]]:
            nonlocal done
            results: list[NDArray[np.float64]] = [np.empty(0)] * len(jobs)
            report.expect(float(sum(job.count for job in jobs)))
            for index, result in call(task, ((job,) for job in jobs)):
                results[index] = result
                done += jobs[index].count
                report(done)
            return results

        yield ask
