"""A folder as a run over a field leaves it, written without any fit: stars on noise."""

import json

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from clresample import Grid
from clresample.simulation.surveys import EUCLID_VIS

SIGMA = 2.0  # [counts] noise of a pixel of every channel
REACH_PX = 20  # a source's light ends there, ten times its width
INSTRUMENTS = {"Euclid": ("VIS",), "Rubin": ("g", "r", "i")}


def write_folder(
    folder, *, n_sources=12, n_px=160, instruments=INSTRUMENTS, seed=3, part_from=0, status=None
):
    """Writes catalogue.fits, fit_table.ecsv, model and residual mosaics, provenance.json.

    n_px: of the first instrument a side; later ones have pixels twice as large, turned by 12 deg
    part_from: column of the field at which its images begin, as those of a part do
    status: {row: (status, reason)}
    returns the catalogue
    """
    rng = np.random.default_rng(seed)
    whole = _placed(n_px, 1, 0.0)
    at = rng.uniform(12, n_px - 12, (n_sources, 2))
    at[:, 1] = np.maximum(at[:, 1], part_from + 12)
    flux = np.sort(10 ** rng.uniform(0, 2, n_sources))[::-1]
    table = _table(whole, at, flux, [c for channels in instruments.values() for c in channels])
    for row, (how, why) in (status or {}).items():
        table["status"][row], table["reason"][row] = how, why
    folder.mkdir(parents=True, exist_ok=True)
    for k, (name, channels) in enumerate(instruments.items()):
        grid = _placed(n_px, 2 if k else 1, 12.0 if k else 0.0)
        if not k and part_from:
            grid = grid.cutout(0, part_from, (n_px, n_px - part_from))
        _write_images(folder, name, channels, grid, whole, at, flux, rng)
    _write_catalogue(folder / "catalogue.fits", table)
    _fits_of(table, rng).write(folder / "fit_table.ecsv", format="ascii.ecsv", overwrite=True)
    run = {
        "mosaics": [[name, 0, 0, *channels] for name, channels in instruments.items()],
        "corner": whole.sky(0, 0).tolist(),
        "part": [2, 2, 256] if part_from else None,
    }
    told = {"clresample": "0.1.0", "run": run, "failed_tiles": {}, "seconds": {"fit": 1.5}}
    (folder / "provenance.json").write_text(json.dumps(told))
    return table


def _placed(n_px, step, angle):
    """A grid about RA 150, Dec 2."""
    scale = EUCLID_VIS.pixel_scale_arcsec * step
    grid = Grid.flat((-(-n_px // step),) * 2, scale, angle_deg=angle)
    return Grid.from_wcs(grid.to_wcs(ra_deg=150.0, dec_deg=2.0), grid.shape)


def _table(grid, at, flux, channels):
    n = len(at)
    table = QTable()
    table["id"] = (np.rint(at[:, 0]).astype(np.int64) << 20) + np.rint(at[:, 1]).astype(np.int64)
    table["parent_id"] = table["id"]
    ra, dec = grid.sky(*at.T)
    table["ra"], table["dec"] = ra * u.deg, dec * u.deg
    table["y"], table["x"] = at[:, 0] * u.pix, at[:, 1] * u.pix
    table["flags"] = np.zeros(n, np.int32)
    table["status"] = np.full(n, "converged", "U120")
    table["reason"] = np.full(n, "", "U120")
    table["n_blend_sources"] = np.ones(n, np.int64)
    table["snr"] = 10 * flux
    table["rms_size"] = np.full(n, 0.2) * u.arcsec
    for channel in channels:
        table[f"flux_{channel}"] = flux * u.uJy
        table[f"flux_err_{channel}"] = flux / 10 * u.uJy
    for channel in channels:
        table[f"max_residual_{channel}"] = np.full(n, 3.0)
    return table


def _write_catalogue(path, table):
    hdu = fits.table_to_hdu(table)
    hdu.name = "CATALOGUE"
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)


def _fits_of(table, rng):
    n = len(table)
    rows = QTable()
    rows["fit_id"] = np.arange(n)
    rows["parent_id"] = table["id"]
    rows["n_refits"] = np.zeros(n, int)
    rows["status"] = [
        f"{s}: {r}" if r else str(s) for s, r in zip(table["status"], table["reason"])
    ]
    rows["n_sources"] = np.ones(n, int)
    rows["n_pixels"] = np.full(n, 4096)
    rows["n_iterations"] = np.full(n, 20)
    rows["seconds"] = rng.uniform(0.1, 2, n) * u.s
    return rows


def _write_images(folder, name, channels, grid, whole, at, flux, rng):
    """A Gaussian of two pixels for each source; residuals of noise alone."""
    there = whole.positions_in(grid, *at.T)
    model = np.zeros(grid.shape)
    for place, one in zip(there, flux, strict=True):
        low = np.clip(np.rint(place).astype(int) - REACH_PX, 0, grid.shape)
        high = np.clip(low + 2 * REACH_PX + 1, 0, grid.shape)
        y, x = np.ogrid[low[0] : high[0], low[1] : high[1]]
        light = np.exp(-((y - place[0]) ** 2 + (x - place[1]) ** 2) / 8)
        model[low[0] : high[0], low[1] : high[1]] += 20 * one * light
    model = np.broadcast_to(model, (len(channels), *grid.shape)).astype(np.float32)
    noise = (SIGMA * rng.standard_normal(model.shape)).astype(np.float32)
    header = grid.to_wcs().to_header(relax=True)
    for i, channel in enumerate(channels):
        header[f"BAND{i + 1}"] = channel
    for what, cube in (("model", model), ("residual", noise)):
        fits.PrimaryHDU(cube, header).writeto(folder / f"{what}_{name}.fits", overwrite=True)
