"""The resampling operator worked out in float64: band, transfer function and factor tables.

With X = A p + t the position of observed pixel p in model pixels and nu = kappa / K,

    I2(X) = K^-2 sum_nu D(nu) F(nu) exp(+2 pi i nu.X),    F(nu) = sum_k I1(x_k) exp(-2 pi i nu.x_k)
    D(nu) = |det A| P2^(A^T nu) / P1^(nu)

which is eq. `reconvampling2D` of the paper summed over the band of the observed PSF.
Images are real, so the sum runs over nu_y >= 0, nu_x >= 0 with the pair D(+,+), D(+,-), and every
exponential is a (cos, sin) pair of real table rows: a plan is a list of real matrices.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np

from ..sky.fourier import is_mirror_symmetric
from ..sky.mapping import Mapping, PaddedMapping
from ..sky.psf import PSF, crop_psf, cut_psf
from .gridding import KaiserBessel, LineTaps, PointTaps
from .transfer import WRAP_MARGIN, Certificate, transfer_function, wrap_radius
from .wave_tables import aligned_tables, line_tables, point_tables, uniform_wave_table

# [bytes] Largest tables of one operator. Frames of 7000 pixels a side reach it; they take minutes,
# in tiles seconds. A WCS that is wrong by orders of magnitude would need far more.
MAX_BYTES = 8 << 30

# Fraction of the band's tolerance that a PSF may lose in light of its outer samples, on which a sum
# over all samples would spend most of its time.
FAINT = 1e-2


@dataclass(frozen=True)
class Precision:
    """Precision of a plan: that of the floating-point type of its operator.

    band_tolerance [1]: |D| / max |D| below which a frequency is dropped
    window: interpolates pixels along lines; see KaiserBessel for its error
    """

    band_tolerance: float
    window: KaiserBessel

    @classmethod
    @functools.cache
    def of(cls, dtype) -> Precision:
        """For float32 or float64; one of each, so that its window is worked out once."""
        if np.dtype(dtype) == np.float32:
            return cls(3e-8, KaiserBessel(10, 1.5))  # window error 5e-7
        return cls(1e-16, KaiserBessel(16, 2.0))  # window error 3e-14


@dataclass(frozen=True, eq=False)
class ResamplingPlan:
    """Tables of one observation; rows 2i, 2i+1 of a table are the cos and sin parts of frequency i.

    mapping: observed pixels -> model pixels; its geometry decides which tables exist
    identity: True for equal pixels and PSFs, when the operator without a shift returns its input
    nu (Hy,), (Hx,) [cycles per model px]: frequencies >= 0 of the two table axes
    axes: the model axis of each table axis; (1, 0) if the observed rows run along the model's y
    psfs: of the model and of the observation
    n_bands, n_terms: C bands of the observation, each the sum of T images of the model, one
        through each PSF of a PSFBasis; T is 1 if the PSF is the same everywhere
    d_plus, d_minus (C * T, Hy, Hx) complex: D(+,+), D(+,-) times K^-2 and the half-plane weights,
        and the phases that shift the observed rows and columns (aligned), lines (affine) or plane
        (distorted) to their positions: their tables are symmetric about 0
    in_y (2Hy, Ny), in_x (2Hx, Nx): transforms of the model
    out_y, out_x: aligned (My, 2Hy), (2Hx, Mx); affine (L, 2Hy), (2Hx, J); distorted (I, 2Hy),
        (2Hx, J)
    twist (Hy, J) complex, lines: affine only; points: distorted only
    windows: plans made by `window`, by its arguments
    """

    mapping: Mapping
    n_bands: int
    n_terms: int
    identity: bool
    certificate: Certificate
    nu: tuple[np.ndarray, np.ndarray]
    axes: tuple[int, int]
    psfs: tuple[PSF, PSF]
    d_plus: np.ndarray
    d_minus: np.ndarray
    in_y: np.ndarray
    in_x: np.ndarray
    out_y: np.ndarray
    out_x: np.ndarray
    twist: np.ndarray | None = None
    lines: LineTaps | None = None
    points: PointTaps | None = None
    windows: dict = field(default_factory=dict)

    @property
    def geometry(self) -> str:
        """The mapping's: "aligned" | "affine" | "distorted"."""
        return self.mapping.geometry

    @property
    def layout(self) -> tuple:
        """Properties, beside sizes of images, that plans in one batch have in common."""
        by_row = None if self.lines is None else self.lines.by_row
        return self.geometry, self.axes, self.n_terms, by_row

    @property
    def n_bytes(self) -> int:
        """Host memory of the tables and the mapping [bytes]."""
        values = (value for part in (self, self.mapping) for value in vars(part).values())
        own = sum(value.nbytes for value in values if isinstance(value, np.ndarray))
        own += sum(taps.n_bytes for taps in (self.lines, self.points) if taps is not None)
        return own + sum(plan.n_bytes for plan in self.windows.values())

    def window(self, shape, reach_px, precision: Precision, size=None, pixel=1) -> ResamplingPlan:
        """The plan of a box of the model and the part of the observation that its light reaches.

        One plan serves all boxes of a shape: its observed pixels are centred on the box, and their
        true offset is a shift of up to half an observed pixel. Not available for distorted
        mappings, which differ from place to place.

        shape (2,) [box px]: of the box; reach_px [model px]: distance to which its light is
            rendered
        size (2,) [observed px]: of the window, at least as many; see PaddedMapping.for_box
        pixel [model px]: side of the box's pixels, which are the plan's model pixels
        """
        key = tuple(shape), reach_px, precision, size, pixel
        if key not in self.windows:
            own, reach = self.mapping.on_pixels(pixel), reach_px / pixel
            mapping = PaddedMapping.for_box(own, shape, reach, size)
            moved = np.abs(own.matrix).sum(axis=1) / 2
            extent = tuple(np.array(shape) + mapping.reach_px + moved)
            known = np.array(self.certificate.wrap_radius_px) / pixel
            radius = np.minimum(known, WRAP_MARGIN * reach)
            # distances in observed pixels up to which light is within the radius
            seen = np.abs(np.linalg.inv(own.matrix)) @ radius
            self.windows[key] = make_resampling_plan(
                mapping,
                self.psfs[0].on_pixels(pixel),
                cut_psf(self.psfs[1], seen),
                precision=precision,
                extent=extent,
                n_terms=self.n_terms,
                radius=tuple(radius.tolist()),
            )
        return self.windows[key]

    def shifted(self, shift) -> tuple[np.ndarray, np.ndarray]:
        """D(+,+), D(+,-) with every observed pixel moved by `shift` (2,) [model px]."""
        return _moved(self.d_plus, self.d_minus, self.nu, [shift[axis] for axis in self.axes])

    @functools.cached_property
    def mirrored(self) -> dict[str, bool]:
        """True if halves of tables mirror each other, as they do if all pixels are on the model."""
        tables = {"in_y": self.in_y, "in_x": self.in_x}
        tables |= {"out_y": self.out_y.T, "out_x": self.out_x}
        return {name: is_mirror_symmetric(table) for name, table in tables.items()}


def make_resampling_plan(
    mapping: Mapping,
    psf_in: PSF,
    psf_out: PSF,
    *,
    precision: Precision,
    extent=None,
    n_terms=1,
    radius=None,
) -> ResamplingPlan:
    """Tables that take a model to the observed pixels and PSF of `mapping`.

    mapping: observed pixels -> model pixels; psf_in (1 or C bands), psf_out (C bands): the PSFs
    n_terms: T; psf_out has T bands in turn for each observed band; see ResamplingPlan
    extent (2,) [model px]: the part of the model, from its first pixel on, that can have light; it
        determines the frequencies; None = all of it
    radius (2,) [model px]: padding of the model; None = `wrap_radius`
    Raises ValueError for incompatible band counts, no overlap, or a PSF without light in the band.
    """
    n_bands = count_bands(mapping, psf_in, psf_out)
    radius = wrap_radius(psf_out, mapping.matrix) if radius is None else radius
    extent = mapping.shape_in if extent is None else extent
    n_fft = _odd(extent[0] + radius[0]), _odd(extent[1] + radius[1])
    _check_size(mapping, psf_out, n_fft, n_bands, precision.window)
    nu, d, max_gain, floored_power = _band(mapping.matrix, psf_in, psf_out, n_fft, precision)
    d = np.broadcast_to(d, (n_bands,) + d.shape[1:])
    n_frequencies = h_y, h_x = len(nu[0]), len(nu[1])
    center, axes, middle = (np.array(mapping.shape_in) - 1) / 2, (0, 1), (0.0, 0.0)
    if mapping.geometry == "affine":
        tables, d, middle = line_tables(mapping, nu, d, center, precision.window)
    elif mapping.geometry == "distorted":
        tables, d, middle = point_tables(mapping, nu, d, center, precision.window)
    d = d * (2 / (n_fft[0] * n_fft[1]))
    d[:, 0] *= 0.5
    d[:, :, h_x - 1] *= 0.5
    d_plus, d_minus = d[:, :, h_x - 1 :], d[:, :, h_x - 1 :: -1]
    if mapping.geometry == "aligned":
        if mapping.matrix[0, 0] == 0:
            axes, nu = (1, 0), nu[::-1]
            d_plus, d_minus = d_plus.swapaxes(1, 2), d_minus.swapaxes(1, 2).conj()
        tables, middle = aligned_tables(mapping, nu, axes, center)
    d_plus, d_minus = _moved(d_plus, d_minus, nu, middle)
    in_y, in_x = (
        uniform_wave_table(nu[i], -center[axes[i]], 1.0, mapping.shape_in[axes[i]]).T
        for i in (0, 1)
    )
    return ResamplingPlan(
        mapping=mapping,
        n_bands=n_bands // n_terms,
        identity=n_terms == 1 and is_identity(mapping, psf_in, psf_out),
        certificate=Certificate(radius, n_fft, n_frequencies, max_gain, floored_power),
        nu=nu,
        axes=axes,
        d_plus=d_plus,
        d_minus=d_minus,
        in_y=in_y,
        in_x=in_x,
        psfs=(psf_in, psf_out),
        n_terms=n_terms,
        **tables,
    )


def _moved(d_plus, d_minus, nu, way):
    """D(+,+), D(+,-) with every observed pixel moved by `way` (2,) [model px] along table axes."""
    phase_y, phase_x = (np.exp(2j * np.pi * nu[i] * way[i]) for i in (0, 1))
    phase_y = phase_y[:, None]
    return d_plus * (phase_y * phase_x), d_minus * (phase_y * phase_x.conj())


def _check_size(mapping, psf_out, n_fft, n_bands, window: KaiserBessel):
    """Raises ValueError if a plan would need more than MAX_BYTES."""
    k = [_half_count(mapping.matrix, psf_out.spacing, i, n_fft[i]) for i in (0, 1)]
    n_bytes = 3 * 16 * n_bands * k[0] * 2 * k[1]  # D and both OTFs; then waves at the pixels
    n_bytes += 16 * sum(n * h for n, h in zip(mapping.shape_in, k, strict=True))
    n_out = mapping.shape_out
    if mapping.geometry == "distorted":
        n_bytes += 8 * (2 * window.n_taps + 3) * n_out[0] * n_out[1]
        n_out = [2 * window.oversampling * h + window.n_taps for h in k]  # of the plane, at most
    n_bytes += 16 * sum(n * h for n, h in zip(n_out, k, strict=True))
    if n_bytes > MAX_BYTES:
        size = float(np.sqrt(abs(np.linalg.det(mapping.matrix))))
        raise ValueError(
            f"an operator from {mapping.shape_in} to {mapping.shape_out} pixels, one {size:.3g} "
            f"times the other's size, needs tables of {n_bytes / 2**30:.3g} GiB, more than "
            f"{MAX_BYTES >> 30}: is the WCS right? If so, use smaller images, or TiledResampler"
        )


def _band(matrix, psf_in: PSF, psf_out: PSF, n_fft, precision: Precision):
    """The frequencies that are summed, D at them, max_gain and floored_power (see Certificate).

    returns nu (Hy,), (Hx,) [cycles per model px] >= 0, D (C, Hy, 2 Hx - 1) for nu_y >= 0 and nu_x
        from -max to +max and 0 where it is under the band's tolerance; max_gain, floored_power (C,)
    """
    nu_y, nu_x = (
        np.arange(_half_count(matrix, psf_out.spacing, i, n_fft[i])) / n_fft[i] for i in (0, 1)
    )
    both = np.concatenate([-nu_x[:0:-1], nu_x])
    psf_in, psf_out = (crop_psf(psf, FAINT * precision.band_tolerance) for psf in (psf_in, psf_out))
    d, max_gain, floored_power = transfer_function(
        psf_in.otf(nu_y, both), psf_out.otf(nu_y, both, matrix)
    )
    d = abs(np.linalg.det(matrix)) * d
    strong = np.abs(d) > precision.band_tolerance * np.abs(d).max(axis=(1, 2), keepdims=True)
    h_y = int(np.flatnonzero(strong.any(axis=(0, 2)))[-1]) + 1
    columns = np.flatnonzero(strong.any(axis=(0, 1))) - (len(nu_x) - 1)
    h_x = int(np.abs(columns).max()) + 1
    d = np.where(strong, d, 0)[:, :h_y, len(nu_x) - h_x : len(nu_x) + h_x - 1]
    return (nu_y[:h_y], nu_x[:h_x]), d, max_gain, floored_power


def count_bands(mapping: Mapping, psf_in: PSF, psf_out: PSF) -> int:
    """Bands of an operator between two PSFs of 1 or C bands.

    Raises ValueError for numbers of bands that do not agree, and for grids that do not overlap.
    """
    n_bands = max(psf_in.n_bands, psf_out.n_bands)
    for name, psf in (("psf_in", psf_in), ("psf_out", psf_out)):
        if psf.n_bands not in (1, n_bands):
            raise ValueError(
                f"{name} has {psf.n_bands} bands but the other PSF has {n_bands}: "
                "give one band or as many as the other"
            )
    if not mapping.covered.any():
        raise ValueError(
            "the grids do not overlap: no pixel of the observation "
            f"{mapping.shape_out} lies on the model {mapping.shape_in}"
        )
    return n_bands


def is_identity(mapping: Mapping, psf_in: PSF, psf_out: PSF) -> bool:
    """Same pixels and the same PSF: D = 1 and the operator must return its input bit for bit."""
    return (
        mapping.geometry == "aligned"
        and mapping.shape_in == mapping.shape_out
        and np.array_equal(mapping.matrix, np.eye(2))
        and not np.any(mapping.offset)
        and psf_in.spacing == psf_out.spacing
        and np.array_equal(psf_in.images, psf_out.images)
        and np.array_equal(psf_in.center, psf_out.center)
    )


def _odd(x: float) -> int:
    """The smallest odd number that is not less."""
    n = int(np.ceil(x))
    return n + 1 - n % 2


def _half_count(matrix, spacing: float, axis: int, n_fft: int) -> int:
    """Frequencies kappa >= 0 inside the bounding box of |A^T nu|_inf <= 1/(2 spacing)."""
    reach = np.abs(np.linalg.inv(matrix).T[axis]).sum() * 0.5 / spacing
    return min(int(np.floor(reach * n_fft * (1 + 1e-12))), (n_fft - 1) // 2) + 1
