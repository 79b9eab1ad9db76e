"""References of the start: whole frames, float64 sums, scipy's least squares."""

import numpy as np
import pytest
from scipy.optimize import nnls

from clresample.deblending.linear.spectra import spectrum_covariance
from clresample.deblending.profiles import FixedProfile
from clresample.deblending.start.profile_start import StartingPoint, StartInput, fit_start_profiles
from clresample.deblending.view import WhitenedView
from clresample.resampling.cache import cached_resampler

from .scenes import frame


def rendered(view, images):
    """Whitened unit-spectrum images (n, Co, My * Mx), float64, of model images (n, Ny, Nx)."""
    padded = np.zeros((len(images), *view.op.shape_in[1:]), view.op.dtype)
    padded[:, : images.shape[1], : images.shape[2]] = images
    out = view.op.render(padded) * view.sqrt_weights
    return out.reshape(*out.shape[:2], -1).astype(np.float64)


def least_squares(units, views, sky=False):
    """Spectra (n, C), sky (C,), covariance (C, n, n) of `rendered` images, by scipy's nnls."""
    spectra, levels, covariances = [], [], []
    for view, unit in zip(views, units, strict=True):
        for c in range(unit.shape[1]):
            rows, target = unit[:, c], (view.data[c] * view.sqrt_weights[c]).ravel()
            if sky:  # a free coefficient is the difference of two non-negative ones
                level = view.sqrt_weights[c].ravel()[None]
                if view.sky_precision is not None:  # as a pixel more, of the level alone
                    known = np.sqrt(view.sky_precision[c])
                    level = np.append(level, known)[None]
                    rows, target = np.pad(rows, ((0, 0), (0, 1))), np.append(target, 0)
                rows = np.concatenate([rows, level, -level])
            size = np.maximum(np.linalg.norm(rows, axis=1), 1e-30)
            a = nnls((rows / size[:, None]).T, target)[0] / size
            spectra.append(a[: len(unit)])
            levels.append(a[-2] - a[-1] if sky else 0.0)
            own = rows[: len(rows) - sky]
            covariances.append(
                spectrum_covariance((own @ own.T)[None])[0, : len(unit), : len(unit)]
            )
    return np.array(spectra).T, np.array(levels), np.array(covariances)


def started(frame, catalogue, positions, views, **given) -> StartingPoint:
    """The start of one scene."""
    return fit_start_profiles(
        [StartInput(frame, list(catalogue), np.asarray(positions, float), views)], **given
    )[0]


def profiles(point, shape):
    """Profiles (n, Ny, Nx) of a StartingPoint over a frame, max = 1."""
    return np.array([point.drawn(i, (0, 0), shape) for i in range(len(point))])


def point_of(images, position):
    """A StartingPoint of given images (n, Ny, Nx), all about one position."""
    n = len(images)
    shapes = [FixedProfile(image) for image in images]
    return StartingPoint(
        source=np.arange(n),
        positions=np.array([position] * n, float),
        undetected=np.zeros(n, bool),
        shapes=shapes,
        thetas=[np.zeros(0)] * n,
        drawn_positions=np.array([position] * n, float),
        peaks=np.array([shape.peak for shape in shapes]),
        spectra=np.ones((n, 1)),
        sky=np.zeros(1),
        spectrum_curvature=np.ones((n, 1)),
    )


def views(device, observations, dtype=np.float64):
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no double precision")
    found = []
    for o in observations:
        op = cached_resampler(frame(), o.grid, o.psf, dtype=dtype, device=device)
        found.append(view(op, o))
    return found


def view(op, o, covered=None):
    """An observation in its own units, with no weight where it is not covered."""
    covered = op.covered if covered is None else covered
    mapping = op.mapping
    root = np.sqrt(o.weights) * covered
    return WhitenedView(op, mapping, covered, np.ones(len(o.data)), root, o.data)
