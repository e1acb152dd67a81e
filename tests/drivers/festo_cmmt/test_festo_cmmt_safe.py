"""The CMMT driver makes its drive safe, whatever else happens."""

from __future__ import annotations

import threading
import time

import pytest
from simulated.axis_bench import AxisBench
from stages.festo import break_wire, service

from drivers.festo_cmmt import driver as festo_cmmt
from rig.core.errors import InstrumentError, InstrumentTimeoutError


def test_an_axis_that_is_made_safe_keeps_its_power() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        it.clock.sleep(0.5)
        axis.make_safe()
        it.bench.now_us += 210_000
        assert it.speed == 0
        assert it.drive.enabled, "a vertical axis hangs by its power"


def test_what_fails_in_one_thread_leaves_another_its_new_connection() -> None:
    """A link that broke is closed before the next request opens it anew, not after."""
    with service({"kind": "close", "command": "read 100", "at": 20}) as it:
        axis = it.homed()
        ended: list[object] = []

        def look() -> None:
            for _ in range(40):
                try:
                    ended.append(axis.position_mm())
                except InstrumentError as error:
                    ended.append(error)

        threads = [threading.Thread(target=look) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sum(isinstance(result, InstrumentError) for result in ended) <= 1


def test_making_a_drive_without_power_safe_does_not_switch_it_on() -> None:
    with service() as it:
        axis = it.connect()
        axis.make_safe()
        axis.stop()
        it.clock.sleep(1)
        assert not it.drive.enabled


def test_make_safe_gets_through_on_a_second_connection() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        it.clock.sleep(0.5)
        break_wire(it, kind="close")
        axis.make_safe()
        it.bench.now_us += 210_000
        assert it.speed == 0
        assert it.drive.fault == 0


@pytest.mark.thorough
def test_make_safe_that_does_not_get_through_says_so_after_one_time_out() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        break_wire(it, kind="silence", count=0)
        before = len(it.wire.said)
        with pytest.raises(InstrumentTimeoutError, match="no answer"):
            axis.make_safe()
        (said,) = it.wire.said[before:]
        assert said.startswith("write 0: 042f"), "it was said all the same, and once"


class RealTime:
    """A bench whose time passes by itself from where another's stands."""

    def __init__(self, bench: AxisBench):
        self._shift = bench.now_us - time.monotonic_ns() // 1000
        self.log, self.load_N = bench.log, bench.load_N

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000 + self._shift


def test_the_modules_make_safe_waits_for_rest_beside_a_live_connection() -> None:
    with service(communication_timeout_ms=5000, max_speed_mm_s=200.0) as it:
        axis = it.homed()
        axis.start_move(70.0, 10.0)
        it.drive._port = port = RealTime(it.bench)
        festo_cmmt.make_safe(it.settings)
        festo_cmmt.make_safe(it.settings)
        assert it.drive.velocity_mm_s(port.now_us) == 0
        assert it.drive.enabled
