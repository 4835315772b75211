"""Settings of all tests: reproducible hypothesis, a cache of their own, one thread each, and what is slow."""

import os
from collections.abc import Iterator
from pathlib import Path

# Before numpy is loaded: processes that run side by side would take each other's cores.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# The same examples at every run: a test that fails, fails for everyone.
settings.register_profile("reproducible", derandomize=True, deadline=None, database=None)
settings.load_profile("reproducible")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Moments that tests compute go to a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "MCSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


SLOW = {"integration", "statistical"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Call what runs whole ensembles, or draws thousands of them, slow; single tests bear the mark themselves."""
    root = Path(__file__).parent
    for item in items:
        if item.path.relative_to(root).parts[0] in SLOW:
            item.add_marker(pytest.mark.slow)
