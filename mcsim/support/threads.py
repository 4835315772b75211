"""Threads whose long work ends when the caller is interrupted."""

from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event


@contextmanager
def interruptible(nthreads: int) -> Iterator[tuple[ThreadPoolExecutor, Callable[[], None]]]:
    """Yield a pool of threads, and a check that its work makes between chunks: it raises once the block has failed.

    Without it, Ctrl-C would wait for all that the threads have begun: a pool joins them at its end.
    """
    over = Event()

    def check() -> None:
        if over.is_set():
            raise CancelledError

    with ThreadPoolExecutor(max(1, nthreads)) as pool:
        try:
            yield pool, check
        except BaseException:
            over.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
