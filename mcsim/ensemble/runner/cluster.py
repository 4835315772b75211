"""Workers: local or remote clusters, calls on them, and a record of who is present."""

import asyncio
import concurrent.futures
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from itertools import islice
from multiprocessing import forkserver
from types import FrameType
from typing import Any
from uuid import uuid4

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait
from distributed.client import ClosedClientError
from distributed.comm.core import CommClosedError, FatalCommClosedError
from distributed.utils import get_mp_context

from mcsim.ensemble.tasks import ATTEMPTS, check_same_packages, packages
from mcsim.errors import InputError, RunError
from mcsim.support.progress import Journal

# The process that a worker is a fork of may have variables that the driver's environment no longer has.
_WORKER_SETUP = """
import logging, os
import mcsim.ensemble.preload
logging.getLogger("distributed").setLevel(logging.CRITICAL)
for name in set(os.environ) - {variables!r}:
    del os.environ[name]
"""

Workers = int | str | Client
"""Number of local processes, the address of a running scheduler, or a client, which is left open."""

LOST = (asyncio.CancelledError, concurrent.futures.CancelledError, CommClosedError, ClosedClientError)
"""Errors of a call whose scheduler is gone; the second is the parent of those that distributed raises for futures."""

ANSWER_S = 5.0  #: time in which the scheduler at an address answers

TURN_S = 30.0
ALONE_S = 300.0  #: time that a run waits for a worker if all are lost

_KEPT_MEMORY = {f"MALLOC_{limit}_THRESHOLD_": str(2**30) for limit in ("TRIM", "MMAP")}
"""For glibc, in bytes. A worker makes maps of the same size repeatedly. distributed's default returns their memory to
the system each time, and new pages cost nearly as much as the transforms. More than a gigabyte is not kept."""

QUIET = {
    "distributed.admin.large-graph-warning-threshold": "1 GB",  # data of a challenge go with its tasks
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "10s",
    "distributed.admin.system-monitor.interval": "2s",
}
"""Settings of Dask without which each worker is asked a hundred times a second what it does: 4 % of a core."""


@contextmanager
def _settings() -> Iterator[None]:
    """Set what Dask asks of this process while it has local workers, some of whom may have to be started again."""
    settings = QUIET | {
        "distributed.nanny.pre-spawn-environ": _environment(),
        "distributed.worker.multiprocessing-method": start_method(),
    }
    with dask.config.set(settings), _script_left_alone():
        yield


class _Shared:
    """Enter a block once for all threads: the first one enters it, and the last one leaves it.

    What a block restores at its end is what it found: of two that overlap, the one that ends last would restore what
    the other one had set.
    """

    def __init__(self, block: Callable[[], AbstractContextManager[None]]) -> None:
        self.block, self.lock, self.inside, self.entered = block, threading.Lock(), 0, ExitStack()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self.lock:
            if not self.inside:
                self.entered.enter_context(self.block())
            self.inside += 1
        try:
            yield
        finally:
            with self.lock:
                self.inside -= 1
                if not self.inside:
                    self.entered.close()


@contextmanager
def _script_left_alone() -> Iterator[None]:
    """Keep child processes started in this block from running the main script.

    multiprocessing runs the script again in each of them, for the functions that it defines; those travel to workers by
    value. A script without ``if __name__ == "__main__"`` would start workers of its own there. A module whose
    specification names it "__main__" is not run again (CPython, Lib/multiprocessing/spawn.py,
    ``_fixup_main_from_name``).
    """
    script = sys.modules["__main__"]
    before = script.__spec__
    script.__spec__ = ModuleSpec("__main__", None)
    try:
        yield
    finally:
        script.__spec__ = before


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Put a first Ctrl-C or SIGTERM off to the end of this block; the next one acts at once.

    What is interrupted while Dask starts workers leaves half a cluster, whose end prints the tracebacks of all of it.
    """
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in found.items() if callable(handler)}
    pending: list[int] = []

    def handled_as_before() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def put_off(number: int, frame: FrameType | None) -> None:
        pending.append(number)
        handled_as_before()

    if threading.current_thread() is not threading.main_thread():  # which alone may handle signals
        yield
        return
    for number in handlers:
        signal.signal(number, put_off)
    try:
        yield
    finally:
        handled_as_before()
    for one in pending:
        signal.raise_signal(one)


def start_method() -> str:
    """Return how worker processes start, and say what they have in common.

    By "forkserver" one process loads the modules, and all workers of a session are its forks: two start at the cost of
    one, and the next ones at next to none. What macOS calculates with does not survive a fork, and a process that was
    itself forked cannot use the server of its parent.
    """
    if sys.platform != "linux" or multiprocessing.parent_process() is not None:
        return "spawn"
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        get_mp_context().set_forkserver_preload(["mcsim.ensemble.preload"])
    return "forkserver"


def load_ahead(workers: Workers) -> None:
    """Let the process that local workers are forks of load its modules while the caller goes on."""
    if not isinstance(workers, int) or workers < 1 or start_method() != "forkserver":
        return
    os.environ.update(_environment())  # as distributed does for good when it starts workers
    alone = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if alone else None  # Ctrl-C is for the driver
    try:
        forkserver.ensure_running()
    finally:
        if alone:
            signal.signal(signal.SIGINT, handler)


def _environment() -> dict[str, str]:
    """Return the variables that count when a worker starts, or the process that it is a fork of."""
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "DUCC0", "NUMBA")}
    given = {name: str(value) for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items()}
    return {"PYTHONHASHSEED": "6640"} | given | single | _KEPT_MEMORY  # the first as distributed has it


_settings_of_all = _Shared(_settings)
_STARTING = threading.Lock()  #: distributed loads modules when a cluster starts, not all of which two threads may


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Yield the client of a local cluster of single-threaded processes, with ports open to this machine alone."""
    if multiprocessing.current_process().daemon:
        raise InputError(
            "A worker of multiprocessing.Pool can start no workers of its own; call mcsim from the main process, or "
            "from a concurrent.futures.ProcessPoolExecutor."
        )
    whole = dict(os.environ) | _environment()
    with _settings_of_all(), ExitStack() as stack:
        try:
            with _STARTING, _interrupted_later():
                cluster = stack.enter_context(
                    LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        processes=True,
                        env=whole,
                        preload=[_WORKER_SETUP.format(variables=set(whole))],
                        scheduler_kwargs={"allowed_failures": ATTEMPTS - 1},
                        host="127.0.0.1",
                        dashboard_address="127.0.0.1:0",
                        memory_limit=None,
                        silence_logs=logging.CRITICAL,
                    )
                )
                client = stack.enter_context(Client(cluster))
        except (OSError, RuntimeError) as error:  # distributed's errors for processes that are late or die at once
            raise RunError(
                f"The worker processes did not start ({type(error).__name__}: {error}); run the same command again "
                "when the machine is less busy or has more memory."
            ) from error
        yield client


def check_workers(workers: Workers) -> None:
    """Raise InputError unless workers are a number of 1 or more, an address or a client."""
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if not isinstance(workers, str | Client) and (not whole or workers < 1):
        raise InputError(f"workers = {workers!r} is no number of 1 or more; give one, or the address of a scheduler.")


@contextmanager
def connected(workers: Workers) -> Iterator[Client]:
    """Yield the client of so many local processes or of the scheduler at an address; or the given one, left open."""
    check_workers(workers)
    if isinstance(workers, Client):
        _check_workers(workers)
        yield workers
        return
    with remote_client(workers) if isinstance(workers, str) else local_client(workers) as client:
        yield client


class _Remote(Client):
    """A client that closes itself if it cannot start for whatever reason: distributed does so for some only.

    What it leaves open ends in a traceback when Python ends.
    """

    def start(self, **settings: Any) -> None:
        """Connect to the scheduler."""
        try:
            super().start(**settings)
        except Exception:
            self.close()
            raise


@contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Keep distributed's client from printing tracebacks of a scheduler that is lost; the error of a call says it."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextmanager
def remote_client(scheduler: str) -> Iterator[Client]:
    """Yield the client of a running scheduler, whose workers have the driver's packages."""
    with _without_tracebacks(), _remote(scheduler) as client:
        _check_workers(client)
        yield client


def _remote(scheduler: str) -> Client:
    """Connect to a running scheduler; raise InputError if none answers."""
    try:
        # No default client: one that fails would leave Dask without a scheduler for the rest of the session.
        return _Remote(scheduler, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        certificates = "certificates that Dask's configuration names in distributed.comm.tls"
        if scheduler.startswith("tls://") and isinstance(error, TypeError):  # from a call without an ssl_context
            refusal = f"{scheduler} needs the {certificates}, and it names none; see workflows/cluster/tls.yaml"
        elif isinstance(error, FatalCommClosedError):
            refusal = f"Nobody at {scheduler} accepts the {certificates}; take those of the scheduler's authority"
        else:
            why = type(error).__name__
            late = f"within {ANSWER_S:g} s ({why})"
            refusal = f"No Dask scheduler answers at {scheduler} {late}; start one or correct the address"
        raise InputError(f"{refusal}.") from error


def threads_of(scheduler: str) -> int:
    """Return the number of threads of the workers of a running scheduler; InputError if there is none."""
    with remote_client(scheduler) as client:
        found = sum(client.nthreads().values())
    if not found:
        raise InputError(
            f"The scheduler at {scheduler} has no worker yet, so the time is not known; start its workers, or give the "
            "number that there will be with --workers."
        )
    return found


def _check_workers(client: Client) -> None:
    """Raise InputError for workers with other packages; the first task checks those that join later."""
    for address, answer in client.run(packages, on_error="return").items():
        if isinstance(answer, CommClosedError):
            continue  # it has left
        if isinstance(answer, Exception):
            raise InputError(
                f"The worker {address} cannot import mcsim ({type(answer).__name__}: {answer}); "
                "start it from the driver's environment."
            )
        check_same_packages(f"The worker {address}", answer, packages())


class Roll:
    """Record of the workers of a cluster; it logs who joins and who leaves."""

    def __init__(self, client: Client, journal: Journal | None = None) -> None:
        self.client, self.journal = client, journal
        self.there = self._threads()

    def _threads(self) -> dict[str, int]:
        """Return the number of threads of each worker; raise CommClosedError if the scheduler does not answer."""
        try:
            found: dict[str, int] = self.client.nthreads()
        except (OSError, AttributeError) as error:  # AttributeError: the client has closed itself
            raise CommClosedError(f"the scheduler does not answer ({error})") from error
        return found

    def call(self) -> int:
        """Return the number of threads of the present workers; replace lost ones of a local cluster."""
        now, cluster = self._threads(), self.client.cluster
        if isinstance(cluster, LocalCluster) and len(now) < len(cluster.worker_spec):
            # A nanny gives up if its worker dies during the start.
            cluster.scale(len(cluster.worker_spec))
        if self.journal is not None:
            for verb, names in (("left", self.there.keys() - now.keys()), ("joined", now.keys() - self.there.keys())):
                if names:
                    self.journal.write(f"{_some(names)} {verb}; {_count(len(now))} now", aloud=not now)
        self.there = now
        return sum(now.values())

    def text(self) -> str:
        """Return a text on the workers at the last call, and the address of the dashboard."""
        link = self.client.dashboard_link
        threads = f"{_count(len(self.there))} with {_count(sum(self.there.values()), 'thread')}"
        text = threads if self.there else "no worker yet: waiting for one"
        return f"{text}; dashboard {link}" if find_spec("bokeh") and link else text


def _count(number: int, noun: str = "worker") -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _some(names: Iterable[str]) -> str:
    first, *others = sorted(names)
    more = [*others[:3], *([f"{len(others) - 3} more"] if len(others) > 3 else [])]
    return f"workers {first}, {', '.join(more)}" if more else f"worker {first}"


def death(error: KilledWorker) -> str:
    """Return a clause on why a call was given up."""
    return (
        f"each of the {error.allowed_failures + 1} workers that computed it died, the last of them "
        f"{error.last_worker.address} (out of memory?)"
    )


def completed(
    client: Client, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any]]:
    """Call a function on the workers of a cluster; yield the index and the result of each call as it completes.

    ``arguments`` may be lazy: three calls are in flight for every present worker thread, so workers may join and leave.
    The exception of a call is raised; RunError if its worker died every time, or the connection is lost.
    """
    try:
        for index, result, killed in answers(Roll(client), function, arguments):
            if killed is not None:
                raise RunError(f"A task was given up, for {death(killed)}; give workers more memory.") from killed
            yield index, result
    except LOST as error:
        raise RunError("The connection to the scheduler is lost; run the same command again.") from error


def answers(
    roll: Roll, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, KilledWorker | None]]:
    """Yield index, result and, if its worker died every time, this error of every call; see :func:`completed`."""
    waiting = enumerate(arguments)
    numbers: dict[Future, int] = {}
    # A callable object has no name but that of its type.
    name = getattr(function, "__name__", type(function).__name__)

    def fill() -> None:
        room = 3 * max(1, roll.call()) - len(numbers)
        for index, call in islice(waiting, max(room, 0)):
            future = roll.client.submit(_in_words, function, *call, key=f"{name}-{uuid4().hex}")
            numbers[future] = index

    fill()
    while numbers:
        for future in _first_of(roll, list(numbers)):
            result: Any = None
            killed: KilledWorker | None = None
            try:
                result = future.result(timeout=TURN_S)
            except TimeoutError:
                if future.status == "error":
                    raise
                continue  # its worker died with the result; another computes it again
            except KilledWorker as error:
                killed = error
            yield numbers.pop(future), result, killed
        fill()


def _in_words(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a worker; drop the causes of its errors, as some cannot be unpickled."""
    try:
        return function(*arguments)
    except (InputError, RunError) as error:
        error.__cause__ = error.__context__ = None
        raise


def _first_of(roll: Roll, flying: list[Future]) -> set[Future]:
    """Return the finished futures, at least one; raise RunError if workers stay absent: a call would never return."""
    missed = 0
    while True:
        try:
            with roll.client.as_current():  # distributed waits with the default client, which may be another, or none
                return set(wait(flying, timeout=TURN_S, return_when="FIRST_COMPLETED")[0])
        except TimeoutError:
            missed = 0 if roll.call() else missed + 1
        if missed * TURN_S >= ALONE_S:
            raise RunError(
                f"No worker has been there for {ALONE_S:g} s; start workers, then run the same command again: what is "
                "finished is kept."
            )
