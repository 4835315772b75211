import numpy as np
import pytest

from mcsim.stats import streaming


def leaves(n: int, missing: tuple[int, ...] = ()):
    rng = np.random.default_rng(n)
    x = rng.normal(size=(n, 3, 4)) + 1j * rng.normal(size=(n, 3, 4))
    return x, lambda i: None if i in missing else streaming.leaf({"x": x[i]}, ("x",))


@pytest.mark.parametrize("n", [2, 3, 7, 8, 37])
def test_against_numpy(n: int) -> None:
    x, node = leaves(n)
    sums = streaming.tree(node, n)
    assert sums is not None
    assert sums.count == n
    np.testing.assert_allclose(sums.mean["x"], x.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(streaming.standard_deviation(sums, "x"), x.std(axis=0, ddof=1), rtol=1e-13)
    for pair in range(3):
        np.testing.assert_allclose(
            streaming.covariance(sums, "x")[pair], np.cov(x[:, pair].T, ddof=1), rtol=1e-12, atol=1e-15
        )


@pytest.mark.parametrize("size", [1, 2, 4, 8, 64])
def test_result_does_not_depend_on_chunks_bit_for_bit(size: int) -> None:
    n, missing = 37, (0, 5, 36, 20, 21, 22, 23)
    _, node = leaves(n, missing)
    whole = streaming.tree(node, n)

    def chunk(index: int):
        start = index * size
        return streaming.tree(lambda i: node(start + i), min(size, n - start))

    chunked = streaming.tree(chunk, -(-n // size))
    assert whole is not None
    assert chunked is not None
    assert whole.count == chunked.count == n - len(missing)
    for kind in ("mean", "square", "comoment"):
        np.testing.assert_array_equal(getattr(whole, kind)["x"], getattr(chunked, kind)["x"])


def test_empty_and_single() -> None:
    assert streaming.tree(lambda i: None, 5) is None
    _, node = leaves(1)
    single = streaming.tree(node, 1)
    assert single is not None
    assert np.isnan(streaming.standard_deviation(single, "x")).all()
    assert np.isnan(streaming.covariance(single, "x")).all()


def test_jackknife_of_a_mean_is_its_standard_error():
    sample = np.random.default_rng(3).normal(size=(20, 4))
    value, error = streaming.jackknife(lambda mean: mean, sample)
    np.testing.assert_allclose(value, sample.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(error, sample.std(axis=0, ddof=1) / np.sqrt(20), rtol=1e-12)
