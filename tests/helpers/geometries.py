"""Geometries that every path of the operator is tested on, and what the tests share."""

import warnings

import numpy as np
import pytest
from astropy.wcs import WCS, Sip

from clresample.resampling import reference
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.resampler import Resampler
from clresample.sky.grid import Grid
from clresample.sky.mapping import Mapping
from clresample.sky.psf import PSF
from clresample.sky.psf_checks import PSFWarning

SHAPE_IN, SHAPE_OUT = (
    (31, 26),
    (13, 18),
)  # not square, odd and even; 2 x 18 pixels overhang the model
TYPES = (np.float32, np.float64)
# relative L2 of an image against the float64 oracle, white noise included
TOLERANCE = {np.float32: 2e-6, np.float64: 1e-12}


def tolerance(device, dtype):
    """Tolerance of the paper's scheme.

    Its PSFs are interpolated on the device, in float32 if it has no float64, so that their transfer
    function has errors of a few 1e-6.
    """
    return TOLERANCE[np.dtype(dtype).type] * (1 if device.has_fp64 else 5)


def turn(angle_deg, scale=2.0, *, flip=False):
    """Jacobian of pixels `scale` times as large, turned, mirrored or not; exact at 90 degrees."""
    quarter, rest = divmod(angle_deg, 90)
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[int(quarter)]
    if rest:
        cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return scale * np.array([[cos, sin], [-sin, cos]]) * (1.0, -1.0 if flip else 1.0)


def affine(matrix, shape_in=SHAPE_IN, shape_out=SHAPE_OUT, *, shift=(0.13, -0.21)):
    """Mapping whose stamps share their centre but for `shift` (2,) [model px]."""
    matrix = np.array(matrix, dtype=float)
    aligned = not matrix[~np.eye(2, dtype=bool)].any() or not np.diag(matrix).any()
    offset = (np.array(shape_in) - 1) / 2 - matrix @ ((np.array(shape_out) - 1) / 2) + shift
    return Mapping(shape_in, shape_out, matrix, offset, "aligned" if aligned else "affine", 0.0)


def distorted(matrix, shape_in=SHAPE_IN, shape_out=SHAPE_OUT, *, bend=4e-3):
    """The affine mapping bent: X(p) = A q + t, q = p + bend (dy dx, dx^2 / 2) about the centre."""
    straight = affine(matrix, shape_in, shape_out)
    n, m = np.indices(shape_out, dtype=float)
    dy, dx = n - n.mean(), m - m.mean()
    positions = straight.at(n + bend * dy * dx, m + bend * dx**2 / 2)
    area = (1 + bend * dx) ** 2
    return Mapping(
        shape_in,
        shape_out,
        straight.matrix,
        straight.offset,
        "distorted",
        float(bend * dx.max() ** 2),
        positions,
        area,
    )


def sky_grid(shape, scale_arcsec, angle_deg=0.0, *, flip=False, form="CD", sip=0.0):
    """Grid with a WCS in the form of a CD matrix or of PC and CDELT; `sip` bends its columns."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"] if sip else ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = 150.1, 2.2
    wcs.wcs.crpix = (shape[1] + 1) / 2, (shape[0] + 1) / 2
    matrix = turn(angle_deg, 1.0, flip=flip)[::-1, ::-1] * [[-1], [1]]
    if form == "CD":
        wcs.wcs.cd = matrix * scale_arcsec / 3600
    else:
        wcs.wcs.pc, wcs.wcs.cdelt = matrix, [scale_arcsec / 3600] * 2
    if sip:
        a, b = np.zeros((3, 3)), np.zeros((3, 3))
        a[2, 0] = b[1, 1] = sip
        wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    return Grid.from_wcs(wcs, shape)


def from_sky(**observed):
    """Mapping of pixels of 0.2 arcsec to a model of 0.1 arcsec, both placed by a WCS."""
    return sky_grid(SHAPE_OUT, 0.2, **observed).map_to(sky_grid(SHAPE_IN, 0.1, form="PC"))


GEOMETRIES = {
    "aligned": lambda: affine(turn(0)),
    "mirrored": lambda: affine(turn(0, flip=True)),
    "half turn": lambda: affine(turn(180)),
    "crossed": lambda: affine(turn(90)),
    "crossed back, mirrored": lambda: affine(turn(270, flip=True)),
    "finer": lambda: affine(np.diag([0.7, 0.4])),
    **{
        f"{a} degrees": lambda a=a: affine(turn(a)) for a in (0.1, 5, 30, 45, 60, 89, 137, 200, 315)
    },
    "45 degrees, mirrored": lambda: affine(turn(45, flip=True)),
    "30 degrees, same scale": lambda: affine(turn(30, 1.0)),
    "30 degrees, finer": lambda: affine(turn(30, 0.6)),
    "shear along x": lambda: affine([[2, 0], [0.9, 2]]),
    "shear along y": lambda: affine([[2, 1.7], [0, 2]]),
    "huge shear": lambda: affine([[2, 30], [0, 2]]),
    "oblong pixels": lambda: affine([[0.5, 0.1], [0.3, 5]]),
    "distorted": lambda: distorted(turn(0)),
    "distorted, 200 degrees, mirrored": lambda: distorted(turn(200, 1.7, flip=True)),
    "CD": lambda: from_sky(angle_deg=-20),
    "CD, other parity": lambda: from_sky(angle_deg=90, flip=True),
    "PC + CDELT": lambda: from_sky(angle_deg=60, flip=True, form="PC"),
    "SIP": lambda: from_sky(angle_deg=10, form="PC", sip=2e-4),
}
ONE_OF_EACH = ("mirrored", "crossed", "30 degrees", "60 degrees", "distorted")


def psfs():
    """PSFs of the model and of the observation, two bands each, all four different."""
    return PSF.gaussian([0.8, 0.9]), PSF.gaussian([1.5, 2.0])


def operator(device, mapping, psf_in, psf_out, dtype=np.float32, **options):
    """The operator of a mapping made by hand; skips where the device has no float64."""
    if dtype == np.float64 and not device.has_fp64:
        pytest.skip(f"{device.name} has no float64")
    plan = make_resampling_plan(mapping, psf_in, psf_out, precision=Precision.of(dtype))
    return Resampler.from_plans([plan], dtype=dtype, device=device, **options)


def expected(op, images, psf_in, psf_out):
    """Result of the float64 oracle for an operator's mapping and padding."""
    return reference.resample(images, op.mapping, psf_in, psf_out, op.certificate.n_fft)


def distance(found, truth):
    """|found - truth| / |truth|, in float64."""
    return np.linalg.norm(np.asarray(found, float) - truth) / np.linalg.norm(truth)


def gaussian_at(core, shape, sigma, center=None):
    """A Gaussian PSF around `core` [samples], whose centre may be stated to lie elsewhere."""
    y, x = (np.arange(n) - c for n, c in zip(shape, core, strict=True))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) / sigma**2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PSFWarning)
        return PSF(image, center=core if center is None else center)


PSF_PAIRS = {
    "even sizes": lambda: (PSF.gaussian(0.8, n_pixels=20), PSF.gaussian(1.5, n_pixels=(18, 22))),
    "not square, small": lambda: (
        PSF.gaussian(0.8, n_pixels=9),
        PSF.gaussian(1.1, n_pixels=(5, 8)),
    ),
    "undersampled": lambda: (PSF.gaussian(0.4), PSF.gaussian(0.6)),
    "oversampled": lambda: (
        PSF.gaussian(0.8, spacing=0.25, n_pixels=61),
        PSF.gaussian(1.5, spacing=0.4, n_pixels=61),
    ),
    "coarser than the pixels": lambda: (PSF.gaussian(0.8), PSF.gaussian(2.5, spacing=1.25)),
    "centres off": lambda: (
        gaussian_at((9.3, 12.1), (22, 25), 0.9),
        gaussian_at((17.6, 8.0), (30, 21), 1.6),
    ),
    "wider than the observation": lambda: (PSF.gaussian(0.8), PSF.gaussian(9.0, n_pixels=101)),
    "one sample": lambda: (PSF([[1.0]]), PSF([[1.0]])),
    "one band for three": lambda: (PSF.gaussian([0.7, 0.8, 0.9]), PSF.gaussian(1.5)),
}
