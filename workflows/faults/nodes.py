"""A cluster of two nodes, of which the second is cut off in the middle of a run, given up, and comes back.

    python workflows/faults/nodes.py
    python workflows/faults/nodes.py --link namespaces    # as root, on Linux

The nodes are two loopback addresses, 127.0.0.1 and 127.0.0.2, the second of which is cut off by stopping all of its
processes; or two network namespaces with a cable between them, which is pulled: then the node goes on to compute and to
write to the file system that both see. Scheduler, workers and driver are started by the ordinary commands.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import psutil
from same import difference, finished

CONFIGURATION = """schema = 1
name = "nodes"
[sky]
spectrum = "wmap7"
lmax = 16
[map]
nside = 8
[[channel]]
name = "W1"
beam = {{ kind = "elliptical_gaussian", fwhm_major_arcmin = 500.0, fwhm_minor_arcmin = 400.0 }}
scan = {{ kind = "parallel_transport" }}
[biposh]
L_max = 2
summary_bin = 5
[ensemble]
realizations = {realizations}
seed = 5
[compute]
chunk = 2
"""
SETTINGS = {
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "2s",  # Dask takes 5 s at least
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s",
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "12s",  # 11 s at least
}
LIMIT_S = 180.0


@dataclass
class Node:
    """A node: its address, what goes before a command to run it there, and how it is cut off and joined again."""

    address: str
    before: tuple[str, ...] = ()
    pull: tuple[str, ...] = ()
    plug: tuple[str, ...] = ()
    worker: subprocess.Popen[bytes] | None = None

    def cut(self) -> None:
        """Nothing comes from this node any more."""
        self._switch(self.pull, signal.SIGSTOP)

    def join(self) -> None:
        """The node is back."""
        self._switch(self.plug, signal.SIGCONT)

    def _switch(self, command: tuple[str, ...], number: signal.Signals) -> None:
        if command:
            subprocess.run(command, check=True)
        elif self.worker is not None:
            with suppress(psutil.Error):
                parent = psutil.Process(self.worker.pid)
                for process in (parent, *parent.children(recursive=True)):
                    process.send_signal(number)


@dataclass
class Found:
    """What became of a run: seconds since its start, realizations that were stored by then, and the comparison."""

    link: str
    nanny: bool
    seconds: dict[str, float] = field(default_factory=dict)
    stored: dict[str, int] = field(default_factory=dict)
    exit_code: int | None = None
    lost: int = 0
    doubled: int = 0
    differing: int = 0
    same_summary: bool = False

    @property
    def sound(self) -> bool:
        """Whether the run ended well, with the result of an undisturbed one."""
        return (self.exit_code, self.lost, self.doubled, self.differing, self.same_summary) == (0, 0, 0, 0, True)


@contextmanager
def addresses() -> Iterator[tuple[Node, Node]]:
    """Two loopback addresses."""
    yield Node("127.0.0.1"), Node("127.0.0.2")


@contextmanager
def namespaces() -> Iterator[tuple[Node, Node]]:
    """Two network namespaces with a cable between them."""
    names = [f"mcsim-{os.getpid()}-{number}" for number in (1, 2)]

    def ip(*words: str, inside: str | None = None) -> None:
        subprocess.run(["ip", *(["-n", inside] if inside else []), *words], check=True)

    try:
        for name in names:
            ip("netns", "add", name)
            ip("link", "set", "lo", "up", inside=name)
        ip("link", "add", "wire", "netns", names[0], "type", "veth", "peer", "name", "wire", "netns", names[1])
        nodes = []
        for number, name in enumerate(names, start=1):
            ip("address", "add", f"10.77.0.{number}/24", "dev", "wire", inside=name)
            ip("link", "set", "wire", "up", inside=name)
            cable = ("ip", "-n", name, "link", "set", "wire")
            nodes.append(Node(f"10.77.0.{number}", ("ip", "netns", "exec", name), (*cable, "down"), (*cable, "up")))
        yield nodes[0], nodes[1]
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False)


def wait_for(condition: Callable[[], object], what: str, seconds: float = LIMIT_S) -> None:
    """Wait until something is so."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} did not happen within {seconds:g} s")
        time.sleep(0.02)


class Cluster:
    """Scheduler and driver on the first of two nodes, a worker on each."""

    def __init__(self, nodes: tuple[Node, Node], nanny: bool, folder: Path) -> None:
        self.nodes, self.nanny, self.folder = nodes, nanny, folder
        self.file = folder / "scheduler.json"
        self.processes: list[subprocess.Popen[bytes]] = []
        options = ("--host", nodes[0].address, "--port", "0", "--no-dashboard", "--scheduler-file", str(self.file))
        self.start(nodes[0], "dask", "scheduler", *options)
        wait_for(lambda: self.file.exists() and self.file.stat().st_size, "the start of the scheduler")
        self.serve(*nodes)

    def start(self, node: Node, *words: str) -> subprocess.Popen[bytes]:
        """Run a module of Python on a node."""
        with (self.folder / f"{node.address}-{words[1]}.out").open("ab") as out:
            command = [*node.before, sys.executable, "-m", *words]
            self.processes.append(subprocess.Popen(command, env=os.environ | SETTINGS, stdout=out, stderr=out))
        return self.processes[-1]

    def serve(self, *nodes: Node) -> None:
        """Start the workers of nodes that have none, as a nanny or a batch system would."""
        for node in nodes:
            if node.worker is None or node.worker.poll() is not None:
                options = ["--host", node.address, "--nthreads", "1", "--memory-limit", "0", "--no-dashboard"]
                # Imports, which may take seconds, are to be over when the scheduler begins to count.
                options += ["--preload", "mcsim.ensemble.tasks", "--nanny" if self.nanny else "--no-nanny"]
                node.worker = self.start(node, "dask", "worker", "--scheduler-file", str(self.file), *options)

    def drive(self, config: Path, store: Path) -> subprocess.Popen[bytes]:
        """``mcsim run`` on these workers."""
        address = json.loads(self.file.read_text())["address"]
        return self.start(self.nodes[0], "mcsim.cli", "run", str(config), "-o", str(store), "--scheduler", address)

    def stop(self) -> None:
        """End everything."""
        for process in self.processes:
            with suppress(psutil.Error):
                for child in psutil.Process(process.pid).children(recursive=True):
                    child.kill()
            process.kill()
            process.wait()


def run_with_a_cut(
    link: str, nanny: bool, config: Path, store: Path, reference: Path, cut_at: int, folder: Path
) -> Found:
    """Run on two nodes, cut off the second when ``cut_at`` realizations are stored, and join it when it is given up."""
    found, log = Found(link, nanny), store.with_name(f"{store.name}.log")
    with {"addresses": addresses, "namespaces": namespaces}[link]() as nodes:
        cluster, second = Cluster(nodes, nanny, folder), nodes[1]
        try:
            driver, begin = cluster.drive(config, store), time.monotonic()

            def until(event: str, happened: Callable[[], bool], *alive: Node) -> None:
                def so() -> bool:
                    cluster.serve(*alive)
                    return driver.poll() is not None or happened()

                wait_for(so, event)
                found.seconds[event] = round(time.monotonic() - begin, 1)
                found.stored[event] = finished(store)

            def logged(verb: str) -> bool:
                lines = log.read_text().splitlines()[before:]
                return any(f"//{second.address}:" in line and f" {verb}; " in line for line in lines)

            until("cut off", lambda: finished(store) >= cut_at, *nodes)
            if driver.poll() is not None:
                raise RuntimeError((folder / f"{nodes[0].address}-run.out").read_text())
            before = len(log.read_text().splitlines())
            second.cut()
            until("given up", lambda: logged("left"), nodes[0])
            second.join()
            until("back", lambda: logged("joined"), *nodes)
            until("end", lambda: False, *nodes)
            found.exit_code = driver.returncode
        finally:
            second.join()
            cluster.stop()
    for name, value in difference(store, reference).items():
        setattr(found, name, value)
    return found


def main() -> int:
    """Run undisturbed and with a cut; exit code 1 if the two differ."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--link", choices=["addresses", "namespaces"], default="addresses")
    parser.add_argument("--no-nanny", action="store_true", help="workers without nannies, as some batch systems want")
    parser.add_argument("--realizations", type=int, default=1500)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mcsim-nodes-") as name:
        folder = Path(name)
        config, reference = folder / "nodes.toml", folder / "reference.zarr"
        config.write_text(CONFIGURATION.format(realizations=chosen.realizations))
        undisturbed = [sys.executable, "-m", "mcsim.cli", "run", str(config), "-o", str(reference)]
        subprocess.run(undisturbed, check=True, stdout=subprocess.DEVNULL)
        store, cut_at = folder / "cut.zarr", chosen.realizations // 10
        found = run_with_a_cut(chosen.link, not chosen.no_nanny, config, store, reference, cut_at, folder)
        if not found.sound:
            for out in folder.glob("*.out"):
                print(out.name, out.read_text()[-3000:], sep="\n", file=sys.stderr)
        log = store.with_name("cut.zarr.log").read_text()
    print(log)
    print(json.dumps(asdict(found)))
    return int(not found.sound)


if __name__ == "__main__":
    sys.exit(main())
