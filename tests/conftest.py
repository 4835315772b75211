"""Settings of all tests: reproducible hypothesis, a cache of their own, one thread each, and what is slow."""

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

# Until all tests are collected: modules and tests stay, and the collector would walk through them again and again.
gc.disable()

# Before numpy is loaded: processes that run side by side would take each other's cores.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# The same examples at every run: a test that fails, fails for everyone.
settings.register_profile("reproducible", derandomize=True, deadline=None, database=None)
settings.load_profile("reproducible")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What tests compute and keep goes to a temporary folder, the same for all processes of a session."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "MCSIM_CACHE", str(shared / "cache"))
        yield


@pytest.fixture(scope="session")
def rhs_from_samples() -> Callable[..., np.ndarray]:
    """The time-ordered reference of differencing: every sample of both sides at its own direction."""
    from mcsim.simulation import tod
    from mcsim.simulation.mapmaking.rhs import BALANCED, noise_by_chunk

    def made(scan, stages, imbalance=BALANCED, noise=None, at_pixel_centres=False):
        """P^T d in uK, shape (npix,); the stages are of sides A and B, and keep the chunks as they come."""
        pieces = tod.chunks(*scan.grid.sample_range(scan.model, scan.side_a))
        draw = noise_by_chunk(noise, pieces)
        streams = [
            tod.through(tod.samples(scan.model, line, scan.grid, at_pixel_centres), own)
            for line, own in zip((scan.side_a, scan.side_b), stages, strict=True)
        ]
        x, weight = imbalance.true, imbalance.weight
        rhs = np.zeros(scan.npix)
        for (low, high), a, b in zip(pieces, *streams, strict=True):
            difference = (1.0 + x) * a.signal_uk - (1.0 - x) * b.signal_uk + draw(low, high)
            np.add.at(rhs, a.pixel, (1.0 + weight) * difference)
            np.add.at(rhs, b.pixel, (weight - 1.0) * difference)
        return rhs

    return made


SLOW = {"integration", "statistical"}


FIRST = {
    "test_challenge",
    "test_compare",
    "test_compare_sides",
    "test_controls",
    "test_damage",
    "test_diagnosis",
    "test_faults",
    "test_foregrounds",
    "test_nuisances",
    "test_prepared_diagnosis",
    "test_script",
}
"""Files of the longest tests and fixtures: no other process takes them over at the end, and all end together."""


def pytest_collection_finish() -> None:
    """Exempt from collection what was imported and collected; it stays."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Call what runs whole ensembles, or draws thousands of them, slow; single tests bear the mark themselves."""
    items.sort(key=lambda item: item.path.stem not in FIRST)
    root = Path(__file__).parent
    for item in items:
        if item.path.relative_to(root).parts[0] in SLOW:
            item.add_marker(pytest.mark.slow)
