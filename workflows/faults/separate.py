"""Scheduler and workers in processes of their own, some of which may be dead."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil


class Cluster:
    """Scheduler and two workers as people start them; parts that were killed are started again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / "scheduler.json"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def heal(self) -> str:
        """Start what does not run; the address of the scheduler."""
        scheduler = self.processes.get("scheduler")
        if scheduler is None or scheduler.poll() is not None:
            self._start_scheduler()
        for name in ("node 0", "node 1"):
            if name not in self.processes or self.processes[name].poll() is not None:
                self._start(
                    name, "worker", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard", "--memory-limit", "0"
                )
        return str(json.loads(self.file.read_text())["address"])

    def _start_scheduler(self) -> None:
        """A scheduler that has written where it listens; on a busy machine the first one may not."""
        for attempt in range(5):
            self.stop()
            self.file.unlink(missing_ok=True)
            self._start("scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
            with suppress(TimeoutError):
                wait_for(self._listens, 60.0 * (1 + attempt))
                return
        raise TimeoutError("no scheduler starts on this machine")

    def _listens(self) -> bool:
        try:
            return bool(json.loads(self.file.read_text())["address"])
        except (OSError, ValueError):
            return False

    def _start(self, name: str, *arguments: str) -> None:
        command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(self.file)]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)

    def victims(self, kind: str) -> list[int]:
        """Processes that are a scheduler, a nanny or a worker by now."""
        if kind == "scheduler":
            return [self.processes["scheduler"].pid]
        nannies = [self.processes[name].pid for name in ("node 0", "node 1")]
        return nannies if kind == "nanny" else [pid for nanny in nannies for pid in workers_of(nanny)]

    def stop(self) -> None:
        """End everything."""
        for process in self.processes.values():
            process.kill()
            process.wait()
        self.processes.clear()


def wait_for(condition: Callable[[], object], seconds: float) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds:g} s")
        time.sleep(0.02)


def workers_of(parent: int) -> list[int]:
    """Worker processes of this process's drivers, or of a nanny: children of its fork server."""
    try:
        servers = [
            p for p in psutil.Process(parent).children() if "multiprocessing.forkserver" in " ".join(p.cmdline())
        ]
        children = [child for server in servers for child in server.children()]
        return [child.pid for child in children if child.status() != psutil.STATUS_ZOMBIE]
    except psutil.Error:
        return []
