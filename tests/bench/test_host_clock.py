"""The calling thread's time by stages: exclusive, of one thread, and nothing stays replaced."""

import threading

from bench.harness.host import STAGES, HostClock, host_stages
from clresample.deblending import batch


def test_a_stage_leaves_out_those_inside_it_and_other_threads():
    now = iter(range(100))
    clock = HostClock(timer=lambda: next(now))
    with clock.stage("outer"):  # from 1 to 4
        with clock.stage("inner"):  # from 2 to 3
            pass
        other = threading.Thread(target=lambda: clock.stage("elsewhere").__enter__())
        other.start()
        other.join()
    assert clock.seconds == {"rest": 1, "outer": 2, "inner": 1}
    assert clock.calls == {"outer": 1, "inner": 1}
    assert clock.mean_s("outer", "inner") == 3


def test_functions_are_counted_while_it_lasts():
    before = batch.render_fits
    with host_stages({"render": STAGES["render"]}) as clock:
        assert batch.render_fits is not before
    assert batch.render_fits is before and set(clock.seconds) == {"rest"}


def test_every_stage_is_there():
    with host_stages() as clock:
        pass
    assert not set(clock.calls) - {"rest"}
