"""Ways in which bench.spoilt makes the input of a scene wrong, and words that name each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from clresample import PSF, Grid

from .spoilt_scenes import ROMAN_SPACING, changed

SHIFT_PX = 0.3  # of half of the bands, in y
SKY_SIGMA = 0.5  # [sigma of a pixel] left in every band
CLIPPED = 0.5  # of the brightest source's peak, in every band
RAY_SIGMA, RAY_PX, RAY_AWAY_PX = 50.0, 6, 3  # a cosmic ray: brightness, pixels, nearest approach
TWICE_PX = 0.7
OFF_PX = 1.0  # [px of the first observation] by which all positions are off


def sigma_of(o):
    """Typical noise (C, 1, 1) of an observation's pixels."""
    return np.array([np.median(w[w > 0]) ** -0.5 for w in o.weights])[:, None, None]


def each(scene, change):
    """The scene with every observation changed."""
    return replace(scene, observations=tuple(change(o) for o in scene.observations))


def wider(scene, by):
    def stretched(image, center):
        place = np.indices(image.shape) - np.reshape(center, (2, 1, 1))
        return map_coordinates(image, place / (1 + by) + np.reshape(center, (2, 1, 1)), order=3)

    def change(o):
        images = [stretched(*one) for one in zip(o.psf.images, o.psf.center, strict=True)]
        return changed(o, psf=PSF(np.array(images), spacing=o.psf.spacing, center=o.psf.center))

    return each(scene, change)


def halves(o, shift_px):
    """One observation as two of half the channels each, the second moved by shift_px in y."""
    wcs = o.grid.to_wcs().deepcopy()
    wcs.wcs.crpix = wcs.wcs.crpix + (0.0, shift_px)
    moved, k = Grid.from_wcs(wcs, o.grid.shape), (len(o.channels) + 1) // 2
    for grid, part in ((o.grid, slice(k)), (moved, slice(k, None))):
        center = o.psf.center[part]
        yield changed(
            o,
            data=o.data[part],
            psf=PSF(o.psf.images[part], spacing=o.psf.spacing, center=center),
            grid=grid,
            weights=o.weights[part],
            channels=o.channels[part],
            zero_points=o.zero_points[part],
            name=f"{o.name} {o.channels[part][0]}",
        )


def between_bands(scene, shift_px):
    """The last observation's second half of bands is moved; without a shift it is only split."""
    *others, last = (
        scene.observations
        if len(scene.observations[-1].channels) > 1
        else (scene.observations[::-1])
    )
    return replace(scene, observations=(*others, *halves(last, shift_px)))


def around(o, place, radius_px=2):
    """Slices of the pixels about a place on the sky."""
    middle = np.rint(o.grid.pixel(*place)).astype(int)
    return tuple(slice(max(i - radius_px, 0), i + radius_px + 1) for i in middle)


def clipped(scene, brightest):
    def change(o):
        part = o.data[:, *around(o, scene.places[brightest])]
        return changed(o, data=np.minimum(o.data, CLIPPED * part.max((1, 2))[:, None, None]))

    return each(scene, change)


def with_ray(scene, brightest):
    """A line of pixels beside the brightest source in the first band of the first observation."""
    first, *others = scene.observations
    y, x = np.rint(first.grid.pixel(*scene.places[brightest])).astype(int)
    data, steps = np.array(first.data), np.arange(RAY_PX)
    rows = np.clip(y + RAY_AWAY_PX + steps // 2, 0, data.shape[1] - 1)
    columns = np.clip(x - 2 + steps, 0, data.shape[2] - 1)
    data[0, rows, columns] += RAY_SIGMA * sigma_of(first)[0, 0, 0]
    return replace(scene, observations=(changed(first, data=data), *others))


def twice(scene, brightest, apart_px):
    grid = scene.observations[0].grid
    y, x = grid.pixel(*scene.places[brightest])
    places = np.vstack([scene.places, grid.sky(y + apart_px, x)])
    return replace(scene, places=places, owners=np.append(scene.owners, brightest))


def off(scene):
    """All positions moved by OFF_PX in one direction."""
    grid = scene.observations[0].grid
    y, x = grid.pixel(*scene.places.T).T
    return replace(scene, places=grid.sky(y + 0.6 * OFF_PX, x + 0.8 * OFF_PX).T)


def without(scene, brightest):
    kept = np.arange(len(scene.places)) != brightest
    return replace(scene, places=scene.places[kept], owners=scene.owners[kept])


def no_weight(scene):
    """The last band of the last observation has no weight."""
    *others, last = scene.observations
    weights = np.array(last.weights)
    weights[-1] = 0
    return replace(scene, observations=(*others, changed(last, weights=weights)))


def in_units(scene, factor):
    def change(o):
        zero_points = np.asarray(o.zero_points) + 2.5 * np.log10(factor)
        return changed(
            o, data=o.data * factor, weights=o.weights / factor**2, zero_points=zero_points
        )

    return each(scene, change)


def with_sky(scene):
    return each(scene, lambda o: changed(o, data=o.data + SKY_SIGMA * sigma_of(o)))


def undersampled(scene):
    """The PSF in samples of a pixel instead of a quarter: every fourth of its samples."""
    step = round(1 / ROMAN_SPACING)

    def change(o):
        image, center = o.psf.images, o.psf.center[0].astype(int)
        first = center % step
        return changed(o, psf=PSF(image[:, first[0] :: step, first[1] :: step]))

    return each(scene, change)


# Name of each way: what does it to a scene whose brightest source is b, and words of a text that
# names the cause. Without words nothing needs to be said.
SPOILT = {
    "nothing": (lambda s, b: s, ""),
    "split in two": (lambda s, b: between_bands(s, 0.0), ""),
    "PSF 2 % wider": (lambda s, b: wider(s, 0.02), r"\bPSF\b"),
    "PSF 5 % wider": (lambda s, b: wider(s, 0.05), r"\bPSF\b"),
    "0.3 px between bands": (
        lambda s, b: between_bands(s, SHIFT_PX), r"shift|WCS|offset|disagree|astrometr",
    ),
    "sky + 0.5 sigma": (lambda s, b: with_sky(s), r"\bsky\b|background"),
    "fit_sky": (
        lambda s, b: replace(s, settings=replace(s.settings, fit_sky=True)), r"\bsky\b|background",
    ),
    "core clipped": (clipped, r"satur|flat top|clipped"),
    "cosmic ray": (with_ray, r"cosmic|hot pixel|sharper than"),
    "brightest not listed": (without, r"list|no source|detected"),
    "listed twice": (lambda s, b: twice(s, b, 0.0), r"twice|apart|same place|AMBIGUOUS"),
    "twice, 0.7 px apart": (lambda s, b: twice(s, b, TWICE_PX), r"twice|apart|AMBIGUOUS"),
    "positions 1 px off": (lambda s, b: off(s), r"position|centroid|offset"),
    "a band without weight": (lambda s, b: no_weight(s), r"weight|NO_COVERAGE"),
    "units of 1e-19": (lambda s, b: in_units(s, 1e-19), r""),
    "units of 1e12": (lambda s, b: in_units(s, 1e12), r""),
}  # fmt: skip

# The same of the scene whose PSF is undersampled where its image has samples of a pixel.
SAMPLED = {
    "nothing": SPOILT["nothing"],
    "undersampled PSF": (lambda s, b: undersampled(s), r"spacing|Nyquist|undersampled"),
}
