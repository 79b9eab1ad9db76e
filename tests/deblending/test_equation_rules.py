"""Normal equations and least squares of several scenes from sums of products, by dense float64."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from clresample.deblending.linear import linearised_scenes as module, spectra as spectra_module
from clresample.deblending.linear.equations import normal_equations
from clresample.deblending.linear.linearised_scenes import LinearisedScenes
from clresample.deblending.linear.spectra import RIDGE

N_SCENES, N_PIXELS = 3, 60
# scene, index there, parameters, first and one-past-last pixel of its light, of each component;
# the first and the third do not meet
PARTS = [(0, 0, 4, 0, 25), (0, 1, 2, 10, 60), (0, 2, 0, 30, 50), (1, 0, 4, 0, 60), (2, 0, 4, 5, 40)]
PARTS += [(2, 1, 3, 20, 60)]
DARK = 4  # the second observation sees nothing of this one
CHANNELS = slice(0, 2), slice(2, 3)
SEEN = [2, 0]  # the scenes that are looked at


class Sums:
    """A Sight whose pixels are one row, in NumPy: of random images, roots and data."""

    ties, aim = None, SimpleNamespace(is_exact=True, allow_wide_pixels=lambda: np.zeros(N_SCENES))

    def __init__(self, channels, seed):
        rng = np.random.default_rng(seed)
        self.channels, self.n_bands = channels, channels.stop - channels.start
        self.root = rng.uniform(0.5, 1.5, (N_SCENES, self.n_bands, N_PIXELS))
        self.data = rng.normal(5, 3, self.root.shape)  # times the root
        self.sky_precision = rng.uniform(10, 40, self.root.shape[:2])
        self.images = rng.uniform(-0.2, 1, (len(PARTS), 5, self.n_bands, N_PIXELS))
        for image, (_, _, n, first, last) in zip(self.images, PARTS, strict=True):
            image[..., :first] = image[..., last:] = 0
            image[1 + n :] = image[n]  # images that one does not have repeat its last
        if channels.start:
            self.images[DARK] = 0
        self.whitened = 0

    def render(self, slots, _images, level):
        assert len(level) == len(slots)
        self.slots, self.whitened = slots, 0
        self.at = [slots.numbers[i] for i in slots.order]

    def whiten(self):
        self.whitened += 1

    def overlapping_pairs(self):
        """Of slots a <= b of a scene that share a pixel, as numbers, and the same."""
        lit = [self.images[i, 0].any(0) for i in self.at]
        n = range(len(lit))
        found = [
            (a, b, 0, 0, 0, 0)
            for a in n
            for b in n
            if a <= b and PARTS[self.at[a]][0] == PARTS[self.at[b]][0] and (lit[a] & lit[b]).any()
        ]
        return np.array(found), np.array(found)

    def compute_residuals(self, scenes, _slots, spectra, sky, error):
        model = sky[:, self.channels, None] * self.root
        for row, i in enumerate(self.at):
            model[PARTS[i][0]] += spectra[row, self.channels, None] * self.images[i, 0]
        self.residual, self.weight = self.data - model, 1 / (1 + (error * model) ** 2)
        r, w = self.residual, self.weight
        sums = w * r**2, w * r * self.root, w * self.root**2
        return np.stack([s.sum(2)[scenes] for s in sums], axis=-1)

    def gram(self, table, n_images):
        assert n_images <= self.slots.n_images.max()  # no work on what no slot has
        own = self.images[self.at][:, :n_images]
        weight = self.weight[[PARTS[self.at[a]][0] for a in table[:, 0]]]
        return np.einsum("xkcp,xcp,xlcp->xckl", own[table[:, 0]], weight, own[table[:, 1]])

    def residual_products(self, n_images):
        assert n_images <= self.slots.n_images.max()
        scene = [PARTS[i][0] for i in self.at]
        both = np.stack([self.residual[scene], self.root[scene]])
        own = self.images[self.at][:, :n_images]
        return np.einsum("xkcp,xcp,oxcp->xcko", own, self.weight[scene], both)


class Listed(SimpleNamespace):
    """Slots that are drawn nowhere."""

    def __len__(self):
        return len(self.order)


@pytest.fixture
def posed(monkeypatch):
    """Makes a LinearisedScenes at Sums of scenes."""

    def slots(chosen, thetas, boxes, pixels, *, slopes, levels):
        order = np.random.default_rng(3).permutation(len(chosen))
        numbers = [c.number for c in chosen]
        counts = (1 + slopes * np.array([PARTS[i][2] for i in numbers]))[order]
        assert [len(t) for t in thetas] == [PARTS[i][2] for i in numbers]
        return Listed(
            order=order, numbers=numbers, n_images=counts, draw=lambda *_: None, boxes=boxes
        )

    def made(fit_sky, scenes=SEEN, slopes=True):
        monkeypatch.setattr(module, "ComponentBatch", slots)
        monkeypatch.setattr(module, "boxes_of", lambda chosen, thetas, t: t)
        monkeypatch.setattr(module, "pixels_of", lambda *_: 1)
        components = [
            SimpleNamespace(scene=b, index=i, number=k) for k, (b, i, *_) in enumerate(PARTS)
        ]
        sights = [Sums(c, k) for k, c in enumerate(CHANNELS)]
        host = SimpleNamespace(put=lambda values, dtype=None: np.asarray(values))
        one = LinearisedScenes(components, sights, N_SCENES, host, None, None, fit_sky=fit_sky)
        thetas = [np.zeros(n) for _, _, n, *_ in PARTS]
        one.render(scenes, thetas, 10.0 ** np.arange(6), slopes=slopes)
        assert [s.whitened for s in sights] == [1, 1]
        return one

    return made


def columns(one, b, channel):
    """Numbers of scene b's components, and of a channel their images (n, 5, P), root, data (P,),
    and the square root of the sky's precision."""
    own = [k for k, part in enumerate(PARTS) if part[0] == b]
    sight = one.sights[int(channel >= 2)]
    c = channel - sight.channels.start
    known = np.sqrt(sight.sky_precision[b, c])
    return own, sight.images[own][:, :, c], sight.root[b, c], sight.data[b, c], known


def with_pixel(values, of_level):
    """Images (..., P) with a pixel more, in which only a level of 1 is, by this value."""
    return np.concatenate([values, np.broadcast_to(of_level, (*values.shape[:-1], 1))], axis=-1)


@pytest.mark.parametrize("fit_sky", [False, True])
@pytest.mark.parametrize("error", [0.0, 0.1])
def test_spectra_are_each_scenes_least_squares(posed, fit_sky, error):
    """Not negative, but for the sky, which is expected to be 0 with its precision; under weights
    that follow the solution before."""
    one, rng = posed(fit_sky, slopes=False), np.random.default_rng(5)
    one.spectra[:], one.sky[:] = rng.uniform(0, 4, (6, 3)), rng.normal(size=(3, 3)) * fit_sky
    before = one.spectra.copy(), one.sky.copy()
    chi2, wanted_chi2 = one.compute_residuals(error), np.zeros(2)
    one.solve(error)
    assert one.normal.shape == (2, 3, 4, 4)
    for row, b in enumerate(SEEN):
        for channel in range(3):
            own, images, root, data, known = columns(one, b, channel)
            model = before[0][own, channel] @ images[:, 0] + before[1][b, channel] * root
            weight = with_pixel(1 / (1 + (error * model) ** 2), 1)
            images, root, data = (
                with_pixel(images, 0), with_pixel(root, known * fit_sky), with_pixel(data, 0)
            )  # fmt: skip
            model = with_pixel(model, before[1][b, channel] * known * fit_sky)
            wanted_chi2[row] += (weight * (data - model) ** 2).sum()
            a = np.concatenate([images[:, 0], root[None][: int(fit_sky)]]) * np.sqrt(weight)
            low = np.where(np.arange(len(a)) < len(own), 0, -np.inf)
            seen = a.any(axis=1)
            best = np.zeros(len(a))
            limits = low[seen], np.inf
            best[seen] = lsq_linear(a[seen].T, data * np.sqrt(weight), limits, tol=1e-14).x
            np.testing.assert_allclose(one.spectra[own, channel], best[: len(own)], atol=2e-6)
            level = best[len(own)] if fit_sky else 0
            assert one.sky[b, channel] == pytest.approx(level, abs=2e-6)
            full = np.concatenate([images[:, 0], root[None]]) * np.sqrt(weight)
            at = np.r_[: len(own), 3]
            np.testing.assert_allclose(
                one.normal[row, channel][np.ix_(at, at)], full @ full.T, atol=1e-9
            )
            np.testing.assert_allclose(
                one.right[row, channel][at], full @ (data * np.sqrt(weight)), atol=1e-7
            )
            if seen.all():
                known = np.linalg.inv((a @ a.T) * (1 + 1e-8 * np.eye(len(a))))[: len(own)]
                found = one.covariance(row)[channel]
                np.testing.assert_allclose(found, known[:, : len(own)], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(chi2, wanted_chi2)
    aside = one.scene == 1
    np.testing.assert_array_equal(one.spectra[aside], before[0][aside])
    np.testing.assert_array_equal(one.sky[1], before[1][1])


@pytest.mark.parametrize("size, portion", [(1.0, 1 << 25), (1e-3, 1 << 25), (1.0, 1)])
@pytest.mark.parametrize("fit_sky", [False, True])
def test_parameters_have_the_normal_equations_of_gauss_and_newton(
    posed, fit_sky, size, portion, monkeypatch
):
    """Changes by a step of the parameters after lit spectra and sky levels have followed it.

    Slopes that a component does not have are 0. Images of unit integral are far smaller than a
    level of 1, whose curvature is no measure of theirs. Channels come together or one by one.
    """
    monkeypatch.setattr(spectra_module, "PORTION_BYTES", portion)
    one, rng, error = posed(fit_sky), np.random.default_rng(6), 0.1
    for sight in one.sights:
        sight.images *= size
    one.spectra[:] = rng.uniform(0.1, 4, (6, 3)) / size
    one.sky[:] = rng.normal(size=(3, 3)) * fit_sky
    one.spectra[1, 2] = 0  # at its bound
    one.compute_residuals(error)
    normal, right = normal_equations(one)
    for row, b in enumerate(SEEN):
        n_own = sum(part[0] == b for part in PARTS)
        matrix, side = np.zeros((4 * n_own,) * 2), np.zeros(4 * n_own)
        for channel in range(3):
            own, images, root, data, known = columns(one, b, channel)
            a = one.spectra[own, channel]
            model = a @ images[:, 0] + one.sky[b, channel] * root
            weight = with_pixel(1 / (1 + (error * model) ** 2), 1)
            images, root, data = with_pixel(images, 0), with_pixel(root, known), with_pixel(data, 0)
            model = with_pixel(model, one.sky[b, channel] * known)
            used = np.arange(4) < np.array([PARTS[i][2] for i in own])[:, None]
            slopes = (a[:, None, None] * images[:, 1:] * used[..., None]).reshape(4 * n_own, -1)
            lit = np.concatenate([images[a > 0, 0], root[None][: int(fit_sky)]])
            inner = (lit * weight) @ lit.T
            spectra = np.arange(len(lit)) < len(lit) - fit_sky
            inner += RIDGE * np.trace(inner[np.ix_(spectra, spectra)]) * np.diag(spectra)
            solved = np.linalg.solve(inner, (lit * weight) @ slopes.T)
            matrix += (slopes * weight) @ slopes.T - ((lit * weight) @ slopes.T).T @ solved
            rest = weight * (data - model)
            side += slopes @ rest - solved.T @ (lit @ rest)
        k, most = 4 * n_own, np.abs(matrix).max()
        np.testing.assert_allclose(normal[row, :k, :k], matrix, atol=1e-8 * most)
        np.testing.assert_allclose(right[row, :k], side, atol=1e-8 * np.abs(side).max())
        assert (
            not normal[row, k:].any() and not normal[row, :, k:].any() and not right[row, k:].any()
        )


def test_light_as_each_profile_sees_it(posed):
    """<u, d - sky> / |u|, 0 where a profile is not seen or its scene is not looked at."""
    one, sky = posed(True, slopes=False), np.random.default_rng(7).normal(size=(3, 3))
    one.spectra[:] = 3.0
    for sight in one.sights:
        sight.images *= 1e-2
    found, wanted = one.signal_to_noise(sky), np.zeros((6, 3))
    for b in SEEN:
        for channel in range(3):
            own, images, root, data, _ = columns(one, b, channel)
            for k, u in zip(own, images[:, 0], strict=True):
                if u.any():
                    rest = data - sky[b, channel] * root
                    wanted[k, channel] = u @ rest / np.linalg.norm(u)
    assert (wanted == 0).sum() == 3 + 1
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_each_component_is_drawn_as_far_as_its_own_brightness_reaches(posed):
    """Boxes are asked for at thresholds of 0.01 of the noise over what is seen of the peak."""
    one = posed(False, scenes=[2])
    assert one.slots.numbers == [4, 5] and sorted(one.at) == [4, 5]
    np.testing.assert_allclose(one.slots.boxes, [1e-6, 1e-6])
    one = posed(False, scenes=[1, 0])
    np.testing.assert_allclose(one.slots.boxes, [2e-3, 1e-3, 1e-4, 1e-5])
    assert one.rows.tolist() == [[1, 0][one.scene[i]] for i in one.at]


@pytest.mark.parametrize("counts", [(2,), (2, 1, 3)])
def test_channels_of_observations_follow_each_other(monkeypatch, counts):
    """Each observation of all scenes in one Sight; of as many channels as their data have."""
    made = []
    monkeypatch.setattr(
        module, "SlotObservation", lambda *given: made.append(given) or SimpleNamespace()
    )
    monkeypatch.setattr(module, "LinearisedScenes", lambda *given, fit_sky: given)
    monkeypatch.setattr(module.Tuning, "of", lambda *given: given)
    op = SimpleNamespace(device="here", dtype="float32")
    views = [[SimpleNamespace(op=op, data=np.zeros((n, 4, 5))) for n in counts] for _ in range(2)]
    module.linearise(views, [], "precision", 0.1, fit_sky=True)
    ends = np.cumsum([0, *counts]).tolist()
    for k, (own, channels, *rest) in enumerate(made):
        assert own == [scene[k] for scene in views] and channels == slice(ends[k], ends[k + 1])
        assert rest == ["here", "float32", ("here", "float32"), "precision", 0.1]
    assert len(made) == len(counts)
