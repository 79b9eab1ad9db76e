"""`clresample deblend`: what it writes, and one clear line for each thing that can be wrong."""

import sys

import numpy as np
import pytest
from astropy.table import QTable, Table

from clresample.cli.command import main
from clresample.cli.deblend import OUTPUTS
from clresample.deblending import iterate
from clresample.files.results import read_result

pytest.importorskip("galsim")
pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The folder that `--example` writes."""
    folder = tmp_path_factory.mktemp("cli") / "trial"
    assert main(["deblend", "--example", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def output(example):
    """The outputs of a run on the example."""
    assert deblend(example / "scene.toml", example / "out", "--max-iter", "20") == 0
    return example / "out"


def deblend(scene, output, *more):
    """Exit status of `clresample deblend SCENE -o OUTPUT ...`."""
    try:
        return main(["deblend", str(scene), "-o", str(output), *map(str, more)])
    except SystemExit as stop:  # argparse's own refusals
        return stop.code


def changed(example, name, old, new):
    """The example's scene file with something else in it."""
    text = (example / "scene.toml").read_text()
    assert old in text
    (example / name).write_text(text.replace(old, new))
    return example / name


def one_line(capsys):
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and text.startswith("clresample deblend: ")
    return text


def test_example_and_output_are_complete(example, output):
    assert {p.name for p in example.iterdir()} >= {
        "scene.toml",
        "sources.ecsv",
        "euclid.fits",
        "euclid_psf.fits",
        "rubin.fits",
        "rubin_psf.fits",
    }
    assert {p.name for p in output.iterdir()} == set(OUTPUTS)
    assert (output / "deblended.png").read_bytes().startswith(b"\x89PNG")


def test_catalogues_and_result_agree(output):
    tables = QTable.read(output / "catalogue.fits", hdu=1), QTable.read(output / "catalogue.ecsv")
    result = read_result(output / "result.fits")
    for table in tables:
        assert list(table["name"]) == [f"galaxy {i}" for i in range(1, 7)]
        assert str(table["flux_VIS"].unit) == "uJy" and str(table["mag_r"].unit) == "mag"
    np.testing.assert_array_equal(tables[0]["flux_i"], tables[1]["flux_i"])
    assert result.channels == ("VIS", "u", "g", "r", "i", "z", "y")
    assert len(result.losses) <= 21


def test_the_model_is_adequate(output):
    result = read_result(output / "result.fits")
    for i, o in enumerate(result.observations):
        chi2 = np.nanmean(result.residual(i) ** 2 * o.weights)
        assert 0.95 < chi2 < 1.06


def test_report_names_files_chi2_and_shifts(example, tmp_path, capsys, monkeypatch):
    """However little a shift gains."""
    monkeypatch.setattr(iterate, "MIN_GAIN", 0.0)
    out = tmp_path / "deep" / "out"
    scene = example / "scene.toml"
    assert deblend(scene, out, "--fit-shifts", "--fit-sky", "--max-iter", 12, "--no-figure") == 0
    written = capsys.readouterr()
    printed = written.out
    assert "6 sources in 7 channels: " in printed and "chi2 per pixel, Euclid: VIS" in printed
    assert "model pixels (y, x)" in printed
    assert sorted(p.name for p in out.iterdir()) == sorted(OUTPUTS[:3])
    assert all(str(out / name) in printed for name in OUTPUTS[:3])
    assert read_result(out / "result.fits").sky.any()
    reading, fitting = written.err.splitlines()
    assert reading == f"clresample deblend: reading {scene}"
    assert "fitting 6 sources to Euclid (VIS), Rubin (u g r i z y) on " in fitting


def test_sources_are_detected_without_a_catalogue(example, tmp_path, capsys):
    pytest.importorskip("sep")
    path = changed(example, "detect.toml", '[sources]\ncatalogue = "sources.ecsv"', "[detection]")
    assert deblend(path, tmp_path / "out", "--max-iter", 10, "--quiet") == 0
    table = Table.read(tmp_path / "out" / "catalogue.ecsv")
    assert len(table) >= 3
    assert capsys.readouterr().err == ""


def test_double_precision(example, tmp_path, double):
    arguments = "--max-iter", 5, "--dtype", "float64", "--no-figure"
    assert deblend(example / "scene.toml", tmp_path / "out", *arguments) == 0
    assert read_result(tmp_path / "out" / "result.fits").rendered[0].dtype == np.float64


def test_nothing_is_replaced_unasked(example, output, capsys):
    before = {p: p.read_bytes() for p in output.iterdir()}
    assert deblend(example / "scene.toml", output) == 2
    assert "exists already" in one_line(capsys)
    assert main(["deblend", "--example", str(example)]) == 2
    assert "exists already" in one_line(capsys)
    assert {p: p.read_bytes() for p in output.iterdir()} == before
    assert deblend(example / "scene.toml", output, "--overwrite", "--max-iter", 2) == 0


def test_interrupted_runs_write_the_best_so_far(example, tmp_path, capsys, monkeypatch):
    from clresample.deblending.solver.multiscale.engine import MultiscaleEngine

    one_round = MultiscaleEngine.round

    def stop(self):
        if self.progress.n_rounds.max() > 5:
            raise KeyboardInterrupt
        return one_round(self)

    monkeypatch.setattr(MultiscaleEngine, "round", stop)
    assert deblend(example / "scene.toml", tmp_path / "out", "--no-figure") == 130
    assert "interrupted" in capsys.readouterr().out
    assert read_result(tmp_path / "out" / "result.fits").status == "interrupted"


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "SCENE.toml is missing"),
        (["scene.toml"], "-o DIR is missing"),
        (["none.toml", "-o", "new"], "none.toml: No such file"),
        (["scene.toml", "-o", "scene.toml"], "is a file, not a folder"),
        (["scene.toml", "-o", "new", "--max-iter", "-1"], "'-1' is not a whole number"),
        (["scene.toml", "-o", "new", "--rel-tol", "1"], "'1' must be at least 0 and less than 1"),
        (["scene.toml", "-o", "new", "--dtype", "half"], "invalid choice: 'half'"),
        (["scene.toml", "-o", "new", "--device", "no such"], "no such"),
        (["scene.toml", "--example", "new"], "--example DIR takes neither"),
    ],
)
def test_wrong_arguments_are_refused(example, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(example)
    try:
        status = main(["deblend", *arguments])
    except SystemExit as stop:
        status = stop.code
    assert status == 2 and message in capsys.readouterr().err
    assert not (example / "new").exists()


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('name = "Euclid"', 'nome = "Euclid"', "key nome is unknown"),
        ('image = "rubin.fits"', 'image = "none.fits"', "observation 2 (Rubin): "),
        ('bands = ["u"', 'bands = ["U"', "no band U"),
        ('"sources.ecsv"', '"scene.toml"', "no table that astropy can read"),
        ('"sources.ecsv"', '"away.csv"', "none of the 1 sources lies inside the model frame"),
        (
            '[sources]\ncatalogue = "sources.ecsv"',
            "[detection]\nthreshold = 1e6",
            "no source above",
        ),
    ],
)
def test_mistakes_in_the_scene_leave_nothing_behind(example, capsys, old, new, message):
    Table({"ra": [151.0], "dec": [2.2]}).write(example / "away.csv", overwrite=True)
    path = changed(example, "wrong.toml", old, new)
    assert deblend(path, example / "new", "--quiet") == 2
    assert message in one_line(capsys)
    assert not (example / "new").exists()


@pytest.mark.parametrize("module, message", [("matplotlib", "--no-figure"), ("sep", "[sources]")])
def test_what_is_not_installed_is_named(example, capsys, monkeypatch, module, message):
    monkeypatch.setitem(sys.modules, module, None)
    if module == "matplotlib":
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    path = changed(example, "detect.toml", '[sources]\ncatalogue = "sources.ecsv"', "[detection]")
    assert deblend(path, example / "new", "--quiet") == 2
    assert message in one_line(capsys)
    assert not (example / "new").exists()


def test_the_example_needs_galsim(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "galsim", None)
    assert main(["deblend", "--example", str(tmp_path / "new")]) == 2
    assert "pip install galsim" in one_line(capsys)
    assert not (tmp_path / "new").exists()
