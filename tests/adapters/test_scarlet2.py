"""Our renderer inside scarlet2: exact where its own is not, and differentiable."""

import numpy as np
import pytest

from clresample import PSF, Grid, Resampler
from clresample.adapters.scarlet2 import renderer_of

scarlet2 = pytest.importorskip("scarlet2", reason="scarlet2 is not installed")
jax = pytest.importorskip("jax")

MODEL = Grid.from_wcs(Grid.flat((60, 60), 0.1).to_wcs(ra_deg=30, dec_deg=5), (60, 60))
TURNED = Grid.flat((24, 24), 0.2, angle_deg=20).to_wcs(ra_deg=30, dec_deg=5)
NARROW, WIDE = PSF.gaussian(1.4), PSF.gaussian([1.5, 1.8])
CHANNELS = ["VIS", "g", "r"]


@pytest.fixture(scope="module")
def frames():
    box = scarlet2.bbox.Box
    model = scarlet2.Frame(box((3, 60, 60)), NARROW.images, MODEL.wcs, CHANNELS)
    return model, scarlet2.Frame(box((2, 24, 24)), WIDE.images, TURNED, ["g", "r"])


def blob():
    y, x = np.indices((60, 60)) - 29.5
    image = np.exp(-0.5 * ((y - 4) ** 2 + (x + 3) ** 2) / 3**2)
    return np.stack([image, 2 * image, 3 * image]).astype(np.float32)


def test_it_renders_the_channels_of_the_observation(frames):
    observed = renderer_of(*frames)(blob())
    exact = Resampler(
        MODEL, NARROW.select([0, 0]), Grid.from_wcs(TURNED, (24, 24)), WIDE, dtype=np.float64
    )(blob()[1:].astype(np.float64))
    np.testing.assert_allclose(observed, exact, atol=2e-6 * exact.max())


def test_scarlet2_takes_it_and_its_gradient_is_the_adjoint(frames):
    data = np.ones((2, 24, 24), np.float32)
    observation = scarlet2.Observation(data, data, psf=WIDE.images, wcs=TURNED, channels=["g", "r"])
    renderer = renderer_of(*frames)
    observation.match(frames[0], renderer=renderer)
    gradient = jax.grad(lambda m: observation.log_likelihood(m))(blob())
    residual = np.asarray(renderer(blob())) - data
    _, pull = jax.vjp(renderer, blob())
    np.testing.assert_allclose(gradient, -pull(residual)[0], atol=1e-5 * np.abs(gradient).max())
    assert not np.any(gradient[0])


def test_unknown_channels_are_refused(frames):
    model, observed = frames
    other = scarlet2.Frame(observed.bbox, observed.psf, observed.wcs, ["z", "y"])
    with pytest.raises(ValueError, match=r"\['z', 'y'\]"):
        renderer_of(model, other)
