"""Workers as jobs of their own, which join as the queue lets them in and leave when their time is over.

    pip install "mcsim[cluster]"
    python jobqueue.py run.toml store.zarr --jobs 20 --system slurm

Queue, account, cores, time and folders come from jobqueue.yaml, a copy of which stands in ~/.config/dask/.
"""

import argparse
import sys

from dask_jobqueue import PBSCluster, SLURMCluster
from distributed import Client

import mcsim


def main() -> int:
    """Run one configuration on jobs of a queue; exit code 1 if realizations failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("config")
    parser.add_argument("store")
    parser.add_argument("--jobs", type=int, default=10, help="at most this many at once")
    parser.add_argument("--system", choices=["slurm", "pbs"], default="slurm")
    chosen = parser.parse_args()
    kind = {"slurm": SLURMCluster, "pbs": PBSCluster}[chosen.system]
    with kind() as cluster, Client(cluster) as client:
        cluster.adapt(minimum_jobs=1, maximum_jobs=chosen.jobs)
        client.wait_for_workers(1)
        result = mcsim.run(chosen.config, chosen.store, workers=client, quiet=False)
    for failure in result.failures:
        print(f"realization {failure.realization} failed: {failure.reason}", file=sys.stderr)
    return int(bool(result.failures))


if __name__ == "__main__":
    sys.exit(main())
