"""Blends dealt to two processes come out as from one device."""

from dataclasses import replace

import numpy as np
import pytest

from clresample import ExtendedSource, Settings, deblend_many, get_device, list_devices
from clresample.cli.device_tools.workload import RenderWorkload, blends
from clresample.deblending.blend import Failure

SETTINGS = Settings(max_iter=6)


def test_results_are_those_of_one_device(device):
    """To rounding: in batches of other sizes second fits start equal to 1e-13, and the solver's
    blocks, which are made of that in float32, to 1e-7. After six iterations that is 4e-7 of the
    losses and 2e-6 of the morphologies; where all is float32, 2e-5 of the spectra."""
    dtype, rtol = (np.float64, 1e-5) if device.has_fp64 else (np.float32, 1e-4)
    given = blends(4, device)
    outside = (ExtendedSource(position_px=(1e4, 1e4)),)
    given[2] = replace(given[2], sources=outside)  # harms no other
    done = []
    fit = {"settings": SETTINGS, "dtype": dtype}
    together = deblend_many(given, device=[device, device], progress=done.append, **fit)
    alone = deblend_many(given, device=device, **fit)
    assert done[-1] == 4
    assert [type(r) for r in together] == [type(r) for r in alone]
    assert isinstance(together[2], Failure) and together[2].reason == alone[2].reason
    for one, other in zip(together, alone):
        if not isinstance(one, Failure):
            assert one.status == other.status
            np.testing.assert_allclose(one.losses, other.losses, rtol=rtol)
            for a, b in zip(one.components, other.components):
                np.testing.assert_allclose(a.morphology, b.morphology, rtol=0, atol=rtol)
                atol = rtol * np.abs(b.spectrum).max()  # a channel may have hardly any light
                np.testing.assert_allclose(a.spectrum, b.spectrum, rtol=0, atol=atol)


@pytest.fixture
def unlike():
    """One device of each name."""
    found = {info.name: info.index for info in list_devices()}
    if len(found) < 2:
        pytest.skip("one device here")
    return [get_device(index) for index in found.values()]


def test_unlike_devices_agree(unlike):
    """Soon after the start. These sources overlap at a signal to noise of a thousand: data that
    differ by 1e-7 change losses by up to 3e-3 on one device too, and by 2e-2 after six iterations.
    """
    settings = Settings(max_iter=3)
    given = blends(6, unlike[0])
    together = deblend_many(given, settings=settings, device=unlike)
    alone = deblend_many(given, settings=settings, device=unlike[0])
    for one, other in zip(together, alone):
        np.testing.assert_allclose(one.losses[-1], other.losses[-1], rtol=1e-2)


def test_unlike_devices_work_side_by_side_in_one_process(unlike):
    """Operators whose launches alternate, each with what the other renders."""
    ops = [RenderWorkload(device).op for device in unlike]
    x = np.random.default_rng(0).standard_normal(ops[0].shape_in)
    truth = ops[0](x)
    for _ in range(3):
        arrays = [op.device.put(x, np.float32) for op in ops]
        seen = [op(array) for op, array in zip(ops, arrays)]
        back = [op.adjoint(array) for op, array in zip(ops, seen)]
        for op, y, again in zip(ops, seen, back):
            assert y.context == op.device.context
            y, again = op.device.get(y), op.device.get(again)
            assert np.linalg.norm(y - truth) < 1e-6 * np.linalg.norm(truth)
            assert abs(np.vdot(again, x) - np.vdot(y, y)) < 1e-5 * np.vdot(y, y)
