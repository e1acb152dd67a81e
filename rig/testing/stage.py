"""The scripts of the roles `stage_z` and `stage_x`, and of `rotary`.

They are written for an axis with 80 mm of travel and 500 mm/s, or 95 deg and 60 deg/s. For one with
less, all ways and speeds are smaller by one factor, so that they take the same time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rig.core.errors import LimitError
from rig.instruments.interfaces import INTERFACES
from rig.testing.raising import raising
from rig.testing.script import Role, Step, at_rest, near, refused, same

ARRIVED_mm = 0.02
TURNED_deg = 0.02
READ_BACK = 1e-3
"""Tolerance of a position or angle that is read back, in mm or deg."""
FED_s = 0.1
"""Shorter than a drive's communication time-out, and many of them longer."""
SPEEDING_UP_S = 0.3
"""Bench time within which an axis has to have come to the speed of a motion."""
SET_POINTS_Hz = 100.0


@dataclass(frozen=True)
class _Scale:
    """The ways and speeds of a script for one stage."""

    low: float
    factor: float

    @classmethod
    def of(cls, stage: Any) -> _Scale:
        """Return the scale of a linear stage, which may go where its `limits` says."""
        position, speed = stage.limits()["position"], stage.limits()["speed"]
        way = position.high - position.low
        return cls(position.low, min(1.0, way / 80.0, speed.high / 500.0))

    @classmethod
    def of_rotary(cls, stage: Any) -> _Scale:
        """Return the scale of a rotary stage."""
        limits = stage.limits()
        way = limits["angle"].high - limits["angle"].low
        shares = (way / 95.0, limits["speed"].high / 60.0, limits["acceleration"].high / 1000.0)
        return cls(limits["angle"].low + 5.0 * min(1.0, *shares), min(1.0, *shares))

    def at(self, position: float) -> float:
        """Return the position or angle on this stage."""
        return self.low + self.factor * position

    def __call__(self, value: float) -> float:
        """Return the way, speed or acceleration on this stage."""
        return self.factor * value


def _reaches(service: Any, speed: float, what: str) -> None:
    """Let bench time pass until the axis has a speed, which is signed; fail where it has not within
    SPEEDING_UP_S."""
    deadline = service.now_s() + SPEEDING_UP_S
    while abs(service.truth("speed") - speed) > 1e-3 * abs(speed) and service.now_s() < deadline:
        service.sleep(0.01)
    near(f"the speed of {what}", service.truth("speed"), speed, 1e-3 * abs(speed), "per second")


def _arrives(stage: Any, service: Any, within_s: float = 5.0) -> None:
    deadline = service.now_s() + within_s
    while stage.moving():
        assert service.now_s() < deadline, f"moving() is true for {within_s:g} s: it never arrives"
        service.sleep(0.02)


# --- linear ----------------------------------------------------------------------------------


def _homed(stage: Any, service: Any) -> None:
    same("homed()", stage.homed(), service.truth("homed"))


def _home(stage: Any, service: Any) -> None:
    """Home the axis, after a move away from the reference if it is homed already. At the reference,
    homing takes no time on the simulated drive, and a drive that reported "homed" before does not
    show whether homing has begun. The driver then reports an error."""
    if service.truth("homed"):
        stage.stop()
        scale = _Scale.of(stage)
        stage.move_to(scale.at(10.0), scale(200.0))
    stage.home()
    assert service.truth("homed"), "home() has returned and the axis is not homed"
    at_rest(service, "after home()")


def _position(stage: Any, service: Any) -> None:
    near("position_mm()", stage.position_mm(), service.truth("position"), READ_BACK, "mm")


def _move_to(position: float, speed: float) -> Step:
    def act(stage: Any, service: Any) -> None:
        scale = _Scale.of(stage)
        stage.move_to(scale.at(position), scale(speed))
        near(
            "the position after move_to()",
            service.truth("position"),
            scale.at(position),
            ARRIVED_mm,
            "mm",
        )
        at_rest(service, "after move_to()")

    return Step(f"move_to({position:g}, {speed:g})", act)


def _retarget(stage: Any, service: Any) -> None:
    """Check that a motion that is changed under way ends at its new target, without a stop
    between."""
    scale = _Scale.of(stage)
    stage.start_move(scale.at(70.0), scale(100.0))
    service.sleep(0.02)
    assert stage.moving(), "moving() is false during a motion"
    up = service.truth("position") < scale.at(70.0)
    _reaches(service, scale(100.0) * (1 if up else -1), "a motion")
    stage.start_move(scale.at(60.0), scale(400.0))
    _arrives(stage, service)
    reached = service.truth("position")
    near("the position after a changed target", reached, scale.at(60.0), ARRIVED_mm, "mm")


def _stop(stage: Any, service: Any) -> None:
    scale = _Scale.of(stage)
    stage.start_move(scale.at(5.0), scale(50.0))
    service.sleep(0.05)
    assert service.truth("speed") != 0, "the axis does not move after start_move()"
    stage.stop()
    at_rest(service, "after stop()")
    way = abs(service.truth("position") - scale.at(5.0))
    assert way > scale(1.0), "stop() has let the motion go to its end"
    assert not stage.moving(), "moving() is true after stop()"


def _keep_alive(stage: Any, service: Any) -> None:
    """Check that the axis continues while only keep-alives are sent."""
    scale = _Scale.of(stage)
    stage.start_move(scale.at(5.0), scale(10.0))
    before = service.truth("position")
    for _ in range(10):
        service.clock.sleep(FED_s)
        stage.keep_alive()
        near("the speed, fed", service.truth("speed"), -scale(10.0), scale(0.1), "mm/s")
    went = abs(service.truth("position") - before)
    assert went > scale(9.0), f"the axis went {went:g} mm of {scale(10.0):g} mm, fed as it was"
    stage.stop()


def _no_timeout(stage: Any, service: Any) -> None:
    """Check that a drive without a fault has none to acknowledge, and stays at rest."""
    same("acknowledge_timeout() without a time-out", stage.acknowledge_timeout(), False)
    at_rest(service, "after acknowledge_timeout()")


def _move_beyond(stage: Any, service: Any) -> None:
    stage.stop()
    scale, limits = _Scale.of(stage), stage.limits()
    inside, slowly = scale.at(40.0), scale(10.0)
    beyond = limits["position"].high + 1.0, limits["speed"].high + 1.0
    for position_mm, speed_mm_s in ((beyond[0], slowly), (inside, beyond[1]), (inside, 0.0)):
        with raising(LimitError, f"start_move({position_mm:g}, {speed_mm_s:g}), beyond limits()"):
            stage.start_move(position_mm, speed_mm_s)
    at_rest(service, "after motions that were refused")


def _rest_from_motion(stage: Any, service: Any) -> None:
    stage.stop()  # also what lets an axis that was made safe move again
    scale = _Scale.of(stage)
    stage.start_move(scale.at(20.0), scale(20.0))
    service.sleep(0.05)
    _rest_stage(stage, service)


def _rest_stage(stage: Any, service: Any) -> None:
    """Check that `make_safe` returns before the axis is at rest: a watcher may call it while the
    bench's clock stands still."""
    before = service.now_s()
    stage.make_safe()
    stage.make_safe()
    same("the bench time after make_safe(), which may not wait for it,", service.now_s(), before)
    service.sleep(0.2)
    at_rest(service, "0.2 s after make_safe()")
    stage.stop()


def _move_unhomed(stage: Any, service: Any) -> None:
    if service.truth("homed"):
        return  # an absolute encoder
    assert not stage.homed(), "homed() is true of an axis that is not"
    scale = _Scale.of(stage)
    for act in (stage.start_move, stage.move_to):
        move = partial(act, scale.at(10.0), scale(10.0))
        refused(service, move, "a motion before homing", "homed")


def _move_after_make_safe(stage: Any, service: Any) -> None:
    """Check that a procedure cannot set the axis in motion again after its watcher has stopped
    it."""
    _excite_stage(stage, service)
    scale = _Scale.of(stage)
    stage.make_safe()
    move = partial(stage.start_move, scale.at(60.0), scale(10.0))
    refused(service, move, "a motion after make_safe()", "made safe")
    refused(service, stage.home, "homing after make_safe()", "made safe")
    stage.stop()
    stage.move_to(scale.at(10.0), scale(100.0))
    reached = service.truth("position")
    near("the position after stop() and move_to()", reached, scale.at(10.0), ARRIVED_mm, "mm")


def _excite_stage(stage: Any, service: Any) -> None:
    scale = _Scale.of(stage)
    stage.home()
    stage.start_move(scale.at(70.0), scale(10.0))
    _reaches(service, scale(10.0), "a motion")


def _fed(stage: Any, service: Any) -> Callable[[], None]:
    leave: Callable[[], None] = service.clock.each_slice(stage.keep_alive)
    return leave


STAGE = Role(
    *INTERFACES["stage_z"],
    (
        Step("homed() at first", _homed),
        Step("home()", _home),
        Step("homed()", _homed),
        _move_to(20, 200),
        Step("position_mm()", _position),
        Step("start_move() under way", _retarget),
        _move_to(40, 400),
        Step("stop()", _stop),
        Step("acknowledge_timeout()", _no_timeout),
        Step("keep_alive()", _keep_alive),
        Step("start_move() beyond limits()", _move_beyond),
        Step("make_safe() in motion", _rest_from_motion),
        _move_to(10, 200),
        Step("make_safe()", _rest_stage),
    ),
    excite=_excite_stage,
    attend=_fed,
    apart=(
        Step("a move before homing", _move_unhomed),
        Step("a move after make_safe()", _move_after_make_safe),
    ),
)

# --- rotary ----------------------------------------------------------------------------------


def _home_rotary(stage: Any, service: Any) -> None:
    stage.home()
    assert service.truth("homed"), "home() has returned and the stage is not homed"
    assert stage.homed(), "homed() is false after home()"
    at_rest(service, "after home()")


def _turn(stage: Any, scale: _Scale, angle: float, speed: float, acceleration: float) -> None:
    stage.turn_to(scale.at(angle), scale(speed), scale(acceleration))


def _turned(service: Any, scale: _Scale, angle: float, what: str) -> None:
    near(f"the angle after {what}", service.truth("angle"), scale.at(angle), TURNED_deg, "deg")


def _turn_to(angle: float, speed: float) -> Step:
    def act(stage: Any, service: Any) -> None:
        scale = _Scale.of_rotary(stage)
        _turn(stage, scale, angle, speed, 500.0)
        _turned(service, scale, angle, "turn_to()")
        at_rest(service, "after turn_to()")

    return Step(f"turn_to({angle:g}, {speed:g})", act)


def _angle(stage: Any, service: Any) -> None:
    near("angle_deg()", stage.angle_deg(), service.truth("angle"), READ_BACK, "deg")


def _returned(stage: Any, service: Any) -> None:
    """Check speed and angle on a way there and back, on which the stage makes the trapezoid."""
    scale = _Scale.of_rotary(stage)
    _turn(stage, scale, 10.0, 50.0, 500.0)
    for end, sign in ((13.5, 1.0), (10.0, -1.0)):
        begun_s, begun_deg = service.now_s(), service.truth("angle")
        stage.start_turn(scale.at(end), scale(5.0), scale(20.0))
        service.sleep(0.45)
        assert stage.moving(), "moving() is false during a turn"
        near("the speed of a turn", service.truth("speed"), sign * scale(5.0), scale(0.05), "deg/s")
        passed_s = service.now_s() - begun_s
        turned = (service.truth("angle") - begun_deg) * sign
        near("the turn so far", turned, scale(5.0) * (passed_s - 0.125), scale(0.02), "deg")
        _arrives(stage, service)
        took_s = service.now_s() - begun_s
        least_s = 3.5 / 5.0 + 5.0 / 20.0 - 0.05
        assert took_s > least_s, f"a turn of {least_s:g} s took {took_s:g} s"
        _turned(service, scale, end, "start_turn()")


def _streamed(stage: Any, service: Any) -> None:
    """Send a profile as data: every 10 ms a set point two steps ahead, at the profile's speed.
    Check that the stage follows without a stop, and ends at the last one."""
    scale = _Scale.of_rotary(stage)
    _turn(stage, scale, 10.0, 50.0, 500.0)
    slowest = stage.limits()["speed"].low
    step_s = 1 / SET_POINTS_Hz
    profile = 10.0 + 3.5 * np.sin(np.pi / 2 * np.clip(step_s * np.arange(103), 0.0, 1.0)) ** 2
    for k in range(100):
        ahead = float(profile[k + 2])
        speed = max(ahead - float(profile[k]), 0.0) / (2 * step_s)
        stage.start_turn(scale.at(ahead), max(scale(speed), slowest), scale(1000.0))
        service.sleep(step_s)
        wanted = scale.at(float(profile[k + 1]))
        near(f"the angle at set point {k}", service.truth("angle"), wanted, 0.05, "deg")
        if 5 <= k < 95:
            assert service.truth("speed") > 0, f"the stage stands at set point {k}"
    _arrives(stage, service)
    _turned(service, scale, 13.5, "the last set point")


def _stop_rotary(stage: Any, service: Any) -> None:
    scale = _Scale.of_rotary(stage)
    # After a fault this is done again, and the stage may have arrived meanwhile.
    ends = (scale.at(5.0), scale.at(0.0))
    end = max(ends, key=lambda angle: abs(service.truth("angle") - angle))
    stage.start_turn(end, scale(20.0), scale(500.0))
    service.sleep(0.05)
    assert service.truth("speed") != 0, "the stage does not turn after start_turn()"
    stage.stop()
    at_rest(service, "after stop()")
    way = abs(service.truth("angle") - end)
    assert way > scale(1.0), "stop() has let the turn go to its end"
    assert not stage.moving(), "moving() is true after stop()"


def _keep_alive_rotary(stage: Any, service: Any) -> None:
    """Check that the stage continues while only keep-alives are sent."""
    scale = _Scale.of_rotary(stage)
    stage.start_turn(scale.at(5.0), scale(5.0), scale(500.0))
    before = service.truth("angle")
    for _ in range(5):
        service.clock.sleep(FED_s)
        stage.keep_alive()
        near("the speed, fed", abs(service.truth("speed")), scale(5.0), scale(0.05), "deg/s")
    went = abs(service.truth("angle") - before)
    assert went > scale(2.0), f"the stage turned {went:g} deg of {scale(2.5):g} deg, fed as it was"
    stage.stop()


def _turn_beyond(stage: Any, service: Any) -> None:
    stage.stop()
    scale = _Scale.of_rotary(stage)
    angle, speed, acceleration = (
        stage.limits()[quantity].high for quantity in ("angle", "speed", "acceleration")
    )
    inside, slowly, gently = scale.at(10.0), scale(5.0), scale(100.0)
    for asked in (
        (angle + 1.0, slowly, gently),
        (inside, speed + 1.0, gently),
        (inside, 0.0, gently),
        (inside, slowly, acceleration + 1.0),
        (inside, slowly, 0.0),
        (float("nan"), slowly, gently),
    ):
        with raising(LimitError, f"start_turn{asked}, beyond limits()"):
            stage.start_turn(*asked)
    at_rest(service, "after turns that were refused")


def _rest_from_turn(stage: Any, service: Any) -> None:
    stage.stop()  # also what lets a stage that was made safe turn again
    scale = _Scale.of_rotary(stage)
    stage.start_turn(scale.at(20.0), scale(20.0), scale(500.0))
    service.sleep(0.05)
    _rest_stage(stage, service)


def _turn_unhomed(stage: Any, service: Any) -> None:
    if service.truth("homed"):
        return  # an absolute encoder
    assert not stage.homed(), "homed() is true of a stage that is not"
    scale = _Scale.of_rotary(stage)
    for act in (stage.start_turn, stage.turn_to):
        turn: Callable[[], None] = partial(act, scale.at(10.0), scale(10.0), scale(100.0))
        refused(service, turn, "a turn before homing", "homed")


def _turn_after_make_safe(stage: Any, service: Any) -> None:
    """Check that a procedure cannot set the stage in motion again after its watcher has stopped
    it."""
    _excite_rotary(stage, service)
    scale = _Scale.of_rotary(stage)
    stage.make_safe()
    turn = partial(stage.start_turn, scale.at(60.0), scale(10.0), scale(100.0))
    refused(service, turn, "a turn after make_safe()", "made safe")
    refused(service, stage.home, "homing after make_safe()", "made safe")
    stage.stop()
    _turn(stage, scale, 10.0, 50.0, 500.0)
    _turned(service, scale, 10.0, "stop() and turn_to()")


def _excite_rotary(stage: Any, service: Any) -> None:
    scale = _Scale.of_rotary(stage)
    stage.home()
    stage.start_turn(scale.at(70.0), scale(10.0), scale(500.0))
    _reaches(service, scale(10.0), "a turn")


ROTARY = Role(
    *INTERFACES["rotary"],
    (
        Step("homed() at first", _homed),
        Step("home()", _home_rotary),
        Step("homed()", _homed),
        _turn_to(20, 50),
        Step("angle_deg()", _angle),
        Step("start_turn() there and back", _returned),
        Step("start_turn() in a stream", _streamed),
        Step("stop()", _stop_rotary),
        Step("keep_alive()", _keep_alive_rotary),
        Step("start_turn() beyond limits()", _turn_beyond),
        Step("make_safe() in motion", _rest_from_turn),
        _turn_to(10, 50),
        Step("make_safe()", _rest_stage),
    ),
    excite=_excite_rotary,
    attend=_fed,
    apart=(
        Step("a turn before homing", _turn_unhomed),
        Step("a turn after make_safe()", _turn_after_make_safe),
    ),
)
