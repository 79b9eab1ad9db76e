"""The normal matrix of a scene's unknowns, against products of whole frames in NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.linear.normal import SCATTER_PX, UnknownLayout, normal_matrix

SHAPE = 15, 17
# (y0, x0, ny, nx) of boxes: the second meets the others, but those not each other; the fourth is
# seen by no pixel, the last begins before the one that was listed first and lies within it.
BOXES = (4, 3, 6, 7), (7, 8, 5, 5), (11, 1, 4, 4), (1, 12, 4, 4), (3, 5, 2, 3)
CHANNELS = slice(0, 2), slice(2, 3)


class Plain:
    """An exposure that shows the frame itself, in channels of other weights; of components from
    `dark` on no pixel."""

    def __init__(self, n_channels, seed, dark=3, n_threads=1):
        self.threads_for = lambda images: n_threads
        self.sqrt_weights = np.random.default_rng(seed).uniform(0.5, 2, (n_channels, *SHAPE))
        self.dark = dark

    def window(self, origin, shape):
        """A box, and a pixel more on each side."""
        low = np.maximum(np.asarray(origin) - 1, 0)
        if tuple(origin) == BOXES[self.dark][:2]:
            return np.array([low, low - 2])
        return np.array([low, np.minimum(np.add(origin, shape) + 1, SHAPE)])

    def observe(self, images, _i, origin, low, high):
        """Images (k, ny, nx) of a box as seen (C, k, ry, rx)."""
        seen = whole(images, origin) * self.sqrt_weights[:, None]
        return seen[:, :, low[0] : high[0], low[1] : high[1]].astype(np.float32)


def whole(images, origin):
    out = np.zeros((len(images), *SHAPE))
    (y, x), (ny, nx) = origin, images.shape[1:]
    out[:, y : y + ny, x : x + nx] = images
    return out


def dense(scene, exposures, images, spectra, layout):
    """The matrix (N, N): each unknown's image in each channel, times those of all others."""
    starts = np.cumsum([0, *layout.sizes])
    n, total = len(images), starts[-1]
    matrix = np.zeros((total, total))
    for i, k in enumerate(layout.n_modes):
        matrix[starts[i] : starts[i] + k, starts[i] : starts[i] + k] += np.eye(k)
    for m in range(layout.n_shifts):
        at = starts[n] + layout.n_sky + m
        matrix[at, at] += SCATTER_PX**-2
    for c, known in enumerate(scene.known_sky[: layout.n_sky]):
        matrix[starts[n] + c, starts[n] + c] += known
    for o, (exposure, part) in enumerate(zip(exposures, scene.channels(), strict=True)):
        for c, root in zip(range(part.start, part.stop), exposure.sqrt_weights, strict=True):
            j = np.zeros((total, *SHAPE))
            for i in range(n):
                if i == exposure.dark:
                    continue
                seen = whole(images[i], scene.origin[i]) * root
                at, k = starts[i], layout.n_modes[i]
                j[at : at + k] = spectra[i, c] * seen[1:]
                j[at + k + c] = seen[0]
                if layout.n_shifts and o:
                    slopes = np.gradient(np.pad(images[i][0], 1, mode="edge"))
                    slopes = whole(np.array(slopes)[:, 1:-1, 1:-1], scene.origin[i])
                    to = starts[n] + layout.n_sky + 2 * (o - 1)
                    j[to : to + 2] += spectra[i, c] * slopes * root
            if layout.n_sky:
                j[starts[n] + c] = root
            j = j.reshape(total, -1)
            matrix += j @ j.T
    return matrix


@pytest.mark.parametrize("n_sky", [0, 3])
@pytest.mark.parametrize("n_shifts", [0, 2])
@pytest.mark.parametrize("bright", [1.0, 3e3])
def test_the_normal_matrix_is_that_of_whole_frames(n_sky, n_shifts, bright):
    """Of modes, spectra, sky levels and a shift; sums of bright sources are float64's.

    With several threads it is the same bit by bit.
    """
    rng = np.random.default_rng(1)
    counts = np.array([3, 1, 0, 2, 2])
    images = [
        rng.random((1 + k, *box[2:])).astype(np.float32)
        for k, box in zip(counts, BOXES, strict=True)
    ]
    scene = SimpleNamespace(
        origin=np.array(BOXES)[:, :2],
        profile=images,
        channels=lambda: CHANNELS,
        known_sky=np.array([0.0, 700.0, 1e5]),
    )
    exposures = [Plain(2, 2), Plain(1, 3)]
    spectra = bright * rng.uniform(1, 2, (5, 3))
    layout = UnknownLayout(counts, 3, n_sky=n_sky, n_shifts=n_shifts)
    found = normal_matrix(scene, exposures, images, spectra, layout).dense()
    threaded = [Plain(2, 2, n_threads=3), Plain(1, 3, n_threads=3)]
    np.testing.assert_array_equal(
        normal_matrix(scene, threaded, images, spectra, layout).dense(), found
    )
    wanted = dense(scene, exposures, images, spectra, layout)
    size = np.sqrt(np.diag(wanted) + 1e-9)
    np.testing.assert_allclose(
        found / size[:, None] / size, wanted / size[:, None] / size, atol=2e-6
    )
