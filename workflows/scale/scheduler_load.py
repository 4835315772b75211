"""What a campaign of a million realizations asks of driver and scheduler: as many tasks, which do nothing.

python workflows/scale/scheduler_load.py --tasks 15625
"""

import argparse
import json
import time

import psutil

from mcsim import config
from mcsim.ensemble import runner, tasks


def nothing(job: tasks.Job, start: int) -> tuple[int, list[tasks.Failure]]:
    """A task with the arguments and the answer of a chunk."""
    return job.chunk, []


def main() -> None:
    """Send the tasks of a campaign through the runner's own loop."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--tasks", type=int, default=15625)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    run = config.load("quickstart")
    job = tasks.Job(config.to_json(run), "0" * 64, "/a/store.zarr", 64, 0, 64 * chosen.tasks, tasks.packages())
    own = psutil.Process()
    with runner.local_client(chosen.workers) as client:
        before, begin = own.memory_info().rss / 1e6, time.monotonic()
        peak = before
        for count, _ in enumerate(runner.completed(client, nothing, ((job, n) for n in range(chosen.tasks)))):
            if count % 500 == 0:
                peak = max(peak, own.memory_info().rss / 1e6)
        seconds = time.monotonic() - begin
    print(
        json.dumps(
            {
                "tasks": chosen.tasks,
                "seconds": round(seconds, 1),
                "tasks_per_s": round(chosen.tasks / seconds, 1),
                "driver_and_scheduler_mb": [round(before), round(peak)],
            }
        )
    )


if __name__ == "__main__":
    main()
