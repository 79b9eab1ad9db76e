"""The sparse normal matrix of many sources, beside dense float64."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.linear import normal
from clresample.deblending.linear.block_matrix import RIDGE, BlockCholesky, BlockMatrix
from clresample.deblending.linear.normal import _NormalAccumulator


def field(n_y, n_x, *, common=0, seed=0):
    """A positive definite matrix of sources on a grid, each beside four others, of 1 to 4 unknowns,
    and of a node of all where it has unknowns in common."""
    rng = np.random.default_rng(seed)
    n = n_y * n_x
    sizes = np.append(rng.integers(1, 5, n), [common] if common else []).astype(int)
    matrix = BlockMatrix(sizes)
    pairs = [(i, i + 1) for i in range(n) if (i + 1) % n_x] + [(i, i + n_x) for i in range(n - n_x)]
    pairs += [(i, n) for i in range(n)] if common else []
    for i, j in pairs:
        rows = rng.normal(size=(sizes[i] + sizes[j] + 2, sizes[i] + sizes[j]))
        rows *= 10.0 ** rng.integers(-2, 3)
        both = rows.T @ rows
        matrix.block(i, i)[:] += both[: sizes[i], : sizes[i]]
        matrix.block(i, j)[:] += both[: sizes[i], sizes[i] :]
        matrix.block(j, j)[:] += both[sizes[i] :, sizes[i] :]
    return matrix


@pytest.mark.parametrize("common", [0, 3])
def test_the_inverse_is_the_dense_one_where_it_is_asked_for(common):
    matrix = field(5, 4, common=common)
    dense = matrix.dense()
    scale = np.sqrt(np.diag(dense))
    scaled = dense / scale[:, None] / scale + RIDGE * np.eye(len(dense))
    wanted = np.linalg.inv(scaled) / scale[:, None] / scale
    found = BlockCholesky(matrix).inverse()
    ends = np.cumsum([0, *matrix.sizes])
    blocks = dict(found.items())
    assert blocks.keys() >= dict(matrix.items()).keys()
    for (i, j), block in blocks.items():
        expected = wanted[ends[i] : ends[i + 1], ends[j] : ends[j + 1]]
        size = np.sqrt(np.outer(*(np.diag(wanted)[ends[k] : ends[k + 1]] for k in (i, j))))
        np.testing.assert_allclose(block / size, expected / size, atol=1e-7)


def test_solutions_are_the_dense_ones():
    matrix, rng = field(4, 4, common=2), np.random.default_rng(3)
    dense = matrix.dense()
    right = [rng.normal(size=n) * np.sqrt(np.diag(matrix.block(i, i)))
             for i, n in enumerate(matrix.sizes)]  # fmt: skip
    scale = np.sqrt(np.diag(dense))
    scaled = dense / scale[:, None] / scale + RIDGE * np.eye(len(dense))
    wanted = np.linalg.solve(scaled, np.concatenate(right) / scale) / scale
    found = np.concatenate(BlockCholesky(matrix).solve(right))
    np.testing.assert_allclose(found * scale, wanted * scale, rtol=1e-6, atol=1e-9)


def test_what_the_data_say_is_kept_and_what_nobody_knows_has_a_number():
    """Of two unknowns of which the data know the sum alone, the sum keeps its error."""
    matrix = BlockMatrix([1, 2])
    matrix.block(0, 0)[:], matrix.block(1, 1)[:] = 4.0, 25.0
    found = BlockCholesky(matrix).inverse()
    assert found.block(0, 0)[0, 0] == pytest.approx(1 / 4, rel=1e-7)
    both = found.block(1, 1)
    assert both.sum() == pytest.approx(4 / 100, rel=1e-5)
    assert both[0, 0] > 1e6 / 25  # nothing is known of one of them alone


def test_draws_scatter_as_the_inverse_says():
    """Exactly: draws of unit vectors are a root of it."""
    matrix = field(3, 3, common=2)
    factor, n = BlockCholesky(matrix), sum(matrix.sizes)
    root = np.array([np.concatenate(factor.draw(unit)) for unit in np.eye(n)])
    dense = matrix.dense()
    scale = np.sqrt(np.diag(dense))
    found = (root.T @ root) @ (dense + RIDGE * np.diag(scale**2))
    np.testing.assert_allclose(found * scale[:, None] / scale, np.eye(n), atol=1e-6)


@pytest.mark.parametrize("common", [0, 3])
def test_equations_are_solved_for_all_nodes(common):
    """Also for those that are no neighbours, which `inverse` leaves out."""
    matrix = field(3, 4, common=common)
    right = [np.random.default_rng(i).normal(size=n) for i, n in enumerate(matrix.sizes)]
    given = np.concatenate(right)
    dense = matrix.dense()
    scale = np.sqrt(np.diag(dense))
    scaled = dense / scale[:, None] / scale + RIDGE * np.eye(len(dense))
    wanted = np.linalg.solve(scaled, given / scale) / scale
    found = BlockCholesky(matrix).solve(right)
    assert [len(part) for part in found] == list(matrix.sizes)
    np.testing.assert_allclose(np.concatenate(found) * scale, wanted * scale, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(np.concatenate(right), given)  # left as they are


def test_a_matrix_that_is_not_positive_definite_is_refused():
    matrix = field(3, 3)
    matrix.block(4, 4)[:] -= 10 * np.trace(matrix.block(4, 4)) * np.eye(matrix.sizes[4])
    with pytest.raises(np.linalg.LinAlgError):
        BlockCholesky(matrix)
    matrix.block(4, 4)[0, 0] = np.nan  # of which NumPy's factor says nothing
    with pytest.raises(np.linalg.LinAlgError):
        BlockCholesky(matrix)


def nearly_one(error):
    """A BlockMatrix of two unknowns that are one to the data, by products with an error."""
    matrix = BlockMatrix([1, 1])
    matrix.block(0, 0)[:] = matrix.block(1, 1)[:] = 4.0
    matrix.block(0, 1)[:] = 4.0 * (1 + error)
    return matrix


@pytest.mark.parametrize("error", [3e-7, 0.999e-6, 1e-6, 3.999e-6, 1e-5, 2e-4])
def test_rounding_that_leaves_a_matrix_indefinite_is_no_knowledge(error):
    """Nor is it by chance nearly infinite ignorance, where a ridge all but equals the error."""
    found = BlockCholesky(nearly_one(error)).inverse().dense()
    assert found.sum() == pytest.approx(1 / 4, rel=1e-3)
    errors = np.sqrt(found.diagonal())
    assert errors.min() > 20 * 0.5  # of those where the other one is known
    assert errors.max() < np.sqrt(1 / (2 * 4 * max(error, 1e-6))) * 1.01


def test_a_matrix_that_is_indefinite_by_more_than_rounding_is_refused():
    with pytest.raises(np.linalg.LinAlgError, match="by more than rounding"):
        BlockCholesky(nearly_one(0.3))


def test_memory_follows_the_number_of_sources():
    """Twice as many in a field that is as deep take hardly more than twice as much."""
    held = []
    for n in (20, 40):
        blocks = dict(BlockCholesky(field(n, 10)).inverse().items())
        held.append(sum(block.size for block in blocks.values()))
    assert held[1] < 2.2 * held[0]
    whole = sum(field(40, 10).sizes) ** 2 / 2
    assert held[1] < 0.15 * whole


def test_neighbours_are_those_whose_rows_meet(monkeypatch):
    """Low in x and high in y as well; and those that see nothing are none."""
    windows = [((30, 2), (50, 20)), ((40, 4), (60, 22)), ((60, 0), (70, 9)), ((45, 3), (45, 9))]
    pairs = []

    class Watched(_NormalAccumulator):
        def _seen(self, i, images, spectrum, origin, low, high):
            return SimpleNamespace(i=i, low=low, high=high, images=0, cell=1)

        def _add(self, one, other, *_):
            pairs.append((one.i, other.i))

    monkeypatch.setattr(normal, "_products", lambda one, other: 0)
    exposure = SimpleNamespace(
        window=lambda at, _: np.array(windows[at]), threads_for=lambda images: 1
    )
    layout = SimpleNamespace(shift=lambda _: None, n_sky=0, spectra_at=lambda c: c)
    images, spectra = [np.zeros((1, 2, 2))] * 4, np.ones((4, 1))
    Watched(None, layout, exposure, 0, slice(0, 1)).run(range(4), images, [()] * 4, spectra)
    assert sorted(pairs) == [(0, 0), (0, 1), (1, 1), (2, 2)]
