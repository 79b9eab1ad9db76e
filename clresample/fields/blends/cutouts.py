"""Cutouts of every mosaic around one fit region, with neighbours' models subtracted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...deblending.blend import Blend
from ...deblending.linear.equations import N_PARAMETERS
from ...deblending.linear.spectra import MODEL_ERROR
from ...sky.box import Box, box_within
from ...sky.frame import model_frame
from ...sky.sources import ExtendedSource, PointSource

# [px] Sides of the cutouts of fits are multiples of this number, like the boxes of their models:
# with smaller steps there are more batches, with larger ones more sky to compute.
SIDE_PX = 4


def make_blend(patch, plan, mosaics, reference, labels, corner, neighbours=None):
    """The Blend of a patch, and the Boxes on the mosaics that its observations were cut from.

    patch: FitRegion of plan: FitPlan; mosaics: of the field; reference: Grid of the model's pixels
    labels (Ny, Nx): patch numbers + 1 of the model's pixels from `corner` (2,) [px] on, at
        least those of `cutouts_box`
    neighbours: {mosaic's name: list of (Box, model (C, Ny, Nx) [counts])}: light of the other
        pieces of the same blend, to be subtracted; None = none is known

    Pixels of other patches are ignored. With those of the other pieces and their light subtracted,
    a galaxy's structure takes what their models lack, and keeps it: of small galaxies cut from a
    large one a tenth, silently (`simulate field --sky bright --size 512`, seed 1). A patch that is
    covered by no mosaic gives a Blend without observations. Raises FileError for pixels that cannot
    be read.
    """
    grid = reference.cutout(patch.box.y0, patch.box.x0, patch.box.shape)
    foreign = ~np.isin(labels, [0, patch.number + 1])
    first = np.array(corner) - patch.box[:2]
    observations, boxes = [], {}
    for mosaic in mosaics:
        box = fit_box(mosaic, grid)
        if not box.area:
            continue
        light = None
        if neighbours is not None:
            light = _light_in(box, neighbours.get(mosaic.name, ()), len(mosaic.channels))
        cut = mosaic.grid.cutout(box.y0, box.x0, box.shape)
        seen = mosaic.observation(
            box,
            ignore=_foreign_pixels(cut, grid, foreign, first),
            subtract=light,
            extra=None if light is None else (MODEL_ERROR * light) ** 2,
            grid=cut,
        )
        if seen is not None:
            observations.append(seen)
            boxes[mosaic.name] = box
    sources = tuple(listed_source(patch, plan, s) for s in patch.sources)
    frame = model_frame(observations, grid=grid) if observations else None
    return Blend(tuple(observations), sources, frame), boxes


def listed_source(patch, plan, s):
    """The source of index s of a plan in the patch's pixels, a free PointSource if it is a star."""
    number = int(plan.ids[s])
    place = tuple(map(float, plan.positions[s] - patch.box[:2]))
    if number in plan.stars:
        return PointSource(position_px=place, name=str(number), free_position=True)
    return ExtendedSource(position_px=place, name=str(number))


def with_profiles(blend, profiles, structures, *, single):
    """A Blend whose sources go on from an earlier fit of theirs on the same frame.

    profiles {id: parameters (n,) of each component}; structures {id: ComponentStructure of each}
    Galaxies with several components keep their number; those with one get n_components=single. One
    that was fitted as a star has no parameters of a galaxy, and its number is open again.
    """
    sources, thetas, known = [], [], []
    for source in blend.sources:
        own = profiles.get(int(source.name), ())
        if own and len(own[0]) == N_PARAMETERS and isinstance(source, ExtendedSource):
            source = replace(source, n_components=len(own) if len(own) > 1 else single)
        sources.append(source)
        thetas.append(own)
        known.append(structures.get(int(source.name), ()))
    given = {"thetas": tuple(thetas), "structures": tuple(known) if structures else ()}
    return replace(blend, sources=tuple(sources), **given)


def fit_box(mosaic, grid) -> Box:
    """The pixels of a mosaic whose centres lie on a grid: those of a fit in it.

    If the noise is correlated, the Box has one more pixel on each side, because the whitening
    filter leaves a cutout's outer pixels without weight. Grids of one shape have Boxes of one
    shape, so that their fits share a batch without padding. The area is 0 if there are no such
    pixels.
    """
    there = mosaic.edge_of(grid)
    if not len(there):
        return Box(0, 0, 0, 0)
    margin = 0 if mosaic.noise is None else 1
    return box_within(there, margin, SIDE_PX, Box.of(mosaic.grid.shape))


def cutouts_box(patch, mosaics, reference) -> Box:
    """The Box of the model's pixels in which all pixels of a patch's cutouts lie."""
    grid, whole = reference.cutout(patch.box.y0, patch.box.x0, patch.box.shape), patch.box
    for mosaic in mosaics:
        box = fit_box(mosaic, grid)
        ends = np.array([box[:2], (box.y0, box.x1), (box.y1, box.x0), box[2:]]) - 0.5
        there = mosaic.grid.positions_in(reference, *ends.T)
        if box.area and np.isfinite(there).all():
            whole = whole.union(Box.around(there))
    return whole


def _foreign_pixels(cut, grid, foreign, first):
    """Pixels (My, Mx) of an observation's grid whose centre lies on a foreign one.

    grid: of the frame; foreign (Ny, Nx): from its pixel `first` (2,) [px] on
    """
    mapping = cut.map_to(grid)
    n, m = np.indices(cut.shape)
    at = np.floor(mapping.at(n, m) + 0.5).astype(int) - first
    inside = ((at >= 0) & (at < np.array(foreign.shape))).all(axis=-1)
    at = np.clip(at, 0, np.array(foreign.shape) - 1)
    return inside & foreign[at[..., 0], at[..., 1]]


def _light_in(box, models, n_channels):
    """Models of Boxes on a mosaic added up (C, Ny, Nx) in one of them."""
    light = np.zeros((n_channels, *box.shape))
    for there, model in models:
        both = box.intersection(there)
        if both.area:
            light[:, *both.relative_to(box).slices] += model[:, *both.relative_to(there).slices]
    return light
