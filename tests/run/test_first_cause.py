"""What comes first: a watcher that makes the bench safe, or a hold, while a call is under way that
fails because of it. The reader is a real thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from rig.bench.settings import FixtureSettings, HoldLimits
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError, RigError
from rig.instruments.roles import ForceFrames
from rig.run.arming import SHUTDOWN_DEADLINE_S
from rig.run.context import Run
from rig.run.holds import HoldError
from rig.run.trip import TripError

PATIENCE_S = 30.0
LIMIT_N = 10.0
REFUSED = InstrumentError("stage_z", "move", "the axis was made safe meanwhile")
UNHEARD = InstrumentTimeoutError("daq", "WAV:DATA?", "no answer within 3 s")


class Sensor:
    """A force sensor that delivers what it is given, once."""

    bytes_consumed = 0
    frames_behind = 0.0

    def __init__(self) -> None:
        self.coming: list[ForceFrames] = []

    def start(self, rate_S_s: float) -> float:
        return rate_S_s

    def read(self) -> ForceFrames | None:
        return self.coming.pop() if self.coming else None

    def stop(self) -> None:
        pass


@pytest.fixture
def sensor() -> Sensor:
    return Sensor()


@pytest.fixture
def run(sensor: Sensor) -> Iterator[Run]:
    """A run with nothing but a clock and a force sensor."""
    slow = SimpleNamespace(settings=SimpleNamespace(timeout_s=2.0))
    plan = SimpleNamespace(
        instruments=(
            SimpleNamespace(role="stage_z", settings=slow.settings, driver=None),
            SimpleNamespace(role="daq", settings=SimpleNamespace(), driver=None),
        ),
        settings=SimpleNamespace(
            name="bench",
            interlock=(),
            holds=HoldLimits(),
            simulation={},
            film=None,
            skin=None,
            fixture=FixtureSettings(mounted="plate"),
        ),
    )
    bench = SimpleNamespace(
        clock=WallClock(), force_sensor=sensor, plan=plan, settings=plan.settings
    )
    made = Run(None, bench, None, {}, bench.clock.now())  # type: ignore[arg-type]
    yield made
    made.arming.make_safe()


def felt(force_N: float, saturated: bool = False) -> ForceFrames:
    force = np.array([[0.0, 0.0, force_N]])
    return ForceFrames(0, force.astype(np.float32), force, np.array([saturated]))


@pytest.mark.parametrize(
    ("frames", "kind", "reported"),
    [
        (felt(2 * LIMIT_N), TripError, "force along z of 20 N is over the limit of 10 N"),
        (felt(1.0, saturated=True), InstrumentError, "1 of 1 frames are saturated"),
    ],
    ids=["over the limit", "saturated"],
)
def test_the_cause_of_making_safe_is_reported_and_not_the_move_that_it_refused(
    run: Run, sensor: Sensor, frames: ForceFrames, kind: type[RigError], reported: str
) -> None:
    acting, stopped = threading.Event(), threading.Event()

    def stop() -> None:
        acting.set()
        stopped.wait(PATIENCE_S)
        raise InstrumentError("stage_z", "make safe", "did not accept the stop")

    run.stream_force(1000.0).watch(LIMIT_N)
    run.arm("stage", lambda: None, emergency=stop)
    sensor.coming.append(frames)
    assert acting.wait(PATIENCE_S)
    threading.Timer(0.05, stopped.set).start()
    with pytest.raises(kind, match=reported) as caught, run.first_cause():
        raise REFUSED
    assert "not stopped at once: stage: stage_z: make safe" in str(caught.value)


def test_a_hold_that_came_and_went_explains_that_an_instrument_was_not_heard(run: Run) -> None:
    run.holds.begin("paused")
    run.holds.end("paused")
    with pytest.raises(HoldError, match="paused"), run.first_cause():
        raise UNHEARD


def test_a_hold_explains_no_refusal(run: Run) -> None:
    run.holds.begin("paused")
    with pytest.raises(InstrumentError, match="made safe meanwhile"), run.first_cause():
        raise REFUSED


def test_without_a_hold_an_instrument_that_is_not_heard_has_failed(run: Run) -> None:
    with pytest.raises(InstrumentTimeoutError), run.first_cause():
        raise UNHEARD


def test_an_off_has_the_time_to_meet_what_is_wrong_with_its_link(run: Run) -> None:
    """To reconnect and to wait for the answer, 2 s each: what it says then is reported, not that it
    took long."""
    run.arm("generator output", lambda: None)
    ((name, deadline_s),) = [(armed.name, armed.deadline_s) for armed in run.arming._armed]
    assert (name, deadline_s) == ("generator output", SHUTDOWN_DEADLINE_S + 4.0)
