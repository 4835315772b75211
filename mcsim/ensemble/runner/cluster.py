"""Workers: clusters of this machine or of others, calls sent to them, and who is there to answer."""

import logging
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from itertools import islice
from typing import Any
from uuid import uuid4

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait
from distributed.comm.core import CommClosedError, FatalCommClosedError

from mcsim.ensemble.tasks import ATTEMPTS, check_same_packages, packages
from mcsim.errors import InputError, RunError
from mcsim.support.progress import Journal

# Ctrl-C reaches all processes of a terminal, and it is the driver that ends the run; workers that lose it say nothing.
_WORKER_SETUP = """
import logging, signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
logging.getLogger("distributed").setLevel(logging.CRITICAL)
"""

TURN_S = 30.0
ALONE_S = 300.0
"""How long a run waits for a worker when all are gone."""

_KEPT_MEMORY = {f"MALLOC_{limit}_THRESHOLD_": str(2**28) for limit in ("TRIM", "MMAP")}
"""For glibc, in bytes. A worker makes the same maps again and again; distributed's default gives their memory back to
the system each time, and fetching its pages anew costs nearly as much as the transforms."""


@contextmanager
def _script_left_alone() -> Iterator[None]:
    """Keep processes that start meanwhile from running the script that this process runs.

    multiprocessing runs it again in each of them, for functions that the script defines; those travel to workers by
    value. A script without ``if __name__ == "__main__"`` would start workers of its own there. What is called
    "__main__" by its specification is not run again (CPython, Lib/multiprocessing/spawn.py, ``_fixup_main_from_name``).
    """
    script = sys.modules["__main__"]
    before = script.__spec__
    script.__spec__ = ModuleSpec("__main__", None)
    try:
        yield
    finally:
        script.__spec__ = before


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Client of a local cluster of single-threaded processes, whose ports are open to this machine alone.

    Raises
    ------
    InputError
        In a process that may have no others below it.
    RunError
        If its processes do not start.
    """
    if multiprocessing.current_process().daemon:
        raise InputError(
            "A worker of multiprocessing.Pool can start no workers of its own; call mcsim from the main process, or "
            "from a concurrent.futures.ProcessPoolExecutor."
        )
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "DUCC0", "NUMBA")}
    settings = {
        "distributed.nanny.pre-spawn-environ": (
            dask.config.get("distributed.nanny.pre-spawn-environ") | single | _KEPT_MEMORY
        ),
        "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
        "distributed.worker.preload": [_WORKER_SETUP],
    }
    with dask.config.set(settings), _script_left_alone(), ExitStack() as stack:
        try:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    memory_limit=None,
                    silence_logs=logging.CRITICAL,
                )
            )
            client = stack.enter_context(Client(cluster))
        except (OSError, RuntimeError) as error:  # what distributed says of processes that are late or die at once
            raise RunError(
                f"The worker processes did not start ({type(error).__name__}: {error}); run the same command again "
                "when the machine is less busy or has more memory."
            ) from error
        yield client


@contextmanager
def remote_client(scheduler: str) -> Iterator[Client]:
    """Client of a scheduler that runs already, whose workers have the driver's packages.

    Raises
    ------
    InputError
        If it does not answer, or one of its workers has other packages.
    """
    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(_refusal(scheduler, error)) from error
    with client:
        _check_workers(client)
        yield client


def _refusal(scheduler: str, error: Exception) -> str:
    """Why there is no connection."""
    if scheduler.startswith("tls://") and isinstance(error, TypeError):  # of a call without an ssl_context
        return (
            f"{scheduler} needs the certificates that Dask's configuration names in distributed.comm.tls, and it names "
            "none; give them as workflows/cluster/tls.yaml does."
        )
    if isinstance(error, FatalCommClosedError):
        return (
            f"Nobody at {scheduler} accepts the certificates that Dask's configuration names in distributed.comm.tls; "
            "take those of the scheduler's authority."
        )
    why = type(error).__name__
    return f"No Dask scheduler answers at {scheduler} within 5 s ({why}); start one or correct the address."


def _check_workers(client: Client) -> None:
    """Refuse workers that cannot do what this driver would; those that join later are checked by their first task."""
    for address, answer in client.run(packages, on_error="return").items():
        if isinstance(answer, CommClosedError):
            continue  # it has left meanwhile
        if isinstance(answer, Exception):
            raise InputError(
                f"The worker {address} cannot import mcsim ({type(answer).__name__}: {answer}); "
                "start it from the driver's environment."
            )
        check_same_packages(f"The worker {address}", answer, packages())


class Roll:
    """Roll of the workers of a cluster: the log says who joins and who leaves.

    Parameters
    ----------
    client
        Of the cluster.
    journal
        Log of a run; without one nothing is said.
    """

    def __init__(self, client: Client, journal: Journal | None = None) -> None:
        self.client, self.journal = client, journal
        self.there: dict[str, int] = client.nthreads()

    def call(self) -> int:
        """Threads of the workers that are there now; lost ones of a cluster of this machine are replaced."""
        now, cluster = self.client.nthreads(), self.client.cluster
        if isinstance(cluster, LocalCluster) and len(now) < len(cluster.worker_spec):
            # A nanny gives up when its worker dies while it starts.
            cluster.scale(len(cluster.worker_spec))
        if self.journal is not None:
            for verb, names in (("left", self.there.keys() - now.keys()), ("joined", now.keys() - self.there.keys())):
                if names:
                    self.journal.write(f"{_some(names)} {verb}; {_count(len(now))} now", aloud=not now)
        self.there = now
        return sum(now.values())

    def text(self) -> str:
        """Who was there at the last call, in words, and where to watch them."""
        link = self.client.dashboard_link
        if not self.there:
            text = "no worker yet: waiting for one"
        else:
            text = f"{_count(len(self.there))} with {sum(self.there.values())} threads"
        return f"{text}; dashboard {link}" if find_spec("bokeh") and link else text


def _count(number: int) -> str:
    return f"{number} worker" if number == 1 else f"{number} workers"


def _some(names: Iterable[str]) -> str:
    first, *others = sorted(names)
    more = [*others[:3], *([f"{len(others) - 3} more"] if len(others) > 3 else [])]
    return f"workers {first}, {', '.join(more)}" if more else f"worker {first}"


def death(error: KilledWorker) -> str:
    """Why a call was given up: its workers died."""
    return (
        f"each of the {error.allowed_failures + 1} workers that computed it died, the last of them "
        f"{error.last_worker.address} (out of memory?)"
    )


def completed(
    client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any]]:
    """Call a function on the workers of a cluster, with a bounded number of calls in flight.

    Parameters
    ----------
    client
        Such as :func:`local_client` gives, or one of any other cluster.
    function
        Importable on the workers; what it returns comes back to this process, so it should be small.
    arguments
        Tuples of positional arguments, one for every call; consumed as calls are sent, so it may be long, or lazy.

    Yields
    ------
    tuple
        Index of the call and its result, in the order of completion. Three calls are in flight for every worker thread
        that there is by then, so workers may join and leave.

    Raises
    ------
    Exception
        What a call raised; ``distributed.KilledWorker`` where its worker died every time.
    """
    for index, result, error in answers(Roll(client), function, arguments):
        if error is not None:
            raise error
        yield index, result


def answers(
    roll: Roll, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, Exception | None]]:
    """As :func:`completed`, with what a call raised, if it did, as a third item."""
    waiting = enumerate(arguments)
    numbers: dict[Future, int] = {}
    # An object that can be called has no name but its type's.
    name = getattr(function, "__name__", type(function).__name__)

    def fill() -> None:
        room = 3 * max(1, roll.call()) - len(numbers)
        for index, call in islice(waiting, max(room, 0)):
            future = roll.client.submit(_in_words, function, *call, key=f"{name}-{uuid4().hex}")
            numbers[future] = index

    fill()
    while numbers:
        # Asked for in turns, for a call that no worker is left to answer would be waited for for ever.
        done, _ = _first_of(roll, list(numbers))
        for future in done:
            result: Any = None
            error: Exception | None = None
            try:
                result = future.result(timeout=TURN_S)
            except TimeoutError as late:
                if future.status != "error":
                    continue  # its worker died with the result: another computes it again
                error = late
            except Exception as raised:
                error = raised
            yield numbers.pop(future), result, error
        fill()


def _in_words(function: Callable[..., Any], *arguments: Any) -> Any:
    """Task: a call whose sentences travel without what caused them, for some libraries' errors cannot be unpickled."""
    try:
        return function(*arguments)
    except (InputError, RunError) as error:
        error.__cause__ = error.__context__ = None
        raise


def _first_of(roll: Roll, flying: list[Future]) -> tuple[set[Future], set[Future]]:
    """Futures that are done, at least one, and the others; RunError when no worker has been there for a while."""
    missed = 0
    while True:
        try:
            return tuple(wait(flying, timeout=TURN_S, return_when="FIRST_COMPLETED"))
        except TimeoutError:
            missed = 0 if roll.call() else missed + 1
        if missed * TURN_S >= ALONE_S:
            raise RunError(
                f"No worker has been there for {ALONE_S:g} s; start workers, then run the same command again: what is "
                "finished is kept."
            )
