"""Displays of objects in notebooks: one line, a card, a figure; none dumps arrays."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from clresample import (
    PSF,
    Detection,
    ExtendedSource,
    Frame,
    Grid,
    Observation,
    Resampler,
    TiledResampler,
    deblend,
)

FLAT = Grid.flat((24, 30), 0.2)
GRI = PSF.gaussian([1.5, 1.6, 1.7], n_pixels=15)


@pytest.fixture(scope="module")
def result():
    y, x = np.indices((24, 30))
    light = 50 * np.exp(-0.5 * ((y - 12) ** 2 + (x - 14) ** 2) / 2.5**2)
    data = light + np.random.default_rng(1).standard_normal((3, 24, 30))
    mask = np.zeros((24, 30), bool)
    mask[:4] = True
    o = Observation(data, GRI, FLAT, variance=1.0, mask=mask, channels=list("gri"), name="<Rubin>")
    return deblend([o], [ExtendedSource(sky_deg=tuple(FLAT.sky(12, 14)))])


@pytest.fixture(scope="module")
def objects(result):
    grid = Grid.from_wcs(FLAT.to_wcs(ra_deg=10, dec_deg=5), FLAT.shape)
    operator = Resampler(FLAT, GRI, Grid.flat((10, 10), 0.4), GRI)
    image = np.where(np.indices(FLAT.shape)[0] > 3, 9.0, 0)
    found = Detection(
        (ExtendedSource(position_px=(12, 14)), ExtendedSource(position_px=(3, 4))),
        Frame(FLAT, GRI.select([0])), np.array([20.5, 5.1]), ("<Rubin>", "all"), image,
        np.arange(2),
    )  # fmt: skip
    return {"FLAT": FLAT, "Grid": grid, "Detection": found, "PSF": GRI,
            "Observation": result.observations[0], "Result": result,
            "Certificate": operator.certificate}  # fmt: skip


NAMES = "FLAT", "Grid", "PSF", "Observation", "Detection", "Result", "Certificate"


class Tags(HTMLParser):
    """Checks that tags close in order."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.parametrize("name", NAMES)
def test_the_repr_is_one_line_without_arrays(objects, name):
    text = repr(objects[name])
    assert "\n" not in text and "array(" not in text
    assert len(text) < 200


@pytest.mark.parametrize("name", NAMES)
def test_the_card_is_whole_html(objects, name):
    text = objects[name]._repr_html_()
    tags = Tags()
    tags.feed(text)
    assert not tags.open
    assert "<Rubin>" not in text  # names are escaped


def test_results_and_detections_count_their_sources(objects):
    assert len(objects["Result"]) == 1 and len(objects["Detection"]) == 2
    text = "Detection(2 sources: 1 in <Rubin>, 1 in all; peaks of 5.1 to 20.5 sigma)"
    assert repr(objects["Detection"]) == text
    none = replace(objects["Detection"], sources=(), peaks=np.zeros(0), found_in=())
    assert repr(none) == "Detection(0 sources; no peaks)" and len(none) == 0
    assert "no peaks" in none._repr_html_()


def test_operators_name_their_sides_and_their_device():
    one = Resampler(FLAT, GRI, Grid.flat((10, 11), 0.4, angle_deg=3), GRI, shift=(0, 0.5))
    name = one.device.name
    about = f"3 bands of 24 x 30 px -> 3 bands of 10 x 11 px, affine, shifted, float32 on {name}"
    assert repr(one) == f"Resampler({about})"
    sides = "3 bands of 10 x 11 px -> 3 bands of 24 x 30 px"
    assert repr(one.T).startswith(f"AdjointLinOp({sides}, float32")
    psf = GRI.select([0])
    tiled = TiledResampler(FLAT, psf, FLAT, psf, progress=False)
    assert (
        repr(tiled)
        == f"TiledResampler(24 x 30 px -> 24 x 30 px, aligned, 1 tiles, float32 on {name})"
    )


@pytest.mark.parametrize("name", ["PSF", "Observation", "Detection", "Result"])
def test_figures_show_by_themselves(objects, name):
    pytest.importorskip("matplotlib")
    figure = objects[name].plot(title="a title")
    png = figure._repr_png_()
    assert png.startswith(b"\x89PNG")
    assert "a title" in [text.get_text() for text in figure.texts]
    assert re.search('src="data:image/png;base64,[A-Za-z0-9+/]{100}', objects[name]._repr_html_())


def test_a_figure_has_a_panel_a_band(objects):
    pytest.importorskip("matplotlib")
    assert len(objects["PSF"].plot().axes) == 3
    assert len(objects["Observation"].plot().axes) == 3
    assert len(objects["Result"].plot().axes) == 3  # observed, model, residual


def test_without_matplotlib_the_card_has_no_picture(objects, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    assert "<img" not in objects["PSF"]._repr_html_()
    with pytest.raises(ImportError, match="pip install matplotlib"):
        objects["PSF"].plot()
