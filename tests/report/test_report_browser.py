"""The report in a real browser: it draws, is moved by mouse and keys, and complains of nothing."""

import io
import re
import shutil

import numpy as np
import pytest
from helpers.browser import BROWSER, Browser
from helpers.field_folder import write_folder

from clresample import write_report
from clresample.report.html import PAGE

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium")
ROOT = "document.documentElement"
DRAWN = f"({ROOT}.dataset.drawn ?? '').includes('tiles')"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """(path, catalogue) of a page of twelve sources in two instruments, one of them failed."""
    folder = tmp_path_factory.mktemp("report")
    rows = write_folder(folder, n_sources=12, n_px=300, status={11: ("failed", "no device")})
    return write_report(folder).path, rows


@pytest.fixture
def browser(page):
    """A browser that shows it, drawn; at its end it must have complained of nothing."""
    with Browser() as one:
        one.open(page[0])
        one.until(DRAWN)
        yield one
        assert one.value(f"{ROOT}.dataset.errors") == "0"
        assert one.messages == []


def seen(browser):
    """Image in the field's canvas: (Ny, Nx, 3)."""
    image = pytest.importorskip("PIL.Image")
    box = browser.value("JSON.stringify(document.getElementById('sky').getBoundingClientRect())")
    x, y, width, height = (
        round(float(re.search(rf'"{k}":([-\d.]+)', box)[1])) for k in ("x", "y", "width", "height")
    )
    picture = np.asarray(image.open(io.BytesIO(browser.picture())).convert("RGB"))
    return picture[y : y + height, x : x + width].astype(int)


def place(browser, row):
    """Position of a source (counted from the brightest) in the window."""
    return browser.value(
        f"(() => {{ const box = document.getElementById('sky').getBoundingClientRect();"
        "const [ny, nx] = DATA.frame.shape;"
        "const zoom = 0.96 * Math.min(box.width / nx, box.height / ny);"
        f"return [box.x + box.width / 2 + (SOURCES.x[{row}] - (nx - 1) / 2) * zoom,"
        f"box.y + box.height / 2 - (SOURCES.y[{row}] - (ny - 1) / 2) * zoom]; }})()"
    )


def test_it_draws_every_source_where_its_light_is(browser):
    assert browser.value(f"{ROOT}.dataset.drawn").endswith("12 marks")
    browser.value("document.getElementById('marks').click()")
    for instrument in (0, 1):
        browser.value(f"document.querySelectorAll('input[name=instrument]')[{instrument}].click()")
        browser.until(f"{DRAWN} && {ROOT}.dataset.drawn.endsWith(' 0 marks')")
        browser.value("document.querySelector('input[name=layer][value=model]').click()")
        browser.value("new Promise((done) => setTimeout(done, 300))")
        browser.until(DRAWN)
        light = seen(browser).sum(axis=2)
        box = browser.value(
            "[document.getElementById('sky').getBoundingClientRect()].map((b) => [b.x, b.y])[0]"
        )
        for row in range(6):
            x, y = (round(a - b) for a, b in zip(place(browser, row), box))
            around = light[y - 14 : y + 15, x - 14 : x + 15]
            bright = np.argwhere(around == around.max()).mean(axis=0) - 14
            others = [place(browser, k) for k in range(12) if k != row]
            if min(np.hypot(a - x - box[0], b - y - box[1]) for a, b in others) > 30:
                assert np.abs(bright).max() <= 3, (instrument, row, bright)


def test_layers_differ(browser):
    browser.value("document.getElementById('marks').click()")
    images = []
    for layer in ("data", "model", "residual"):
        browser.value(f"document.querySelector('input[name=layer][value={layer}]').click()")
        browser.value("new Promise((done) => setTimeout(done, 300))")
        browser.until(DRAWN)
        images.append(seen(browser)[100:400, 200:500])
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(images[a] - images[b]).mean() > 3
    assert "σ" in browser.value("document.getElementById('ramp-low').textContent")


def test_a_click_on_a_source_shows_it_in_every_channel(browser, page):
    rows = page[1]
    order = np.argsort(-rows["snr"])
    browser.click(*place(browser, 2))
    browser.until(f"{ROOT}.dataset.shown === '{rows['id'][order[2]]}'")
    browser.until(f"{ROOT}.dataset.stamps === '12'")  # three of each of four channels
    text = browser.value("document.getElementById('source').innerText")
    assert all(f"\n{name}\n" in text for name in ("VIS", "g", "r", "i"))
    assert f"{rows['flux_g'][order[2]].value:.4g}" in text and "Flux [µJy]" in text
    flat = browser.value(
        "[...document.querySelectorAll('.stamps canvas')].map((c) => {"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const all = [...d].filter((_, i) => i % 4 === 1);"
        "return Math.max(...all) - Math.min(...all); })"
    )
    assert min(flat) > 60
    browser.value("document.querySelectorAll('.steps button')[1].click()")
    browser.until(f"{ROOT}.dataset.shown === '{rows['id'][order[3]]}'")


def test_keys_zoom_choose_layers_and_open_sources(browser):
    browser.value("document.getElementById('sky').focus()")
    before = browser.value("document.getElementById('scale-text').textContent")
    for _ in range(6):
        browser.key("+", "+")
    browser.until(f"document.getElementById('scale-text').textContent !== '{before}'")
    browser.key("3", "3")
    browser.until("document.querySelector('input[value=residual]').checked")
    browser.key("Enter", "\r")
    browser.until(f"Boolean({ROOT}.dataset.shown)")


def test_the_wheel_zooms_only_once_the_field_has_the_focus(browser):
    where = {"x": 500, "y": 600, "deltaX": 0, "deltaY": -300}
    scale = "document.getElementById('scale-text').textContent"
    before = browser.value(scale)
    browser.mouse("mouseWheel", **where)
    browser.value("new Promise((done) => setTimeout(done, 300))")
    assert browser.value(scale) == before
    browser.value("document.getElementById('sky').focus({ preventScroll: true })")
    browser.mouse("mouseWheel", **where)
    browser.until(f"{scale} !== '{before}'")


def test_tables_are_sorted_and_lead_to_sources(browser, page):
    first = "document.querySelector('#sources tbody td').textContent"
    heads = "[...document.querySelectorAll('#sources th button')]"
    head = f"{heads}.find((b) => b.textContent.startsWith('S/N'))"
    browser.value(f"{head}.click()")
    assert browser.value(f"{head}.parentNode.getAttribute('aria-sort')") == "descending"
    browser.value(f"{head}.click()")
    assert browser.value(first) == str(page[1]["id"][np.argmin(page[1]["snr"])])
    browser.value("document.querySelector('#fits td a').click()")
    browser.until(f"Boolean({ROOT}.dataset.shown)")
    assert "#source-" in browser.value("location.hash")


def test_colours_follow_the_user_and_the_button(page):
    paper = "getComputedStyle(document.body).backgroundColor"
    with Browser(dark=True) as browser:
        browser.open(page[0])
        browser.until(DRAWN)
        dark = browser.value(paper)
        browser.value("document.getElementById('theme').click()")
        assert browser.value(paper) != dark
        assert browser.messages == []


def test_without_a_script_the_tables_are_there(page):
    with Browser(script=False, size=(1400, 4000)) as browser:
        browser.open(page[0])
        root = browser.ask("DOM.getDocument", depth=-1)["root"]["nodeId"]
        for selector, there in (("#sources tbody tr", True), (".live canvas", False)):
            node = browser.ask("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
            try:
                height = browser.ask("DOM.getBoxModel", nodeId=node)["model"]["height"]
            except AssertionError:  # it has no box
                height = 0
            assert (height > 0) == there, selector


def test_a_page_without_images_marks_its_sources(tmp_path, page):
    folder = tmp_path / "run"
    shutil.copytree(page[0].parent, folder)
    for path in folder.glob("*_*.fits"):
        path.unlink()
    with Browser() as browser:
        browser.open(write_report(folder).path)
        browser.until(f"({ROOT}.dataset.drawn ?? '') === '0 tiles, 12 marks'")
        assert browser.value("document.getElementById('scale-text').textContent").endswith(" px")
        assert browser.value(f"{ROOT}.dataset.errors") == "0" and browser.messages == []


def test_hostile_names_run_nothing(tmp_path):
    bad = "</script><script>pwned=1</script><img src=x onerror=pwned=2>"
    names = {"<b>E": ("<i onclick=pwned=3>",), "R": ("&lt;",)}
    rows = write_folder(tmp_path / "run", instruments=names, status={0: ("failed", bad)})
    with Browser() as browser:
        browser.open(write_report(tmp_path / "run").path, f"#source-{rows['id'][0]}")
        browser.until(DRAWN)
        browser.until(f"Boolean({ROOT}.dataset.stamps)")
        assert browser.value("typeof pwned") == "undefined"
        assert bad in browser.value("document.getElementById('source').innerText")
        assert browser.value(f"{ROOT}.dataset.errors") == "0" and browser.messages == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"eJ', '"xx'),  # texts that are no pixels
        ("new View(canvas)", "new Viev(canvas)"),  # a script that is not the one that was written
        ('<div class="wrap">', '<div class="wrap"><img src="http://127.0.0.1:9/x.png">'),
    ],
)
def test_a_broken_page_is_noticed(tmp_path, page, old, new):
    path = tmp_path / "broken.html"
    path.write_text(page[0].read_text().replace(old, new))
    with Browser() as browser:
        browser.open(path)
        browser.value("new Promise((done) => setTimeout(done, 500))")
        errors = browser.value(f"{ROOT}.dataset.errors")
        assert browser.messages or errors != "0" or not browser.value(DRAWN)


def luminance(colour):
    """Relative luminance of #rrggbb."""
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    r, g, b = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


def test_text_has_contrast_in_light_and_dark():
    style = (PAGE / "report.css").read_text()
    blocks = re.findall(r"\{\s*color-scheme: \w+;(.*?)\}", style, re.DOTALL)
    assert len(blocks) == 3 and blocks[1].split() == blocks[2].split()
    for block in blocks:
        colours = dict(re.findall(r"--([\w-]+): (#\w{6});", block))
        for ink, paper in (
            ("ink", "paper"), ("soft", "paper"), ("soft", "raised"), ("accent", "paper"),
            ("accent", "raised"), ("on-accent", "accent"),
        ):  # fmt: skip
            a, b = sorted((luminance(colours[ink]), luminance(colours[paper])))
            assert (b + 0.05) / (a + 0.05) >= 4.5, (ink, paper)
