"""One group of patches fitted: from the mosaics to a part on disk."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ...deblending.assessment.status import with_source_misfit_status
from ...deblending.batch import deblend_many
from ...deblending.blend import Blend, Failure
from ...deblending.ended import Ended
from ...deblending.inspection.inspect import InputWarning
from ...deblending.settings import FitSettings, Settings
from ...device.device import get_device
from ...device.discovery import DeviceLostError
from ...measurement.catalogue import Flag, add_positions, catalogue_columns
from ...measurement.columns import Columns
from ...measurement.detection import detect_more
from ...measurement.late_sources import fit_with_late_sources
from ...resampling.cache import default_cache
from ...sky.box import Box
from ...sky.grid import Grid
from ...sky.sources import ExtendedSource, SourceWarning
from ..blends.cutouts import make_blend, with_profiles
from ..blends.plan import FitPlan, source_ids
from ..blends.search import nearest
from ..sky_level import messages_in_run
from .group_results import SEPARATOR, GroupResults
from .wings import continued, galaxies_beyond

# Errors that concern one patch only: the others of its group continue.
ERRORS = (ValueError, ArithmeticError, MemoryError, OSError, np.linalg.LinAlgError)
# Iterations of the first fits of a cut blend's pieces. The next round replaces these fits and uses
# only their light, which it subtracts with an assumed error of 15 % (MODEL_ERROR).
ROUGH_ITERATIONS = 60
# `Settings.loss_tol` of these fits, 25 times the default. Profiles of the two largest blends of
# `simulate field --sky bright`, seed 1, then take 63 renderings in place of 111, to the same chi2
# within 0.4 %.
ROUGH_TOL = 25 * Settings.loss_tol
# [px] Model pixels times sources above which a blend is large, and the largest number of iterations
# of large blends. Large galaxies with clumps need up to a thousand, in which light moves between
# clumps or neighbours and the galaxy. After 150 their groups have all of it: in `simulate field
# --sky bright`, seed 1, the light within 3 half-light radii of each of six galaxies is 0.98 to 1.02
# of the truth, and the whole groups' fluxes are 0.90 to 1.10.
LARGE, LARGE_ITERATIONS = 500_000, 150
# The same for fits that go on from the structure of an earlier one, which begin where that ended:
# whole groups' fluxes are 0.96 to 1.04 of the truth in that field.
CONTINUED_ITERATIONS = 100
# Chi2 per pixel of a fit above which its residuals are not searched: they then show errors of the
# model, with dozens of peaks, for example around a star with a wrong PSF. Large galaxies with
# clumps have up to 10 in a first fit.
MAX_CHI2 = 100.0
POSITIONS = ("y", "x", "y_centroid", "x_centroid")  # columns in pixels of a fit's frame


@dataclass(frozen=True, eq=False)
class FieldJob:
    """Data common to all groups of a field.

    mosaics, reference: of the field; folder: of its parts; plan: FitPlan
    origin_px (2,) [px]: (y, x) of the first pixel of labels.npy in the model's pixels
    core: Box of the model's pixels whose sources enter the catalogue; is_part: whether it is a part
        of the field's area
    settings: of the fits; threshold [sigma]: of the second pass; passes: 1, or 2 to search the
        residuals too; memory [bytes]: of the device; device: as `get_device` takes it
    field_number: of the ids
    """

    mosaics: tuple
    reference: Grid
    folder: Path
    plan: FitPlan
    origin_px: tuple[int, int]
    core: Box
    is_part: bool = False
    settings: FitSettings = Settings()
    threshold: float = 5.0
    passes: int = 2
    memory: int = 1 << 30
    device: object = None
    field_number: int = 0

    @property
    def channels(self) -> tuple[str, ...]:
        """Names (C,) of all channels of all mosaics."""
        return tuple(c.name for mosaic in self.mosaics for c in mosaic.channels)

    @property
    def bands(self) -> tuple[str, ...]:
        """Names (B,) of the bands of all channels."""
        names = [c.band or c.name for mosaic in self.mosaics for c in mosaic.channels]
        return tuple(dict.fromkeys(names))


@dataclass(frozen=True, eq=False)
class _BlendCutout:
    """A patch with its blend and the Boxes of its observations on the mosaics.

    more: sources found in residuals, (id, y, x, id of the host), see FOUND_COLUMNS
    """

    patch: object
    blend: Blend
    boxes: dict
    seconds: float
    more: tuple = ()

    def joined(self, more, profiles, structures, *, single):
        """The same with more sources, all of which go on from profiles, see `with_profiles`."""
        own = tuple(_source(self.patch, *row) for row in more)
        blend = replace(self.blend, sources=self.blend.sources + own)
        blend = with_profiles(blend, profiles, structures, single=single)
        return replace(self, blend=blend, more=(*self.more, *more))


def fit_group(job, group, given) -> tuple[dict, bytes]:
    """Fits a group: {"sources", "patches", "failed", "seconds"}, and its part as bytes.

    given: GroupInputs of the group. A patch that fails is in the part with its reason. Raises
    KeyboardInterrupt after Ctrl-C, DeviceLostError where the device no longer
    answers.
    """
    try:
        return _fitted(job, group, given)
    finally:
        default_cache().clear()  # its positions and PSFs are not used again


def _fitted(job, group, given):
    """As `fit_group`, whose operators stay in the cache."""
    began, part, cuts = time.perf_counter(), GroupResults(), []
    for number in group.patches:
        patch, start = job.plan.patches[number], time.perf_counter()
        corner, labels = given.labels[number]
        around = None if given.light is None else given.light[number]
        more = [row[1:] for row in group.found if row[0] == number]
        try:
            blend, boxes = make_blend(
                patch,
                job.plan,
                job.mosaics,
                job.reference,
                labels,
                corner,
                around,
            )
        except ERRORS as error:
            _set_aside(part, job, patch, group.round, _line(error))
            continue
        if not blend.observations:
            _set_aside(part, job, patch, group.round, "no pixel here has a weight")
            continue
        cut = _BlendCutout(patch, blend, boxes, time.perf_counter() - start)
        # numbers of components are not tested in each round: a borderline source would alternate
        before = given.before.get(number, ({}, {}))
        cuts.append(cut.joined(more, *before, single=1))
    cuts, results = _fits_of(job, given, cuts, part, group.round)
    for cut, result in zip(cuts, results, strict=True):
        if isinstance(result, Failure):
            if result.status == Ended.INTERRUPTED:
                raise KeyboardInterrupt
            _set_aside(part, job, cut.patch, group.round, _line(result.reason))
            continue
        try:
            _take(part, job, cut, result, group.round)
        except ERRORS as error:
            _set_aside(part, job, cut.patch, group.round, _line(error))
    return _summary(part, time.perf_counter() - began), part.to_bytes()


def mark_failed(job, group, reason) -> tuple[dict, bytes]:
    """As `fit_group` for a group that could not be fitted: each source with the reason."""
    part = GroupResults()
    for number in group.patches:
        _set_aside(part, job, job.plan.patches[number], group.round, _line(reason))
    return _summary(part, 0.0), part.to_bytes()


def _summary(part, seconds):
    return {
        "sources": sum(len(rows) for rows in part.rows),
        "patches": len(part.patches),
        "failed": part.n_failed,
        "seconds": seconds,
    }


def _source(patch, number, y, x, host):
    """The source of an id at (y, x) [px] of the field's model pixels, in a patch's fit."""
    return ExtendedSource(position_px=(y - patch.box.y0, x - patch.box.x0), name=str(number))


def is_large(n_sources, shape):
    """Returns True if a fit has more than LARGE model pixels times sources.

    shape (2,) [px].
    """
    return n_sources * shape[0] * shape[1] > LARGE


def _fits(job, blends, rough=None):
    """Results and Failures of blends; one that was interrupted ends all.

    rough (n): bool, those of few iterations, see ROUGH_ITERATIONS; None = none
    """
    if not blends:
        return []
    device, sizes = get_device(job.device), {}
    for i, blend in enumerate(blends):
        frame = blend.frame.shape
        large = is_large(len(blend.sources), frame)
        continued = any(one is not None for own in blend.structures for one in own)
        limits = bool(rough and rough[i]), large, continued
        sizes.setdefault((limits, frame, *(o.shape for o in blend.observations)), []).append(i)
    results: list = [None] * len(blends)
    for (limits, *_), alike in sizes.items():  # all at once, those of one size would be padded too
        settings, few = _settings(job, *limits), [blends[i] for i in alike]
        with warnings.catch_warnings():
            for kind in (SourceWarning, InputWarning):  # the results' messages are stored
                warnings.simplefilter("ignore", kind)
            run = {"device": device, "memory": job.memory, "processes": 1}
            found = deblend_many(few, settings=settings, **run)
        if any(r.status == Ended.INTERRUPTED for r in found):
            raise KeyboardInterrupt
        for failure in (r for r in found if isinstance(r, Failure)):
            if failure.error and issubclass(failure.error, DeviceLostError):
                raise DeviceLostError(failure.reason)
        for i, result in zip(alike, found, strict=True):
            results[i] = result
    return results


def _settings(job, rough, large, continued):
    """Settings of rough fits, and of those of large blends, which may be `continued` ones.

    The paper's method needs all its iterations.
    """
    settings = job.settings
    if not isinstance(settings, Settings) or not (rough or large):
        return settings
    most = CONTINUED_ITERATIONS if continued else LARGE_ITERATIONS
    if rough:
        most, tol = min(most, ROUGH_ITERATIONS), max(settings.loss_tol, ROUGH_TOL)
        settings = replace(settings, loss_tol=tol, errors=False)
    return replace(settings, max_iter=min(settings.max_iter, most))


def _fits_of(job, given, cuts, part, n_round):
    """Fits blends, and again with the sources detected in their residuals: (cuts, results).

    The residuals are those of the complete fit. A short fit of 30 iterations without structure, as
    in `clresample deblend`, leaves the structure of bright galaxies in the residuals. In simulated
    fields 15 % of all rows were then clumps, and no more true sources were found. Pieces of a cut
    blend are searched after their rough fits; their new sources are stored in the group's results,
    for the next round. A search after the next round would cost one more fit.
    """

    def fit(some):
        rough = [n_round == 0 and bool(cut.patch.siblings) for cut in some]
        return _fits(job, [cut.blend for cut in some], rough)

    def find(cut, result):
        if _chi2(result) > MAX_CHI2:
            return None
        try:
            rows = _found(job, given, cut, result)
        except ERRORS:
            return None  # the fit is kept
        is_piece = bool(cut.patch.siblings)
        if is_piece:
            part.found += [(cut.patch.number, *row) for row in rows]
        if not rows or is_piece:
            return None
        names = [int(source.name) for source in result.sources]
        before = (dict(zip(names, own)) for own in (result.thetas, result.structures))
        return cut.joined(rows, *before, single=None)

    if job.passes == 1 or n_round > 0:
        return cuts, fit(cuts)
    pairs = fit_with_late_sources(cuts, fit, find)
    return [cut for cut, _ in pairs], [result for _, result in pairs]


def _chi2(result):
    """Chi2 per pixel of a fit, prior included; 0 of one that has no loss."""
    n = sum(np.count_nonzero(o.weights) for o in result.observations)
    return 2 * float(result.losses[-1]) / max(n, 1) if len(result.losses) else 0.0


def _found(job, given, cut, result):
    """Sources in a fit's residuals on its patch's own light: (id, y, x, id of the host)."""
    found = detect_more(result, threshold=job.threshold)
    own = [i for i, s in enumerate(found.sources) if _on_patch(given, cut.patch, s)]
    if not own:
        return []
    places = np.array([found.sources[i].position_px for i in own]) + cut.patch.box[:2]
    ids = source_ids(places, job.field_number).tolist()
    rows = zip(ids, places.tolist(), found.hosts[own].tolist(), strict=True)
    names = [int(source.name) for source in result.sources]
    hosts = _hosts(job, cut)
    return [(n, *at, n if h < 0 else hosts.get(names[h], names[h])) for n, at, h in rows]


def _hosts(job, cut):
    """{id: id of its host} of the sources of a cut."""
    return job.plan.host_of | {row[0]: row[3] for row in cut.more}


def _on_patch(given, patch, source):
    """Returns True if a source lies on a pixel of the patch's own light."""
    corner, labels = given.labels[patch.number]
    y, x = nearest(np.array(source.position_px) + patch.box[:2])[0] - np.array(corner)
    inside = 0 <= y < labels.shape[0] and 0 <= x < labels.shape[1]
    return bool(inside and labels[y, x] == patch.number + 1)


def _take(part, job, cut, result, n_round):
    """Adds a fitted patch to the part."""
    patch, origin = cut.patch, np.array(cut.patch.box[:2])
    result = with_source_misfit_status(result)  # wide pixels contain light of other blends
    names = [int(source.name) for source in result.sources]
    host_of = _hosts(job, cut)
    hosts = np.array([host_of.get(name, name) for name in names], np.int64)
    rows = catalogue_columns(result, groups=hosts, bands=job.bands)
    ids = np.array([int(name) for name in rows.values.pop("name")], np.int64)
    for name in POSITIONS:
        rows.put(name, rows[name] + origin[0 if name[0] == "y" else 1])
    if len(cut.boxes) < len(job.mosaics):
        rows["flags"][:] |= Flag.NO_COVERAGE
    partner = rows["ambiguous_with"]
    rows.put("ambiguous_with", np.where(partner < 0, -1, ids[partner]))
    _add_columns(rows, ids, job, patch, result.status, "")
    models = [
        (job.mosaics.index(mosaic), box, result.model(i) - _sky(result, i))
        for i, (mosaic, box) in enumerate(_mosaics_of(job, cut.boxes))
    ]
    if patch.siblings and result.thetas and (beyond := galaxies_beyond(result)):
        models = [_continued(job, patch, beyond, result, i, *one) for i, one in enumerate(models)]
    part.rows.append(rows)
    thetas = [theta for own in result.thetas for theta in own]
    structures = [one for own in result.structures if patch.siblings for one in own]
    pairs = zip_longest(thetas, structures)
    for c, (theta, structure) in zip(result.components, pairs, strict=True):
        spectrum = _all_channels(job, result.channels, c.spectrum)
        given = origin + c.origin, c.morphology, spectrum, theta, structure
        part.add_component(ids[c.source], patch, *given)
    for model in models:
        part.add_model(patch, *model)
    shifts = np.zeros((len(job.mosaics), 2))
    shifts[[i_mosaic for i_mosaic, *_ in models]] = result.shifts
    sky = _all_channels(job, result.channels, result.sky)
    part.add_offsets(patch, shifts, np.nan_to_num(sky))
    seconds = cut.seconds + sum(result.seconds.values())
    n_iterations = max(len(result.losses) - 1, 0)
    part.patches.append(
        (
            patch.number,
            patch.parent,
            n_round,
            result.status,
            len(rows),
            patch.box.area,
            n_iterations,
            seconds,
            _ascii(SEPARATOR.join(messages_in_run(result.messages, job.mosaics))),
        )
    )


def _continued(job, patch, beyond, result, i, i_mosaic, box, model):
    """A model of a piece with the light of its galaxies where the pieces beside it are fitted."""
    mosaic, region = job.mosaics[i_mosaic], box
    for k in patch.siblings:
        there = job.plan.patches[k].box
        seen = mosaic.box_on(job.reference.cutout(there.y0, there.x0, there.shape))
        region = region.union(seen) if seen.area else region
    channels, grid = result.channel_slices()[i], result.frame.grid
    return i_mosaic, region, continued(model, beyond, channels, box, region, mosaic, grid)


def _sky(result, i):
    """The fitted sky of an observation's channels (Co, 1, 1)."""
    return result.sky[result.channel_slices()[i], None, None]


def _mosaics_of(job, boxes):
    return [(mosaic, boxes[mosaic.name]) for mosaic in job.mosaics if mosaic.name in boxes]


def _all_channels(job, channels, values):
    """Values of some channels among all (C,), NaN for the others."""
    have = dict(zip(channels, values, strict=True))
    return np.array([have.get(name, np.nan) for name in job.channels])


def _set_aside(part, job, patch, n_round, reason):
    """Adds a patch without a fit: its sources have their positions and the reason."""
    sources = list(patch.sources)
    rows = Columns()
    positions, ids = job.plan.positions[sources], job.plan.ids[sources]
    add_positions(rows, job.reference, positions, "")
    rows.put("flags", np.full(len(sources), int(Flag.NOT_CONVERGED), np.int32))
    rows.put("ambiguous_with", np.full(len(sources), -1))
    rows.put("group_id", np.array([job.plan.host_of[i] for i in ids.tolist()], np.int64))
    rows.put("n_group", np.zeros(len(sources), np.int32))
    _add_columns(rows, ids, job, patch, Ended.FAILED, reason)
    part.rows.append(rows)
    status = f"{Ended.FAILED}: {reason}"
    part.patches.append(
        (patch.number, patch.parent, n_round, status, len(rows), patch.box.area, 0, 0.0, "")
    )
    part.n_failed += 1


def _add_columns(rows, ids, job, patch, status, reason):
    """Adds the columns of a field's catalogue to those of a blend."""
    n = len(ids)
    peaks = job.plan.peak_of
    if patch.pieces > 1:
        cut = f"blend of {patch.n_blend_sources} sources cut into {patch.pieces} pieces"
        reason = f"{reason}; {cut}" if reason else cut
    rows.put("id", ids)
    rows.put("parent_id", np.full(n, patch.parent, np.int64))
    rows.put("detection_snr", np.array([peaks.get(i, np.nan) for i in ids.tolist()]))
    rows.put("detection_pass", np.array([1 if i in peaks else 2 for i in ids.tolist()], np.int16))
    rows.put("n_blend_sources", np.full(n, patch.n_blend_sources, np.int32))
    rows.put("status", np.full(n, status))
    rows.put("reason", np.full(n, reason))


def _line(error):
    """An error as FITS tables hold it."""
    return _ascii(str(error) or type(error).__name__)[:190].rstrip()


def _ascii(text):
    """A text in one line of ASCII, as FITS tables hold it."""
    return " ".join(text.split()).encode("ascii", "replace").decode()
