"""Readers and PSF formats that other packages add by entry points."""

import re
import sys

import numpy as np
import pytest
from astropy.io import fits
from helpers.checkout import ROOT

from clresample import PSF, read_field, read_scene
from clresample.fields.psfs.read import FORMATS, read_psf_field
from clresample.fields.readers.formats import READERS, read_survey
from clresample.files.scene_keys import SceneError
from clresample.sky.box import Box
from clresample.sky.grid import Grid

MODULE = """
import numpy as np
from clresample import Grid, Mosaic, PSF
from clresample.fields.mosaic import Channel, FilePlane, ConstantPlane


def read_dots(path, **given):
    grid = Grid.from_wcs(Grid.flat((20, 21), 0.2).to_wcs(ra_deg=10, dec_deg=2), (20, 21))
    channel = Channel(given.get("channels", ["dots"])[0], FilePlane(path[0], 0), ConstantPlane(1.0))
    given["inputs"]["dots"] = path[0]
    return Mosaic(given.get("name", "Dots"), grid, (channel,), given["psf"](grid))


def read_round(path, grid, *, spacing, **given):
    return PSF.gaussian(float(path.read_text()), n_pixels=15, spacing=spacing)


def read_nothing(path, *more, **given):
    return None
"""
POINTS = """[clresample.readers]
dots = fake_survey:read_dots
hst = fake_survey:read_nothing
nothing = fake_survey:read_nothing
broken = fake_survey:missing

[clresample.psf_formats]
round = fake_survey:read_round
none = fake_survey:read_nothing
"""
FIELD = """
[[mosaic]]
name = "D"
format = "dots"
path = "dots.fits"
psf = "width.txt"
psf_format = "round"
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package beside ours with readers of its own, as an installer leaves it."""
    site = tmp_path / "site"
    about = site / "fake_survey-1.2.dist-info"
    about.mkdir(parents=True)
    (site / "fake_survey.py").write_text(MODULE)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: fake-survey\nVersion: 1.2\n")
    (about / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(site))
    yield site
    sys.modules.pop("fake_survey", None)


def test_a_field_is_read_by_anothers_reader_and_psf(package, tmp_path):
    fits.PrimaryHDU(np.ones((20, 21), "f4")).writeto(tmp_path / "dots.fits")
    (tmp_path / "width.txt").write_text("1.3")
    (tmp_path / "field.toml").write_text(FIELD)
    (mosaic,) = read_field(tmp_path / "field.toml").mosaics
    assert mosaic.name == "D" and mosaic.channels[0].name == "dots"
    assert mosaic.psf.psf_at(3, 4).fwhm_px[0] == pytest.approx(3.1, abs=0.3)
    (tmp_path / "scene.toml").write_text(FIELD.replace("mosaic", "observation"))
    assert [o.name for o in read_scene(tmp_path / "scene.toml").observations] == ["D"]


def test_the_names_are_listed_and_our_own_stay(package, tmp_path):
    assert list(READERS)[-3:] == ["broken", "dots", "nothing"] and "round" in FORMATS
    assert READERS["hst"].__module__ == "clresample.fields.readers.hst"
    (tmp_path / "field.toml").write_text(FIELD.replace("dots", "dosts", 1))
    with pytest.raises(SceneError, match='format is .dosts., must be .*"legacy" or "broken"'):
        read_field(tmp_path / "field.toml")


def test_faults_of_others_are_told_in_one_line(package, tmp_path):
    grid = Grid.flat((9, 9), 0.2)
    for go, said in (
        (
            lambda: read_survey("broken", "x"),
            "'broken' of fake-survey 1.2 cannot be",
        ),
        (lambda: read_survey("nothing", "x"), "reader 'nothing' is None .*, must be Mosaic"),
        (
            lambda: read_psf_field(tmp_path, "none", grid),
            "'none' is None .*, must be PSFField or",
        ),
    ):
        with pytest.raises(ValueError, match=said):
            go()
    other = package / "other-1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (other / "entry_points.txt").write_text("[clresample.readers]\ndots = json:loads\n")
    with pytest.raises(ValueError, match="added by fake-survey 1.2 and other 1: uninstall one"):
        read_survey("dots", "x")


def test_the_reader_of_the_documentation_reads(tmp_path):
    text = (ROOT / "docs" / "howto" / "formats.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    exec(code, names := {})
    wcs = Grid.flat((9, 8), 0.2).to_wcs(ra_deg=10, dec_deg=2).to_header()
    planes = [
        fits.ImageHDU(np.full((9, 8), v, "f4"), wcs, name=n) for v, n in ((2, "SCI"), (5, "WHT"))
    ]
    planes[0].header["FILTER"], planes[0].header["ZP"] = "g", 27.5
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(tmp_path / "one.fits")
    inputs, psf = {}, PSF.gaussian(1.2, n_pixels=11)
    mosaic = names["read_my_survey"](
        [tmp_path / "one.fits"], inputs=inputs, notes=[], psf=lambda grid: psf
    )
    (channel,) = mosaic.channels
    box = Box(1, 1, 4, 5)
    assert (channel.read(box) == 2).all() and (channel.weights(box) == 5).all()
    assert (channel.name, channel.zero_point) == ("g", 27.5) and len(inputs) == 1


def test_without_such_packages_our_own_remain():
    assert "dots" not in READERS and "round" not in FORMATS
    assert len(READERS) == 6 and len(FORMATS) == 7
