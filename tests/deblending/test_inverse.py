"""The inverse curvature of sources' best determined coefficients, against NumPy in full."""

import numpy as np
import pytest

from clresample.deblending.solver.multiscale import inverse, scale_direction
from clresample.deblending.solver.multiscale.evidence import (
    LocalPowerSpectra,
    SourceEvidence,
    blurred_light,
)
from clresample.deblending.solver.multiscale.inverse import BlockPreconditioner, CurvatureBlock
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.scale_direction import coefficients_of

SPECTRUM = np.array([3.0, 1.0])


def galaxy(ny, nx, sigma=4.0):
    """A profile (ny, nx) with its peak beside the middle."""
    y, x = np.arange(ny) - 0.45 * ny, np.arange(nx) - 0.55 * nx
    return np.exp(-0.5 * (y[:, None] ** 2 + x**2) / sigma**2)


def answers(widths=(1.0, 2.5)):
    """R^T w R of one pixel in each channel: smooth, of the widths [px], and the pixel."""
    lag = np.arange(-20, 21)
    found = [np.outer(*2 * [np.exp(-0.25 * (lag / w) ** 2)]) * 50 for w in widths]
    return np.array(found), np.full((len(widths), 2), 20)


def whole(block):
    """The inverse (m, m) that a CurvatureBlock stands for."""
    m, n_rows = len(block.indices), inverse.PANEL
    root, at = np.zeros((-(-m // n_rows) * n_rows,) * 2), 0
    for i in range(0, len(root), n_rows):
        size = n_rows * (i + n_rows)
        root[i : i + n_rows, : i + n_rows] = block.cholesky[at : at + size].reshape(n_rows, -1)
        at += size
    assert at == block.cholesky.size and not np.triu(root, 1).any()
    return root[:m, :m].T @ root[:m, :m]


class Made:
    """A galaxy's BlockPreconditioner, and its curvature in full."""

    def __init__(self, shape, strengths, found=None, sigma=4.0):
        prior = self.prior = MultiscalePrior()
        self.profile = galaxy(*shape, sigma)
        spectra = LocalPowerSpectra(prior)
        found = answers() if found is None else found
        response = spectra.from_impulse_responses(*found)
        self.lags = np.tensordot(SPECTRUM**2, found[0], 1)
        evidence = SourceEvidence(spectra, prior, self.profile, response)
        light = [
            blurred_light(self.profile, s, n)
            for s, n in zip(prior.scales_px, prior.steps, strict=True)
        ]
        self.made = BlockPreconditioner(evidence, self.profile, light)
        self.strengths = np.array(strengths)
        self.sizes = [a.shape for a in light]

    def columns(self):
        """U (ny nx, n) of all coefficients, by its definition."""
        p, found = self.profile, []
        for (ny, nx), step, taps in zip(
            self.sizes, self.prior.steps, self.prior.kernels(), strict=True
        ):
            radius = len(taps) // 2
            along = []
            for n, side in zip((ny, nx), p.shape, strict=True):
                full = np.zeros((n, side + 2 * radius + step))
                for i in range(n):
                    full[i, i * step : i * step + 2 * radius + 1] = taps
                along.append(full[:, radius : radius + side])
            for row in along[0]:
                for column in along[1]:
                    u = np.sqrt(p) * np.outer(row, column) * step
                    found.append((u - p * (p * u).sum() / (p * p).sum()).ravel())
        return np.array(found).T

    def curvature(self):
        """H (n, n) in full."""
        ny, nx = self.profile.shape
        far = np.zeros((2 * ny - 1, 2 * nx - 1))
        middle = np.array(self.lags.shape) // 2
        for i in range(1 - ny, ny):
            for k in range(1 - nx, nx):
                if abs(i) <= middle[0] and abs(k) <= middle[1]:
                    far[i + ny - 1, k + nx - 1] = self.lags[i + middle[0], k + middle[1]]
        y, x = np.divmod(np.arange(ny * nx), nx)
        between = far[y[:, None] - y + ny - 1, x[:, None] - x + nx - 1]
        u = self.columns()
        precision = np.repeat(self.strengths**-2, [a * b for a, b in self.sizes])
        return u.T @ between @ u + np.diag(precision)

    def binned(self, places, step):
        """H (m, m) of some coefficients, on pixels of step x step: U is summed over them, and T is
        the mean between theirs."""
        n_cells = [-(-n // step) for n in self.profile.shape]
        u = np.zeros((*(n * step for n in n_cells), len(places)))
        ny, nx = self.profile.shape
        u[:ny, :nx] = self.columns()[:, places].reshape(ny, nx, -1)
        u = u.reshape(n_cells[0], step, n_cells[1], step, -1).sum((1, 3)).reshape(-1, len(places))
        lags, between = np.pad(self.lags, 64), 0
        middle = np.array(lags.shape) // 2
        y, x = np.divmod(np.arange(n_cells[0] * n_cells[1]), n_cells[1])
        dy, dx = (step * (a[:, None] - a) for a in (y, x))
        for i in range(1 - step, step):
            for k in range(1 - step, step):
                share = (step - abs(i)) * (step - abs(k)) / step**4
                between = between + share * lags[dy + i + middle[0], dx + k + middle[1]]
        return u.T @ between @ u + np.diag(self.precision(places))

    def precision(self, places):
        """1 / alpha^2 (m,) of some coefficients."""
        return np.repeat(self.strengths**-2.0, [a * b for a, b in self.sizes])[places]

    def blocks(self):
        return self.made.blocks(self.strengths, SPECTRUM).blocks


def between(matrix, curvature):
    """Least and largest of what a matrix makes of the curvature, 1 of its inverse."""
    values = np.linalg.eigvals(matrix @ curvature).real
    return values.min(), values.max()


@pytest.mark.parametrize(
    "strengths, error",
    [((0.3, 0.1, 0.05), 0.001), ((0.003, 0.3, 0.05), 1.0), ((0.003, 0.01, 1.0), 0.5)],
)
def test_one_block_is_the_inverse_of_its_part_of_the_curvature(strengths, error):
    """To the lags that T leaves out on every pixel; and to a factor of 2 on binned ones, where only
    coarser scales are in it. Of a diagonal that factor is over 5000."""
    made = Made((17, 20), strengths)
    (block,) = made.blocks()
    places, found = block.indices, whole(block)
    assert block.level == 0 and len(places) == len(set(places)) > 10
    curvature = made.curvature()[np.ix_(places, places)]
    values = np.linalg.eigvals(found @ curvature).real
    assert values.min() > 1 / (1 + error) and values.max() < 1 + error
    diagonal = np.linalg.eigvals(curvature / curvature.diagonal()).real
    assert diagonal.max() / diagonal.min() > 5000


@pytest.mark.parametrize(
    "shape, strengths, step, most_pixels",
    [
        ((17, 20), (0.003, 0.3, 0.05), 2, inverse.MAX_PIXELS),
        ((17, 20), (0.003, 0.01, 1.0), 2, 9 * 10),
        ((17, 20), (0.003, 0.01, 1.0), 4, 9 * 10 - 1),
        ((40, 44), (1e-5, 1e-5, 0.018), 2, inverse.MAX_PIXELS),  # fewer than the window has rows
        ((40, 44), (0.003, 0.01, 1.0), 4, 200),
    ],
)
def test_binned_pixels_hold_sums_of_structure_and_means_of_what_the_data_say(
    shape, strengths, step, most_pixels, monkeypatch
):
    """The block is the inverse on such pixels, to what little light its window leaves out."""
    assert inverse.COARSEST == 2
    monkeypatch.setattr(inverse, "MAX_PIXELS", most_pixels)
    monkeypatch.setattr(inverse, "MIN_DATA_TO_PRIOR", 10.0)
    made = Made(shape, strengths)
    (block,) = made.blocks()
    low, high = between(whole(block), made.binned(block.indices, step))
    assert 0.99 < low and high < 1.04


@pytest.mark.parametrize("more", [0, 1])
def test_a_source_of_more_coefficients_than_a_block_holds_has_two(more, monkeypatch):
    made = Made((17, 20), (1e-5, 0.3, 1e-5))
    (places,) = (block.indices for block in made.blocks())
    monkeypatch.setattr(inverse, "MAX_BLOCK_SIZE", len(places) - more)
    made = Made((17, 20), (1e-5, 0.3, 1e-5))
    parts = [block.indices for block in made.blocks() if block.level == 0]
    assert len(parts) == 1 + more
    assert sorted(np.concatenate(parts)) == sorted(places)


def test_each_part_of_a_large_source_is_the_inverse_there(monkeypatch):
    """Parts with the finest scale in them see each pixel; parts lie side by side, none of them
    long and narrow, so that each has all there is within it."""
    monkeypatch.setattr(inverse, "MAX_BLOCK_SIZE", 150)
    made = Made((26, 30), (0.3, 0.1, 0.05))
    curvature, blocks = made.curvature(), made.blocks()
    ends = np.cumsum([0, *(a * b for a, b in made.sizes)])
    for block in blocks:
        level, places = block.level, block.indices
        low, high = between(whole(block), curvature[np.ix_(places, places)])
        assert 0.98 < low and high < (1.2, 1.8, 1.3)[level]
        assert (places.min() < ends[1]) == (level == 0) and places.min() >= ends[level]
    assert {block.level for block in blocks} == {0, 1, 2}
    first = [b.indices[b.indices < ends[1]] for b in blocks if b.level == 0]
    for own in first:
        sides = np.ptp(np.divmod(own, made.sizes[0][1]), axis=1) + 1
        assert sides.prod() < 1.7 * len(own) + 10 and sides.max() < 3 * sides.min()


def test_a_large_source_has_the_direction_that_only_the_prior_constrains(monkeypatch):
    """Its curvature is 1, nearly all by the prior, where a change of equal |z / alpha| has a
    thousand times as much. A source of one block has no such direction."""
    strengths = np.array((0.3, 0.1, 0.05))
    small = Made((17, 20), strengths).made.blocks(strengths, SPECTRUM)
    assert small.direction is None and len(small.blocks) == 1
    monkeypatch.setattr(inverse, "MAX_BLOCK_SIZE", 150)
    made = Made((26, 30), strengths)
    d, curvature = made.made.blocks(strengths, SPECTRUM).direction.values, made.curvature()
    assert d @ curvature @ d == pytest.approx(1, rel=0.02)
    by_prior = made.precision(slice(None)) * d @ d
    assert 0.9 < by_prior <= 1
    turned = np.roll(d, 1)
    by_data = turned @ curvature @ turned - made.precision(slice(None)) * turned @ turned
    assert by_data > 1000 * (1 - by_prior)


def test_what_the_data_say_of_neighbours_reaches_half_a_spectrum():
    """Answers to one pixel are taken as far as 31 pixels, here to the ends of the box."""
    along = np.exp(-np.abs(np.arange(-32, 33)) / 40)
    found = np.array([50 * np.outer(along, along)] * 2), np.full((2, 2), 32)
    made = Made((32, 5), (0.3, 1e-5, 1e-5), found, sigma=20.0)
    (block,) = made.blocks()
    places = block.indices
    low, high = between(whole(block), made.curvature()[np.ix_(places, places)])
    assert len(places) > 150 and 0.99 < low and high < 1.01


def test_coefficients_of_which_the_data_say_little_are_in_no_block():
    made = Made((17, 20), (1e-5, 1e-5, 1e-5))
    assert made.blocks() == ()
    made = Made((17, 20), (1e-5, 0.3, 1e-5))
    places = np.concatenate([block.indices for block in made.blocks()])
    first = made.sizes[0][0] * made.sizes[0][1]
    assert places.min() >= first and places.max() < first + made.sizes[1][0] * made.sizes[1][1]


def test_large_sources_have_parts_and_wide_waves_across_them(monkeypatch):
    """Parts share no coefficient; the coarser scales in a second level make the worst direction's
    curvature right to a factor of a hundred, which is thousands without them."""
    monkeypatch.setattr(inverse, "MAX_BLOCK_SIZE", 150)
    made = Made((26, 30), (0.3, 0.3, 0.3))
    blocks = made.blocks()
    curvature = made.curvature()
    assert {block.level for block in blocks} > {0}
    n = len(curvature)
    total, worst = np.zeros((n, n)), []
    for level in sorted({block.level for block in blocks}):
        seen = np.concatenate([block.indices for block in blocks if block.level == level])
        assert len(seen) == len(set(seen))
        for block in blocks:
            assert len(block.indices) <= 150
            if block.level == level:
                total[np.ix_(block.indices, block.indices)] += whole(block)
        used = np.flatnonzero(total.diagonal())
        values = np.linalg.eigvals((total @ curvature)[np.ix_(used, used)]).real
        worst.append(values.max() / values.min())
    assert worst[-1] < 0.1 * worst[0]


@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("shape", [(12, 15), (40, 3)])
def test_transforms_do_what_the_matrix_between_pixels_does(step, shape, monkeypatch):
    """Also where answers are strong as far as they are taken, and pixels are further apart."""
    rng = np.random.default_rng(0)
    sharpness, images = rng.random(64 * 33), rng.normal(size=(40, *shape)).astype(np.float32)
    wanted = inverse.seen_through(sharpness, images, step)
    np.testing.assert_array_equal(
        wanted, images.reshape(40, -1) @ inverse._between(sharpness, shape, step)
    )
    monkeypatch.setattr(inverse, "MANY_PIXELS", 0)
    found = inverse.seen_through(sharpness, images, step)
    np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


def test_wide_waves_are_seen_on_coarser_pixels(monkeypatch):
    """So that T between the pixels stays small, and the inverse right to a factor of a few."""
    made, sizes = Made((40, 44), (0.003, 0.01, 1.0)), []
    between = inverse._between

    def watched(sharpness, shape, step):
        sizes.append((shape[0] * shape[1], step))
        return between(sharpness, shape, step)

    monkeypatch.setattr(inverse, "_between", watched)
    monkeypatch.setattr(inverse, "MAX_PIXELS", 200)
    (block,) = made.blocks()
    places, found = block.indices, whole(block)
    values = np.linalg.eigvals(found @ made.curvature()[np.ix_(places, places)]).real
    assert sizes[0][0] <= 200 and sizes[0][1] == 4
    assert values.min() > 0.5 and values.max() < 10


def test_blocks_stand_until_something_has_changed():
    made = Made((17, 20), (0.1, 0.1, 0.1))
    first = made.blocks()
    made.strengths = made.strengths * 2.6  # under e
    assert made.blocks() is first
    made.strengths = made.strengths * [1.1, 1, 1]
    second = made.blocks()
    assert second is not first
    assert made.made.blocks(made.strengths, SPECTRUM * [1.9, 1.5]).blocks is second
    assert made.made.blocks(made.strengths, SPECTRUM * [2.1, 1]).blocks is not second


def test_a_curvature_that_is_no_sum_of_squares_leaves_its_diagonal():
    curvature = np.array([[1.0, 3.0], [3.0, 1.0]], np.float32)
    block = CurvatureBlock(0, np.arange(2), inverse._root(curvature, np.array([0.5, 1.0])))
    np.testing.assert_allclose(whole(block), np.diag([1 / 1.5, 1 / 2]), rtol=1e-6)


def test_a_matrix_that_float32_cannot_factor_is_factored_in_float64():
    curvature = np.full((2, 2), 2.0**30, np.float32)
    block = CurvatureBlock(0, np.arange(2), inverse._root(curvature, np.full(2, 0.5)))
    np.testing.assert_allclose(whole(block), [[1, -1], [-1, 1]], rtol=1e-5)


def test_matrices_and_transforms_give_the_same_coefficients(monkeypatch):
    prior, profile = MultiscalePrior(), galaxy(31, 44).astype(np.float32)
    window, strengths = (slice(3, 29), slice(5, 44)), np.array(prior.strengths)
    wanted = profile[window] * np.float32(0.5)
    by_matrices = coefficients_of(prior, profile, wanted, strengths, window)[1]
    monkeypatch.setattr(scale_direction, "MAX_MATRIX_SIDE", 0)
    by_transforms = coefficients_of(prior, profile, wanted, strengths, window)[1]
    assert np.abs(by_matrices - by_transforms).max() < 2e-4 * np.abs(by_transforms).max()
    assert np.abs(by_matrices - wanted).max() < 0.1 * wanted.max()
