"""Rules of tiles, and of the slabs of the paper's scheme."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.geometries import (
    GEOMETRIES,
    affine,
    distance,
    psfs,
    sky_grid,
)

from clresample.device.tuning import Tuning
from clresample.paper.operator.resampler import PaperResampler
from clresample.paper.operator.slabs import cut_slabs
from clresample.paper.operator.tables import cos_sin_table, wave_planes
from clresample.resampling.plan import Precision, make_resampling_plan
from clresample.resampling.tiled.layout import TileCosts, _taper, make_groups, window_of
from clresample.resampling.transfer import wrap_radius
from clresample.sky.grid import Grid
from clresample.sky.psf import PSF


def test_a_taper_is_one_inside_and_falls_smoothly_to_zero():
    y, x = _taper((40, 61), (8.0, 20.0))
    assert (y.shape, x.shape) == ((40,), (61,))
    for taper, width in ((y, 8), (x, 20)):
        np.testing.assert_array_equal(taper, taper[::-1])
        np.testing.assert_array_equal(taper[width:-width], 1)
        edge = taper[:width]
        assert (np.diff(edge) > 0).all() and 0 < edge[0] < 1e-2
        np.testing.assert_allclose(edge + edge[::-1], 1)  # about the middle of its width
        # smooth to order 3: it begins as the fourth power, 35 of it
        u = (np.arange(2) + 0.5) / width
        np.testing.assert_allclose(edge[:2], 35 * u**4, rtol=0.5)


def test_a_window_leaves_its_margin_and_half_a_pixel():
    for name, margin in (("30 degrees", (5, 9)), ("mirrored", (3, 3)), ("oblong pixels", (7, 4))):
        mapping = GEOMETRIES[name]()
        window = window_of(mapping, np.array(margin))
        places = window.at(*np.indices(window.shape_out)).reshape(-1, 2)
        low, high = places.min(axis=0), places.max(axis=0)
        assert (low >= np.array(margin) + 0.5 - 1e-9).all()
        np.testing.assert_allclose(low, np.array(window.shape_in) - 1 - high)  # in the middle
        assert (low <= np.array(margin) + 1.0).all()


def groups_of(device, grid_in, psf_in, grid_out, psf_out, *, memory, tolerance_px=1e-4):
    return make_groups(
        grid_in,
        psf_in,
        grid_out,
        psf_out,
        precision=Precision.of(np.float32),
        tolerance_px=tolerance_px,
        tuning=replace(Tuning.of(device, np.float32), tile_flops=0.0, pixel_flops=0.0),
        memory=memory,
    )


def check_groups(groups, grid_in, grid_out, psf_out, tolerance_px):
    """Windows that reach half the wrap radius, or more, beyond their tiles before they fall off
    over as much, or 24 px; pixels within the tolerance of where they are; each given once."""
    given = np.zeros(grid_out.shape, int)
    for group in groups:
        mapping = group.mapping
        radius = np.array(wrap_radius(psf_out, mapping.matrix))
        margin = radius / 2 + np.maximum(radius / 2, 24)
        margins = [np.ceil(margin * off) for off in (0.998, 1, 1.002)]  # bent scales differ
        places = mapping.at(*np.indices(mapping.shape_out))
        inside, shift = places.reshape(-1, 2), 0.5
        if mapping.geometry == "distorted":  # of that one tile, as far as there is a model
            tile = grid_out.cutout(*group.tiles[0].origin, mapping.shape_out)
            inside, shift = places[tile.map_to(grid_in, 0.0).covered], 0.0
        for axis, taper in enumerate(group.taper):
            x = np.arange(len(taper))
            low, high = inside[:, axis].min(), inside[:, axis].max()
            for beyond in (low, len(taper) - 1 - high):
                rest = [beyond - n[axis] - shift for n in margins]
                assert any(-1e-6 <= x < (0.5 if shift else 1) + 1e-6 for x in rest)
            away = np.maximum(low - x, x - high)
            assert (taper[away <= radius[axis] / 2] > 1 - 1e-6).all()
            middle = away[np.abs(taper - 0.5).argmin()] - shift
            wanted = (radius[axis] / 2 + margin[axis]) / 2
            assert abs(middle - wanted) < 1.6
        for tile in group.tiles:
            (y, x), shape = tile.origin, tile.mask.shape
            given[y : y + shape[0], x : x + shape[1]] += tile.mask
            true = grid_out.cutout(y, x, shape).map_to(grid_in, 0.0)
            true = true.at(*np.indices(shape))
            off = np.hypot(*(places + tile.window_origin - true)[tile.mask].T)
            assert off.max() <= tolerance_px + 1e-9
    np.testing.assert_array_equal(given, grid_out.map_to(grid_in).covered)


def test_tiles_of_flat_frames(device):
    grid_in = Grid.flat((200, 190), 0.1)
    for sigma, angle in ((1.2, 20), (6.0, 0), (1.2, 90)):  # 6: radius wider than twice the taper
        grid_out = Grid.flat((90, 95), 0.2, angle_deg=angle)
        psf_in, psf_out = PSF.gaussian(1.5, n_pixels=25), PSF.gaussian(sigma, n_pixels=65)
        groups = groups_of(device, grid_in, psf_in, grid_out, psf_out, memory=3 << 20)
        assert len(groups) == 1 and (angle != 20 or len(groups[0].tiles) > 1)
        check_groups(groups, grid_in, grid_out, psf_out, 1e-6)


@pytest.mark.parametrize("sip, angle", [(1.3e-7, 0), (5e-8, 30), (5e-5, 10)])
def test_tiles_of_bent_frames(device, sip, angle):
    """Some tiles aligned and some affine; all of them affine; all of them distorted."""
    grid_in, grid_out = sky_grid((150, 140), 0.1), sky_grid((120, 130), 0.12, angle, sip=sip)
    psf_in, psf_out = PSF.gaussian(1.5, n_pixels=25), PSF.gaussian(1.4, n_pixels=25)
    groups = groups_of(device, grid_in, psf_in, grid_out, psf_out, memory=7 << 16)
    kinds = {group.mapping.geometry for group in groups}
    n_tiles = sum(len(group.tiles) for group in groups)
    if sip == 5e-5:
        assert kinds == {"distorted"} and len(groups) == n_tiles
    else:
        assert kinds == ({"affine"} if angle else {"aligned", "affine"})
        assert 1 < len(groups) < n_tiles
    check_groups(groups, grid_in, grid_out, psf_out, 1e-4)


def test_sides_are_the_longer_ones():
    """Of windows, lengths and lines of pixels that are not square, at most by a few per cent."""
    given, precision = (PSF.gaussian(0.9), PSF.gaussian([1.1, 1.3])), Precision.of(np.float32)
    for matrix in ([[0.5, 0.1], [0.3, 3.0]], [[2.4, 0.3], [0.2, 0.7]], [[1.0, 2.5], [-1.2, 0.4]]):
        for margin in ((14, 30), (30, 14)):
            trial = affine(matrix, (90, 90), (32, 32))
            sizes = TileCosts(trial, np.array(margin), *given, precision, SimpleNamespace())
            for m in (12, 60, 100):
                window = window_of(affine(matrix, (90, 90), (m, m)), np.array(margin))
                plan = make_resampling_plan(window, *given, precision=precision)
                n, k, j = sizes.sides("affine", m)
                assert n >= max(window.shape_in)
                assert k >= max(len(plan.in_y), len(plan.in_x))
                assert j >= plan.out_x.shape[1]


def test_slabs_take_every_unit_once_and_are_alike():
    for n_units, unit_rows, n_slabs, chunk in ((17, 6, 4, 10), (5, 3, 9, 100), (8, 2, 1, 3)):
        slabs = cut_slabs(n_units, unit_rows, n_slabs, chunk)
        assert len(slabs) == min(n_slabs, n_units)
        assert [s.first for s in slabs] == list(np.cumsum([0, *(s.n_units for s in slabs)])[:-1])
        assert sum(s.n_units for s in slabs) == n_units
        assert max(s.n_units for s in slabs) - min(s.n_units for s in slabs) <= 1
        for s in slabs:
            rows = s.n_units * unit_rows
            assert s.chunk <= chunk and s.n_chunks == -(-rows // chunk)
            assert rows <= s.n_rows == s.n_chunks * s.chunk < rows + s.n_chunks


def test_waves_of_the_papers_scheme():
    k, x = 9, np.array([0.3, -2.7, 1000.25])
    planes = wave_planes(k, x, 8)
    angle = 2 * np.pi * np.arange(5)[:, None] * x / k
    np.testing.assert_allclose(planes[:, 0, :3], np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(planes[:, 1, :3], np.sin(angle), atol=1e-12)
    assert not planes[:, :, 3:].any()
    angle = 2 * np.pi * np.arange(6)[:, None] * np.arange(5) / k
    table = cos_sin_table(6, k)
    assert table.shape == (6, 10)
    assert distance(table[:, 0::2], np.cos(angle)) < 1e-15 * 10
    np.testing.assert_allclose(table[:, 1::2], np.sin(angle), atol=1e-14)


def test_slabs_fit_the_cache_and_the_largest_buffer(device, monkeypatch):
    """But for a unit by which they may differ; they are no more than that takes.

    As many images go together as fit with them.
    """
    mapping, pair = GEOMETRIES["30 degrees"](), psfs()
    found = PaperResampler.from_mapping(mapping, *pair, device=device)._factors
    model, kernel = (found.n_terms * n * 4 for n in (found.n_cols, found.l_pad))  # [bytes]
    for cache, largest in ((model // 5, 1 << 30), (1 << 30, kernel // 3), (3 * model, 1 << 30)):
        with monkeypatch.context() as patch:
            patch.setattr(found, "tuning", replace(found.tuning, slab_bytes=cache))
            patch.setattr(device, "max_alloc", largest)
            found.prepare()
        most = max(slab.n_units for slab in found.slabs) - 1
        assert most * found.unit_rows * found.n_cols * 4 <= cache
        assert most * found.unit_rows * found.l_pad * 4 <= largest / 2
        fewer = len(found.slabs) - 1
        assert model > fewer * cache or kernel > fewer * (largest // 2)
        one = max(slab.n_rows for slab in found.slabs) * found.n_cols * 4
        assert found.group == max(1, cache // one)
