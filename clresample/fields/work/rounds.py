"""All groups of fits, round by round, whatever happens to their workers."""

from __future__ import annotations

from dataclasses import replace

from ...files.whole_file import FileError
from .fitting import Group, fit_group, set_aside
from .part import PartFile
from .pool import run_tasks

# Rounds in which a cut blend's pieces are fitted again with their neighbours' light subtracted.
# The first takes the neighbours out, the second lets their better models count.
ROUNDS = 2


def fitted(job, options, progress):
    """Fit all groups that are not yet, round by round; the paths of the parts, the last round's
    of each patch counting."""
    parts, before = [], ()
    progress.stage("fit", len(job.plan.patches))
    rounds = [job.plan.groups] + [job.plan.giants] * (ROUNDS if job.plan.giants else 0)
    for n_round, groups in enumerate(rounds):
        if n_round == 1:
            progress.stage("pieces", ROUNDS * sum(map(len, job.plan.giants)))
        tasks = [
            Group(f"fit-{n_round}-{i:06d}", patches, n_round, before)
            for i, patches in enumerate(groups)
        ]
        names = _fit_round(job, tasks, options, progress)
        parts += names
        if n_round == 0:
            cut = {number for group in job.plan.giants for number in group}
            before = tuple(n for n, ps in names.items() if cut & set(ps))
        else:
            before = tuple(names)
    # by round and group, in whichever order they ended: sums of models are the same to the last bit
    return [PartFile(job.folder / f"{name}.fits") for name in sorted(parts)]


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
