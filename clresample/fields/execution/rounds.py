"""Fits all groups, round by round, in spite of failing workers."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np

from ...device.workers.outcome import Cause
from ...files.atomic import FileError
from ..blends.plan import predicted_cost
from .fitting import fit_group, is_large, mark_failed
from .group_inputs import FitGroup, gather_inputs
from .group_results import FOUND_COLUMNS, GroupResultsFile, results_file
from .search_setup import read_search_setup
from .tasks import TaskKind
from .time_left import TimeLeft, remember_pace, remembered_pace

# Largest number of times that a cut blend's piece is fitted again, with its neighbours' light
# subtracted. Crowded pieces settle in the third or fourth round.
ROUNDS = 4
# The same for large pieces, which take tens of seconds each (fitting.LARGE). The first round
# subtracts their neighbours' light; the changes in later rounds are smaller than the assumed error
# of that light.
LARGE_ROUNDS = 1
# [errors] A blend's pieces have settled if no flux changes by more than this between two rounds.
# Fluxes of a fit end within 0.2 errors of the minimum (Settings.loss_tol), those of two fits within
# 0.3 of each other, so a smaller number would not be reached.
MAX_FLUX_CHANGE_SIGMA = 0.3
# [of a flux] The same for bright sources. Pixels from which a neighbour's light is subtracted have
# weights for an error of 15 % of that light (MODEL_ERROR). If the light changes by 0.5 %, a flux
# measured on 50 pixels changes by at most sqrt(50) 0.5 / 15 = 0.24 of its error.
SETTLED_PART = 0.005


def part_path(job, group):
    """Path of the results of a group."""
    return results_file(job.folder, group.name).path


FIT = TaskKind(gather_inputs, fit_group, part_path)


def fit_all_groups(job, engine, progress):
    """Fits all groups that are not on disk yet, round by round.

    A cut blend's pieces are fitted again with the new sources of their residuals, and then as long
    as the fluxes of a neighbour change. Of neighbours the fainter one is fitted first, so that each
    has the last light of the other: the rough fit of a faint one has the light of the bright one's
    wings in its pixels, and that would be lost if both gave it up at once.
    returns the GroupResultsFiles, of which the last round of each patch is valid, and the parents
        of the cut blends whose pieces had not settled when the rounds ended
    """
    progress.stage("fit", len(job.plan.patches))
    tasks = [FitGroup(_name(0, i), patches) for i, patches in enumerate(job.plan.groups)]
    names = _fit_round(job, tasks, engine, progress)
    parts, history = list(names), _PieceHistory(job)
    history.add(names)
    pieces = {n for group in job.plan.cut_groups for n in group}
    pending = {n for n in pieces if job.plan.patches[n].siblings}
    moved: set[int] = set()
    for n_round in itertools.count(1):
        again = history.first_of({n for n in pending if history.may_refit(n)})
        groups = [few for g in job.plan.cut_groups if (few := tuple(n for n in g if n in again))]
        if not groups:
            break
        progress.stage(f"pieces, round {n_round}", sum(map(len, groups)))
        tasks = [
            FitGroup(
                _name(n_round, i),
                patches,
                n_round,
                history.last_fits({k for n in patches for k in job.plan.patches[n].siblings}),
                history.last_fits(patches),
                history.found_in(patches),
            )
            for i, patches in enumerate(groups)
        ]
        names = _fit_round(job, tasks, engine, progress)
        history.add(names)
        moved_now = history.moved(again)
        moved = moved - again | moved_now
        pending -= again
        pending |= {n for n in pieces if moved_now.intersection(job.plan.patches[n].siblings)}
        parts += names
    # a piece's second fit follows a rough one, with which its fluxes cannot be compared
    unsettled = {
        job.plan.patches[n].parent
        for n in moved
        if len(history.names[n]) > 2 and pending.intersection(job.plan.patches[n].siblings)
    }
    # sorted by name, so that sums of models do not depend on the order in which the groups ended
    return [results_file(job.folder, name) for name in sorted(parts)], unsettled


def _is_large(job, number):
    """Returns True if a patch is large, see fitting.LARGE."""
    patch = job.plan.patches[number]
    return is_large(len(patch.sources), patch.box.shape)


def _name(n_round, i):
    return f"fit-{n_round}-{i:06d}"


class _PieceHistory:
    """The files of results of a cut blend's pieces, round by round.

    names {piece: names of its files}; light {piece: sum of all fluxes of its rough fit}
    found {piece: what was found in its residuals}
    """

    def __init__(self, job):
        self.job, self.names, self.found, self.light = job, {}, {}, {}

    def add(self, names):
        """Adds a round: {name: patches} of its parts."""
        for name in sorted(names):
            (table,) = results_file(self.job.folder, name).read("FOUND")
            for row in zip(*(table[column].tolist() for column in FOUND_COLUMNS), strict=True):
                self.found.setdefault(row[0], []).append(row)
            for patch in names[name]:
                if self.job.plan.patches[patch].pieces > 1:
                    self.names.setdefault(patch, []).append(name)
        rough = [(n, known[0]) for n, known in self.names.items() if n not in self.light]
        self.light |= dict.fromkeys((n for n, _ in rough), 0.0)
        for patch, flux, _ in self._fluxes(rough).values():
            self.light[patch] += float(np.nansum(flux))

    def may_refit(self, patch):
        """Returns True if a piece may be fitted again."""
        most = LARGE_ROUNDS if _is_large(self.job, patch) else ROUNDS
        return len(self.names[patch]) <= most

    def first_of(self, pending):
        """Those of the pieces that are due which do not wait for a neighbour that is.

        The one of fewer fits is first, of equally many the fainter one.
        """

        def turn(n):
            return len(self.names[n]), self.light[n], n

        siblings = {n: pending.intersection(self.job.plan.patches[n].siblings) for n in pending}
        return {n for n in pending if all(turn(n) < turn(k) for k in siblings[n])}

    def last_fits(self, patches):
        """(patch, name of its last file of results) of some pieces."""
        return tuple((n, self.names[n][-1]) for n in sorted(patches))

    def found_in(self, patches):
        """`FitGroup.found` of some pieces: all that was found in their residuals so far."""
        return tuple(row for patch in patches for row in self.found.get(patch, ()))

    def moved(self, patches):
        """Pieces whose flux changed by over MAX_FLUX_CHANGE_SIGMA errors since their fit before.

        The change must also exceed SETTLED_PART of the flux.
        """
        old = self._fluxes([(n, self.names[n][-2]) for n in patches])
        moved = set()
        for source, (patch, flux, error) in self._fluxes(
            [(n, self.names[n][-1]) for n in patches]
        ).items():
            if source not in old:
                moved.add(patch)
                continue
            known = np.isfinite(error) & (error > 0)
            change = np.abs(flux - old[source][1])[known]
            part = SETTLED_PART * np.abs(flux[known])
            if (change > np.maximum(MAX_FLUX_CHANGE_SIGMA * error[known], part)).any():
                moved.add(patch)
        return moved

    def _fluxes(self, pairs):
        """{id: (patch, fluxes (C,), errors (C,))} of (patch, name of its part)."""
        found, of_name = {}, {}
        for patch, name in pairs:
            of_name.setdefault(name, set()).add(patch)
        for name, patches in of_name.items():
            rows, parts = results_file(self.job.folder, name).read("CATALOGUE", "COMPONENTS")
            where = dict(zip(parts["id"].tolist(), parts["fit_id"].tolist(), strict=True))
            flux, error = (_columns(rows, kind, self.job) for kind in ("flux", "flux_err"))
            for k, source in enumerate(rows["id"].tolist()):
                if where.get(source) in patches:
                    found[source] = where[source], flux[k], error[k]
        return found


def _columns(rows, kind, job):
    """Columns of all bands that the rows have: (S, B)."""
    names = [f"{kind}_{b}" for b in job.bands if f"{kind}_{b}" in rows]
    return np.array([rows[name] for name in names], float).reshape(len(names), len(rows)).T


def _fit_round(job, tasks, engine, progress):
    """Fits the groups of one round; {name: patches} of their parts."""
    names, todo = {}, []
    there = _parts_of(job.folder)
    for task in tasks:
        mine = {name: ps for name, ps in there.items() if name.startswith(task.name)}
        names |= mine
        left = tuple(p for p in task.patches if p not in {q for ps in mine.values() for q in ps})
        progress.step(len(task.patches) - len(left))
        if left:
            todo.append(
                task
                if len(left) == len(task.patches)
                else replace(task, name=f"{task.name}-{left[0]}", patches=left)
            )
    tries: dict[tuple, int] = {}

    def again(outcome):
        group = outcome.task
        if outcome.cause is Cause.DISK:  # which would lose all
            raise FileError(
                f"{job.folder}: {outcome.reason}; what is finished stays: --resume goes on"
            )
        tries[group.patches] = tries.get(group.patches, 0) + 1
        if tries[group.patches] < 2:  # it may have been killed from outside: try once more
            return [group]
        if len(group.patches) == 1:
            return None
        half = len(group.patches) // 2
        halves = [
            replace(group, name=f"{group.name}-{few[0]}", patches=few)
            for few in (group.patches[:half], group.patches[half:])
        ]
        time_left.split(group.name, {half.name: _cost(job, half) for half in halves})
        return halves

    costs = {group.name: _cost(job, group) for group in todo}
    devices = read_search_setup(job.folder).devices
    alike = f"{devices}, {len(job.channels)} channels, {engine.n_workers}"
    time_left = TimeLeft(costs, engine.n_workers, time.monotonic(), remembered_pace(alike))
    progress.time_left(time_left.left(time.monotonic()))
    for outcome in engine.run(FIT, job, todo, again=again, stage="fit"):
        group, value = outcome.task, outcome.value
        time_left.end(group.name, outcome.worker, outcome.start_s, outcome.end_s)
        progress.time_left(time_left.left(time.monotonic()))
        if outcome.reason is not None:
            value, content = mark_failed(job, group, outcome.reason)
            FIT.keep(job, group, content)
            progress.message(f"{len(group.patches)} blends are set aside: {outcome.reason}")
        names[group.name] = group.patches
        progress.step(value["patches"], value["sources"])
    # pieces differ from whole blends, and a resumed run may have begun on another device
    if time_left.pace is not None and tasks[0].round == 0 and not there:
        remember_pace(alike, time_left.pace)
    return names


def _cost(job, group):
    """Predicted relative time of a group's fits."""
    return sum(predicted_cost(job.plan.patches[number]) for number in group.patches)


def _parts_of(folder):
    """{name: patches} of the parts on disk."""
    found = {}
    for path in sorted(folder.glob("fit-*.arrays")):
        (patches,) = GroupResultsFile(path).read("PATCHES")
        found[path.stem] = tuple(patches["fit_id"].tolist())
    return found
