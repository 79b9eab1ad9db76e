"""`clresample deblend --example`: a scene file that shows every key, with images to try it on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from ..files.fits import write_fits
from ..files.results import write_catalogue
from ..files.whole_file import check_output
from ..simulation.scenes import simulate_scene

SEED, N_SOURCES = 11, 6
ANGLE_DEG = 15.0  # of Rubin's pixels against Euclid's
CENTER_DEG = 150.1, 2.2  # right ascension, declination

SCENE = """\
# What to deblend:  clresample deblend scene.toml -o out
# File names are relative to this file's folder. Lines that begin with # are optional keys.

[[observation]]                   # one such table per instrument
name = "Euclid"
image = "euclid.fits"             # FITS image or cube with a celestial WCS
psf = "euclid_psf.fits"           # in the image's pixels, pixel response included
variance = [{euclid_variance}]        # a file, one number, or one for each channel; or weight =
zero_point = [{euclid_zero}]            # [mag] AB of one count; for all observations or none
# hdu = 0                         # number, "NAME" or "NAME,VERSION"; the first image otherwise
# bands = ["VIS"]                 # of a cube, by number or name; all otherwise
# channels = ["VIS"]              # their names in the catalogue
# psf_hdu = 0
# psf_bands = 0
# psf_center = "core"             # "middle" of the array (default), "core", or [y, x]
# psf_spacing = 0.5               # of the PSF's samples [pixels]
# mask = "euclid_mask.fits"       # not 0 = ignore the pixel
# mask_hdu = 0
# variance_hdu = "VAR"

[[observation]]
name = "Rubin"
image = "rubin.fits"
psf = "rubin_psf.fits"
variance = [{rubin_variance}]
zero_point = [{rubin_zero}]
bands = ["u", "g", "r", "i", "z", "y"]

[sources]
catalogue = "sources.ecsv"        # any table that astropy reads
# ra = "RA"                       # column names, where they are others; or y and x [model pixels]
# dec = "DEC"
# name = "ID"
# type = "CLASS"                  # "point" or "extended", the default
# components = "N"                # spectra of an extended source, 1 otherwise
# format = "ascii.ecsv"           # where astropy cannot guess

# [detection]                     # instead of [sources]
# threshold = 5.0                 # [sigma] of a peak, in one instrument or in all together
# passes = 2                      # 2 = also search the residuals of a first fit

[frame]                           # the model's pixels
psf_sigma_px = 0.8
# like = "Euclid"                 # whose pixels; the finest otherwise
# footprint = "union"             # or "intersection"

[fit]
# max_iter = 300
# tol = 1e-5                      # a fit ends when its loss falls by less than this part of itself
# monotone = true                 # false for galaxies of arms and tails
# structure_px = 2.0              # size of the structure in a galaxy [model pixels]
fit_shifts = false                # let all observations but the first move by a constant shift
fit_sky = false                   # fit a constant in each channel
"""


def write_example(folder, *, overwrite=False) -> list[Path]:
    """Write scene.toml, images and PSFs of a simulated blend, and its sources' positions.

    Returns the paths, the scene file first. Raises FileError for files that exist, ImportError
    without GalSim.
    """
    folder = Path(folder)
    names = (
        "scene.toml",
        "sources.ecsv",
        *(f"{o}{p}.fits" for o in ("euclid", "rubin") for p in ("", "_psf")),
    )
    paths = {name: folder / name for name in names}
    for path in paths.values() if folder.exists() else ():
        check_output(path, overwrite=overwrite)
    scene = simulate_scene(SEED, n_sources=N_SOURCES, angle_deg=ANGLE_DEG, center_deg=CENTER_DEG)
    folder.mkdir(parents=True, exist_ok=True)
    values = {}
    for name, image in (("euclid", scene.euclid), ("rubin", scene.rubin)):
        write_fits(
            paths[f"{name}.fits"],
            image.data.astype(np.float32),
            image.grid,
            bands=image.survey.bands,
            unit="count",
            overwrite=overwrite,
        )
        hdu = fits.PrimaryHDU(image.psf.images)
        for i, band in enumerate(image.survey.bands):
            hdu.header[f"BAND{i + 1}"] = band
        hdu.writeto(paths[f"{name}_psf.fits"], overwrite=overwrite)
        values[f"{name}_variance"] = ", ".join(f"{s**2:.6g}" for s in image.survey.noise_sigma)
        values[f"{name}_zero"] = ", ".join(f"{z:.4f}" for z in image.survey.zero_points_mag)
    table = QTable()
    table["name"] = [f"galaxy {i + 1}" for i in range(len(scene.profiles))]
    table["ra"], table["dec"] = scene.positions_deg.T * u.deg
    write_catalogue(paths["sources.ecsv"], table, overwrite=overwrite)
    paths["scene.toml"].write_text(SCENE.format(**values))
    return list(paths.values())
