"""Fitted blends to FITS files and back, bit by bit."""

from __future__ import annotations

import json
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCSHDO_EFMT, WCSHDO_P17, WCSHDO_all
from astropy.wcs.wcs import WCSHDO_SIP

from ..deblending.ended import Ended
from ..deblending.posterior.errors import Errors
from ..deblending.result import Component, Result
from ..measurement.catalogue import catalogue
from ..sky.frame import Frame
from ..sky.grid import Grid
from ..sky.observation import Observation
from ..sky.psf import PSF
from ..sky.sources import ExtendedSource, PointSource, Source
from ..sky.validation.checks import check_instance
from .array_hdus import array_of, image_hdu
from .atomic import FileError, check_output
from .draws import draw_hdus, read_draws
from .fits import add_provenance, celestial_header, open_fits, write_hdus
from .fits_names import check_channels, check_columns, text_card
from .tables import flag_table_hdu, table_hdu

FORMAT = 7  # of the files; raised when an older reader would misread them
KINDS = {kind.__name__: kind for kind in (Source, PointSource, ExtendedSource)}
# of an observation, as JSON
KEPT = ("name", "channels", "bands", "zero_points", "saturation", "unit", "n_invalid", "messages")
BOX = ("source", "y", "x", "n_y", "n_x")
# HDUs of Errors
ERRORS = {
    "FLUXCOV": "flux",
    "COLOURCOV": "colour",
    "MOMENTCOV": "moments",
    "OUTSIDEBOX": "outside_box_moments",
}
ERRORS |= {
    "FLUXBIAS": "flux_correction",
    "MOMENTBIAS": "moment_bound_bias",
    "RESIDUALMAX": "residuals",
    "OUTER": "outside",
    "UNSETTLED": "unsettled",
}
ADDED = ("OUTER", "UNSETTLED")  # not in earlier files
ARRAYS = ("sky", "covariance", "shifts", "losses")
# every WCS card with the 17 digits that give back the same float64
RELAX = WCSHDO_all | WCSHDO_SIP | WCSHDO_P17 | WCSHDO_EFMT


def write_result(path, result, *, overwrite=False, device=None, inputs=None):
    """Writes a fitted blend to FITS, whole or not at all.

    HDUs that `read_result` reads: ABOUT (keys and JSON: sources, names, status, messages, ...),
    COMPONENTS (boxes), SPECTRA (n, C), MORPHOLOGIES (one after the other), SKY, COVARIANCE, SHIFTS,
    LOSSES, where the result has errors FLUXCOV, COLOURCOV, MOMENTCOV, OUTSIDEBOX, FLUXBIAS,
    MOMENTBIAS, RESIDUALMAX, OUTER, UNSETTLED, MORPHOLOGYERR (one after the other), those of the
    draws (see draws.py), MODELPSF, and per observation from 1 on: DATA, WEIGHTS, PSF, RENDERED. For
    other programs: CATALOGUE, FLAGS, SCENE (C, Ny, Nx) = all sources in the model frame, and per
    observation MODEL and RESIDUAL, 0 where data have no weight. All images have their WCS; a flat
    sky is put at RA = Dec = 0. For NaN and infinity see array_hdus.py.

    path: of the file; result: of `deblend`; overwrite: replace a file that exists
    device: name of the OpenCL device; inputs: {what: file}; both for the header

    Raises FileError when the file exists or cannot be written.
    """
    path = Path(path)
    check_channels(check_instance("result", result, Result).channels)
    check_output(path, overwrite=overwrite)
    primary = fits.PrimaryHDU()
    primary.header["CLSTATUS"] = text_card(" ".join(result.status.split()), "how the fit ended")
    add_provenance(primary.header, result.rendered[0].dtype, device, inputs or {}, None)
    hdus = [primary, table_hdu(_catalogue(result), "CATALOGUE"), flag_table_hdu()]
    hdus += _fit_hdus(result)
    for i in range(len(result.observations)):
        hdus += _observation_hdus(result, i)
    write_hdus(path, hdus)


def _catalogue(result):
    """The catalogue, without magnitudes where bands have names too long for those of colours."""
    try:
        check_columns(f"colour_err_{a}_{b}" for a, b in pairwise(result.bands))
    except ValueError:
        return catalogue(result, magnitudes=False)
    return catalogue(result)


def _fit_hdus(result):
    """HDUs of the fit as a whole, ABOUT to SCENE."""
    boxes = [(c.source, *c.origin, *c.morphology.shape) for c in result.components]
    flat = [np.ravel(c.morphology) for c in result.components]
    spectra = [c.spectrum for c in result.components]
    shape = (len(result.channels), *result.frame.shape)
    scene = sum((result.source_model(i) for i in range(len(result.sources))), np.zeros(shape))
    cards, tables = _placed(result.frame.grid, 0)
    return [
        _about_table(_about(result)),
        fits.BinTableHDU(Table(np.array(boxes, int).reshape(-1, 5), names=BOX), name="COMPONENTS"),
        image_hdu("SPECTRA", np.array(spectra) if spectra else np.zeros((0, len(result.channels)))),
        image_hdu("MORPHOLOGIES", np.concatenate(flat) if flat else np.zeros(0)),
        *(image_hdu(name.upper(), getattr(result, name)) for name in ARRAYS),
        *_error_hdus(result.errors),
        *draw_hdus(result.draws),
        image_hdu("MODELPSF", result.frame.psf.images),
        image_hdu("SCENE", scene, cards),
        *tables,
    ]


def _error_hdus(errors):
    """HDUs of Errors, none without any."""
    if errors is None:
        return []
    flat = [np.ravel(m) for m in errors.morphology]
    return [
        *(image_hdu(name, getattr(errors, key)) for name, key in ERRORS.items()),
        image_hdu("MORPHOLOGYERR", np.concatenate(flat) if flat else np.zeros(0)),
    ]


def _observation_hdus(result, i):
    """HDUs of observation i, DATA to PSF."""
    o = result.observations[i]
    cards, tables = _placed(o.grid, i + 1)
    for k, channel in enumerate(o.channels):
        cards[f"BAND{k + 1}"] = text_card(channel, f"plane {k + 1}")
    images = {"DATA": o.data, "WEIGHTS": o.weights}
    more = {}
    if result.components:
        residual = np.where(o.weights > 0, result.residual(i), 0.0)  # 0 where data have no weight
        more = {"MODEL": result.model(i), "RESIDUAL": residual}
    return [
        *(image_hdu(name, image, cards, i) for name, image in images.items()),
        *tables,
        *(image_hdu(name, image, cards, i) for name, image in more.items()),
        image_hdu("RENDERED", np.asarray(result.rendered[i]), None, i),
        image_hdu("PSF", o.psf.images, None, i),
    ]


def read_result(path) -> Result:
    """Reads the blend that `write_result` wrote to a file, equal to the last bit.

    Files do not contain Result.draws and varying PSFs (Observation.psf_field): psf is that in the
    middle of the image; `rendered` was made with the PSF of each source.

    path: of the file

    Raises FileError for a file that does not exist, is not FITS, is damaged, holds no blend, or was
    written in another format.
    """
    with open_fits(path) as hdus:
        if "ABOUT" not in hdus or "COMPONENTS" not in hdus:
            raise FileError(f"{path}: holds no fitted blend (no HDU ABOUT with COMPONENTS)")
        about = {row["key"]: json.loads(row["value"]) for row in hdus["ABOUT"].data}
        if about["format"] != FORMAT:
            raise FileError(
                f"{path}: has format {about['format']}, this version reads {FORMAT}: fit it again"
            )
        numbers = range(len(about["observations"]))
        frame = Frame(
            _grid(path, hdus["SCENE"], about["frame"], hdus),
            _psf(array_of(hdus["MODELPSF"]), about["frame"]),
        )
        return Result(
            observations=tuple(
                _observation(path, hdus, i, about["observations"][i]) for i in numbers
            ),
            frame=frame,
            sources=tuple(_source(path, **source) for source in about["sources"]),
            components=_components(hdus),
            rendered=tuple(array_of(hdus["RENDERED", i + 1]) for i in numbers),
            status=Ended(about["status"]),
            messages=tuple(about["messages"]),
            seconds=about["seconds"],
            psf_error=about.get("psf_error", 0.0),
            unlisted=tuple(map(tuple, about.get("unlisted", ()))),
            errors=_errors(hdus),
            draws=read_draws(hdus, [(row["n_y"], row["n_x"]) for row in hdus["COMPONENTS"].data]),
            **{key: array_of(hdus[key.upper()]) for key in ARRAYS},
        )


def _about(result):
    return {
        "format": FORMAT,
        "status": result.status,
        "messages": result.messages,
        "seconds": result.seconds,
        "psf_error": result.psf_error,
        "unlisted": result.unlisted,
        "sources": [
            # without ExtendedSource.profile, which only starts a fit
            {"kind": type(s).__name__}
            | {f.name: getattr(s, f.name) for f in fields(s) if f.compare}
            for s in result.sources
        ],
        "frame": _placing(result.frame.grid, result.frame.psf),
        "observations": [
            {key: getattr(o, key) for key in KEPT}
            | {"unit": o.unit and o.unit.to_string()}
            | {"noise": o.noise and [n.autocorrelation.tolist() for n in o.noise]}
            | _placing(o.grid, o.psf)
            for o in result.observations
        ],
    }


def _placing(grid, psf):
    """Properties of a grid and a PSF that images and WCS do not hold."""
    flat = {"jacobian": grid.jacobian, "origin": grid.origin} if grid.is_flat else None
    return {"flat": flat, "spacing": psf.spacing, "center": psf.center}


def _about_table(about):
    # JSON writes float64 with the digits that give it back, and anything else than ASCII escaped
    values = [json.dumps(value, default=lambda array: array.tolist()) for value in about.values()]
    return fits.BinTableHDU(Table([list(about), values], names=("key", "value")), name="ABOUT")


def _placed(grid, number):
    """WCS cards that restore the same float64, and HDUs of look-up tables.

    number: of the grid in the file, which sets the version numbers of its tables apart
    """
    placed = grid.to_wcs().to_fits(relax=RELAX)
    for hdu in placed:
        for k, card in enumerate(list(hdu.header.cards)):
            value = card.value
            if isinstance(value, float) and fits.Card.fromstring(str(card)).value != value:
                del hdu.header[k]
                hdu.header.insert(k, fits.Card.fromstring(f"{card.keyword:8}= {value:.17G}"))
    cards = placed[0].header
    for axis in (1, 2):
        for key in (f"DP{axis}.EXTVER", f"D2IM{axis}.EXTVER"):
            if key in cards:
                cards[key] += 2 * number
    for hdu in placed[1:]:
        hdu.ver += 2 * number
    return cards, placed[1:]


def _grid(path, hdu, about, hdus):
    shape, flat = hdu.shape[-2:], about["flat"]
    if flat is not None:
        return Grid.from_jacobian(shape, flat["jacobian"], flat["origin"])
    return Grid.from_wcs(celestial_header(path, hdu.header, hdus), shape)


def _psf(images, about):
    return PSF.restore(images, spacing=about["spacing"], center=about["center"])


def _observation(path, hdus, i, about):
    data = hdus["DATA", i + 1]
    return Observation.restore(
        array_of(data),
        _psf(array_of(hdus["PSF", i + 1]), about),
        _grid(path, data, about, hdus),
        weights=array_of(hdus["WEIGHTS", i + 1]),
        noise=about.get("noise"),
        **{key: about[key] for key in KEPT if key in about},
    )


def _source(path, *, kind, **given):
    if kind not in KINDS:
        raise FileError(f"{path}: a source is a {kind}, this version knows {', '.join(KINDS)}")
    return KINDS[kind](**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


def _errors(hdus):
    if "MORPHOLOGYERR" not in hdus:
        return None
    flat, maps = array_of(hdus["MORPHOLOGYERR"]), []
    for row in hdus["COMPONENTS"].data:
        shape = int(row["n_y"]), int(row["n_x"])
        end = shape[0] * shape[1]
        maps.append(flat[:end].reshape(shape).copy())
        flat = flat[end:]
    arrays = {
        key: array_of(hdus[name])
        for name, key in ERRORS.items()
        if name in hdus or name not in ADDED
    }
    return Errors(**arrays, morphology=tuple(maps))


def _components(hdus):
    spectra, flat = array_of(hdus["SPECTRA"]), array_of(hdus["MORPHOLOGIES"])
    components, end = [], 0
    for row, spectrum in zip(hdus["COMPONENTS"].data, spectra, strict=True):
        source, y, x, n_y, n_x = (int(row[key]) for key in BOX)
        start, end = end, end + n_y * n_x
        morphology = flat[start:end].reshape(n_y, n_x).copy()
        components.append(Component(source, (y, x), morphology, spectrum.copy()))
    return tuple(components)
