"""All groups of fits, round by round, whatever happens to their workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...files.whole_file import FileError
from .fitting import Group, fit_group, set_aside
from .part import PartFile
from .pool import run_tasks

# Most rounds in which a cut blend's pieces are fitted again, their neighbours' light subtracted.
# The first takes the neighbours out; crowded pieces settle by the third or fourth.
ROUNDS = 4
# [errors] A blend's pieces have settled when no flux changes by more than this from one round to
# the next. Fits end within 0.2 of their limit (Settings.enough), two of them within 0.3 of each
# other: a smaller number would not be reached.
SETTLED = 0.3


def fitted(job, options, progress):
    """Fit all groups that are not yet, round by round.

    returns the PartFiles, the last round's of each patch counting, and the parents of those cut
    blends whose pieces had not settled when the rounds ended
    """
    progress.stage("fit", len(job.plan.patches))
    names = _fit_round(job, _tasks(0, job.plan.groups), options, progress)
    parts, last = list(names), names
    pending = {job.plan.patches[n].parent for group in job.plan.giants for n in group}
    before: tuple[str, ...] = ()
    for n_round in range(1, ROUNDS + 1):
        groups = _of_parents(job.plan, pending)
        if not groups:
            break
        progress.stage(f"pieces, round {n_round}", sum(map(len, groups)))
        mine = {number for group in groups for number in group}
        older = before if n_round > 2 else ()  # of round 0, neighbours were in the data
        before = tuple(sorted(name for name, patches in last.items() if mine & set(patches)))
        names = _fit_round(job, _tasks(n_round, groups, before, older), options, progress)
        pending = _unsettled(job, before, names)
        parts, last = parts + list(names), names
    # by round and group, in whichever order they ended: sums of models are the same to the last bit
    return [_file(job, name) for name in sorted(parts)], pending


def _tasks(n_round, groups, before=(), older=()):
    return [
        Group(f"fit-{n_round}-{i:06d}", patches, n_round, before, older)
        for i, patches in enumerate(groups)
    ]


def _file(job, name):
    return PartFile(job.folder / f"{name}.fits")


def _of_parents(plan, parents):
    """The groups of pieces of these blends."""
    few = (tuple(n for n in g if plan.patches[n].parent in parents) for g in plan.giants)
    return tuple(group for group in few if group)


def _unsettled(job, before, names):
    """Parents of blends with a flux that changed by over SETTLED errors since the round before."""
    old = _fluxes(job, before)
    moved = set()
    for source, (parent, flux, error) in _fluxes(job, names).items():
        if source not in old:
            moved.add(parent)
            continue
        change = np.abs(flux - old[source][1])[np.isfinite(error) & (error > 0)]
        if (change > SETTLED * error[np.isfinite(error) & (error > 0)]).any():
            moved.add(parent)
    return moved


def _fluxes(job, names):
    """{id: (parent, fluxes (C,), errors (C,))} of the cut blends' sources in some parts."""
    cut = {p.parent for p in job.plan.patches if p.pieces > 1}
    found = {}
    for name in names:
        rows = _file(job, name).table("CATALOGUE")
        columns = [
            [np.asarray(getattr(rows[key], "value", rows[key]), float) for key in keys]
            for keys in (
                [f"{kind}_{c}" for c in job.channels if f"{kind}_{c}" in rows.colnames]
                for kind in ("flux", "flux_err")
            )
        ]
        for k, (source, parent) in enumerate(zip(rows["id"], rows["parent_id"], strict=True)):
            if int(parent) in cut:
                values = [np.array([column[k] for column in kind]) for kind in columns]
                found[int(source)] = (int(parent), *values)
    return found


def _fit_round(job, tasks, options, progress):
    """Fit the groups of one round; {name: patches} of their parts."""
    names, todo = {}, []
    for task in tasks:
        mine = _parts_of(job.folder, task)
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
        _check_space(job.folder, outcome.reason)
        tries[group.patches] = tries.get(group.patches, 0) + 1
        if tries[group.patches] < 2:  # killed from outside, perhaps: the same once more
            return [group]
        if len(group.patches) == 1:
            return None
        half = len(group.patches) // 2
        return [
            replace(group, name=f"{group.name}-{few[0]}", patches=few)
            for few in (group.patches[:half], group.patches[half:])
        ]

    for outcome in run_tasks(
        fit_group, job, todo, options.workers, limit_s=options.limit_s, again=again
    ):
        group, value = outcome.task, outcome.value
        if outcome.reason is not None:
            value = set_aside(job, group, outcome.reason)
            progress.say(f"{len(group.patches)} blends are set aside: {outcome.reason}")
        names[group.name] = group.patches
        progress.step(value["patches"], value["sources"])
    return names


def _parts_of(folder, task):
    """{name: patches} of the parts on disk that hold patches of a group, whole or split."""
    found = {}
    for path in sorted(folder.glob(f"{task.name}*.fits")):
        patches = PartFile(path).table("PATCHES")["patch"]
        found[path.stem] = tuple(int(p) for p in patches)
    return found


def _check_space(folder, reason):
    """Raise FileError where a group failed because the disk is full: going on would lose all."""
    if "cannot be written" in reason or "No space left" in reason:
        raise FileError(f"{folder}: {reason}; what is finished stays: --resume goes on")
