"""Promises of every operator between two pixel grids, however it computes its sums."""

import numpy as np
import pytest
from astropy import units as u
from astropy.wcs import WCS
from helpers.geometries import GEOMETRIES, distance, operator, psfs

from clresample.device.device import Device
from clresample.paper.operator.resampler import PaperResampler
from clresample.resampling import resampler
from clresample.resampling.grid_operator import GridOperator
from clresample.resampling.resampler import Resampler
from clresample.resampling.tiled.resampler import TiledResampler
from clresample.resampling.transfer import Certificate, floor_warnings
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF

every_operator = pytest.mark.parametrize("kind", [Resampler, PaperResampler, TiledResampler])
GRID_IN = Grid.flat((40, 37), 0.1)
GRID_OUT = Grid.flat((22, 19), 0.2, angle_deg=20, center_arcsec=(0.05, 0.1))


def make(kind, device, **options):
    return kind(GRID_IN, psfs()[0], GRID_OUT, psfs()[1], device=device, **options)


@every_operator
def test_what_can_be_read_back(device, kind):
    op = make(kind, device)
    assert isinstance(op, GridOperator)
    mapping = GRID_OUT.map_to(GRID_IN)
    np.testing.assert_array_equal(op.mapping.matrix, mapping.matrix)
    np.testing.assert_array_equal(op.mapping.offset, mapping.offset)
    np.testing.assert_array_equal(op.covered, mapping.covered)
    assert 0 < op.covered.mean() < 1
    assert op.geometry == mapping.geometry == "affine"
    assert (op.shape_in, op.shape_out) == ((2, 40, 37), (2, 22, 19))
    outside = op(np.ones(op.shape_in))[:, ~op.covered]
    assert outside.size and not outside.any()


@every_operator
def test_one_shape_rule_for_shifts(device, kind):
    op = make(kind, device, shift=(0.25, -1))
    np.testing.assert_array_equal(op.shift, (0.25, -1))
    x = np.random.default_rng(1).normal(size=op.shape_in)
    shifted = op(x)
    op.shift = 0.5
    np.testing.assert_array_equal(op.shift, (0.5, 0.5))
    op.shift = [(0.25, -1)]  # as one of a batch of one
    np.testing.assert_array_equal(op.shift, (0.25, -1))
    np.testing.assert_array_equal(op(x), shifted)
    for wrong in ((1, 2, 3), [(0, 0), (1, 1)], (np.nan, 0), (0, np.inf), [[1], [2]]):
        with pytest.raises(ValueError, match=r"shift is .*must be \(2,\)"):
            op.shift = wrong
    np.testing.assert_array_equal(op.shift, (0.25, -1))
    np.testing.assert_array_equal(op(x), shifted)
    with pytest.raises(ValueError, match="read-only"):
        op.shift[0] = 3.0
    with pytest.raises(ValueError, match="shift is"):
        make(kind, device, shift=(np.nan, 0))


@every_operator
def test_complex_images_are_refused(device, kind):
    op = make(kind, device)
    x, y = np.ones(op.shape_in, complex), np.ones(op.shape_out, complex)
    for run, name, image in ((op.forward, "x", x), (op.adjoint, "y", y), (op.T.forward, "x", y)):
        with pytest.raises(
            ValueError, match=f"{name} must be an array of real numbers, not of type complex128"
        ):
            run(image)


@every_operator
def test_the_certificate_names_what_was_found(device, kind):
    found = make(kind, device).certificate
    assert isinstance(found, Certificate)
    assert all(k % 2 == 1 and k > n for k, n in zip(found.n_fft, (40, 37), strict=True))
    assert all(0 < h <= (k + 1) // 2 for h, k in zip(found.n_frequencies, found.n_fft, strict=True))
    assert all(5 < radius < 60 for radius in found.wrap_radius_px)
    np.testing.assert_allclose(found.max_gain, (1, 1), rtol=1e-6)
    assert found.floored_power.shape == (2,) and not floor_warnings(found)
    with pytest.raises(AttributeError):
        found.n_fft = (1, 1)
    for figure in (f"K = {found.n_fft[0]}, {found.n_fft[1]}", "gain <= 1;", "px", "0.00%"):
        assert figure in repr(found)
    assert "\n" not in repr(found)


def test_a_batch_of_geometries_gives_one_of_each(device):
    plans = [make(Resampler, device).plans[0]] * 3
    op = Resampler.from_plans(plans, device=device, shift=(1, 0))
    assert len(op.mapping) == len(op.certificate) == 3
    assert op.covered.shape == (3, 22, 19) and op.geometry == "affine"
    np.testing.assert_array_equal(op.shift, [(1, 0)] * 3)
    op.shift = [(0, 0), (1, 1), (2, 2)]
    np.testing.assert_array_equal(op.shift[1], (1, 1))
    with pytest.raises(ValueError, match=r"shift is .*\(2,\) or \(3, 2\)"):
        op.shift = [(0, 0)]


@pytest.mark.parametrize("kind", [Resampler, PaperResampler])
def test_from_a_mapping_or_from_two_grids(device, kind):
    op = make(kind, device, shift=(0.5, 0))
    again = kind.from_mapping(op.mapping, *psfs(), device=device, shift=(0.5, 0))
    x = np.random.default_rng(2).normal(size=op.shape_in)
    np.testing.assert_array_equal(op(x), again(x))
    with pytest.raises(ValueError, match="psf_in has 2 bands.*3"):
        kind.from_mapping(op.mapping, psfs()[0], PSF.gaussian([1, 2, 3]), device=device)


def test_the_public_way_past_the_checks(device):
    op = Resampler.from_mapping(GEOMETRIES["30 degrees"](), *psfs(), device=device)
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, *op.shape_in)), rng.normal(size=(2, *op.shape_out))
    for run, into, image, shape in (
        (op.forward, op.forward_into, x, op.shape_out),
        (op.adjoint, op.adjoint_into, y, op.shape_in),
    ):
        image = image.astype(np.float32)
        out = device.empty((2, *shape), np.float32)
        assert into(device.put(image), out) is None
        np.testing.assert_array_equal(out.get(), run(image))


def test_whole_frames_in_arrays_of_any_layout_and_type(device):
    op = make(TiledResampler, device)
    x = np.random.default_rng(4).normal(size=(3, *op.shape_in)).astype(np.float32)
    truth = op(x)
    assert truth.dtype == np.float32
    for layout in (np.asfortranarray(x), x.astype(">f4"), x.astype(float), x.tolist()):
        np.testing.assert_array_equal(op(layout), truth)
    for out in (
        np.full(truth.shape, np.nan, np.float32),
        np.full(truth.shape, np.nan),  # float64: cast
        np.full((*truth.shape, 2), np.nan, np.float32)[..., 1],
    ):
        assert op.forward(x, out=out) is out
        np.testing.assert_array_equal(out, truth)
    for out, match in (([1.0], "out is a builtins.list"), (np.zeros((5, 5)), "out has shape")):
        with pytest.raises(ValueError, match=match):
            op.forward(x, out=out)
    with pytest.raises(ValueError, match=r"x has shape \(0, 2, 40, 37\)"):
        op(x[:0])
    with pytest.raises(ValueError, match="y is on the device: TiledResampler takes NumPy arrays"):
        op.adjoint(device.zeros(op.shape_out, np.float32))


def test_the_result_may_replace_the_image(device):
    grid = Grid.flat((30, 31), 0.1)
    shifted = TiledResampler(grid, PSF.gaussian(1.0), grid, PSF.gaussian(1.5), device=device)
    x = np.random.default_rng(5).normal(size=shifted.shape_in).astype(np.float32)
    truth = shifted(x)
    assert distance(shifted.forward(x, out=x), truth) == 0


def test_a_turned_grid_of_the_papers_scheme_says_what_it_costs(device):
    op = make(PaperResampler, device)
    k_y, k_x = op.certificate.n_fft
    # both halves of nu_x, cos and sin, for nu_y >= 0
    assert op.n_terms == (k_y + 1) // 2 * 4 * ((k_x + 1) // 2)
    assert op.model_axis in (0, 1)


@every_operator
@pytest.mark.parametrize(
    "given, said",
    [
        ({"grid_in": None}, r"grid_in is None \(NoneType\), must be Grid"),
        ({"psf_in": None}, "psf_in is None"),
        ({"grid_out": (3, 3)}, "grid_out is"),
        ({"psf_out": "psf.fits"}, r"psf_out is 'psf.fits' .str., must be PSF: give PSF\(array\)"),
        (
            {"grid_in": WCS(naxis=2)},
            r"grid_in is a WCS without a shape: give Grid.from_wcs",
        ),
        ({"tolerance_px": np.nan}, "tolerance_px is nan"),
        ({"tolerance_px": -1}, "tolerance_px is -1"),
        ({"dtype": None}, "dtype is None, must be float32 or float64"),
        ({"dtype": "nonsense"}, "dtype is 'nonsense'"),
        ({"dtype": complex}, "dtype is .*complex"),
        ({"shift": "a"}, "shift must be"),
    ],
)
def test_parts_of_other_types_are_refused_by_name(device, kind, given, said):
    parts = {
        "grid_in": Grid.flat((12, 12), 0.1),
        "psf_in": PSF.gaussian(1.0, n_pixels=11),
        "grid_out": Grid.flat((6, 6), 0.2),
        "psf_out": PSF.gaussian(1.0, n_pixels=11),
        "device": device,
    }
    with pytest.raises(ValueError, match=said):
        kind(**(parts | given))


@every_operator
def test_wcs_that_know_their_shape_are_grids_and_arrays_are_psfs(device, kind):
    grids = Grid.flat((12, 13), 0.1), Grid.flat((6, 7), 0.2, angle_deg=8)
    wcs = [grid.to_wcs(ra_deg=10, dec_deg=3) for grid in grids]
    for one, grid in zip(wcs, grids, strict=True):
        one.array_shape = grid.shape
    psf = PSF.gaussian(1.0, n_pixels=11)
    op = kind(wcs[0], psf.images[0], wcs[1], psf.images[0], device=device)
    pair = (Grid.from_wcs(one, grid.shape) for one, grid in zip(wcs, grids, strict=True))
    model, seen = pair
    x = np.random.default_rng(1).random((12, 13))
    np.testing.assert_array_equal(op(x), kind(model, psf, seen, psf, device=device)(x))


@every_operator
def test_arrays_that_are_no_real_numbers_are_refused_by_name(device, kind):
    op = make(kind, device)
    x = np.ones(op.shape_in)
    masked = np.ma.MaskedArray(x, False)
    np.testing.assert_array_equal(op(masked), op(x))
    masked[..., 0, 0] = np.ma.masked
    for image, said in (
        (masked, "x is masked at"),
        (x.astype("M8[s]"), "not of type datetime64"),
        (x.astype(str), "not of type <U"),
    ):
        with pytest.raises(ValueError, match=said):
            op(image)
    y = op(x)
    with_unit = op(x * u.nJy)
    assert with_unit.unit == u.nJy
    np.testing.assert_array_equal(with_unit.value, y)
    np.testing.assert_array_equal(op.T(y * u.nJy).value, op.adjoint(y))
    fixed = y.copy()
    fixed.flags.writeable = False
    for out in (y.astype(int), y.astype(complex), fixed, np.ma.MaskedArray(y, False), y * u.Jy):
        with pytest.raises(ValueError, match="out is a .*must be a plain array of floats"):
            op(x, out=out)


def test_no_launch_has_more_groups_than_a_gpu_takes(device, monkeypatch):
    """Batches larger than that, launched as on a GPU."""
    launches, launch = [], Device.launch
    monkeypatch.setattr(device, "kind", "GPU")
    monkeypatch.setattr(resampler, "MAX_GROUPS", 7)

    def seen(self, kernel, size, local):
        launches.append([n // g for n, g in zip(size, local)])
        return launch(self, kernel, size, local)

    monkeypatch.setattr(Device, "launch", seen)
    for mapping in (GEOMETRIES["mirrored"](), GEOMETRIES["distorted"]()):
        op = operator(device, mapping, *psfs())
        x = np.random.default_rng(3).standard_normal((11, *op.shape_in)).astype(np.float32)
        y = op(x)
        assert distance(y[10], op(x[10])) < 1e-6
        op.adjoint(y)
    assert max(groups[-1] for groups in launches) <= 7  # images, two bands each
