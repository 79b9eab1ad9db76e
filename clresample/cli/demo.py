"""`python -m clresample.cli.demo`: galaxies in Euclid and Rubin, deblended and resampled.

Six blended galaxies are simulated, then fitted to both telescopes' images at once and to each
alone, and compared with the truth. Writes deblended.png, the catalogue, and the joint fit with its
models and residuals; and the files of `demo_resample`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from ..deblending.batch import deblend
from ..deblending.settings import Settings
from ..device.device import get_device
from ..device.discovery import DeviceError
from ..files.plot_deblended import plot_deblended
from ..files.results import write_result
from ..files.tables import write_catalogue
from ..measurement.catalogue import catalogue
from ..simulation.scenes import simulate_scene
from ..simulation.sdr import sdr
from ..sky.frame import model_frame
from ..sky.sources import ExtendedSource
from . import demo_resample
from .demo_sky import ANGLE_DEG, CENTER_DEG

SEED, N_SOURCES = 10, 6
MODES = {"Rubin": ("Rubin",), "Euclid": ("Euclid",), "joint": ("Euclid", "Rubin")}


def fit_all(scene, *, device=None):
    """{mode: (Result, SDR (S,) [dB], seconds)} of a simulated scene, positions given.

    All modes are fitted on Euclid's pixels, on which the truth lies; the SDR compares images of
    unit sum.
    """
    seen = {image.survey.name: image.observation() for image in scene.images}
    sources = [
        ExtendedSource(sky_deg=tuple(map(float, place)), name=f"{i + 1}")
        for i, place in enumerate(scene.positions_deg)
    ]
    fitted = {}
    for mode, names in MODES.items():
        observations = [seen[name] for name in names]
        frame = model_frame(observations, grid=scene.euclid.grid)
        given = {"frame": frame, "device": device}
        # compiles the kernels where no earlier run has
        deblend(observations, sources, settings=Settings(max_iter=1), **given)
        started = time.perf_counter()
        result = deblend(observations, sources, **given)
        took = time.perf_counter() - started
        models = np.array([result.source_model(i).sum(axis=0) for i in range(len(sources))])
        fitted[mode] = result, sdr(scene.euclid.truth, models, unit_sum=True), took
    return fitted


def run(folder="demo", *, device=None):
    """Makes the demonstration's files in `folder`; returns `fit_all`'s result and the files."""
    folder, device = Path(folder), get_device(device)
    sky = {"angle_deg": ANGLE_DEG, "center_deg": CENTER_DEG, "spectra": "smooth"}
    scene = simulate_scene(SEED, n_sources=N_SOURCES, **sky)
    folder.mkdir(parents=True, exist_ok=True)
    fitted = fit_all(scene, device=device)
    result = fitted["joint"][0]
    names = "deblended.png", "catalogue.fits", "catalogue.ecsv", "result.fits"
    files = [folder / name for name in names]
    table = catalogue(result)
    plot_deblended(files[0], result, title="Six galaxies, two telescopes, one model")
    for path in files[1:3]:
        write_catalogue(path, table, overwrite=True)
    write_result(files[3], result, overwrite=True, device=device.name)
    _report(scene, fitted, device)
    print()
    files += demo_resample.run(folder, device=device)[1]
    for path in files:
        print(path.resolve())
    return fitted, files


def _report(scene, fitted, device):
    shapes = " and ".join(f"{i.survey.name} {i.data.shape}" for i in (scene.euclid, scene.rubin))
    print(f"{N_SOURCES} galaxies in {shapes}, turned by {ANGLE_DEG:g} degrees, on {device.name}")
    print("SDR [dB] of each galaxy against the truth, by what it was fitted to")
    print("galaxy  mag VIS  mag i " + "".join(f"{mode:>9}" for mode in fitted))
    i_band = scene.rubin.survey.bands.index("i")
    for i in range(N_SOURCES):
        magnitudes = scene.euclid.magnitudes[i, 0], scene.rubin.magnitudes[i, i_band]
        print(
            f"{i + 1:6d} {magnitudes[0]:8.1f} {magnitudes[1]:6.1f} "
            + "".join(f"{found[1][i]:9.1f}" for found in fitted.values())
        )
    for label, values in (
        ("median", [f"{np.median(found[1]):.1f}" for found in fitted.values()]),
        ("iterations", [f"{len(found[0].losses) - 1}" for found in fitted.values()]),
        ("seconds", [f"{found[2]:.2f}" for found in fitted.values()]),
    ):
        print(f"{label:23}" + "".join(f"{value:>9}" for value in values))


def main(argv=None):
    """Runs the demonstration; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m clresample.cli.demo", description=__doc__.split("\n")[0]
    )
    parser.add_argument(
        "folder", nargs="?", default="demo", help="where to write (default %(default)s)"
    )
    parser.add_argument("--device", help="as for `clresample devices`")
    arguments = parser.parse_args(argv)
    try:
        run(arguments.folder, device=arguments.device)
    except (DeviceError, ImportError, OSError, ValueError) as error:
        print(f"clresample.cli.demo: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
