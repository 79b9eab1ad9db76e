"""Leading axes of images on their way into JAX and PyTorch."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample.adapters.batched import with_bands

ONE = SimpleNamespace(shape_in=(1, 4, 5), shape_out=(1, 2, 3))
TWO = SimpleNamespace(shape_in=(2, 4, 5), shape_out=(2, 2, 3))


@pytest.mark.parametrize("shape", [(1, 4, 5), (7, 1, 4, 5), (6, 7, 1, 4, 5)])
def test_whole_items_and_batches_stay_as_they_are(shape):
    x = np.zeros(shape)
    assert with_bands(ONE, x)[0] is x and not with_bands(ONE, x)[1]


def test_one_image_of_one_band_gets_its_band_axis():
    x, is_flat = with_bands(ONE, np.zeros((4, 5)))
    assert x.shape == (1, 4, 5) and is_flat


@pytest.mark.parametrize(
    "op, shape", [(ONE, (3, 4, 5)), (ONE, (5, 4)), (ONE, (5,)), (TWO, (4, 5)), (TWO, (1, 4, 5))]
)
def test_other_shapes_are_refused(op, shape):
    with pytest.raises(ValueError, match=r"x has shape .*, expected \(...,\) \+ \([12], 4, 5\)"):
        with_bands(op, np.zeros(shape))
