"""Sums over realizations under any chunks and gaps, and stores that give back what was written, whatever it was."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mcsim.bipolar import modes
from mcsim.ensemble import store
from mcsim.ensemble.layout import Layout
from mcsim.stats import streaming

numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@given(
    st.data(),
    st.integers(1, 40),
    st.integers(0, 6),
)
def test_sums_do_not_depend_on_chunks(data, count, power):
    """Chunks are of any power of two: bit for bit the same, and the same as numpy's over the rows that exist."""
    x = data.draw(arrays.arrays(np.float64, (count, 3), elements=numbers))
    there = data.draw(arrays.arrays(np.bool_, count))

    def node(row):
        return streaming.leaf({"x": x[row]}, ("x",)) if there[row] else None

    size = 2**power
    whole = streaming.tree(node, count)
    chunked = streaming.tree(
        lambda index: streaming.tree(lambda row: node(size * index + row), min(size, count - size * index)),
        -(-count // size),
    )
    if whole is None:
        assert not there.any()
        assert chunked is None
        return
    assert whole.count == chunked.count == there.sum()
    for kind in ("mean", "square", "comoment"):
        np.testing.assert_array_equal(getattr(whole, kind)["x"], getattr(chunked, kind)["x"])
    np.testing.assert_allclose(whole.mean["x"], x[there].mean(axis=0), rtol=1e-9, atol=1e-9)
    if there.sum() > 1:
        # Of numbers up to 1e6 the squares carry a rounding error of 1e12 times 1e-16.
        covariance = np.cov(x[there].T)
        np.testing.assert_allclose(streaming.covariance(whole, "x"), covariance, rtol=1e-9, atol=1e-2)


@pytest.mark.slow
@settings(max_examples=15)
@given(st.data(), st.integers(1, 7), st.integers(1, 3), st.booleans(), st.sampled_from([None, 12]))
def test_a_store_gives_back_what_was_written(data, realizations, chunk, paired, kept_npix):
    layout = Layout(realizations, chunk, ("A", "B"), ("A,A", "A,B", "B,B"), modes(1, True), 4, paired, kept_npix)
    sizes = layout.sizes()
    expected = {}
    for name, (dims, dtype, _, _) in layout.variables().items():
        shape = (realizations, *(sizes[dim] for dim in dims))
        elements = st.floats(-(2.0**100), 2.0**100, width=32)
        real = data.draw(arrays.arrays(np.float64, shape, elements=elements))
        expected[name] = (real * (1.0 + 0.5j) if dtype == "complex128" else real).astype(dtype)
    finished = data.draw(arrays.arrays(np.bool_, realizations))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "any.zarr"
        store.create(path, layout, {"configuration": {}, "digest": "none"})
        for first in range(0, realizations, chunk):
            rows = slice(first, min(first + chunk, realizations))
            store.write(path, first, {name: values[rows] for name, values in expected.items()}, finished[rows])
        found = store.read(path, 0, realizations, maps=True)
        np.testing.assert_array_equal(found["done"], finished)
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name][finished], values[finished])
