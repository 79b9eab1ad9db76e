"""Every control of the report's field, table and chart, in a real browser."""

import re
import time

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.visualization import ZScaleInterval
from astropy.wcs import WCS
from helpers.browser import BROWSER, Browser
from helpers.field_folder import write_folder

from clresample import write_report
from clresample.report import alone

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium")
ROOT = "document.documentElement.dataset"
N_PX = 300
PAIR = re.compile(r"(\w+) ([−\d.]+) ± ([\d.]+)")


class Square:
    """Cutouts in which every source is a square of 100 counts about the middle of its mosaic."""

    def __init__(self, folder):
        self.mosaics = [type("Mosaic", (), {"name": name}) for name in ("Euclid", "Rubin")]

    def separate(self, ids, i_mosaic):
        own = type("Separation", (), {"own": np.full((3 if i_mosaic else 1, 80, 80), 100.0)})
        return own, None, (30, 30)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """(path, catalogue) of a page of twelve sources, two flagged, one failed, two in one blend."""
    folder = tmp_path_factory.mktemp("controls")
    rows = write_folder(folder, n_px=N_PX, status={11: ("failed", "no device")})
    (folder / "models.fits").touch()
    path = folder / "catalogue.fits"
    with fits.open(path, mode="update") as hdus:
        table = hdus["CATALOGUE"].data
        table["flags"][[3, 4]] = 64, 1
        table["parent_id"][1] = table["parent_id"][0]
        table["flux_g"] *= np.linspace(0.2, 2, len(table))
    rows["flux_g"] *= np.linspace(0.2, 2, len(rows))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(alone, "FieldCutouts", Square)
        return write_report(folder).path, rows


@pytest.fixture(scope="module")
def shared(tmp_path_factory, page):
    """A browser that shows the page, with a folder that takes what it saves."""
    with Browser(size=(1400, 1100)) as one:
        one.saved = tmp_path_factory.mktemp("saved")
        yield one


@pytest.fixture
def browser(shared, page):
    """That browser with a fresh page; at its end the page must have complained of nothing."""
    shared.open(page[0], f"?{time.monotonic()}")
    shared.until(f"({ROOT}.drawn ?? '').includes('tiles')")
    shared.save_into(shared.saved)
    yield shared
    assert shared.value(f"{ROOT}.errors") == "0" and shared.messages == []


def choose(browser, name, value):
    """Chooses in a list, or writes into a field."""
    browser.value(
        f"(() => {{ const e = byId('{name}'); e.value = '{value}';"
        "for (const kind of ['input', 'change'])"
        "e.dispatchEvent(new Event(kind, { bubbles: true })); })()"
    )
    browser.value("new Promise((done) => setTimeout(done, 60))")
    browser.until(f"{ROOT}.drawn !== 'waiting'")


def text(browser, name):
    return browser.value(f"byId('{name}').textContent")


def saved(browser, button):
    """File that a button saves."""
    browser.value(f"delete {ROOT}.saved")
    browser.value(f"{button}.click()")
    path = browser.saved / browser.until(f"{ROOT}.saved")
    end = time.monotonic() + 20
    while not path.is_file():
        assert time.monotonic() < end, path
        time.sleep(0.05)
    return path


def corner(browser):
    box = browser.value(
        "[byId('sky').getBoundingClientRect()].map((b) => [b.x, b.y, b.width, b.height])[0]"
    )
    return box


@pytest.mark.parametrize("instrument", [0, 1])
def test_values_under_the_pointer_are_those_of_the_files(browser, page, instrument):
    browser.value(f"document.querySelectorAll('input[name=instrument]')[{instrument}].click()")
    name, channels = (("Euclid", ["VIS"]), ("Rubin", ["g", "r", "i"]))[instrument]
    files = [fits.getdata(page[0].parent / f"{k}_{name}.fits") for k in ("model", "residual")]
    x0, y0, width, height = corner(browser)
    bright = browser.value("[SOURCES.x[0], SOURCES.y[0]]")
    zoom = 0.96 * min(width / N_PX, height / N_PX)
    places = [(0, 0), (-61.3, 40.2), (80.4, 33.1), (bright[0] - 149.5, bright[1] - 149.5)]
    for x, y in places:
        browser.mouse("mouseMoved", x0 + width / 2 + x * zoom, y0 + height / 2 - y * zoom)
        browser.until("!byId('values').textContent.includes('…')")
        head, *lines = text(browser, "values").splitlines()
        column, row = map(int, re.search(r"pixel \((\d+), (\d+)\)", head).groups())
        assert "[counts]" in head and len(lines) == len(channels)
        if instrument == 0:
            assert abs(column - (149.5 + x)) <= 1 and abs(row - (149.5 + y)) <= 1
        for c, line in enumerate(lines):
            model, left = (float(file[c, row, column]) for file in files)
            true = {"data": model + left, "model": model, "residual": left}
            told = {k: (float(v.replace("−", "-")), float(e)) for k, v, e in PAIR.findall(line)}
            assert line.startswith(channels[c]) and set(told) == set(true)
            for kind, (value, error) in told.items():
                assert abs(value - true[kind]) <= 1.2 * error + 0.06, (kind, line)
            assert told["residual"][1] < 0.5  # a quarter of the noise


def test_the_saved_view_is_that_of_the_files_with_its_sky(browser, page):
    browser.value("document.querySelectorAll('input[name=instrument]')[1].click()")
    for _ in range(3):
        browser.value("byId('zoom-in').click()")
    browser.value("new Promise((done) => setTimeout(done, 200))")
    path = saved(browser, "byId('save-fits')")
    folder = page[0].parent
    with fits.open(path) as hdus, fits.open(folder / "model_Rubin.fits") as models:
        header, cube = hdus[0].header, hdus[0].data
        x, y, (n, ny, nx) = header["X0"], header["Y0"], cube.shape
        true = models[0].data[:, y : y + ny, x : x + nx]
        true = true + fits.getdata(folder / "residual_Rubin.fits")[:, y : y + ny, x : x + nx]
        good = np.isfinite(cube)
        assert n == 3 and good.mean() > 0.6 and nx < models[0].shape[2]
        most = 0.035 * np.abs(true) + 0.2 * 2
        assert (np.abs(cube - true) <= most)[good].all()
        assert header["BAND2"] == "r" and header["BUNIT"] == "ct"
        own, theirs = WCS(header).celestial, WCS(models[0].header).celestial
        apart = own.pixel_to_world(3.0, 5.0).separation(theirs.pixel_to_world(x + 3.0, y + 5.0))
        assert apart.arcsec < 0.01


def test_a_source_is_shown_and_saved_alone(browser, page):
    browser.value("location.hash = 'source-' + SOURCES.id[0]")
    browser.until(f"{ROOT}.stamps === '16'")
    assert "Alone" in text(browser, "source")
    button = "[...document.querySelectorAll('.steps button')].find((b) => b.textContent === 'FITS')"
    with fits.open(saved(browser, button)) as hdus:
        assert [hdu.header["EXTNAME"] for hdu in hdus] == ["VIS", "g", "r", "i"]
        for hdu in hdus:
            assert [hdu.header[f"PLANE{k}"] for k in (1, 2, 3, 4)] == [
                "data", "model", "residual", "alone"
            ]  # fmt: skip
            data, model, left, own = hdu.data.astype(float)
            np.testing.assert_allclose(data, model + left, atol=1e-3)
            square = own - left
            assert set(np.round(np.unique(square))) <= {0, 99, 100, 101}
    place = page[1][0]
    first = hdus[0].header
    at = WCS(first).celestial.world_to_pixel(SkyCoord(place["ra"], place["dec"]))
    expected = place["x"].value - first["X0"], place["y"].value - first["Y0"]
    np.testing.assert_allclose(at, expected, atol=0.02)


def test_places_and_sources_are_searched_for(browser, page):
    def answer(words):
        browser.value(f"byId('place').value = '{words}'")
        browser.value("document.querySelector('#search button').click()")
        return text(browser, "answer")

    row = page[1][2]
    at = SkyCoord(row["ra"], row["dec"])
    for words in (
        f"{at.ra.deg:.6f} {at.dec.deg:.6f}",
        f"{at.ra.deg:.6f}, +{at.dec.deg:.6f}",
        at.to_string("hmsdms", precision=3),
        at.to_string("hmsdms", sep=":", precision=3),
        at.to_string("hmsdms", sep=" ", precision=3),
    ):
        found = answer(words)
        told = SkyCoord(*re.findall(r"[\d.]+", found.removeprefix("RA, Dec ")), unit=u.deg)
        assert told.separation(at).arcsec < 0.05, (words, found)
        browser.value("byId('sky').focus()")
        browser.key("c", "c")
        copied = SkyCoord(*browser.value(f"{ROOT}.copied").split(), unit=u.deg)
        assert copied.separation(at).arcsec < 0.01
    assert "outside the field" in answer("10.0 45.0")
    for words in ("", "abc", "150", "150 95", "10:70:00 2:00:00"):
        assert "neither" in answer(words), words
    answer(str(row["id"]))
    browser.until(f"{ROOT}.shown === '{row['id']}'")


def test_filters_hold_for_the_table_the_marks_and_the_chart(browser, page):
    rows = page[1]
    mags = 23.9 - 2.5 * np.log10(rows["flux_g"].value)
    flags = np.zeros(12, int)
    flags[[3, 4]] = 64, 1
    middle = float(np.sort(mags)[5]) + 0.001
    band = "DATA.columns.findIndex((c) => c.kind === 'magnitude' && c.channel === 'g')"
    for values, expected in (
        ({"filter-flags": "64"}, flags == 64),
        ({"filter-flags": "any"}, flags > 0),
        ({"filter-flags": "0"}, flags == 0),
        ({"filter-status": browser.value("DATA.statuses.indexOf('failed')")}, np.arange(12) == 11),
        ({"filter-snr": "100"}, rows["snr"] >= 100),
        ({"filter-band": browser.value(band), "filter-high": middle}, mags <= middle),
        ({"filter-band": browser.value(band), "filter-low": middle}, mags >= middle),
        ({"filter-snr": "1e9"}, np.zeros(12, bool)),
    ):
        for name, value in values.items():
            choose(browser, name, value)
        n = int(np.sum(expected))
        shown = browser.value("[...document.querySelectorAll('#sources td a')].map((a) => a.text)")
        assert sorted(shown) == sorted(str(i) for i in rows["id"][expected]), values
        assert text(browser, "matches") == f"{n} of 12 sources"
        browser.until(f"{ROOT}.drawn.endsWith('tiles, {n} marks') && {ROOT}.points === '{n}'")
        browser.value("document.querySelector('#filters [type=reset]').click()")
        browser.until("byId('matches').textContent === '12 of 12 sources'")


def test_the_table_made_by_the_script_reads_as_the_page_without_it(browser, page):
    cells = re.search(r"<tbody>(.*?)</tbody>", page[0].read_text().split('id="sources"')[1])[1]
    static = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in cells.split("</tr>")[:-1]]
    made = browser.value(
        "[...document.querySelectorAll('#sources tbody tr')].map("
        "(r) => [...r.cells].map((c) => c.textContent))"
    )
    assert made == static and "AB mag" in text(browser, "sources")


def test_limits_follow_the_pixels_in_view(browser, page):
    paths = [page[0].parent / f"{kind}_Euclid.fits" for kind in ("model", "residual")]
    data = sum(map(fits.getdata, paths))
    choose(browser, "limits", "minmax")
    browser.value("new Promise((done) => setTimeout(done, 200))")
    low, high = (float(browser.value(f"byId('{k}').value")) for k in ("low", "high"))
    assert abs(low - data.min()) < 3 and data.max() * 0.6 < high <= data.max() * 1.04
    choose(browser, "limits", "zscale")
    browser.value("new Promise((done) => setTimeout(done, 200))")
    low, high = (float(browser.value(f"byId('{k}').value")) for k in ("low", "high"))
    expected = ZScaleInterval(n_samples=20000, max_reject=0.5).get_limits(data[0])
    assert abs(low - expected[0]) < 1.5 and abs(high - expected[1]) < 0.2 * expected[1]
    choose(browser, "high", "77")
    assert browser.value("byId('limits').value") == "own" and "77" in text(browser, "ramp-high")


def light(browser):
    """The field's own canvas, as the text of a PNG."""
    return browser.value("byId('sky').toDataURL()")


def test_stretch_colours_and_bands_change_the_picture(browser):
    browser.value("byId('marks').click()")
    browser.value("document.querySelectorAll('input[name=instrument]')[1].click()")
    seen = []
    for name, value in (
        ("band", "-1"), ("band", "0"), ("stretch", "linear"), ("stretch", "log"),
        ("palette", "viridis"), ("palette", "inferno"), ("palette", "inverted"),
    ):  # fmt: skip
        choose(browser, name, value)
        browser.until(f"{ROOT}.drawn.endsWith(' 0 marks')")
        seen.append(light(browser))
    for k, one in enumerate(seen):
        assert all(one != other for other in seen[:k]), k


def test_layers_blink_and_stand_side_by_side_with_one_pan(browser):
    layer = "document.querySelector('input[name=layer]:checked').value"
    browser.value("byId('sky').focus()")
    browser.key("b", "b")
    browser.until(f"{layer} === 'model'")
    browser.until(f"{layer} === 'residual'")
    browser.key("b", "b")
    one = int(browser.value(f"{ROOT}.drawn").split()[0])
    browser.key("s", "s")
    browser.until(f"{ROOT}.drawn.startsWith('{3 * one} tiles')")
    x0, y0, width, height = corner(browser)

    def pixels():
        found = []
        for k in range(3):
            browser.mouse("mouseMoved", x0 + (k + 0.55) * width / 3, y0 + 0.4 * height)
            found.append(text(browser, "values").splitlines()[0])
        return found

    before = pixels()
    browser.mouse("mousePressed", x0 + 40, y0 + 200, button="left", clickCount=1)
    browser.mouse("mouseMoved", x0 + 80, y0 + 220, button="left", buttons=1)
    browser.mouse("mouseReleased", x0 + 80, y0 + 220, button="left", clickCount=1)
    after = pixels()
    assert len(set(before)) == len(set(after)) == 1 and before != after
    choose(browser, "compare", "instruments")
    browser.mouse("mouseMoved", x0 + 0.9 * width, y0 + 0.5 * height)
    assert text(browser, "values").startswith("Rubin")


def test_overlays_are_drawn(browser):
    browser.value("byId('marks').click()")
    browser.until(f"{ROOT}.drawn.endsWith(' 0 marks')")
    seen = [light(browser)]
    for name in ("labels", "ellipses", "outlines"):
        browser.value(f"byId('{name}').click()")
        browser.value("new Promise((done) => setTimeout(done, 120))")
        seen.append(light(browser))
    assert all(a != b for a, b in zip(seen, seen[1:], strict=False))


def test_points_of_the_chart_open_their_sources(browser, page):
    choose(browser, "colour-a", browser.value("byId('colour-a').options[0].value"))
    choose(browser, "colour-b", browser.value("byId('colour-b').options[1].value"))
    browser.value("byId('diagram').scrollIntoView()")
    browser.value("byId('diagram').focus({ preventScroll: true })")
    rows = page[1]
    colours = 2.5 * np.log10(rows["flux_g"].value / rows["flux_VIS"].value)
    for _ in range(3):
        browser.key("ArrowRight")
    found = text(browser, "point")
    row = np.argsort(colours)[2]
    assert str(rows["id"][row]) in found
    assert float(found.split("colour ")[1].split(",")[0].replace("−", "-")) == pytest.approx(
        colours[row], abs=0.006
    )
    browser.key("Enter", "\r")
    browser.until(f"{ROOT}.shown === '{rows['id'][row]}'")


def test_regions_and_pictures_are_saved(browser, page):
    lines = saved(browser, "byId('save-regions')").read_text().splitlines()
    rows = page[1]
    assert lines[1] == "icrs" and len(lines) == 2 + len(rows)
    found = {re.search(r"\{(\d+)\}", line)[1]: line for line in lines[2:]}
    ra, dec, a, b = map(float, re.findall(r"[\d.]+", found[str(rows["id"][0])])[:4])
    assert abs(ra - rows["ra"][0].value) < 1e-6 and abs(dec - rows["dec"][0].value) < 1e-6
    assert a == b == 0.4  # twice the size of 0.2 arcsec
    assert saved(browser, "byId('save-png')").read_bytes()[:4] == b"\x89PNG"
    regions = pytest.importorskip("regions")
    assert len(regions.Regions.parse("\n".join(lines), format="ds9")) == len(rows)


def test_nothing_is_wider_than_a_phone(page):
    with Browser(size=(390, 800)) as browser:
        browser.open(page[0], f"#source-{page[1]['id'][0]}")
        browser.until(f"Boolean({ROOT}.shown)")
        choose(browser, "compare", "layers")
        assert browser.value("document.documentElement.scrollWidth") <= 390
