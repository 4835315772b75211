"""Settings of all tests: reproducible hypothesis, and a cache of their own instead of the user's."""

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

# The same examples at every run: a test that fails, fails for everyone.
settings.register_profile("reproducible", derandomize=True, deadline=None, database=None)
settings.load_profile("reproducible")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Moments that tests compute go to a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "MCSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
