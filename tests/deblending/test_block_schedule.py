"""Blocks of inverse curvature count a fixed number of rounds later, whenever they are made."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from clresample.deblending.solver.multiscale import block_schedule
from clresample.deblending.solver.multiscale.block_schedule import (
    BLOCK_DELAY_ROUNDS,
    BlockSchedule,
)

# Sources of two scenes; the second one is fixed.
SCENE = np.array([0, 0, 1, 1])


class Maker:
    """Says what its blocks were asked for, once it may."""

    def __init__(self, go):
        self.go = go

    def blocks(self, strengths, spectrum):
        assert self.go.wait(10)
        return [tuple(strengths), tuple(spectrum)]


@pytest.fixture(params=[1, 3])
def schedule(request, monkeypatch):
    monkeypatch.setattr(block_schedule, "host_threads", lambda _: request.param)
    go = threading.Event()
    makers = [Maker(go), None, Maker(go), Maker(go)]
    if request.param == 1:
        go.set()  # made at once, where there is one thread alone
    return SimpleNamespace(go=go, made=BlockSchedule(makers, SCENE, None))


def asked(schedule, sources, value, rounds):
    strengths, spectra = np.full((4, 2), float(value)), np.full((4, 1), -float(value))
    schedule.request(sources, strengths, spectra, np.array(rounds))
    strengths[:], spectra[:] = 99, 99  # what a block is for was said then
    return [(value, value), (-value,)]


def test_blocks_count_a_fixed_number_of_their_scenes_rounds_later(schedule):
    made, delay = schedule.made, BLOCK_DELAY_ROUNDS
    (none, *_), wanted = made.blocks, asked(made, [0, 2], 5, [7, 3])
    assert not made.take(np.array([6 + delay, 2 + delay])) and made.blocks == [none] * 4
    schedule.go.set()
    assert not made.take(np.array([6 + delay, 2 + delay]))  # not earlier, though they are there
    assert made.take(np.array([6 + delay, 3 + delay])) and made.blocks == [none, none, wanted, none]
    assert made.take(np.array([7 + delay, 3 + delay])) and made.blocks == [
        wanted,
        none,
        wanted,
        none,
    ]
    assert not made.take(np.array([70, 70]))


def test_blocks_are_waited_for_where_they_are_named_or_asked_for_again(schedule):
    made = schedule.made
    (none, *_), first = made.blocks, asked(made, [0, 3], 5, [7, 7])
    schedule.go.set()
    assert made.take(np.array([0, 0]), [3]) and made.blocks == [none, none, none, first]
    second = asked(made, [0], 6, [7, 7])
    assert made.blocks == [first, none, none, first]
    made.take(np.array([99, 99]))
    assert made.blocks[0] == second


def test_what_goes_on_alone_takes_its_blocks_when_it_would_have(schedule):
    (none, *_), wanted = schedule.made.blocks, asked(schedule.made, [0, 2, 3], 5, [7, 3])
    part = schedule.made.subset([3, 2], np.array([0, 0]))
    schedule.go.set()
    rounds = np.array([3 + BLOCK_DELAY_ROUNDS])
    assert not part.take(rounds - 1) and part.take(rounds)
    assert part.blocks == [wanted, wanted] and schedule.made.blocks == [none] * 4


def test_an_error_of_a_thread_is_raised_where_its_blocks_count(schedule):
    schedule.made._inverses[0] = SimpleNamespace(blocks=lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        asked(schedule.made, [0], 5, [7, 7])
        schedule.made.take(np.array([99, 99]))
