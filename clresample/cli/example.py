"""`clresample deblend --example`: a scene file that shows every key, with images to try it on.

The scene file is example.toml, which lies beside this module.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from ..files.atomic import atomic_files, check_folder, check_output
from ..files.fits import write_fits, write_hdus
from ..files.tables import write_catalogue
from ..simulation.scenes import simulate_scene
from .demo_sky import ANGLE_DEG, CENTER_DEG

SEED, N_SOURCES = 11, 6
FILES = (
    "scene.toml",
    "sources.ecsv",
    "euclid.fits",
    "euclid_psf.fits",
    "rubin.fits",
    "rubin_psf.fits",
)


def write_example(folder, *, overwrite=False) -> list[Path]:
    """Writes scene.toml, images and PSFs of a simulated blend, and its sources' positions.

    Returns the paths, the scene file first. Raises FileError for files that exist, ImportError
    without GalSim.
    """
    folder = Path(folder)
    paths = {name: folder / name for name in FILES}
    check_folder(folder)
    for path in paths.values() if folder.exists() else ():
        check_output(path, overwrite=overwrite)
    sky = {"angle_deg": ANGLE_DEG, "center_deg": CENTER_DEG, "spectra": "smooth"}
    scene = simulate_scene(SEED, n_sources=N_SOURCES, **sky)
    with atomic_files(paths.values()) as parts:
        _write(dict(zip(paths, parts, strict=True)), scene)
    return list(paths.values())


def _write(paths, scene):
    """Writes a simulated scene's files, by name under these paths."""
    for name, image in (("euclid", scene.euclid), ("rubin", scene.rubin)):
        bands, data = image.survey.bands, image.data.astype(np.float32)
        path = paths[f"{name}.fits"]
        write_fits(path, data, image.grid, bands=bands, unit="count")
        psf = fits.PrimaryHDU(image.psf.images)
        for i, band in enumerate(bands):
            psf.header[f"BAND{i + 1}"] = band
        write_hdus(paths[f"{name}_psf.fits"], [psf])
    table = QTable()
    table["name"] = [f"galaxy {i + 1}" for i in range(len(scene.profiles))]
    table["ra"], table["dec"] = scene.positions_deg.T * u.deg
    write_catalogue(paths["sources.ecsv"], table)
    example = resources.files(__package__).joinpath("example.toml")
    paths["scene.toml"].write_bytes(example.read_bytes())
