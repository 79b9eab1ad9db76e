"""Gathers the inputs of a group of fits, so that workers need no access to the run folder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...sky.box import Box
from ..blends.cutouts import cutouts_box
from .group_results import results_file


@dataclass(frozen=True)
class FitGroup:
    """Patches that are fitted side by side, with the name of their file of results.

    name: of the file of results; patches: numbers; round: 0, or the repetition of a cut blend's
        pieces
    neighbour_models: (patch, name of a file of results) of neighbours, whose models are subtracted
    last_fits: (patch, name of a file of results) of the fits before, from which these go on
    found: (patch, id, y, x, id of the host) of sources that an earlier round detected in a patch's
        residuals, at (y, x) [px] of the field's model pixels
    """

    name: str
    patches: tuple[int, ...]
    round: int = 0
    neighbour_models: tuple[tuple[int, str], ...] = ()
    last_fits: tuple[tuple[int, str], ...] = ()
    found: tuple[tuple[int, int, float, float, int], ...] = ()


@dataclass(frozen=True, eq=False)
class GroupInputs:
    """Inputs of a group's fits beside the mosaics.

    labels {patch: (corner (2,) [px], (Ny, Nx) int32)}: patch numbers + 1 of the pixels of its
        cutouts, from the model pixel `corner` on
    light {patch: {mosaic's name: [(Box, model (C, Ny, Nx) [counts])]}}: of the neighbours; None in
        the first round
    before {patch: (profiles, structures)}: of the last fits, {id: of each component}, see
        `with_profiles`
    """

    labels: dict
    light: dict | None
    before: dict


def gather_inputs(job, group) -> GroupInputs:
    """Reads the inputs of a group from the run's folder. Raises FileError, OSError."""
    whole = np.load(job.folder / "labels.npy", mmap_mode="r")
    region = Box.of(whole.shape)
    labels = {}
    for number in group.patches:
        box = cutouts_box(job.plan.patches[number], job.mosaics, job.reference)
        y, x = job.origin_px
        there = Box(box.y0 - y, box.x0 - x, box.y1 - y, box.x1 - x).intersection(region)
        corner = there.y0 + y, there.x0 + x
        labels[number] = corner, np.array(whole[there.slices])
    of_file: dict[str, dict] = {}
    for number, name in group.last_fits:
        of_file.setdefault(name, {})[number] = job.plan.patches[number].box[:2]
    before: dict[int, tuple[dict, dict]] = {}
    for name, corners in of_file.items():
        before |= results_file(job.folder, name).last_fits(corners)
    return GroupInputs(labels, None if group.round == 0 else _light(job, group), before)


def _light(job, group):
    """{patch: {mosaic's name: [(Box, model)]}} of neighbours that overlap its cutouts."""
    of_file: dict[str, list] = {}
    for patch, name in group.neighbour_models:
        of_file.setdefault(name, []).append(patch)
    models: dict[int, list] = {}
    for name, patches in sorted(of_file.items()):
        for patch, i, box, model in results_file(job.folder, name).models(patches):
            models.setdefault(patch, []).append((i, box, model))
    found = {}
    for number in group.patches:
        patch = job.plan.patches[number]
        grid = job.reference.cutout(patch.box.y0, patch.box.x0, patch.box.shape)
        seen = [mosaic.box_on(grid) for mosaic in job.mosaics]
        found[number] = own = {}
        for sibling in patch.siblings:
            for i, box, model in models.get(sibling, ()):
                both = box.intersection(seen[i])
                if both.area:
                    here = np.ascontiguousarray(model[:, *both.relative_to(box).slices])
                    own.setdefault(job.mosaics[i].name, []).append((both, here))
    return found
