"""Compiled loops where nothing can be written."""

from pathlib import Path

import mcsim.support.compiled


def test_loops_compile_where_no_folder_can_be_written(monkeypatch):
    """As in a container whose user has no home, under a package that belongs to root."""

    def no_locator(*arguments):
        raise RuntimeError("cannot cache function 'double': no locator available")

    monkeypatch.setattr("numba.core.caching.FunctionCache.__init__", no_locator)

    @mcsim.support.compiled.njit(nogil=True)
    def double(x):
        return 2 * x

    assert double(2) == 4


def test_no_module_caches_by_itself():
    root = Path(mcsim.__file__).parent
    own = [path for path in root.rglob("*.py") if "njit(cache" in path.read_text(encoding="utf-8")]
    assert [path.name for path in own] == ["compiled.py"]
