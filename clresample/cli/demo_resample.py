"""Part of the demonstration: a simulated Euclid image rendered for Rubin, with the truth.

Writes euclid.fits, rubin.fits, rubin_truth.fits and resampled.png.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..files.fits import write_fits
from ..files.panels import Panel, save_panels, stretch_limits
from ..resampling.resampler import Resampler
from ..simulation.galaxies import draw, random_galaxy
from ..simulation.sdr import sdr
from ..simulation.surveys import EUCLID_VIS, RUBIN_UGRIZY
from ..sky.grid import Grid
from .demo_sky import ANGLE_DEG, CENTER_DEG

SEED = 20
N_GALAXIES, BRIGHTEST, FAINTEST = 40, 19.5, 24.5  # magnitudes, more faint ones than bright
N_PIXELS = 110  # of Rubin, a side
BAND = RUBIN_UGRIZY.bands.index("i")


class SimulatedSky(NamedTuple):
    """The same galaxies twice, without noise, in Euclid's counts.

    euclid (Ny, Nx), rubin (My, Mx): drawn by GalSim under each telescope's PSF and pixels
    """

    grid_euclid: Grid
    grid_rubin: Grid
    euclid: np.ndarray
    rubin: np.ndarray


def simulate(seed=SEED):
    """Galaxies of bulge, disk and knots, uniform over the field, drawn for both telescopes."""
    rng = np.random.default_rng(seed)
    # Rubin's turned square fits into Euclid's field
    turned = np.cos(np.radians(ANGLE_DEG)) + np.sin(np.radians(ANGLE_DEG))
    n_euclid = EUCLID_VIS.n_same_sky(int(N_PIXELS * turned) + 10, RUBIN_UGRIZY)
    euclid_grid = EUCLID_VIS.grid(n_euclid)
    rubin_grid = RUBIN_UGRIZY.grid(N_PIXELS, angle_deg=ANGLE_DEG)
    euclid, rubin = np.zeros(euclid_grid.shape), np.zeros(rubin_grid.shape)
    half = 0.45 * n_euclid * EUCLID_VIS.pixel_scale_arcsec
    for _ in range(N_GALAXIES):
        galaxy = random_galaxy(rng)
        position = rng.uniform(-half, half, 2)
        magnitude = FAINTEST - (FAINTEST - BRIGHTEST) * rng.power(1.5) ** 2
        galaxy *= float(EUCLID_VIS.counts([magnitude])[0])
        for image, grid, sigma in (
            (euclid, euclid_grid, EUCLID_VIS.psf_sigma_arcsec[0]),
            (rubin, rubin_grid, RUBIN_UGRIZY.psf_sigma_arcsec[BAND]),
        ):
            image += draw(galaxy, grid, psf_sigma_arcsec=sigma, position_arcsec=position)
    grids = (Grid.from_wcs(_wcs(grid), grid.shape) for grid in (euclid_grid, rubin_grid))
    return SimulatedSky(*grids, euclid, rubin)


def _wcs(grid):
    return grid.to_wcs(ra_deg=CENTER_DEG[0], dec_deg=CENTER_DEG[1])


def run(folder="demo", *, device=None):
    """Makes the demonstration's files in `folder`; returns its SDR [dB] and the files' paths."""
    started = time.perf_counter()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sky = simulate()
    drawn = time.perf_counter()
    psf_in, psf_out = EUCLID_VIS.psf(), RUBIN_UGRIZY.psf()[BAND]
    op = Resampler(sky.grid_euclid, psf_in, sky.grid_rubin, psf_out, device=device)
    op(sky.euclid)  # compiles the kernels where no earlier run has
    ready = time.perf_counter()
    rendered = op(sky.euclid)
    took = time.perf_counter() - ready
    quality = float(sdr(sky.rubin, rendered))

    files = [folder / name for name in ("euclid.fits", "rubin.fits", "rubin_truth.fits")]
    images = (sky.euclid, sky.grid_euclid), (rendered, sky.grid_rubin), (sky.rubin, sky.grid_rubin)
    for path, (image, grid) in zip(files, images, strict=True):
        made_here = {"coverage": op.covered, "device": op.device.name} if image is rendered else {}
        write_fits(path, image, grid, unit="count", overwrite=True, **made_here)
    picture = folder / "resampled.png"
    _draw(picture, sky, rendered, quality)

    print(
        f"Euclid {sky.euclid.shape} -> Rubin {rendered.shape}, turned by {ANGLE_DEG:g} degrees: "
        f"{1000 * took:.1f} ms on {op.device.name}"
    )
    print(f"SDR {quality:.1f} dB against GalSim's own drawing of the same galaxies")
    print(
        f"drawing {drawn - started:.1f} s, set-up and kernels {ready - drawn:.2f} s, "
        f"everything {time.perf_counter() - started:.1f} s"
    )
    return quality, [*files, picture]


def _draw(path, sky, rendered, quality):
    limits = stretch_limits(sky.rubin)
    residual = rendered - sky.rubin
    limit = float(np.abs(residual).max())
    share = limit / sky.rubin.max()
    grid = sky.grid_rubin
    panels = [
        Panel(sky.euclid, sky.grid_euclid, "Euclid, simulated", "the input"),
        Panel(rendered, grid, "as Rubin sees it", "rendered from Euclid's pixels", limits=limits),
        Panel(sky.rubin, grid, "truth", "drawn by GalSim", limits=limits),
        Panel(
            residual,
            grid,
            "residual",
            f"SDR {quality:.1f} dB; colours: ±{share:.0e} of the peak",
            residual=limit,
        ),
    ]
    save_panels(path, panels, like=grid, title="One operator: resampling and convolution")
