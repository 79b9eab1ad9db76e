"""Cutouts of fitted sources without their neighbours, as astropy CCDData."""

from __future__ import annotations

import numpy as np
from astropy import units as u

from ...adapters.astropy import ccddata_of
from ..component_images import source_image
from .choice import MissingSource, chosen_observation, chosen_sources
from .deviations import deviations
from .separation import (
    Separation,
    check_kind,
    faintest_light,
    models_on,
    separation_of,
)
from .window import sized_window, window_of


def cutout(result, source, observation, what="data", *, size=None, unit=None):
    """See `Result.cutout`."""
    check_kind(what)
    chosen = chosen_sources(result, source)
    i_observation, channel = chosen_observation(result.observations, observation)
    found, origin = separate(result, chosen, i_observation, size=size)
    o = result.observations[i_observation]
    name = "+".join(result.sources[s].name or str(s) for s in chosen)
    return as_ccddata(found, o, origin, what, channel=channel, unit=unit, name=name)


def separate(result, chosen, i_observation, *, size=None) -> tuple[Separation, tuple[int, int]]:
    """Separates sources from all others; also returns the window's first pixel (y, x).

    chosen: numbers of sources; size: see `Result.cutout`
    Raises ValueError for a window without pixels of the image.
    """
    o = result.observations[i_observation]
    position = _position(result, chosen, i_observation)
    if not np.isfinite(position).all():
        raise MissingSource(f"source {chosen[0]} has no place in observation {o.label!r}")
    whole = tuple(slice(0, n) for n in o.shape[1:])
    if size is None:
        images = [source_image(result, s, i_observation, whole) for s in chosen]
        own = sum((image for image in images if image is not None), np.zeros(o.shape))
        corners = window_of(own, o.weights, position, float(o.psf.fwhm_px.max()))
    else:
        corners = sized_window(size, position, o.grid.pixel_scale_arcsec)
    y0, x0, y1, x1 = corners
    low = max(y0, 0), max(x0, 0)
    window = slice(low[0], min(y1, o.shape[1])), slice(low[1], min(x1, o.shape[2]))
    if any(part.stop <= part.start for part in window):
        raise MissingSource(
            f"source {', '.join(map(str, chosen))} lies outside of observation {o.label!r}"
        )
    channels = result.channel_slices()[i_observation]
    sky = np.asarray(result.sky)[channels, None, None]
    found = separation_of(
        o.data[:, *window] - sky,
        o.weights[:, *window],
        models_on(result, i_observation, window),
        chosen,
        deviations(result, chosen, i_observation, window),
        faintest_light(result.model(i_observation) - sky),
    )
    return found.padded((low[0] - y0, low[1] - x0), (y1 - y0, x1 - x0)), (y0, x0)


def _position(result, chosen, i_observation):
    """Position (2,) [px] of sources on an observation: the middle of their positions."""
    positions = result.frame.positions_of([result.sources[s] for s in chosen])
    at = result.footprints[i_observation].locate(positions)
    return (at.min(axis=0) + at.max(axis=0)) / 2


def as_ccddata(found, observation, origin, what, *, channel=None, unit=None, name="", first=(0, 0)):
    """Converts a Separation, or one channel of it, to CCDData.

    observation: has its grid, names, zero points and PSF; unit: None for counts, or one of flux
        density; name: of the source
    origin (2,) [px]: (y, x) of the first pixel in it; first (2,) [px]: (y, x) of the observation's
        first pixel in the instrument's image
    Raises ValueError for a unit of another kind, and for any unit without zero points.
    """
    o, (y0, x0) = observation, origin
    image, variance, mask = found.image(what), found.variance(what), found.mask
    psf = o.psf
    if o.psf_field is not None:
        n_y, n_x = found.data.shape[1:]
        psf = o.psf_field.psf_at(y0 + (n_y - 1) / 2, x0 + (n_x - 1) / 2)
    unit, scale = _scale(o, unit)
    image, variance = image * scale[:, None, None], variance * scale[:, None, None] ** 2
    bands = range(len(image)) if channel is None else [channel]
    some = list(bands)
    cards = [
        ("OBJECT", name[:60], "source"),
        ("CUTKIND", what, "what the image is"),
        ("INSTRUME", o.label[:60], "observation"),
        ("LTV1", -float(first[1] + x0), "[px] x here minus x in the image"),
        ("LTV2", -float(first[0] + y0), "[px] y here minus y in the image"),
    ]
    cards += [(f"BAND{k + 1}", o.channels[c], f"plane {k + 1}") for k, c in enumerate(some)]
    if o.zero_points is not None and unit == u.ct:
        zero = [float(o.zero_points[c]) for c in some]
        keys = ["MAGZERO"] if len(set(zero)) == 1 else [f"MAGZERO{k + 1}" for k in range(len(zero))]
        cards += [(k, z, "[mag] AB of one count") for k, z in zip(keys, zero, strict=False)]
    return ccddata_of(
        image[some],
        o.grid.cutout(y0, x0, image.shape[1:]),
        variance=variance[some],
        mask=mask[some],
        psf=psf.select(some),
        unit=unit,
        cards=cards,
    )


def _scale(observation, unit):
    """The unit, and the value of one count of each channel (C,) in it."""
    n_channels = observation.shape[0]
    if unit is None:
        return u.ct, np.ones(n_channels)
    try:
        wanted = u.Unit(unit)
        if wanted == u.ct:
            return u.ct, np.ones(n_channels)
        micro = (1 * u.uJy).to_value(wanted)
    except (ValueError, TypeError, u.UnitConversionError):
        raise ValueError(
            f"unit is {str(unit)!r}, must be None or ct for counts, or a flux density such as 'uJy'"
        ) from None
    if observation.flux_scale is None:
        raise ValueError(
            f"unit is {unit}, but observation {observation.label!r} has no zero_points: leave the "
            "unit out for counts"
        )
    return wanted, micro * observation.flux_scale
