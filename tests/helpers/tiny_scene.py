"""A scene file with all its files, small enough to be fitted in a tenth of a second."""

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from clresample.cli.command import main

N = 20  # pixels along a side of the larger image
RA, DEC = 150.0, 2.0  # [deg]
OF_FIT = {"catalogue.fits", "catalogue.ecsv", "result.fits"}  # what the command writes of it
SCENE = """
[[observation]]
name = "A"
image = "a.fits"
psf = "pa.fits"
variance = 0.01

[[observation]]
name = "B"
image = "b.fits"
psf = "pb.fits"
weight = "wb.fits"

[sources]
catalogue = "sources.ecsv"

[fit]
max_iter = 2
"""


def gaussian(n, sigma, y=None, x=None):
    y, x = ((n - 1) / 2 if p is None else p for p in (y, x))
    i = np.arange(n)
    return np.exp(-((i[:, None] - y) ** 2 + (i - x) ** 2) / (2 * sigma**2))


def header(n, scale, angle=0.0):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    h = fits.Header()
    h["CTYPE1"], h["CTYPE2"], h["CRVAL1"], h["CRVAL2"] = "RA---TAN", "DEC--TAN", RA, DEC
    h["CRPIX1"] = h["CRPIX2"] = (n + 1) / 2
    for key, value in (("CD1_1", -c), ("CD1_2", s), ("CD2_1", s), ("CD2_2", c)):
        h[key] = value * scale / 3600
    return h


def write_scene(folder) -> Path:
    """The files of a scene of two instruments and two sources; returns the scene file."""
    rng = np.random.default_rng(0)
    light = 10 * gaussian(N, 2.0, 8, 9) + 5 * gaussian(N, 2.5, 12, 12)
    images = {
        "a": (light + rng.normal(0, 0.1, (N, N)), header(N, 0.2)),
        "b": (light[:14, :14] + rng.normal(0, 0.1, (14, 14)), header(14, 0.3, 20)),
        "pa": (gaussian(11, 1.0), None),
        "pb": (gaussian(13, 1.4), None),
        "wb": (np.full((14, 14), 100.0), None),
    }
    for name, (image, cards) in images.items():
        fits.PrimaryHDU(image.astype("f4"), cards).writeto(folder / f"{name}.fits")
    table = Table()
    table["ra"] = RA + np.array([0.5, -1.0]) * 0.2 / 3600
    table["dec"] = DEC + np.array([-1.5, 2.5]) * 0.2 / 3600
    table["name"], table["type"] = ["one", "two"], ["extended", "point"]
    table.write(folder / "sources.ecsv", format="ascii.ecsv")
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml"


def deblend(folder, *more, output="out"):
    """Exit status of `clresample deblend` on a scene of `write_scene`, without a figure."""
    output = str(folder / output) if output else ""
    argv = ["deblend", str(folder / "scene.toml"), "-o", output, "--no-figure", "--quiet", *more]
    try:
        return main(argv)
    except SystemExit as stop:  # argparse's own refusals
        return stop.code


def change(folder, old, new):
    """Puts something else into the scene file."""
    text = (folder / "scene.toml").read_text()
    assert old in text
    (folder / "scene.toml").write_text(text.replace(old, new, 1))
