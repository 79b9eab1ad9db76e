"""Names of observations and channels that are to be parts of FITS columns' names."""

import warnings

import pytest
from astropy.io import fits
from helpers.blends import SCALE, blend, observe, round_component

from clresample.files.fits_names import check_catalogue_names, text_card
from clresample.files.results import write_result
from clresample.files.tables import read_catalogue, write_catalogue
from clresample.measurement.catalogue import catalogue
from clresample.sky.grid import Grid


def test_columns_too_long_for_fits_are_refused_by_name(tmp_path):
    """As colours of two channels, each of which by itself would do, and chi2 of observations."""
    grid, names = Grid.flat((60, 70), SCALE), ("g" * 30, "r" * 30)
    one = observe(grid, names, zero_points=(25.0, 25.0))
    result = blend([round_component(0, (30, 35), (1, 2))], observations=(one,))
    check_catalogue_names([one])
    with pytest.raises(ValueError, match="'colour_err_ggggggggg'... of the catalogue has 72 char"):
        check_catalogue_names([one], magnitudes=True)
    with pytest.raises(ValueError, match="of the catalogue has 69 characters, FITS takes 68"):
        check_catalogue_names([observe(grid, ("i",), name="o" * 64)])
    with pytest.raises(ValueError, match="has 60 characters, columns of the catalogue take 53"):
        check_catalogue_names([observe(grid, ("i" * 50 + "'" * 5,))])
    table = catalogue(result, magnitudes=True)
    with pytest.raises(ValueError, match="give observations and channels shorter names"):
        write_catalogue(tmp_path / "cat.fits", table)
    assert not list(tmp_path.iterdir())
    write_catalogue(tmp_path / "cat.ecsv", table)
    write_result(tmp_path / "blend.fits", result)  # whose catalogue is without colours then
    assert read_catalogue(tmp_path / "blend.fits").colnames[-1] == "ambiguous_with"
    assert "mag_" not in " ".join(read_catalogue(tmp_path / "blend.fits").colnames)


@pytest.mark.parametrize("text", ["x" * n for n in range(46, 75)] + ["'" * 27, "'" * 30, "'" * 40])
def test_comments_are_left_out_where_a_card_has_no_room(text):
    """Cut by astropy, they would be a warning to the user."""
    header = fits.Header()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        header["BUNIT"] = text_card(text, "flux per pixel")
        found = fits.Header.fromstring(header.tostring())
    length = len(text) + text.count("'")
    room = length <= 68 - len(" / flux per pixel") or length > 68
    assert (found["BUNIT"], found.comments["BUNIT"]) == (text, "flux per pixel" if room else "")
