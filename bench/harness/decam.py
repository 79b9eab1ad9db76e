"""Single exposures of DECam in the data folder, as scene files for `clresample deblend`.

The sky is the median of the pixels of each cutout's rim. Masked pixels have weight 0 in the files.
Sources are detected, or listed in an order and with omissions that must change no flux.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from clresample.fields.psfs.psfex import PSFExPSF
from clresample.sky.observation import ZERO_POINT_UJY

from .toml import lines_of

RIM_PX = 5  # [px] width of the rim from which the sky is taken
APERTURE_PX = 40.0  # [px] about decam_galaxy, whose light ends there
NANOMAGGIE_MAG = 22.5  # AB magnitude of one nanomaggie
# decam_pair: its first pixel in the CCD (y, x), from the corners of the CCD that its header names
PAIR_ORIGIN_PX = (1463.0, 34.0)
Z = 4  # of the table's columns of ugrizY
PAIR, PAIR_TABLE = "decam-520206-S16", "tractor-1816p325-sub.fits"
# decam_galaxy: ra, dec [deg] of the galaxy and of its two neighbours, as `detect` finds them
GALAXY = ((9.123216, 3.397605), (9.121311, 3.399866), (9.121402, 3.400426))
ORDERS = {
    "decam_galaxy-first": (0, 1, 2),
    "decam_galaxy-last": (1, 2, 0),
    "decam_galaxy-middle": (2, 0, 1),
    "decam_galaxy-without1": (0, 2),
    "decam_galaxy-without2": (0, 1),
    "decam_galaxy-alone": (0,),
}


@dataclass(frozen=True)
class Exposure:
    """One image (Ny, Nx) [counts] above its sky, weight (Ny, Nx), PSF image, header, zero point."""

    name: str
    image: np.ndarray
    weight: np.ndarray
    psf: np.ndarray
    header: fits.Header
    zero_point: float


def above_sky(image, weight):
    """The image without the median of its rim's pixels that have a weight."""
    rim = np.ones(image.shape, bool)
    rim[RIM_PX:-RIM_PX, RIM_PX:-RIM_PX] = False
    return image - np.median(image[rim & (weight > 0)])


def exposures(folder):
    """Exposures of decam_galaxy or decam_star; the PSFEx tables count their cutouts' pixels."""
    table = Table(fits.getdata(next(folder.glob("survey-ccds.fits*")), 1))
    found = []
    for row in table:
        path = folder / row["image_filename"].strip().rpartition("/")[2]
        weight, mask = (fits.getdata(str(path).replace("_ooi_", f"_{c}_")) for c in ("oow", "ood"))
        weight = np.where(mask == 0, weight, 0.0)
        image, header = fits.getdata(path, header=True)
        psf = next(folder.glob(f"{path.name.split('.')[0]}*psfex.fits"))
        middle = (np.array(image.shape) - 1) / 2
        band = row["filter"].strip()
        n_before = sum(e.name[0] == band for e in found)
        found.append(
            Exposure(
                f"{band}{n_before or ''}",
                above_sky(image, weight),
                weight,
                PSFExPSF(psf).psf_at(*middle).images[0],
                header,
                float(row["ccdzpt"] + 2.5 * np.log10(row["exptime"])),
            )
        )
    return found


def pair(folder):
    """The exposure of decam_pair and the Tractor's table."""
    path = folder / f"{PAIR}-image-sub.fits"
    image, header = fits.getdata(path, header=True)
    weight = np.maximum(fits.getdata(folder / f"{PAIR}-invvar-sub.fits"), 0.0)  # rounding errors
    middle = (np.array(image.shape) - 1) / 2 + PAIR_ORIGIN_PX
    psf = PSFExPSF(folder / f"{PAIR}-psfex.fits").psf_at(*middle).images[0]
    zero_point = fits.getheader(path)["MAGZERO"]
    one = Exposure("z", above_sky(image, weight), weight, psf, header, float(zero_point))
    return one, Table(fits.getdata(folder / PAIR_TABLE, 1))


def write_scene(folder, found, places=None):
    """Writes exposures as FITS files with a scene file beside them; returns its path.

    places (S, 2) [deg]: ra, dec of the sources; None leaves them to detection
    """
    folder.mkdir()
    lines = []
    for one in found:
        keys = {"name": f"DECam-{one.name}", "channels": [one.name], "zero_point": one.zero_point}
        for key, array in (("image", one.image), ("weight", one.weight), ("psf", one.psf)):
            keys[key] = f"{key}-{one.name}.fits"
            header = None if key == "psf" else one.header
            fits.writeto(folder / keys[key], np.asarray(array, np.float32), header)
        lines += ["[[observation]]", *lines_of(keys)]
    if places is None:
        lines.append("[detection]")
    else:
        Table(np.asarray(places, float), names=("ra", "dec")).write(folder / "sources.ecsv")
        lines += ["[sources]", *lines_of({"catalogue": "sources.ecsv"})]
    path = folder / f"{folder.name}.toml"
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def scene_files(data, folder):
    """Writes the scenes of the data folder that are there: {scene: path of its file}."""
    paths = {}
    for name in ("decam_galaxy", "decam_star"):
        if (data / name).is_dir():
            found = exposures(data / name)
            paths[name] = write_scene(folder / name, found)
            for more, order in ORDERS.items() if name == "decam_galaxy" else ():
                paths[more] = write_scene(folder / more, found, [GALAXY[i] for i in order])
    if (data / "decam_pair").is_dir():
        paths["decam_pair"] = write_scene(folder / "decam_pair", [pair(data / "decam_pair")[0]])
    return paths


def measured(table, band):
    """Position, flags, flux and its error of each source of a catalogue in a band."""
    sky = [name for name in ("ra", "dec") if name in table.colnames]
    columns = {name: table[name] for name in (*sky, "flags")}
    columns |= {key: table[f"{key}_{band}"] for key in ("flux", "flux_err")}
    values = {key: np.asarray(getattr(c, "value", c), float) for key, c in columns.items()}
    return [{key: float(value[s]) for key, value in values.items()} for s in range(len(table))]


def compared(rows, data):
    """Figures of DECam's scenes among the rows of bench.real, for its summary."""
    found, light = {}, {}
    for row in rows:
        if row["scene"].startswith("decam_galaxy"):
            light = light or {e.name: aperture(e) for e in exposures(data / "decam_galaxy")}
            one = nearest(row["sources"], *GALAXY[0])
            ratio, error = (one[key] / light[row["band"]] for key in ("flux", "flux_err"))
            group = found.setdefault("decam_galaxy's flux over the light within 40 px", {})
            group[f"{row['scene']}, {row['band']}"] = f"{ratio:.3f} +- {error:.3f}"
        if row["scene"] == "decam_pair":
            found["decam_pair against the Tractor: ratio, sigma"] = _against_tractor(row, data)
    return found


def aperture(one):
    """Light [uJy] of an exposure of decam_galaxy about the galaxy, neighbours of 0.3 % included."""
    x, y = WCS(one.header).all_world2pix(*GALAXY[0], 0)
    rows, columns = np.indices(one.image.shape)
    inside = np.hypot(rows - y, columns - x) < APERTURE_PX
    return one.image[inside].sum() * 10 ** (-0.4 * (one.zero_point - ZERO_POINT_UJY))


def nearest(sources, ra, dec):
    """The one of a row's sources that is nearest to a place [deg]."""
    at = np.array([[s["ra"], s["dec"]] for s in sources])
    apart = (at - (ra, dec)) * (np.cos(np.deg2rad(dec)), 1)
    return sources[int(np.argmin(np.hypot(*apart.T)))]


def _against_tractor(row, data):
    table, figures = pair(data / "decam_pair")[1], {}
    to_ujy = 10 ** (-0.4 * (NANOMAGGIE_MAG - ZERO_POINT_UJY))
    for true in table:
        flux, error = true["decam_flux"][Z] * to_ujy, true["decam_flux_ivar"][Z] ** -0.5 * to_ujy
        one = nearest(row["sources"], true["ra"], true["dec"])
        pull = (one["flux"] - flux) / np.hypot(one["flux_err"], error)
        figures[true["type"].strip()] = f"{one['flux'] / flux:.3f}, {pull:.1f}"
    figures["both galaxies of DEV over its light in its pixels"] = _both_of_dev(row, table, to_ujy)
    return figures


def _both_of_dev(row, table, to_ujy):
    """Fluxes of the two galaxies of which the Tractor's DEV is one, over its light in its pixels.

    The Tractor lists two sources where the image has three, 15 px apart: its DEV of 6.4 arcsec is a
    model of two of them (chi2 6030 for 4580 pixels; three of GalSim's Sersic profiles have 4568),
    and 29 % of its flux lies beyond the pixels that it was fitted to. In a fit of all three, n = 4
    of the large one has a chi2 higher by 57 than n = 1 (48 with a free sky).
    """
    dev = table[[true["type"].strip() == "DEV" for true in table]][0]
    away = [
        np.hypot((s["ra"] - dev["ra"]) * np.cos(np.deg2rad(dev["dec"])), s["dec"] - dev["dec"])
        for s in row["sources"]
    ]
    pair = [row["sources"][i] for i in np.argsort(away)[:2]]
    scale = dev["decam_fracin"][Z] * to_ujy
    light, light_error = dev["decam_flux"][Z] * scale, dev["decam_flux_ivar"][Z] ** -0.5 * scale
    flux, error = sum(s["flux"] for s in pair), np.hypot(*(s["flux_err"] for s in pair))
    return f"{flux / light:.3f}, {(flux - light) / np.hypot(error, light_error):.1f}"
