"""L-BFGS on the device: inner products, directions and steps as in NumPy."""

import numpy as np
import pytest
from helpers.solver import close, every_type, ragged

from clresample.deblending.solver.buffers import SceneBuffers
from clresample.deblending.solver.multiscale import lbfgs_steps
from clresample.deblending.solver.multiscale.exchange_direction import ExchangeDirection
from clresample.deblending.solver.multiscale.inverse import CurvatureBlock, SourceBlocks, _panels
from clresample.deblending.solver.multiscale.lbfgs_pairs import LbfgsPairs
from clresample.deblending.solver.multiscale.lbfgs_steps import (
    AGAIN,
    NEXT,
    REST,
    STAY,
    TRY,
    LbfgsSteps,
)
from clresample.deblending.solver.multiscale.prior import MultiscalePrior
from clresample.deblending.solver.multiscale.scale_direction import ScaleDirection
from clresample.deblending.solver.multiscale.structure import LatentLayout
from clresample.deblending.solver.multiscale.vectors import SolverVectors

N_PAIRS = 4


def two_loops(g, pairs, h):
    """-H g of pairs (s, y), oldest first (Nocedal & Wright 2006, algorithm 7.4)."""
    q, past = g.copy(), []
    for s, y in reversed(pairs):
        a = (s @ q) / (s @ y)
        past.append(a)
        q -= a * y
    if pairs:
        s, y = pairs[-1]
        q *= (s @ y) / (y @ (h * y))
    r = h * q
    for (s, y), a in zip(pairs, reversed(past), strict=True):
        r += s * (a - (y @ r) / (s @ y))
    return -r


def test_pairs_give_the_direction_of_the_two_loops():
    """Of scenes with other numbers of pairs, one of them without curvature, past a full ring."""
    rng, n, n_scenes = np.random.default_rng(0), 12, 3
    matrix = rng.normal(size=(n, n))
    matrix = matrix @ matrix.T + np.eye(n)
    pairs, h = LbfgsPairs(n_scenes, N_PAIRS), rng.uniform(0.5, 2, n)
    kept = [[] for _ in range(n_scenes)]
    s_ring, y_ring = np.zeros((2, n_scenes, pairs.n_slots, n))
    for k in range(9):
        taken = np.array([i for i in range(n_scenes) if k < (9, 3, 0)[i]], int)
        s = rng.normal(size=(n_scenes, n))
        y = s @ matrix * (-1 if k == 2 else 1)
        for i in range(n_scenes):
            s_ring[i, pairs.spare[i]], y_ring[i, pairs.spare[i]] = s[i], y[i]
        sy, yy = np.einsum("bkn,bn->bk", s_ring, y), np.einsum("bkn,bn->bk", y_ring, h * y)
        pairs.take(taken, sy[taken], yy[taken])
        for i in taken:
            kept[i] = (kept[i] + [(s[i], y[i])] * (k != 2))[-N_PAIRS:]
        g = rng.normal(size=(n_scenes, n))
        a, c, scale = pairs.coefficients(s_ring @ g[0], y_ring @ (h * g[0]))
        y_part = np.einsum("bk,bkn->bn", a, y_ring) - g[0]
        d = scale[:, None] * h * y_part - np.einsum("bk,bkn->bn", c, s_ring)
        for i in range(n_scenes):
            np.testing.assert_allclose(d[i], two_loops(g[0], kept[i], h), rtol=1e-9, atol=1e-9)
    assert pairs.count.tolist() == [4, 2, 0]
    pairs.forget(np.array([True, False, False]))
    a, c, scale = pairs.coefficients(s_ring @ g[0], y_ring @ g[0])
    assert not a[0].any() and not c[0].any() and scale[0] == 1


class Made:
    """Vectors of ragged scenes, filled with random numbers, and the same in NumPy."""

    def __init__(self, build, dtype):
        if dtype == np.float64 and not build.has_fp64:
            pytest.skip(f"{build.name} has no double precision")
        prior, rng = MultiscalePrior(), np.random.default_rng(0)
        scenes, states = map(list, zip(*ragged(build, dtype), strict=True))
        self.b = b = SceneBuffers(scenes, states, build, dtype, prior)
        self.latents = LatentLayout(b.host_boxes, build.get(b.free)[: b.n_free], prior.steps)
        self.v = v = SolverVectors(b, self.latents, N_PAIRS + 1)
        self.host, self.device = {}, build
        for name in SolverVectors.NAMES:
            array = getattr(v, name)
            self.host[name] = rng.normal(size=array.shape).astype(dtype).astype(float)
            build.upload(self.host[name].astype(dtype), array)
        for name in ("x", "x_new"):  # some at their bound
            array = self.host[name]
            array[..., -v.n_spectra - v.n_sky :: 3] = 0
            build.upload(array.astype(dtype), getattr(v, name))
        self.scene = np.zeros(v.size, int)
        self.bounded = np.zeros(v.size, bool)
        seen = np.zeros(v.size, int)
        for scene, first, length, bounded in v.chunks:
            self.scene[first : first + length] = scene
            self.bounded[first : first + length] = bounded
            seen[first : first + length] += 1
        assert (seen == 1).all()
        assert self.bounded.sum() == v.n_spectra
        self.pairs = LbfgsPairs(3, N_PAIRS)
        self.pairs.used[:] = 5, 2, 5
        self.pairs._order[:] = np.arange(5)
        self.steps = LbfgsSteps(v)
        self.follow([TRY, TRY, REST])

    def follow(self, mode):
        self.steps.follow(self.pairs, np.array(mode))

    def get(self, name):
        return self.device.get(getattr(self.v, name)).astype(float)

    def held(self, x, g):
        return self.bounded & (x <= 0) & (g > 0)

    def apply(self, vector, blocks, exchanges=()):
        """H of a vector (size,): h, but what the blocks of all levels say, and exchanges."""
        out = self.host["h"] * vector
        for s, some in enumerate(blocks):
            for level in range(2):
                for block, matrix in some:
                    where = self.latents.start[s] + getattr(
                        block, "indices", np.arange(len(matrix))
                    )
                    if getattr(block, "level", 1) == level:
                        before = out[where] if level else 0
                        out[where] = before + matrix @ vector[where]
        for i, some in enumerate(exchanges):
            for exchange in some:
                d, source = np.zeros(len(out)), self.b.host_first[i] + exchange.source
                d[self.latents.start[source] + exchange.places] = exchange.values
                d[slice(*self.v.parts()[i, 1])] = exchange.spectra.ravel()
                out += d * (d @ vector)
        return out


def random_exchanges(made, seed=6):
    """Two of each scene, of its sources with coefficients."""
    rng, b, found = np.random.default_rng(seed), made.b, []
    n = made.latents.shape.prod(2).sum(1)
    for own in np.split(n, b.host_first[1:-1]):
        found.append([])
        for i in np.flatnonzero(own)[:2]:
            places = rng.permutation(own[i])[: own[i] // 2]
            values = rng.normal(size=len(places)), rng.normal(size=(len(own), b.n_channels))
            found[-1].append(ExchangeDirection(i, places, *values))
    assert max(map(len, found)) > 1
    return found


def random_blocks(made, seed=5):
    """Blocks of two levels, and the matrices they stand for, of the first source that has
    coefficients; of one level for the others. All have a direction."""
    rng, blocks = np.random.default_rng(seed), []
    for n in made.latents.shape.prod(2).sum(1):
        found = []
        for level, places in enumerate((range(0, n, 2), range(1, n, 2), range(0, n, 3))):
            if not n or (level == 2 and any(blocks)):
                continue
            places = rng.permutation(np.array(places))[:37]
            root = np.tril(rng.normal(size=(len(places), len(places)))).astype(np.float32)
            block = CurvatureBlock(int(level == 2), places, _panels(root))
            found.append((block, root.T.astype(float) @ root))
        if found:
            d = rng.normal(size=n).astype(np.float32)
            found.append((ScaleDirection(d), np.outer(d, d.astype(float))))
        blocks.append(found)
    return blocks


def source_blocks(blocks):
    """SourceBlocks of what `random_blocks` returned."""
    parts = [[block for block, _ in some] for some in blocks]
    return [SourceBlocks(tuple(some[:-1]), some[-1] if some else None) for some in parts]


@every_type
@pytest.mark.parametrize("with_blocks", [False, True])
def test_inner_products_are_those_of_each_scene(build, dtype, with_blocks):
    m = Made(build, dtype)
    blocks = random_blocks(m) if with_blocks else [[]] * len(m.b.host_boxes)
    exchanges = random_exchanges(m) if with_blocks else []
    m.steps.take_blocks(source_blocks(blocks), exchanges)
    x, g, s, hy = (m.host[k] for k in ("x", "g", "s", "hy"))
    m.steps.queue_products()
    sums, slope, energy = m.steps.products()
    on = m.scene < 2
    y = np.where(on, m.host["g_new"] - g, 0)
    s, hy = s.copy(), hy.copy()
    s[0, on], hy[0, on] = (m.host["x_new"] - x)[on], m.apply(y, blocks, exchanges)[on]
    close(m.get("s"), s, dtype)
    close(m.get("hy"), hy, dtype)
    free_g = np.where(m.held(m.host["x_new"], m.host["g_new"]), 0, m.host["g_new"])
    for i, used in ((0, 5), (1, 2)):
        part = m.scene == i
        for k in range(used):
            wanted = s[k] * free_g, hy[k] * free_g, s[k] * y, hy[k] * y
            scale = [np.sqrt((w[part] ** 2).sum()) for w in wanted]
            found = (sums[i, k] - [w[part].sum() for w in wanted]) / scale
            close(1 + found, np.ones(4), dtype)
        assert slope[i] == pytest.approx((g * s[0])[part].sum(), rel=1e-3)
        wanted = (m.host["precision"] * m.host["x_new"] ** 2)[part].sum()
        assert energy[i] == pytest.approx(wanted, rel=1e-3)
    assert not sums[1, 2:].any()  # of slots that are not in use there is nothing


@every_type
@pytest.mark.parametrize("mode", [NEXT, AGAIN, TRY, STAY])
def test_a_step_does_what_its_scene_asks_for(build, dtype, mode):
    m = Made(build, dtype)
    rng = np.random.default_rng(1)
    a, c = rng.normal(size=(2, 3, 5))
    a[:, 4] = c[:, 4] = 0
    a[1, 2:] = c[1, 2:] = 0
    scale, length = rng.uniform(0.5, 1, (2, 3))
    blocks, exchanges = random_blocks(m), random_exchanges(m)
    m.steps.take_blocks(source_blocks(blocks), exchanges)
    m.steps.queue_products()
    x, g, hg, d, s, hy = (m.get(k) for k in ("x", "g", "hg", "d", "s", "hy"))
    m.follow([mode, mode, REST])
    m.steps.advance(a, c, scale, length)
    if mode == NEXT:
        x, g = m.host["x_new"], m.host["g_new"]
        hg = m.apply(np.where(m.held(x, g), 0, g), blocks, exchanges)
    if mode in (NEXT, AGAIN):
        b = m.scene
        q = np.einsum("kn,nk->n", hy, a[b]) - hg
        d = scale[b] * q - np.einsum("kn,nk->n", s, c[b])
        d = np.where(m.held(x, g), 0, d)
    x_new = x if mode == STAY else x + length[m.scene] * d
    x_new = np.where(m.bounded, np.maximum(x_new, 0), x_new)
    for name, wanted in (("x", x), ("g", g), ("hg", hg), ("d", d), ("x_new", x_new)):
        close(m.get(name), np.where(m.scene < 2, wanted, m.host[name]), dtype)


@every_type
def test_a_scene_that_is_no_number_harms_no_other(build, dtype):
    """Nor through its blocks, which follow those of the scene before: rows that fill no panel."""
    found = []
    for bad in (1.0, np.nan):
        m = Made(build, dtype)
        m.steps.take_blocks(source_blocks(random_blocks(m)))
        build.upload(np.where(m.scene == 1, bad, m.host["g_new"]).astype(dtype), m.v.g_new)
        m.steps.queue_products()
        m.follow([NEXT, NEXT, REST])
        m.steps.advance(*np.zeros((2, 3, 5)), *np.zeros((2, 3)))
        found.append(np.vstack([m.get("hy"), m.get("hg")])[:, m.scene == 0])
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("most", [5, 1000])
def test_runs_hold_every_element_once_and_are_as_long_as_directions_allow(most, monkeypatch):
    monkeypatch.setattr(lbfgs_steps, "MAX_RUN", most)
    of = np.repeat([0, 1, 2], [20, 6, 4])
    places = np.concatenate([np.arange(20), [4, 5, 6, 7, 12, 30], [6, 13, 30, 31]])
    runs, order, firsts = lbfgs_steps._runs(places, of)
    found = [
        (first + k % length, int(of[order[firsts[of_run]]]))
        for (first, length, of_run, at), (*_, to) in zip(runs, runs[1:], strict=False)
        for k, of_run in zip(range(to - at), np.repeat(range(of_run, of_run + 3), length))
    ]
    assert found == list(zip(places[order], of[order], strict=True))
    assert sorted(order) == list(range(len(of))) and tuple(runs[-1, 2:]) == (len(firsts), len(of))
    first = [0, 4, 6, 7, 8, 12, 13, 14, 30, 31]
    assert runs[:-1, 0].tolist() == sorted({*first, *range(0, 20, most), *range(30, 32, most)})


def test_only_new_roots_are_uploaded(build, monkeypatch):
    """Blocks that stay keep their place; where room runs out, or is hardly used, all move."""
    m = Made(build, np.float32)
    shelf, uploads = m.steps.shelf, []
    upload = m.b.device.upload
    monkeypatch.setattr(
        type(m.b.device), "upload", lambda d, v, a: uploads.append(v.size) or upload(v, a)
    )

    def made(value, m=20):
        return CurvatureBlock(0, np.arange(m), _panels(np.full((m, m), float(value))))

    def held():
        """The value of each block on the device, if it is the same all over."""
        flat, out = m.b.device.get(shelf.values), []
        for block in blocks:
            part = flat[shelf.first(block) :][: block.cholesky.size]
            np.testing.assert_array_equal(part, block.cholesky)
            out.append(part[0])
        return out

    blocks = [made(k) for k in range(1, 9)]
    shelf.retain(blocks)
    before, first = shelf.values, [shelf.first(b) for b in blocks]
    blocks[3] = made(20)
    uploads.clear()
    shelf.retain(blocks)
    assert len(uploads) == 1 and uploads[0] < 2 * blocks[3].cholesky.size
    assert shelf.values is before and held() == [1, 2, 3, 20, 5, 6, 7, 8]
    assert [shelf.first(b) for b in blocks[4:]] == first[4:]
    blocks = [made(k + 30) for k in range(8)]
    shelf.retain(blocks)
    assert shelf.values is not before and held() == list(range(30, 38))
    before, blocks = shelf.values, blocks[1:4]  # a quarter of the room, which is enough
    shelf.retain(blocks)
    assert shelf.values is before and held() == [31, 32, 33]
    blocks = blocks[1:]
    shelf.retain(blocks)
    assert shelf.values.size < before.size and held() == [32, 33]


@every_type
def test_other_strengths_reach_every_vector(build, dtype):
    m = Made(build, dtype)
    light = np.random.default_rng(2).uniform(1, 2, m.latents.size)
    weights = np.random.default_rng(3).uniform(1, 2, (len(m.b.host_boxes), 3, 3))
    m.steps.reweigh(m.b.put(light), weights)
    names = "h", "g_new", "precision"
    h, g, stiff = (m.host[name].copy() for name in names)
    for i, planes in enumerate(m.latents.planes()):
        for j, (first, length) in enumerate(planes):
            part = slice(first, first + length)
            precision, curvature, change = weights[i, j]
            stiff[part] = precision
            h[part] = 1 / (precision + curvature * light[part])
            g[part] += change * m.host["x_new"][part]
    for name, wanted in zip(names, (h, g, stiff), strict=True):
        close(m.get(name), wanted, dtype)


def test_spectra_and_sky_go_there_and_back(build):
    m = Made(build, np.float64)
    m.v.unpack_spectra(m.v.x_new)
    tail = m.host["x_new"][m.latents.size :]
    both = np.concatenate([build.get(a).ravel() for a in (m.b.spectra, m.b.sky)])
    np.testing.assert_array_equal(both, tail)
    rng = np.random.default_rng(4)
    pull, d_spectra = rng.normal(size=(3, 10)), rng.normal(size=m.b.spectra.shape)
    rows = np.array([0, 4, 7, 10])
    build.upload(d_spectra, m.b.d_spectra)
    m.v.pack_gradients(m.b.put(pull), build.put(rows, np.int32))
    wanted = np.concatenate([d_spectra.ravel(), np.add.reduceat(pull, rows[:-1], 1).ravel()])
    close(m.get("g_new")[m.latents.size :], wanted, np.float64)


def test_a_part_of_a_batch_goes_on_alone(build):
    """Scenes 2 and 0, in this order, with all their vectors."""
    m = Made(build, np.float32)
    keep = np.array([2, 0])
    scenes, states = map(list, zip(*ragged(build, np.float32), strict=True))
    prior = MultiscalePrior()
    b = SceneBuffers([scenes[i] for i in keep], [states[i] for i in keep], build, np.float32, prior)
    latents = LatentLayout(b.host_boxes, build.get(b.free)[: b.n_free], prior.steps)
    other = SolverVectors(b, latents, N_PAIRS + 1)
    other.copy_from(m.v, keep)
    for name in SolverVectors.NAMES:
        found, wanted = build.get(getattr(other, name)), build.get(getattr(m.v, name))
        parts = [wanted[..., a:b] for kind in range(3) for a, b in m.v.parts()[keep, kind]]
        np.testing.assert_array_equal(found, np.concatenate(parts, axis=-1))
    pairs = m.pairs.subset(keep)
    assert pairs.used.tolist() == [5, 5]
