"""Fits of real scenes with all settings by default: chi2, residuals and flags of misfits.

    python -m bench.real [--quick] [--scene SCENE.toml ...] [--json FILE]

The scenes are those of the data folder, CLRESAMPLE_DATA or shared/data beside the checkout:

hsc_blend     seven galaxies in HSC's grizy, at the positions of their catalogue
hst_hsc       docs/hst_hsc.toml: HST and HSC, sources detected, shifts and sky fitted
hst, hsc      the images of either alone, likewise
cosmos-*      HST images of single COSMOS galaxies, those of the highest signal to noise, each from
              its brightest point
decam_*       DECam's single exposures, sources detected; decam_galaxy also with its sources listed
              in several orders, and without each neighbour, which must change no flux
further ones  files for `clresample deblend`, named by --scene, as they are

A row is one band of one scene:

chi2          per pixel with a weight
status        how the fit ended
seconds       wall time, from files or arrays to the catalogue, detection included;
core_s        processor time, of all threads
residual      [sigma] the largest of any source, filtered with the PSF (`measurement.residuals`)
source        that source's number
flagged       whether the catalogue flags it as a misfit; null where the library has no such flag
n_unflagged   sources with a residual over 5 sigma in this band that are not flagged

The JSON has the sources' fluxes, errors and flags too, and what was said of the scene, which the
summary counts. It compares decam_galaxy's flux with the light in an aperture, and decam_pair's
fluxes with the Tractor's.
"""

from __future__ import annotations

import io
import tempfile
import time
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from astropy.table import QTable
from scipy.ndimage import gaussian_filter

from clresample import PSF, ExtendedSource, Flag, Grid, Observation, catalogue, deblend, summary
from clresample.cli.command import main as clresample
from clresample.deblending.posterior.residuals import max_filtered_residuals
from clresample.files.results import read_result
from clresample.simulation.galaxies import import_galsim, open_catalogue

from .harness import decam, records
from .harness.clock import on_all_cores
from .harness.options import ROOT, BadOption, Parser, data_folder, run
from .harness.toml import lines_of

STRUCTURED = 5.0  # [sigma] A residual above this is no noise.
N_COSMOS = 12
QUICK_COSMOS = 4
# What a scene file's [fit] says of the data, not of the model: kept, while the rest is default.
ABOUT_THE_DATA = ("fit_shifts", "fit_sky")
HSC_SCALE_ARCSEC = 0.168
HST_ZERO_POINT = 25.94  # [mag] AB magnitude of 1 count/s in COSMOS' F814W images
PEAK_SIGMA_PX = 2.0  # Smoothing of a COSMOS image before its brightest point is looked for.
COLUMNS = records.columns(
    "scene:21 band:5 chi2:6.2f status:15 seconds:7.2f core_s:6.2f iterations:10d n_sources:9d "
    "residual:8.1f source:6d flagged:7 n_unflagged:11d"
)


def hsc_blend(folder):
    """Observation and sources of the HSC blend; its mask is not used, as in scarlet's example."""
    with np.load(folder / "hsc_cosmos_blend.npz") as file:
        observation = Observation(
            file["images"],
            PSF(file["psfs"]),
            Grid.flat(file["images"].shape[1:], HSC_SCALE_ARCSEC),
            variance=file["variance"],
            channels=[str(name) for name in file["filters"]],
            zero_points=27.0,
            name="HSC",
        )
        places = file["catalog"]
    return observation, [ExtendedSource(position_px=(float(y), float(x))) for x, y in places]


def cosmos_galaxies(folder, n_galaxies):
    """Name, observation and source of the COSMOS galaxies of highest signal to noise."""
    galaxies = open_catalogue(folder / "cosmos")
    order = np.argsort(-galaxies.stamp_flux / np.sqrt(galaxies.variance), kind="stable")
    for i in order[:n_galaxies]:
        image, psf = (f(int(i)).array for f in (galaxies.getGalImage, galaxies.getPSFImage))
        smooth = gaussian_filter(image, PEAK_SIGMA_PX)
        peak = np.unravel_index(smooth.argmax(), smooth.shape)
        observation = Observation(
            image,
            PSF(psf, center="core"),
            Grid.flat(image.shape, galaxies.pixel_scale[i]),
            variance=galaxies.variance[i],
            channels=["F814W"],
            zero_points=HST_ZERO_POINT,
            name="HST",
        )
        yield (
            f"cosmos-{galaxies.ident[i]}",
            observation,
            ExtendedSource(position_px=tuple(map(float, peak))),
        )


def scene_files(data, folder):
    """Writes docs/hst_hsc.toml with all settings by default, and either instrument alone.

    returns {scene: path}
    """
    text = (ROOT / "docs" / "hst_hsc.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text.replace("../../shared/data", data.resolve().as_posix()))
    observations = tables["observation"]
    paths = {}
    chosen = {"hst_hsc": observations} | {o["name"].lower(): [o] for o in observations}
    for name, some in chosen.items():
        fit = {key: tables["fit"][key] for key in ABOUT_THE_DATA if key in tables["fit"]}
        if len(some) == 1:
            fit.pop("fit_shifts", None)
        lines = [line for o in some for line in ("[[observation]]", *lines_of(o))]
        for title in ("detection", "sources"):
            if title in tables:
                lines += [f"[{title}]", *lines_of(tables[title])]
        paths[name] = folder / f"{name}.toml"
        paths[name].write_text("\n".join([*lines, "[fit]", *lines_of(fit), ""]), encoding="utf-8")
    return paths


def fit_file(path, folder):
    """Runs `clresample deblend` on a scene file; returns a function that reads what it wrote."""
    out = folder / f"out-{path.stem}"
    command = ["deblend", str(path), "-o", str(out), "--no-figure", "--quiet"]
    with redirect_stdout(io.StringIO()):
        status = clresample(command)
    if status:
        raise BadOption(f"clresample deblend {path} ended with exit status {status}")
    return lambda: (read_result(out / "result.fits"), QTable.read(out / "catalogue.ecsv"))


def fit_arrays(observation, sources):
    """Fits one instrument's image with known positions; returns a function for the rest."""
    result = deblend([observation], sources)
    table = catalogue(result)
    return lambda: (result, table)


def rows_of(name, fit):
    """Rows of one scene; fit: does all that is timed, returns what gives Result and catalogue."""
    started = time.perf_counter(), time.process_time()
    done = fit()
    seconds, core_s = time.perf_counter() - started[0], time.process_time() - started[1]
    result, table = done()
    found, misfit = summary(result), getattr(Flag, "MISFIT", None)
    flagged = (
        np.zeros(len(table), bool) if misfit is None else np.array(table["flags"]) & misfit != 0
    )
    for i, observation in enumerate(result.observations):
        for band, worst in zip(
            observation.channels, max_filtered_residuals(result, i).T, strict=True
        ):
            source = int(np.nanargmax(worst)) if np.isfinite(worst).any() else -1
            yield {
                "scene": name,
                "band": band,
                "chi2": found["chi2"][band],
                "status": result.status,
                "seconds": seconds,
                "core_s": core_s,
                "iterations": found["n_iterations"],
                "n_sources": found["n_sources"],
                "residual": float(worst[source]),
                "source": source,
                "flagged": None if misfit is None else bool(flagged[source]),
                "n_unflagged": int(((worst > STRUCTURED) & ~flagged).sum()),
                "stages": found["seconds"],
                "sources": decam.measured(table, band),
                "messages": [*observation.messages, *result.messages],
            }


def plan(data, more, n_galaxies, folder):
    """Yields (name, fit) of every scene; more: scene files named by the user."""
    if (data / "hsc_cosmos_blend.npz").is_file():
        observation, sources = hsc_blend(data)
        yield "hsc_blend", lambda: fit_arrays(observation, sources)
    files = scene_files(data, folder) if (data / "hst_hsc").is_dir() else {}
    files |= decam.scene_files(data, folder)
    for name, path in (files | {path.stem: path for path in more}).items():
        yield name, lambda path=path: fit_file(path, folder)
    if n_galaxies and (data / "cosmos").is_dir():
        import_galsim()
        for name, image, source in cosmos_galaxies(data, n_galaxies):
            yield name, lambda image=image, source=source: fit_arrays(image, [source])


def summarise(rows):
    """Figures of all scenes together: how fits ended, how many misfits have no flag, DECam's."""
    scenes = {row["scene"]: row for row in rows}
    return {
        "all scenes": {
            "scenes": len(scenes),
            "converged": sum(row["status"] == "converged" for row in scenes.values()),
            "largest chi2": max(row["chi2"] for row in rows),
            "bands with a residual over 5 sigma": sum(r["residual"] > STRUCTURED for r in rows),
            "sources and bands over 5 sigma, not flagged": sum(r["n_unflagged"] for r in rows),
            "seconds": sum(row["seconds"] for row in scenes.values()),
            "scenes with messages": "; ".join(n for n, r in scenes.items() if r["messages"]),
        }
    } | decam.compared(rows, data_folder())


def main(options):
    data, threads = data_folder(), on_all_cores()
    if not data.is_dir() and not options.scene:
        raise BadOption(f"no data folder at {data}: set CLRESAMPLE_DATA, or name files by --scene")
    record = records.record(threads) | {"settings": "all by default", "data": str(data)}
    n_galaxies = QUICK_COSMOS if options.quick else N_COSMOS
    n_galaxies = n_galaxies if options.galaxies is None else options.galaxies

    def found():
        with tempfile.TemporaryDirectory() as folder:
            for name, fit in plan(data, options.scene, n_galaxies, Path(folder)):
                if not options.only or name.startswith(tuple(options.only)):
                    for row in rows_of(name, fit):
                        yield row
                    records.print_lines(row["messages"])

    def figures(rows):
        if not rows:
            raise BadOption(f"no scene in {data}, or none that --only names")
        return summarise(rows)

    records.show(COLUMNS, found(), record, options.json, summarise=figures)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", f"{QUICK_COSMOS} COSMOS galaxies only")
    about = f"how many COSMOS galaxies, from the highest signal to noise ({N_COSMOS})"
    parser.add_number("galaxies", about)
    about = "scenes whose names start so: hsc_blend, cosmos"
    parser.add("only", about, nargs="+", metavar="NAME")
    about = "further scenes"
    parser.add("scene", about, nargs="+", type=Path, default=[], metavar="SCENE.toml")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
