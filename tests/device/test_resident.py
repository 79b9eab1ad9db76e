"""Images stay on the device while the host has them, and are uploaded once."""

import gc

import numpy as np
import pytest


@pytest.fixture
def uploads(build, monkeypatch):
    """Sizes of the arrays that are uploaded."""
    found, upload = [], build.upload
    monkeypatch.setattr(
        build,
        "upload",
        lambda values, *given, **more: found.append(values.size) or upload(values, *given, **more),
    )
    return found


def test_a_batch_of_known_images_is_put_together_on_the_device(build, uploads):
    images = [np.full((2, 3), float(k)) for k in range(4)]
    stack = build.resident.stack
    whole = stack(images, np.float32)
    assert stack(images, np.float32) is whole and uploads == [24]
    for rows in ([0, 1, 2], [3, 1], [2], [1, 0, 2, 3]):
        np.testing.assert_array_equal(
            build.get(stack([images[k] for k in rows], np.float32)),
            np.float32([images[k] for k in rows]),
        )
    assert uploads == [24]
    more = [images[1], np.full((2, 3), 9.0), images[0]]
    np.testing.assert_array_equal(build.get(stack(more, np.float32)), np.float32(more))
    assert uploads == [24, 6]


def test_each_type_is_uploaded(build, uploads):
    if not build.has_fp64:
        pytest.skip(f"{build.name} has no double precision")
    image = np.full(3, 0.1)
    for dtype in (np.float32, np.float64):
        assert build.get(build.resident.stack([image], dtype))[0, 0] == dtype(0.1)
    assert uploads == [3, 3]


def test_an_image_cannot_change_once_it_is_there(build):
    image = np.zeros(3)
    build.resident.stack([image], np.float32)
    with pytest.raises(ValueError, match="read-only"):
        image[0] = 1


def test_what_the_host_has_forgotten_takes_no_memory(build):
    gc.collect()
    before, known = build.in_use, len(build.resident._rows)
    images = [np.zeros(1000) for _ in range(3)]
    build.resident.stack(images, np.float32)
    assert build.in_use == before + 12000
    del images[:2]
    assert len(build.resident._rows) == known + 1 and build.in_use == before + 12000
    del images[0]
    assert len(build.resident._rows) == known and build.in_use == before
