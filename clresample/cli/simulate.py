"""A field with its truth, in files to try `clresample field` on: `clresample simulate field`."""

from __future__ import annotations

import argparse
from pathlib import Path

from .fields.sky_options import add_images, add_sky
from .options import print_note

FILES = "field.toml", "truth.ecsv"
CLUMPS = "clumps.ecsv"  # written where a field's galaxies have clumps
TILE = 1  # number of the tile of Euclid's MER that a simulated field becomes
# Options by the arguments of `simulate_field` that have another name.
OPTIONS = {"n_pixels": "--size", "rubin_bands": "--bands", "psf_variation": "--psf-variation"}
CELL_PX = 150  # side of a cell of Rubin's coadds
DESCRIPTION = """\
Write a simulated field of galaxies and stars as Euclid (VIS) and Rubin see it:
mosaics with RMS, masks and PSFs that vary, field.toml for `clresample field`, and
truth.ecsv. One seed gives one field. --sky real draws large and bright galaxies,
stars that saturate, and images with faults; clumps.ecsv lists clumps by galaxy."""


def add_simulate(commands):
    """Adds `clresample simulate`."""
    parser = commands.add_parser(
        "simulate",
        help="write a simulated field with its truth",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=["field"], help="field: mosaics of two surveys")
    parser.add_argument("-o", "--output", metavar="DIR", required=True, help="to write into")
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    add_sky(parser.add_argument_group("sky"))
    add_images(parser.add_argument_group("images"))
    parser.set_defaults(run=run)


def run(arguments):
    """Runs the command. Raises ValueError and FileError, one line, for unusable arguments."""
    from ..files.atomic import check_folder, check_output
    from ..simulation.field import simulate_field
    from ..simulation.spoilers import Spoilers

    folder = Path(arguments.output)
    check_folder(folder)
    for name in FILES if folder.exists() else ():
        check_output(folder / name, overwrite=arguments.overwrite)
    size = arguments.spoilers
    spoilers = None if size is None else Spoilers().scaled(size)
    try:
        field = simulate_field(
            arguments.seed,
            sky=arguments.sky,
            spoilers=spoilers,
            n_large=arguments.large,
            n_pixels=arguments.size,
            density=arguments.density,
            rubin_bands=tuple(arguments.bands),
            angle_deg=arguments.angle,
            clustering=arguments.clustering,
            stars=arguments.stars,
            psf_variation=arguments.psf_variation,
            bad_columns=arguments.bad_columns,
        )
    except (ImportError, ValueError) as error:
        name, _, rest = str(error).partition(" ")
        raise ValueError(f"{OPTIONS.get(name, name)} {rest}") from error
    write = write_field if arguments.format == "plain" else write_surveys
    for path in write(folder, field, overwrite=arguments.overwrite):
        print(path)
    print_note(arguments, f"next: clresample field {folder / FILES[0]} -o {folder / 'out'}")


def write_field(folder, field, *, overwrite=True) -> list[Path]:
    """Writes a SimulatedField: an image and a PSF cube of each mosaic, field.toml, truth.ecsv.

    An image file has the HDUs SCI (cube of bands, tile-compressed without loss), RMS and MASK,
    whose bit BAD (1) marks dead columns. All files appear together. overwrite: whether they may
    replace others. Returns the paths, field.toml first.
    """
    return _written(_write_plain, folder, field, overwrite)


def write_surveys(folder, field, *, overwrite=True) -> list[Path]:
    """Writes a SimulatedField in its surveys' formats, field.toml and truth.ecsv.

    As `write_field`. euclid/ holds a tile of MER, rubin/ a cell coadd for each band. Dead columns
    have the flag 1 there and NO_DATA here. Raises ValueError for PSFs sampled more finely than the
    images, which these formats do not hold.
    """
    spacings = [mosaic.psf_spacing for mosaic in field.mosaics]
    if set(spacings) != {1.0}:
        raise ValueError(
            f"PSFs have sample spacings {spacings} px, must be 1 in surveys' formats: write the "
            "plain format, --format plain"
        )
    return _written(_write_surveys, folder, field, overwrite)


def _written(write, folder, field, overwrite):
    """Moves the files that write(part, field) made in a folder `part` to `folder`; their paths."""
    from ..files.atomic import atomic_tree

    with atomic_tree(folder, overwrite=overwrite) as part:
        paths = write(part, field)
    return [Path(folder) / path.relative_to(part) for path in paths]


def _write_plain(folder, field):
    """The files of `write_field`."""
    import numpy as np
    from astropy.io import fits
    from astropy.table import Table

    from ..files.fits import write_hdus

    paths, tables = [], []
    lossless = {"compression_type": "GZIP_2", "quantize_level": 0}
    for mosaic in field.mosaics:
        name = mosaic.survey.name.lower()
        header = mosaic.grid.to_wcs().to_header(relax=True)
        for i, band in enumerate(mosaic.survey.bands):
            header[f"BAND{i + 1}"] = band
        rms = np.broadcast_to(
            mosaic.noise_sigma[:, None, None].astype(np.float32), mosaic.data.shape
        )
        tile = {"tile_shape": (1, 64, mosaic.data.shape[2])}
        mask = fits.ImageHDU(2 * mosaic.bad_pixels.astype(np.uint8), name="MASK")
        mask.header["MP_BAD"] = (1, "bit of dead columns")
        hdus = [
            fits.PrimaryHDU(),
            fits.CompImageHDU(mosaic.data, header, name="SCI", **lossless, **tile),
            fits.CompImageHDU(np.array(rms), name="RMS", **lossless, **tile),
            mask,
        ]
        write_hdus(folder / f"{name}.fits", hdus)
        y, x = mosaic.psf_positions.T
        places = fits.table_to_hdu(Table({"x": x, "y": y}))
        places.name = "POSITIONS"
        images = fits.ImageHDU(mosaic.psf_images, name="PSF")
        write_hdus(folder / f"{name}_psf.fits", [fits.PrimaryHDU(), images, places])
        paths += [folder / f"{name}.fits", folder / f"{name}_psf.fits"]
        tables.append(_toml(mosaic, name))
    return _with_truth(folder, tables, paths, field)


def _with_truth(folder, tables, paths, field):
    """Writes field.toml and truth.ecsv; all paths, field.toml first."""
    from astropy.table import Table

    (folder / FILES[0]).write_text("\n".join(tables))
    written = [FILES[1]]
    Table(field.truth).write(folder / FILES[1], format="ascii.ecsv", overwrite=True)
    if field.clumps:
        Table(field.clumps).write(folder / CLUMPS, format="ascii.ecsv", overwrite=True)
        written.append(CLUMPS)
    return [folder / FILES[0], *paths, *(folder / name for name in written)]


def _write_surveys(folder, field):
    """The files of `write_surveys`."""
    import numpy as np

    from ..fields.psfs.sampled import ScatteredPSF
    from ..fields.readers.writers import write_cell_coadd, write_mer_tile

    euclid, rubin = field.mosaics
    for name in ("euclid", "rubin"):
        (folder / name).mkdir()
    paths = []
    for i, (band, point) in enumerate(_bands(euclid)):
        paths += write_mer_tile(
            folder / "euclid",
            TILE,
            band,
            euclid.data[i],
            euclid.grid,
            rms=np.full(euclid.grid.shape, euclid.noise_sigma[i], np.float32),
            flags=euclid.bad_pixels.astype(np.uint8),
            zero_point=point,
            psfs=euclid.psf_images[:, i],
            places=euclid.psf_positions,
        )
    for i, (band, point) in enumerate(_bands(rubin)):
        psf = ScatteredPSF(rubin.psf_images[:, i], rubin.psf_positions)
        path = write_cell_coadd(
            folder / "rubin" / f"coadd_{band}.fits",
            band,
            rubin.data[i],
            rubin.grid,
            variance=np.full(rubin.grid.shape, rubin.noise_sigma[i] ** 2),
            mask={"NO_DATA": rubin.bad_pixels},
            zero_point=point,
            psf_at=lambda y, x, psf=psf: psf.psf_at(y, x).images[0],
            cell_px=CELL_PX,
        )
        paths.append(path)
    coadds = ", ".join(f'"rubin/coadd_{band}.fits"' for band in rubin.survey.bands)
    # the reader would estimate the correlation of MER's noise; this simulation's is white
    tables = [
        f'[[mosaic]]\nformat = "euclid-mer"\npath = "euclid"\nname = "{euclid.survey.name}"\n'
        'noise = "white"\n',
        f'[[mosaic]]\nformat = "rubin-coadd"\npath = [{coadds}]\nname = "{rubin.survey.name}"\n',
    ]
    return _with_truth(folder, tables, paths, field)


def _bands(mosaic):
    """Pairs of a band's name and its zero point [mag]."""
    return zip(mosaic.survey.bands, mosaic.survey.zero_points_mag, strict=True)


def _toml(mosaic, name):
    """The table of a mosaic in field.toml."""
    points = ", ".join(f"{p:.6f}" for p in mosaic.survey.zero_points_mag)
    return f"""[[mosaic]]
name = "{mosaic.survey.name}"
image = "{name}.fits"
hdu = "SCI"
rms = "{name}.fits"
rms_hdu = "RMS"
mask = "{name}.fits"
mask_hdu = "MASK"
mask_bits = ["BAD"]
zero_point = [{points}]
psf = "{name}_psf.fits"
psf_format = "cube"
psf_spacing = {mosaic.psf_spacing}
"""
