"""astropy's image containers, and regions of catalogues."""

import numpy as np
import pytest
from astropy import units as u
from astropy.nddata import (
    CCDData,
    Cutout2D,
    InverseVariance,
    NDData,
    StdDevUncertainty,
    UnknownUncertainty,
    VarianceUncertainty,
)
from astropy.table import QTable

from clresample import PSF, Grid
from clresample.adapters.astropy import observation_of, regions_of

WCS = Grid.flat((12, 14), 0.2, angle_deg=10).to_wcs(ra_deg=150, dec_deg=2)
PIXELS = np.random.default_rng(1).standard_normal((12, 14))
NARROW = PSF.gaussian(1.5, n_pixels=11)


@pytest.mark.parametrize(
    "uncertainty",
    [StdDevUncertainty(np.full((12, 14), 2.0)), VarianceUncertainty(np.full((12, 14), 4.0)),
     InverseVariance(np.full((12, 14), 0.25))],
)  # fmt: skip
def test_every_kind_of_uncertainty_is_a_weight(uncertainty):
    mask = np.zeros((12, 14), bool)
    mask[3, 4] = True
    image = CCDData(PIXELS, unit="adu", wcs=WCS, mask=mask, uncertainty=uncertainty)
    o = observation_of(image, NARROW, channels=["g"])
    np.testing.assert_array_equal(o.data[0][~mask], PIXELS[~mask])
    np.testing.assert_array_equal(o.weights[0], np.where(mask, 0, 0.25))
    assert o.zero_points is None


def test_units_of_flux_give_the_zero_point():
    o = observation_of(CCDData(PIXELS, unit="nJy", wcs=WCS), NARROW)
    assert o.zero_points == pytest.approx([31.4], abs=1e-3)
    with pytest.raises(ValueError, match="MJy / sr"):
        observation_of(NDData(PIXELS, unit="MJy/sr", wcs=WCS), NARROW)


def test_a_cutout_keeps_its_place():
    whole = Grid.from_wcs(WCS, PIXELS.shape)
    cut = Cutout2D(PIXELS, (7, 6), (5, 6), wcs=WCS)
    o = observation_of(cut, NARROW, weights=1.0)
    y0, x0 = cut.origin_original[::-1]
    np.testing.assert_allclose(o.grid.positions_in(whole, 0, 0), (y0, x0), atol=1e-6)


def test_what_cannot_be_used_is_refused():
    with pytest.raises(ValueError, match="no wcs"):
        observation_of(NDData(PIXELS), NARROW)
    unknown = NDData(PIXELS, wcs=WCS, uncertainty=UnknownUncertainty(PIXELS))
    with pytest.raises(ValueError, match="UnknownUncertainty"):
        observation_of(unknown, NARROW)


def test_regions_hold_the_moments():
    """An ellipse on the sky, drawn on pixels: its second moments are those of the catalogue."""
    pytest.importorskip("regions", reason="regions is not installed")
    table = QTable(
        {"name": ["a", "star"], "ra": [150, 150.0005] * u.deg, "dec": [2, 2] * u.deg,
         "rms_size": [1.0, np.nan] * u.arcsec, "e1": [0.3, np.nan], "e2": [0.4, np.nan],
         "position_angle": [np.degrees(np.arctan2(0.4, 0.3)) / 2, np.nan] * u.deg}
    )  # fmt: skip
    ellipse, circle = regions_of(table)
    assert ellipse.meta["text"] == "a"
    assert circle.radius == 1 * u.arcsec
    grid = Grid.flat((400, 400), 0.02)  # north up, east left
    mask = ellipse.to_pixel(grid.to_wcs(ra_deg=150, dec_deg=2)).to_mask(mode="center")
    inside = mask.to_image(grid.shape) > 0
    north, west = (np.argwhere(inside) - np.argwhere(inside).mean(0)).T * 0.02
    nn, ee, ne = (north**2).mean(), (west**2).mean(), -(north * west).mean()
    # a uniform ellipse has a quarter of its squared half-axes; ours are twice the moments' roots
    assert np.sqrt((nn + ee) / 2) == pytest.approx(1.0, rel=0.01)
    assert (nn - ee) / (nn + ee) == pytest.approx(0.3, abs=0.01)
    assert 2 * ne / (nn + ee) == pytest.approx(0.4, abs=0.01)
    with pytest.raises(ValueError, match="no ra and dec"):
        regions_of(table[["name", "rms_size"]])
