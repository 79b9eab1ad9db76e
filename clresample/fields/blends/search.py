"""Detection, tile by tile: sources and their footprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...files.atomic import FileError
from ...measurement.detection import detect, noise_scatter
from ...measurement.signal_to_noise import WIDTHS_ARCSEC
from ...sky.box import Box
from ...sky.frame import model_frame
from ...sky.sources import PointSource

# [sigma] Level of footprints in the combined signal-to-noise image. At 2, light outside a source's
# footprint is below the noise everywhere. With a lower level noise links separate sources; with a
# higher one faint wings extend into another blend.
FOOTPRINT_SIGMA = 2.0
# [FWHM of the widest PSF] Radius of the footprint of peaks without other pixels above
# FOOTPRINT_SIGMA, which were detected by one instrument alone.
MIN_RADIUS = 0.5
SAMPLE_PX = 512  # [model px] side of the part of a field from which the noise is measured


@dataclass(frozen=True, eq=False)
class TileDetections:
    """Detections of the search of one tile.

    positions (S, 2) [px]: (y, x) in the field's model pixels of sources in the core; peaks (S,)
        [sigma]
    snr_map (Ny, Nx) [sigma]: float16, signal to noise of all instruments together, of the core
    lit (Ny, Nx) bool: the core's pixels of footprints, grown by the PSF
    hosts (S, 2) [px]: position of the source whose clump each may be, its own where there is none;
        None = their own
    stars (S,): bool, stars with a saturated or masked core; None = no source is one
    """

    positions: np.ndarray
    peaks: np.ndarray
    snr_map: np.ndarray
    footprint_mask: np.ndarray
    hosts: np.ndarray | None = None
    stars: np.ndarray | None = None


def search_tile(mosaics, reference, tile, *, threshold, scatters=None) -> TileDetections:
    """Searches one tile in all mosaics together.

    mosaics: of the field; reference: Grid of the model's pixels; tile: SearchTile
    threshold [sigma]: least signal to noise of a peak
    scatters {mosaic's name: scatters of its signal to noise}: see `snr_scatter`; None = each tile's

    Raises FileError for pixels that cannot be read, ImportError without sep.
    """
    observations = observations_on(mosaics, reference, tile.outer)
    n_y, n_x = tile.core.shape
    if not observations:
        empty = np.zeros((n_y, n_x))
        return TileDetections(np.zeros((0, 2)), np.zeros(0), empty.astype(np.float16), empty > 0)
    frame = model_frame(observations, grid=_cut(reference, tile.outer))
    known = scatters and [scatters[o.name] for o in observations]
    found = detect(observations, frame, threshold=threshold, scatters=known)
    positions = np.array([s.position_px for s in found.sources]).reshape(-1, 2)
    radius = footprint_radius(observations, frame)
    lit = grown_footprints(found.image > FOOTPRINT_SIGMA, positions, radius)
    positions = positions + tile.outer[:2]
    hosts = positions[found.groups]
    stars = np.array([isinstance(s, PointSource) for s in found.sources], bool)
    own = tile.core.contains(positions)
    inner = tile.core.relative_to(tile.outer).slices
    light = np.clip(found.image[inner], -100, 6e4).astype(np.float16)
    own_peaks = found.peaks[own]
    return TileDetections(positions[own], own_peaks, light, lit[inner], hosts[own], stars[own])


def place_known_sources(mosaics, reference, tile, positions, *, scatters=None) -> TileDetections:
    """TileDetections of a catalogue's sources at positions (S, 2) [px of the field].

    Their footprints are those of `search_tile`; peaks are the combined signal to noise there. The
    nearest one to a star with a saturated core, within the radius of footprints, is that star.
    """
    whole = tile._replace(core=tile.outer)
    outer = search_tile(mosaics, reference, whole, threshold=1e30, scatters=scatters)
    own = tile.core.contains(positions)
    near = tile.outer.contains(positions)
    light = outer.snr_map.astype(np.float64)
    at = nearest(positions[near]) - np.array(tile.outer[:2])
    observations = observations_on(mosaics, reference, tile.outer)
    inner = tile.core.relative_to(tile.outer).slices
    lit, stars = np.zeros(light.shape, bool), np.zeros(len(positions), bool)
    if observations:
        frame = model_frame(observations, grid=_cut(reference, tile.outer))
        radius = footprint_radius(observations, frame)
        for star in outer.positions if near.any() else ():
            away = np.where(near, np.hypot(*(positions - star).T), np.inf)
            stars[away.argmin()] |= away.min() <= radius
        lit = grown_footprints(light > FOOTPRINT_SIGMA, at, radius)
    at = nearest(positions[own]) - np.array(tile.outer[:2])
    peaks = light[at[:, 0], at[:, 1]]
    return TileDetections(positions[own], peaks, outer.snr_map[inner], lit[inner], stars=stars[own])


def snr_scatter(mosaics, reference) -> dict:
    """{mosaic's name: scatters of its signal to noise without sources}, from the field's middle.

    A list from `noise_scatter` for each mosaic, valid for the whole field, so that detections do
    not depend on the division into tiles. The middle is that of the mosaic with the smallest
    pixels; mosaics without pixels there are measured in their own.
    """
    region = Box.of(reference.shape)
    found = _scatters_about(np.array(region[2:]) // 2, mosaics, reference, region)
    for mosaic in mosaics:
        if mosaic.name not in found:
            middle = mosaic.grid.positions_in(reference, *((np.array(mosaic.grid.shape) - 1) / 2))
            found |= _scatters_about(middle, [mosaic], reference)
    return {mosaic.name: found.get(mosaic.name, [1.0] * len(WIDTHS_ARCSEC)) for mosaic in mosaics}


def _scatters_about(middle, mosaics, reference, region=None):
    """{name: `noise_scatter`} of the mosaics with pixels about a position (2,) [px] of a region."""
    if not np.isfinite(middle).all():
        return {}
    box = Box.at(nearest(middle)[0], (0, 0)).grown(SAMPLE_PX // 2)
    box = box if region is None else box.intersection(region)
    try:
        observations = observations_on(mosaics, reference, box)
    except FileError:  # the search of its tile reports it
        return {}
    if not observations:
        return {}
    frame = model_frame(observations, grid=_cut(reference, box))
    return {o.name: noise_scatter(o, frame).tolist() for o in observations}


def observations_on(mosaics, reference, box):
    """The Observations of all mosaics that overlap a Box of the model's pixels.

    Their PSFs are those of the mosaics' middles, so that signal to noise does not depend on the
    Box. If a PSF is wider than its filter by a tenth, it is lower by half a percent.
    """
    grid, found = _cut(reference, box), []
    for mosaic in mosaics:
        there = mosaic.box_on(grid)
        middle = Box.of(mosaic.grid.shape)
        seen = mosaic.observation(there, psf_box=middle) if there.area else None
        if seen is not None and seen.grid.map_to(grid).covered.any():
            found.append(seen)
    return found


def footprint_radius(observations, frame) -> int:
    """Radius [model px] by which footprints grow: half the FWHM of the widest PSF."""
    scale = frame.grid.pixel_scale_arcsec
    widths = [o.psf.fwhm_px.max() * o.grid.pixel_scale_arcsec / scale for o in observations]
    return max(1, round(MIN_RADIUS * max(widths)))


def grown_footprints(bright, positions, radius):
    """Pixels of connected bright parts with a source and of discs around the sources, dilated.

    bright (Ny, Nx) bool; positions (S, 2) [px]; radius [px]
    """
    seeds = np.zeros(bright.shape, bool)
    at = nearest(positions)
    seeds[at[:, 0], at[:, 1]] = True
    lit = ndimage.binary_propagation(seeds, np.ones((3, 3), bool), mask=bright | seeds)
    if not lit.any():
        return lit
    return ndimage.distance_transform_edt(~lit) <= radius


def nearest(positions) -> np.ndarray:
    """Pixels (S, 2) int of positions (S, 2) [px]; an edge belongs to one pixel only."""
    return np.floor(np.asarray(positions).reshape(-1, 2) + 0.5).astype(int)


def _cut(reference, box):
    """The grid of a Box of the reference's pixels."""
    return reference.cutout(box.y0, box.x0, box.shape)
