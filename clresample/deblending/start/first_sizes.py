"""Sizes of large galaxies, from a coarse grid, before the least squares of all shapes begin.

Those step from what is expected, galaxies of a few pixels. Where one galaxy of a scene is far
larger, small profiles of all sources share its light at first, and each grows into it. So sizes
GROWTH times apart are compared here,

    gain_k = sum_c max(0, <u_k, r + A_c u>)^2 / |u_k|^2,  less the same of the present size

u_k being a source's whitened image at size k, u and A_c those of the present one, r the residual of
all sources at their present sizes. The source that gains the most takes its new size, the spectra
of all are solved for again, and so on: the galaxy that explains the most light comes first, and
what it explains is no gain of others, in whatever order they are listed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..profiles import Galaxy

# Sizes follow each other by this factor: the least squares find their way from half of it.
GROWTH = 3.0
# Chi2 by which another size must be better. Noise gains under 10 for the few numbers of a profile;
# smaller differences are left to the least squares, which take account of what is expected.
NEED = 25.0
# Most rounds, in each of which sources that are apart from each other take other sizes; what is
# left then is for the least squares.
N_ROUNDS = 12


def first_sizes(looking, thetas, error) -> list:
    """Parameters (N) of components, large galaxies with sizes from the grid.

    looking: Looking that has its solution at `thetas` (N), those that are expected
    error: part of the light that adds to the noise
    """
    thetas = [np.array(theta, float) for theta in thetas]
    grid = _grid(looking, thetas, error)
    for _ in range(N_ROUNDS):
        if not grid:
            break
        scenes = np.unique(looking.scene[list(grid)])
        looking.look(scenes, thetas, np.zeros(len(thetas)), slopes=False)
        looking.solve(error)
        looking.compare(error)
        chosen = _choose(looking, thetas, grid)
        for i, size in chosen.items():
            thetas[i][0] = size
        scenes = looking.scene[np.array(list(chosen), int)]
        grid = {i: sizes for i, sizes in grid.items() if looking.scene[i] in scenes}
    return thetas


def _grid(looking, thetas, error):
    """Sizes [ln px] of galaxies that may have another one than that expected: {component: sizes}.

    All light there, whosever it is, is clearly more significant as such a profile weighs it than as
    the one before does.
    """
    going = [i for i, c in enumerate(looking.components) if isinstance(c.shape, Galaxy)]
    going = [i for i in going if looking.components[i].shape.whole]
    if not going:
        return {}
    before, grid = dict(enumerate(_significance(looking, looking.sky, error))), {}
    while going:
        sizes = {i: grid.get(i, [thetas[i][0]])[-1] + np.log(GROWTH) for i in going}
        sizes = {i: s for i, s in sizes.items() if 2 * np.exp(s) < max(looking.components[i].frame)}
        if not sizes:
            break
        now = _significance(_sized(looking, thetas, list(sizes.items())), looking.sky, error)
        going = [i for i, new in zip(sizes, now, strict=True) if new > before[i] + NEED]
        before = dict(zip(sizes, now, strict=True))
        for i in going:
            grid.setdefault(i, [thetas[i][0]]).append(sizes[i])
    return grid


def _choose(looking, thetas, grid):
    """New sizes [ln px] of the components that gain the most of all near them: {component: size}.

    looking: its residual is that of `thetas`; grid: see `_grid`, of scenes that were solved last
    """
    # of one component these follow each other, the present size first
    listed = [(i, s) for i, own in grid.items() for s in dict.fromkeys([thetas[i][0], *own])]
    around = _sized(looking, thetas, listed)
    component = np.array([i for i, _ in listed])
    first = np.flatnonzero(np.diff(component, prepend=-1))
    present = np.repeat(first, np.diff(first, append=len(listed)))
    gain = np.zeros(len(listed))
    for sight, (table, _) in zip(around.sights, around.pairs, strict=True):
        a, b = around.at[table[:, :2]].T
        own = component[a] == component[b]
        table, a, b = table[own], a[own], b[own]
        products = sight.gram(looking.device.put(table.astype(np.int32)), 1)[..., 0, 0]
        alone, shared, right = np.zeros((3, len(listed), sight.n_bands))
        for one, other in ((a, b), (b, a)):
            at = other == present[one]
            shared[one[at]] = products[at]
        alone[a[a == b]] = products[a == b]
        right[around.at] = sight.pull(1)[:, :, 0, 0]
        right += looking.spectra[component][:, sight.channels] * shared
        square = np.maximum(right, 0) ** 2
        gain += np.divide(square, alone, out=np.zeros_like(square), where=alone > 0).sum(axis=1)
    gain -= gain[present]
    return dict(_apart(around, listed, gain))


def _apart(around, listed, gain):
    """Of those `listed` (n) whose gain (n,) is clear the largest ones, in boxes apart."""
    low, high = np.zeros((2, len(listed), 2))
    low[around.at], high[around.at] = around.slots.origin, around.slots.origin + around.slots.size
    taken: list[int] = []
    for k in np.argsort(-gain, kind="stable"):
        if gain[k] <= NEED:
            break
        same = [j for j in taken if around.scene[j] == around.scene[k]]
        if not ((low[same] < high[k]) & (low[k] < high[same])).all(axis=1).any():
            taken.append(int(k))
    return [listed[k] for k in taken]


def _sized(looking, thetas, listed):
    """A Looking that has looked at components [(i, ln size)] as they would be at these sizes."""
    components, parameters, count = [], [], {}
    for i, size in listed:
        c = looking.components[i]
        count[c.scene] = index = count.get(c.scene, -1) + 1
        components.append(replace(c, index=index))
        parameters.append(np.array([size, *thetas[i][1:]]))
    around = looking.instead(components)
    scenes = np.unique(around.scene)
    around.look(scenes, parameters, np.zeros(len(components)), slopes=False)
    return around


def _significance(looking, sky, error):
    """Chi2 (N,) that each of the components looked at explains of all light but the sky's."""
    return (np.maximum(looking.signal_to_noise(sky, error), 0) ** 2).sum(axis=1)
