"""Kernels of one formula each against NumPy, on builds for CPUs and for GPUs.

Terms and spectra, windows, turned spectra; in buffers that reveal elements that were not written.
"""

import numpy as np
import pytest
from helpers.buffers import Guards, fill_with_nan
from helpers.solver import close, every_type

from clresample.deblending.solver.boxes import ALIGN
from clresample.device.tuning import Tuning


@pytest.fixture
def queue(build, monkeypatch):
    """Queues a kernel by its file, name and number of pixels (x, y, items).

    NumPy arrays are arguments by name; `get` returns them after the kernel.
    """
    fill_with_nan(monkeypatch)
    guards = Guards(monkeypatch)

    def run(file, name, size, dtype, *, get, defines=(), **given):
        if dtype == np.float64 and not build.has_fp64:
            pytest.skip(f"{build.name} has no double precision")
        tuning = Tuning.of(build, dtype)
        launch = build.launcher(
            file,
            name,
            dtype=dtype,
            local_size=tuning.local_size(3),
            ROWS=tuning.row_loops,
            **({"WG": tuning.sum_group, "ALIGN": ALIGN} | dict(defines)),
        )
        arrays = {
            k: build.put(v, None if v.dtype.kind == "i" else dtype)
            for k, v in given.items()
            if isinstance(v, np.ndarray)
        }
        launch((1 if tuning.row_loops else size[0], *size[1:]), **(given | arrays))
        return build.get(arrays[get])

    yield run
    assert guards.overwritten() == []


def random(*shape, seed=0):
    return np.random.default_rng([seed, *shape]).normal(size=shape)


@every_type
def test_spectra_of_terms_and_back(queue, dtype):
    """Of an observation in the middle of all channels; of more sources than are launched."""
    n, n_bands, n_terms, n_channels, channel = 11, 3, 4, 6, 2
    shares, spectra = random(n, n_bands, n_terms), random(n, n_channels)
    own = spectra[:, channel : channel + n_bands, None]
    given = {
        "n_sources": n,
        "n_bands": n_bands,
        "n_terms": n_terms,
        "n_channels": n_channels,
        "channel": channel,
        "shares": shares,
    }
    for n_rows in (n, 4):
        parts = np.full(shares.shape, np.nan)
        found = queue(
            "scene.cl", "split_spectra", (n_bands, n_rows, 1), dtype,
            get="parts", defines={"VW": 4}, **given, spectra=spectra, parts=parts,
        )  # fmt: skip
        close(found, own * shares, dtype)
        parts = random(*shares.shape, seed=1)
        found = queue(
            "scene.cl", "merge_spectra", (n_bands, n_rows, 1), dtype,
            get="spectra", defines={"VW": 4}, **given, spectra=spectra, parts=parts,
        )  # fmt: skip
        wanted = spectra.copy()
        wanted[:, channel : channel + n_bands] = (shares * parts).sum(axis=2)
        close(found, wanted, dtype)


@every_type
def test_squares(queue, dtype):
    image = random(3, 5, 37)
    given = {"my": 5, "mx": 37, "image": image}
    found = queue("scene.cl", "square", (37, 5, 3), dtype, get="image", defines={"VW": 4}, **given)
    close(found, image**2, dtype)


LOW = np.array([(2, 3), (-4, -5), (10, 30), (17, 1), (-9, 0), (0, 40), (5, -11), (3, 33), (12, 29)])
FIRST = np.array([0, 4, 4, 9])  # of three scenes, one of them without


def seen(windows, b, shape):
    """Windows (G, C, wy, wx) of scene b added up over its image, by slices."""
    wy, wx = windows.shape[2:]
    whole = np.zeros((windows.shape[1], shape[0] + 200, shape[1] + 200))
    for g in range(FIRST[b], FIRST[b + 1]):
        y, x = LOW[g] + 100
        whole[:, y : y + wy, x : x + wx] += windows[g]
    return whole[:, 100 : 100 + shape[0], 100 : 100 + shape[1]]


@every_type
@pytest.mark.parametrize("add", [0, 1])
def test_windows_are_put_together(queue, add, dtype):
    """Some of them wholly, some in part outside; over what is there, or added to it."""
    n_bands, shape, size = 2, (18, 40), (9, 11)
    windows, image = random(len(LOW), n_bands, *size), random(3, n_bands, *shape)
    wanted = add * image + np.array([seen(windows, b, shape) for b in range(3)])
    found = queue(
        "windows.cl", "add_windows", (shape[1], shape[0], 3 * n_bands), dtype, get="image",
        first=FIRST.astype(np.int32), low=LOW.astype(np.int32), n_bands=n_bands, my=shape[0],
        mx=shape[1], wy=size[0], wx=size[1], add=add, windows=windows, image=image,
    )  # fmt: skip
    close(found, wanted, dtype)


@every_type
def test_windows_are_cut_out(queue, dtype):
    """Pixels beyond are 0; the transpose of assembling them."""
    n_bands, shape, size = 2, (18, 40), (9, 11)
    image, scene = random(3, n_bands, *shape), np.repeat([0, 2], [4, 5]).astype(np.int32)
    wanted = np.zeros((len(LOW), n_bands, *size))
    for g, (y, x) in enumerate(LOW):
        padded = np.pad(image[scene[g]], [(0, 0), (60, 60), (60, 60)])
        wanted[g] = padded[:, 60 + y : 60 + y + size[0], 60 + x : 60 + x + size[1]]
    found = queue(
        "windows.cl", "cut_windows", (size[1], size[0], len(LOW) * n_bands), dtype, get="windows",
        scene=scene, low=LOW.astype(np.int32), n_bands=n_bands, my=shape[0], mx=shape[1],
        wy=size[0], wx=size[1], image=image, windows=np.full(wanted.shape, np.nan),
    )  # fmt: skip
    close(found, wanted, dtype)


def amplitudes(quads):
    """Cos and sin sums (..., 2Hy, 2Hx) as amplitudes at (+nu_y, +nu_x) and (+nu_y, -nu_x)."""
    cc, cs, sc, ss = (quads[..., i::2, j::2] for i in (0, 1) for j in (0, 1))
    return cc - ss - 1j * (cs + sc), cc + ss + 1j * (cs - sc)


def quads_of(plus, minus):
    """And back."""
    out = np.empty((*plus.shape[:-2], 2 * plus.shape[-2], 2 * plus.shape[-1]))
    out[..., 0::2, 0::2], out[..., 0::2, 1::2] = (plus + minus).real, (minus - plus).imag
    out[..., 1::2, 0::2], out[..., 1::2, 1::2] = -(plus + minus).imag, (minus - plus).real
    return out


def planes(d_plus, d_minus):
    """Transfer functions as the kernels take them: (..., Hy, 4, Hx)."""
    return np.stack([d_plus.real, d_plus.imag, d_minus.real, d_minus.imag], axis=-2)


@every_type
@pytest.mark.parametrize("n_terms", [1, 3])
@pytest.mark.parametrize("which", [None, [1, 0, 2, 2, 1, 0, 0, 1, 2]])
def test_spectra_are_turned_by_their_slots_offsets(queue, which, n_terms, dtype):
    """From one image of a slot to every band's, with the slot's own sum of the bands' terms, and
    where there are several plans with the transfer functions of its own."""
    h_y, h_x, n_bands, n, first = 5, 16, 2, 3, 2
    slots, items = 5, 9  # of which those from `first` on, n items each
    z0 = random(items, 2 * h_y, 2 * h_x)
    n_plans = 1 if which is None else 3
    shape = 2, n_plans, n_bands, n_terms, h_y, h_x
    d = random(*shape) + 1j * random(*shape, seed=1)
    which = np.zeros(items, np.int32) if which is None else np.array(which, np.int32)
    shares = random(slots, n_bands, n_terms) if n_terms > 1 else np.ones((slots, n_bands, 1))
    turn = np.exp(2j * np.pi * random(slots, h_y + h_x))
    found = queue(
        "terms.cl", "apply_transfer", (h_x, h_y + 1, items * n_bands), dtype, get="z",
        defines={"TERMS": n_terms}, h_y=h_y, n_pad=2 * h_x, n_bands=n_bands, n=n, first=first,
        z0=z0, phase=np.stack([turn.real, turn.imag], axis=-1), D=planes(*d), shares=shares,
        n_plans=n_plans, which=which, z=np.full((items * n_bands, 2 * h_y, 2 * h_x), np.nan),
    )  # fmt: skip
    plus, minus = amplitudes(z0)
    for item in range(items):
        slot = first + item // n
        y, x = turn[slot, :h_y, None], turn[slot, h_y:]
        d_plus, d_minus = np.einsum("ct,pctyx->pcyx", shares[slot], d[:, which[item]])
        wanted = quads_of(d_plus * y * x * plus[item], d_minus * y * x.conj() * minus[item])
        close(found[item * n_bands : (item + 1) * n_bands], wanted, dtype)


@every_type
def test_terms_are_added_and_spread(queue, dtype):
    h_y, h_x, n_bands, n_terms, n_plans = 3, 8, 2, 3, 2
    n = n_plans * n_bands
    terms, z = random(n, n_terms, 2 * h_y, 2 * h_x), random(n, 2 * h_y, 2 * h_x)
    given = {"n_terms": n_terms, "h_y": h_y, "n_pad": 2 * h_x, "terms": terms, "z": z}
    found = queue("terms.cl", "sum_terms", (h_x, h_y + 1, n), dtype, get="z", **given)
    close(found, terms.sum(axis=1), dtype)
    shape = 2, n_plans, n_bands, n_terms, h_y, h_x
    d = random(*shape) + 1j * random(*shape, seed=1)
    for stride, own in ((n_bands * n_terms * 4 * h_y * h_x, d), (0, d[:, [0, 0]])):
        table = planes(*d)
        found = queue(
            "terms.cl", "split_terms", (h_x, h_y + 1, n), dtype, get="terms", **given,
            n_bands=n_bands, D=table, stride_d=stride,
        )  # fmt: skip
        plus, minus = (f[:, None] for f in amplitudes(z))
        d_plus, d_minus = own.conj().reshape(2, n, n_terms, h_y, h_x)
        close(found, quads_of(d_plus * plus, d_minus * minus), dtype)
