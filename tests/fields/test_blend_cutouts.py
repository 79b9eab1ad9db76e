"""Observations of one blend, cut from a field's mosaics."""

from types import SimpleNamespace

import numpy as np
import pytest

from clresample import PSF, Grid
from clresample.fields.blends.cutouts import make_blend
from clresample.fields.blends.plan import FitPlan, FitRegion
from clresample.fields.execution.group_inputs import FitGroup, gather_inputs
from clresample.fields.mosaic import Mosaic
from clresample.sky.box import Box

REGION = Box(5, 9, 133, 137)  # of labels.npy, in the reference's pixels


@pytest.mark.parametrize("x0, angle_deg", [(61, 0), (64, 0), (66, 0), (64, 40)])
def test_pixels_of_other_blends_have_no_weight_also_beyond_the_box(tmp_path, x0, angle_deg):
    """Cutouts of coarse pixels end up to a multiple of 4 of them beyond the blend's box."""
    grids = Grid.flat((140, 150), 0.1), Grid.flat((44, 50), 0.3, angle_deg=angle_deg)
    reference, coarse = (Grid.from_wcs(g.to_wcs(ra_deg=10.0, dec_deg=-3.0), g.shape) for g in grids)
    psf = PSF.gaussian(1.5)
    mosaics = tuple(
        Mosaic.of_arrays(name, np.ones(g.shape), psf, g, weights=1.0)
        for name, g in (("fine", reference), ("coarse", coarse))
    )
    patch = FitRegion(0, 1, Box(40, x0, 72, x0 + 32), (0,))
    labels = np.full((128, 128), 2, np.int32)  # another blend fills all that is not of this one
    own = patch.box.grown(-4)
    labels[own.relative_to(REGION).slices] = 1
    np.save(tmp_path / "labels.npy", labels)
    plan = FitPlan(np.array([[56.0, x0 + 16.0]]), np.array([9]), np.ones(1), (patch,), ((0,),))
    job = SimpleNamespace(
        folder=tmp_path, plan=plan, mosaics=mosaics, reference=reference, origin_px=REGION[:2]
    )
    corner, near = gather_inputs(job, FitGroup("a", (0,))).labels[0]
    blend, boxes = make_blend(patch, plan, mosaics, reference, near, corner)
    for mosaic, o in zip(mosaics, blend.observations, strict=True):
        places = np.indices(o.shape[1:]).reshape(2, -1) + np.array(boxes[mosaic.name][:2])[:, None]
        at = mosaic.grid.positions_in(reference, *places)
        expected = own.contains(at).reshape(o.shape[1:])
        assert 0 < expected.sum() < expected.size
        np.testing.assert_array_equal(o.weights[0] > 0, expected)
    reach = mosaics[1].grid.positions_in(reference, *np.array(boxes["coarse"]).reshape(2, 2).T)
    assert (reach < np.array(patch.box[:2])).any() or (reach > np.array(patch.box[2:])).any()
