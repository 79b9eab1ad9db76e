"""README's and the start page's examples run as they stand, in turn, in an empty folder."""

import numpy as np
import pytest
from helpers.checkout import ROOT
from helpers.snippets import snippets

from clresample.cli.command import main, parser

MAX_README_LINES = 90
# Whole fields take half a minute; tests/fields run them. Their words are parsed here.
PARSED_ONLY = "simulate", "field", "report"


def run(text):
    """The names that a page's Python leaves; its commands are executed in their turn."""
    names = {}
    for kind, code in snippets(text):
        if kind == "python":
            exec(compile(code, "<page>", "exec"), names)
        elif code[0] in PARSED_ONLY:
            parser().parse_args(code)
        else:
            assert not main(code), code
    return names


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Runs a page in an empty folder, without windows; returns its names."""
    pytest.importorskip("galsim")
    pytest.importorskip("matplotlib").use("Agg")
    pytest.importorskip("sep")
    monkeypatch.chdir(tmp_path)
    return lambda name: run((ROOT / name).read_text())


def test_readme_runs_and_ends_in_a_table_a_picture_and_one_galaxy(page, tmp_path):
    names = page("README.md")
    assert len(names["found"].sources) == 6
    assert (tmp_path / "blend.png").stat().st_size > 10_000
    assert (tmp_path / "alone.fits").exists()
    scene, alone = names["scene"], names["alone"]
    first = names["catalogue"](names["result"])[0]
    away = scene.positions_deg - [first["ra"].value, first["dec"].value]
    i = np.hypot(*away.T).argmin()
    noise = scene.euclid.survey.noise_sigma[0] * np.sqrt(alone.data.size)
    assert abs(np.nansum(alone.data) - scene.euclid.counts[i, 0]) < 5 * noise
    assert names["mine"].channels == tuple("ugrizy")
    assert (tmp_path / "try-it" / "out" / "catalogue.ecsv").exists()


def test_the_start_page_runs(page, tmp_path):
    names = page("docs/start.md")
    assert len(names["found"].sources) == 6
    assert (tmp_path / "try-it" / "out" / "deblended.png").exists()


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MAX_README_LINES


def test_code_is_found_in_its_order():
    text = "    clresample devices  # all\n```python\na\n```\nx\n"
    text += "```{code-cell}\n:tags: [b]\nc\n```\n```toml\nd = 1\n    clresample no\n```\n"
    text += "    pip install x\n    clresample tune -o 'a b'\n"
    assert snippets(text) == [
        ("command", ["devices"]),
        ("python", "a"),
        ("python", "c"),
        ("command", ["tune", "-o", "a b"]),
    ]
