"""The commands on bad input, bad outputs and signals: one short line, nothing half-written."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from helpers.checkout import ROOT, run_python
from helpers.resample_files import resample
from helpers.tiny_scene import OF_FIT, change, deblend, gaussian

from clresample.cli import deblend as command


def refused(capsys):
    """The one line that a command said, short and of printable characters."""
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and len(text) < 1000
    assert text[:-1].isprintable()
    return text


def kept(folder):
    return {p.name for p in folder.iterdir()}


@pytest.mark.parametrize(
    "text, said",
    [
        ("max_iter = " + "9" * 400, "max_iter is"),
        ("rel_tol = " + "9" * 400, "rel_tol is"),
        ("correlation_px = " + "9" * 400, "correlation_px is"),
        ("max_iter = " + "9" * 5000, "not TOML"),
        ("rel_tol = nan", "rel_tol is nan"),
        ("x = " + "[" * 3000 + "]" * 3000, "nested too deeply"),
        ('x = "' + "long" * 2000 + '"', "key x is unknown"),
        ('"\\u001b[31m\\n" = 1', "\\x1b[31m"),
    ],
)
def test_scene_files_that_cannot_be_meant(scene, capsys, text, said):
    change(scene, "max_iter = 2", text)
    if text.startswith("max_iter = 99") and len(text) < 500:
        change(scene, text, "max_iter = -" + "9" * 400)
    assert deblend(scene) == 2
    assert said in refused(capsys)


def test_tables_with_two_values_a_row(scene, capsys):
    table = Table({"ra": [[1.0, 2.0]] * 2, "dec": [1.0, 2.0]})
    table.write(scene / "sources.ecsv", format="ascii.ecsv", overwrite=True)
    assert deblend(scene) == 2
    assert "column ra has (2,) values a row, a position takes one" in refused(capsys)


def test_tables_of_complex_numbers(scene, capsys):
    table = Table({"ra": [1 + 1j, 2], "dec": [1.0, 2.0]})
    table.write(scene / "sources.fits", overwrite=True)
    change(scene, "sources.ecsv", "sources.fits")
    assert deblend(scene) == 2
    assert "column ra is not a position in deg (its type is >c16)" in refused(capsys)


@pytest.mark.parametrize("value", [1e400, "many", 1.5])
def test_components_that_are_no_number(scene, capsys, value):
    table = Table.read(scene / "sources.ecsv")
    table["type"], table["components"] = "extended", value
    table.write(scene / "sources.ecsv", format="ascii.ecsv", overwrite=True)
    assert deblend(scene) == 2
    assert "row 1: components is" in refused(capsys)


@pytest.mark.parametrize("n_sources, n_components", [(2, 10**6), (10_000, 1), (2, 10**300)])
def test_too_much_work_is_refused_before_it_starts(scene, capsys, n_sources, n_components):
    table = Table.read(scene / "sources.ecsv")
    table = table[np.arange(n_sources) % 2]
    table["type"], table["name"] = "extended", np.arange(n_sources)
    table["components"] = [float(n_components)] * n_sources
    table.write(scene / "sources.ecsv", format="ascii.ecsv", overwrite=True)
    began = time.process_time()
    assert deblend(scene) == 2
    assert time.process_time() - began < 15
    said = refused(capsys)
    assert f"{n_sources} sources have " in said
    assert "components, but no channel has more than" in said


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_absurd_pixels_are_refused(scene, capsys, scale):
    with fits.open(scene / "b.fits", mode="update") as hdus:
        for key in ("CD1_1", "CD1_2", "CD2_1", "CD2_2"):
            hdus[0].header[key] *= scale
    assert deblend(scene) == 2
    assert "Traceback" not in refused(capsys)


def test_an_evenly_bright_psf_is_none(scene, capsys):
    fits.PrimaryHDU(np.ones((300, 300), "f4")).writeto(scene / "pb.fits", overwrite=True)
    assert deblend(scene) == 2
    assert "too wide for its 300 x 300 image, or no PSF" in refused(capsys)


def test_large_psfs_are_no_burden(scene):
    fits.PrimaryHDU(gaussian(1001, 1.4)).writeto(scene / "pb.fits", overwrite=True)
    began = time.process_time()
    assert deblend(scene) == 0
    assert time.process_time() - began < 20


@pytest.mark.parametrize("name", ["x" * 60, "caf\u00e9", "a\tb\n\x1b"])
def test_names_of_channels(scene, capsys, name):
    change(scene, 'image = "a.fits"', f'image = "a.fits"\nchannels = [{ascii(name)}]')
    change(scene, "'", '"')
    change(scene, "'", '"')
    text = (scene / "scene.toml").read_text().replace("\\x", "\\u00")
    (scene / "scene.toml").write_text(text)
    status = deblend(scene)
    if len(name) > 53:
        assert status == 2 and "has 60 characters, columns of the catalogue take 53" in refused(
            capsys
        )
        assert not (scene / "out").exists()
    else:
        assert status == 0
        plain = "".join(c if " " <= c <= "~" else "?" for c in name)
        names = Table.read(scene / "out" / "catalogue.fits", hdu=1).colnames
        assert f"flux_{plain}" in names


def test_channels_that_are_one_in_fits(scene, capsys):
    change(scene, 'image = "a.fits"', 'image = "a.fits"\nchannels = ["\u00e9"]')
    change(scene, 'image = "b.fits"', 'image = "b.fits"\nchannels = ["\u00e8"]')
    assert deblend(scene) == 2
    assert "are one in FITS" in refused(capsys)


def test_outputs_over_inputs_are_refused(scene, capsys):
    (scene / "sources.ecsv").rename(scene / "catalogue.ecsv")
    change(scene, "sources.ecsv", "catalogue.ecsv")
    before = (scene / "catalogue.ecsv").read_bytes()
    assert deblend(scene, "--overwrite", output=".") == 2
    assert "catalogue.ecsv: is one of the inputs, and is kept" in refused(capsys)
    assert (scene / "catalogue.ecsv").read_bytes() == before
    assert deblend(scene, output="") == 2
    assert "-o is empty: give a folder" in refused(capsys)


def test_the_fit_never_begins_where_nothing_can_be_written(scene, capsys, monkeypatch):
    def read_only(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(command, "_fit", lambda *_: pytest.fail("the fit has begun"))
    monkeypatch.setattr("os.mkdir", read_only)
    assert deblend(scene) == 2
    assert "cannot be written (Read-only file system)" in refused(capsys)
    assert not (scene / "out").exists()


def test_devices_links_and_pipes(files, capsys):
    os.mkfifo("pipe")
    os.symlink("in.fits", "link")
    for output, said in (
        ("/dev/null", "/dev/null: is a device, a pipe or a socket"),
        ("pipe", "pipe: is a device"),
        ("link", "link: is a symbolic link"),
        ("", "-o is empty"),
    ):
        assert resample("--overwrite", output=output) == 2
        assert said in refused(capsys)
    for name in ("pipe", "/dev/zero"):
        assert resample(image=name) == 2
        assert f"{name}: is not a regular file" in refused(capsys)


@pytest.mark.filterwarnings("error")
def test_images_that_overflow_are_refused(files, capsys, double):
    with fits.open("in.fits") as hdus:
        fits.PrimaryHDU(hdus[0].data.astype(float) * 1e39, hdus[0].header).writeto("huge.fits")
    assert resample(image="huge.fits") == 2
    said = refused(capsys)
    assert "huge.fits: x holds numbers of up to" in said and "or use --dtype float64" in said
    assert not os.path.exists("out.fits")
    assert resample("--dtype", "float64", image="huge.fits") == 0


def test_file_names_with_control_characters(files, capsys):
    os.rename("in.fits", "i\tn\n.fits")
    assert resample(image="i\tn\n.fits") == 0
    with fits.open("out.fits") as hdus:
        assert hdus[0].header["CLFILE1"] == "i?n?.fits"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_leave_all_or_nothing(scene, number):
    """At any time: outputs are a set, parts are gone, and the status is that of Ctrl-C."""
    change(scene, "max_iter = 2", "max_iter = 100000\nloss_tol = 1e-300")
    run = subprocess.Popen(
        [sys.executable, "-m", "clresample.cli", "deblend", str(scene / "scene.toml")]
        + ["-o", str(scene / "out"), "--no-figure"],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    said = ""
    while "fitting" not in said:
        said += run.stderr.readline()
    run.send_signal(number)
    rest = run.communicate(timeout=120)[1]
    # shells show 130 too if Python ends by SIGINT, as it does after Ctrl-C in a dataclass's `exec`
    assert (run.returncode if run.returncode >= 0 else 128 - run.returncode) == 130, rest
    assert "Traceback" not in rest
    assert not (scene / "out").exists() or kept(scene / "out") == OF_FIT
    assert not [name for name in kept(scene) if name.startswith((".part-", ".done-"))]


def test_ctrl_c_before_a_command_is_known(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("clresample.cli.command.Parser.parse_args", interrupted)
    from clresample.cli import main

    assert main(["devices"]) == 130
    assert refused(capsys) == "clresample: interrupted\n"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_ctrl_c_while_the_command_is_imported():
    interrupted = """
import sys
class Interrupted:
    def find_spec(name, *_):
        if name == "clresample.cli.deblend":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted)
from clresample.cli import main
sys.exit(main(["--help"]))
"""
    answer = run_python("-c", interrupted)
    assert (answer.returncode, answer.stderr) == (130, "clresample: interrupted\n")
