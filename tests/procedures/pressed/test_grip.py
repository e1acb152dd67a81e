"""A grip that answers alarms: when it does, when it does not, and what bounds it."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from procedures.path_trial.settings import PathTrialSettings
from procedures.pressed.axes import SentMove
from procedures.pressed.grip import Grip, GripSettings, grip_reading
from procedures.pressed.hold import ForceHold
from procedures.pressed.record.trial_record import TrialRecord
from procedures.slip_trial.settings import SlipTrialSettings
from rig.control.force_servo import ForceServo, settings_from
from rig.core.errors import InstrumentError, LimitError
from rig.files.journal.detections import SLIP, Detection

SET_N = 4.0


class Held:
    """A run under a held force, and what the grip asks of it."""

    def __init__(self, **changes: Any):
        self.now_s, self.older_s, self.shown_N = 2.0, 0.0, SET_N
        self.rises_N: list[float] = []
        self.events: list[tuple[str, str]] = []
        self.warnings: list[str] = []
        self.tripped = False
        self.settings = GripSettings(regrip=True, **changes)
        self.record = TrialRecord(1, 100.0, 1000.0, 4.0, motion_from_s=1.0)
        run: Any = SimpleNamespace(
            settings=self.settings,
            clock=SimpleNamespace(now=lambda: self.now_s),
            force=SimpleNamespace(
                older_s=0.0, mean_N=lambda seconds: np.array([0.0, 0.0, self.shown_N])
            ),
            check_watchers=self.check_watchers,
            event=self.event,
        )
        self.run = run
        self.grip = Grip(run, self.record, self.squeeze)

    def event(self, level: str, code: str, message: str) -> None:
        self.events.append((code, message))
        if level == "warning":
            self.warnings.append(message)

    def check_watchers(self) -> None:
        if self.tripped:
            raise LimitError("force over the limit")

    def squeeze(self, rise_N: float) -> SentMove:
        self.rises_N.append(round(rise_N, 9))
        return SentMove(self.now_s + 0.001, self.now_s + 0.002)

    def alarm(self, age_s: float = 0.003, kind: str = SLIP, set_N: float = SET_N) -> None:
        at_s = self.now_s - age_s
        self.grip.answer(Detection(kind, round(1e3 * at_s), at_s, self.now_s, 0.9), set_N)


def test_an_alarm_in_the_motion_raises_the_force_by_one_step() -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.alarm()
    held.grip.end()
    assert held.rises_N == [0.8]
    (squeeze,) = held.record.squeezes
    assert (squeeze.sample_s, squeeze.decided_s) == pytest.approx((1.997, 2.0))
    assert (squeeze.from_N, squeeze.to_N) == pytest.approx((4.0, 4.8))
    assert (squeeze.sent_s, squeeze.acknowledged_s) == pytest.approx((2.001, 2.002))
    assert "set point raised from 4 N to 4.8 N" in held.events[0][1]


@pytest.mark.parametrize("kind", ["predictive", "roll", "rejected"])
def test_only_a_slip_is_an_alarm(kind: str) -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.alarm(kind=kind)
    assert held.rises_N == []


def test_nothing_is_raised_before_the_motion_and_after_its_end() -> None:
    """On the way down, while the force is brought up and in the tap the grip is not armed; in the
    lift it no longer is."""
    held = Held()
    held.alarm()
    held.grip.begin(SET_N)
    held.alarm(age_s=1.5)
    held.grip.end()
    held.alarm()
    assert held.rises_N == []
    assert held.record.unanswered == [0.5], "it came in the motion, and its sample did not"


def test_an_alarm_for_ever_raises_the_stated_number_of_steps_and_no_more() -> None:
    held = Held(regrip_times=3)
    held.grip.begin(SET_N)
    for _ in range(50):
        held.alarm()
        held.now_s += 0.15
    assert held.rises_N == [0.8] * 3
    assert len(held.record.unanswered) == 47
    assert "all 3 steps have been made (--regrip-times)" in held.events[-1][1]
    assert held.warnings == []


def test_an_alarm_that_comes_late_raises_nothing() -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.alarm(age_s=0.11)
    assert held.rises_N == []
    assert "0.11 s after its sample, more than 0.1 s" in held.events[-1][1]
    assert held.warnings == [held.events[-1][1]], "the closing lines repeat it"
    held.alarm(age_s=0.12)
    assert "0.12 s after its sample" in held.events[-1][1]
    assert len(held.warnings) == 1, "one a trial"
    held.alarm(age_s=0.09)
    assert held.rises_N == [0.8]


def test_a_force_that_is_old_or_not_there_raises_nothing() -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.run.force.older_s = 0.06
    held.alarm()
    held.run.force.older_s, held.shown_N = 0.0, 1.9
    held.alarm()
    assert held.rises_N == []
    assert [message.partition(": no squeeze: ")[2] for _, message in held.events] == [
        "the latest force is 0.06 s old",
        "the force sensor shows 1.9 N where 4 N are held",
    ]
    assert held.warnings == [held.events[0][1]]


def test_a_trip_comes_before_the_squeeze() -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.tripped = True
    with pytest.raises(LimitError):
        held.alarm()
    assert held.rises_N == []
    assert held.record.squeezes == []


def test_to_squeeze_always_takes_all_steps_when_the_motion_begins() -> None:
    held = Held(regrip_on="motion", regrip_times=2)
    held.grip.begin(SET_N)
    held.alarm()
    assert held.rises_N == [1.6]


def test_the_highest_set_point_has_to_be_below_the_largest_force() -> None:
    with pytest.raises(ValidationError, match="to 16 N, which is not below largest_force_N 15 N"):
        SlipTrialSettings(regrip=True, normal_force_N=8.0)
    assert SlipTrialSettings(normal_force_N=8.0).largest_held_N == 8.0
    assert SlipTrialSettings(regrip=True, normal_force_N=7.0).largest_held_N == pytest.approx(14.0)
    course = {"force_times_s": (0.0, 1.0), "force_shares": (1.0, 3.0)}
    with pytest.raises(ValidationError, match="largest_force_N 15 N"):
        PathTrialSettings(regrip=True, **course)
    with pytest.raises(ValidationError, match="regrip_on alarm needs a detector"):
        SlipTrialSettings(regrip=True, detector="none")


class Contact:
    """z on a contact of 100 N/mm, held by a servo 100 times a second. z accelerates by 200 mm/s²;
    the force sensor shows what was 4 ms before, and may be wrong."""

    DT_S, DELAY = 0.00025, 16

    def __init__(self, sensed: Any, limit_N: float = 15.0):
        self.sensed, self.commanded_mm, self.stopped = sensed, 0.0, False
        self.target_late_s = self.now_s = self.speed_mm_s = 0.0
        self.positions_mm = [0.0] * (self.DELAY + 1)
        self.clock, self.stage = SimpleNamespace(now=lambda: self.now_s), self
        links = SimpleNamespace(silent_s=lambda role: 0.0, is_idle=lambda role: True)
        force = SimpleNamespace(measured_s=1.0, older_s=0.0)
        torque = SimpleNamespace(is_due=lambda: False)
        self.ticks = SimpleNamespace(begun=0)
        servo = ForceServo(settings_from(SET_N, 100.0, 0.01, 0.004))
        record = TrialRecord(1, 100.0, 1000.0, 4.0)
        self.hold = ForceHold(
            servo, self, links, force, record, self.ticks, 0.0, torque, limit_N  # type: ignore[arg-type]
        )  # fmt: skip

    def start_move(self, position_mm: float, speed_mm_s: float, sent: Any = None) -> None:
        self.commanded_mm = position_mm

    def stop(self) -> None:
        self.stopped = True

    def let_pass(self, seconds: float) -> None:
        for _ in range(round(seconds / self.DT_S)):
            way_mm = self.commanded_mm - self.positions_mm[-1]
            wanted = np.copysign(np.sqrt(2 * 200.0 * abs(way_mm)), way_mm)
            wanted = np.clip(wanted, -abs(way_mm) / self.DT_S, abs(way_mm) / self.DT_S)
            most = 200.0 * self.DT_S
            self.speed_mm_s += float(np.clip(wanted - self.speed_mm_s, -most, most))
            self.positions_mm.append(self.positions_mm[-1] + self.speed_mm_s * self.DT_S)
            self.now_s += self.DT_S

    @property
    def true_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        return SET_N + 100.0 * self.positions_mm[-1]

    def tick(self, after_s: float = 0.01) -> None:
        self.let_pass(after_s)
        self.ticks.begun += 1
        felt_N = SET_N + 100.0 * self.positions_mm[-1 - self.DELAY]
        self.hold.step(self.sensed(felt_N), torque_too=False)


def test_a_squeeze_is_on_its_way_before_the_next_tick_and_the_servo_completes_it() -> None:
    contact = Contact(lambda felt_N: felt_N)
    contact.tick()
    contact.let_pass(0.004)
    contact.hold.squeeze(4.8, 10.0)
    assert contact.commanded_mm == pytest.approx(0.008), "0.8 N on 100 N/mm, in the same instant"
    contact.tick(after_s=0.006)
    assert contact.true_N > 4.3, "a tick of the servo later it would not have begun"
    for _ in range(30):
        contact.tick()
        assert contact.true_N < 4.9
    assert contact.true_N == pytest.approx(4.8, abs=0.02)


@pytest.mark.parametrize(
    "sensed",
    [lambda felt_N: SET_N, lambda felt_N: SET_N + 0.15 * np.sin(50 * felt_N)],
    ids=["stuck", "stuck, with noise"],
)
def test_a_sensor_that_does_not_show_the_squeeze_ends_it_before_z_presses_on(sensed: Any) -> None:
    """The servo takes the new set point for missing and would press for ever: 0.8 N a tick."""
    contact = Contact(sensed)
    contact.tick()
    contact.hold.squeeze(4.8, 10.0)
    with pytest.raises(InstrumentError, match="the force has not followed"):  # noqa: PT012
        for _ in range(200):
            contact.tick()
    assert contact.stopped
    # 2.5 ways of the squeeze, 0.3 of the held force, and one tick more.
    assert contact.true_N < SET_N + 2.5 * 0.8 + 0.3 * SET_N + 2.0


@pytest.mark.parametrize("ticks_between", [1, 2, 3, 4])
def test_alarms_in_a_row_do_not_take_z_further_than_one_squeeze_by_all_steps(
    ticks_between: int,
) -> None:
    """The sensor is stuck and the detector alarms again and again: each squeeze would grant z the
    way of one that is new, up to 22 N here."""
    contact = Contact(lambda felt_N: SET_N)
    contact.tick()
    with pytest.raises(InstrumentError, match="the force has not followed"):  # noqa: PT012
        for number in range(200):
            if number % ticks_between == 0 and (steps := number // ticks_between + 1) <= 5:
                contact.hold.squeeze(SET_N + 0.8 * steps, 10.0)
            contact.tick()
    assert contact.true_N < SET_N + 2.5 * 4.0 + 0.3 * SET_N + 2.0


def test_a_large_squeeze_takes_z_no_further_than_the_force_limit_leaves_room_for() -> None:
    contact = Contact(lambda felt_N: SET_N, limit_N=12.0)
    contact.tick()
    contact.hold.squeeze(11.0, 10.0)
    with pytest.raises(InstrumentError, match="the force has not followed"):  # noqa: PT012
        for _ in range(200):
            contact.tick()
    assert contact.true_N < 12.0 + 0.3 * SET_N + 2.0, "and not 2.5 ways of 7 N"


def test_alarms_in_a_row_are_followed_by_a_sensor_that_is_right() -> None:
    contact = Contact(lambda felt_N: felt_N - 0.25 * SET_N, limit_N=9.0)
    contact.tick()
    for step in range(1, 6):
        contact.let_pass(0.002)
        contact.hold.squeeze(SET_N + 0.8 * step, 10.0)
    for _ in range(60):
        contact.tick()
    assert contact.true_N - 0.25 * SET_N == pytest.approx(8.0, abs=0.05)


def test_a_slip_that_takes_a_quarter_of_the_force_is_no_wrong_sensor() -> None:
    contact = Contact(lambda felt_N: felt_N - 0.25 * SET_N)
    contact.tick()
    contact.hold.squeeze(4.8, 10.0)
    for _ in range(50):
        contact.tick()
    assert contact.true_N - 0.25 * SET_N == pytest.approx(4.8, abs=0.05)


def noise_N(number: int) -> float:  # noqa: N802 - the unit keeps its capital
    """Noise of the sensor at the n-th reading, 0.02 N rms."""
    return float(np.random.default_rng(number).normal(0.0, 0.02))


@pytest.mark.parametrize("sticks_at_N", [4.0, 4.6, 5.6])
def test_a_sensor_that_sticks_in_a_course_ends_it_before_z_presses_on(sticks_at_N: float) -> None:
    """The force is to rise by 4 N/s; from one value on the sensor shows that value, with noise, so
    that no repeated reading betrays it."""
    readings = itertools.count()
    contact = Contact(lambda felt_N: min(felt_N, sticks_at_N) + noise_N(next(readings)))
    contact.tick()
    with pytest.raises(InstrumentError, match="the force has not followed"):  # noqa: PT012
        for number in range(200):
            contact.hold.hold_at(SET_N + 0.04 * min(number, 100), 10.0)
            contact.tick()
    assert contact.stopped
    assert contact.true_N < sticks_at_N + 4.0


@pytest.mark.parametrize("rate_N_s", [-20.0, -4.0, 1.0, 4.0, 20.0])
@pytest.mark.parametrize("lost", [0.0, 0.25])
def test_a_course_is_followed_by_a_sensor_that_is_right(rate_N_s: float, lost: float) -> None:
    """Also where a slip has taken a quarter of the force, and where the force comes back."""
    contact = Contact(lambda felt_N: felt_N - lost * SET_N)
    contact.tick()
    there_N = SET_N + np.clip(rate_N_s / 100.0 * np.arange(200), -3.0, 6.0)
    for set_N in (*there_N, *there_N[::-1], *[SET_N] * 20):
        contact.hold.hold_at(float(set_N), 10.0)
        contact.tick()
    assert contact.true_N - lost * SET_N == pytest.approx(SET_N, abs=0.1)


def test_a_grip_that_answers_while_the_force_is_let_go_is_no_wrong_sensor() -> None:
    """The set point falls by 20 N/s, an alarm squeezes, the slip takes the force, and a second
    alarm squeezes from far below the first."""
    slipped_N = 0.0
    contact = Contact(lambda felt_N: felt_N - slipped_N)
    contact.tick()
    set_N = SET_N
    for number in range(60):
        set_N = max(set_N - 0.2, 0.8)
        if number in (5, 12):
            slipped_N += 0.6
            set_N += 0.8
            contact.hold.squeeze(set_N, 10.0)
        else:
            contact.hold.hold_at(set_N, 10.0)
        contact.tick()
    assert contact.true_N - slipped_N == pytest.approx(0.8, abs=0.1)


def test_the_stages_of_the_latency_are_counted_from_the_sample_of_the_first_alarm() -> None:
    held = Held()
    held.grip.begin(SET_N)
    held.alarm(age_s=0.003)
    held.grip.end()
    held.record.motion_to_s = 3.0
    times_s = np.arange(3000) / 1000
    # From 2.006 s on F_n rises by 0.02 N in each millisecond: 0.08 N, a tenth, at 2.010 s.
    normal_N = SET_N + np.clip((times_s - 2.006) * 20.0, 0.0, 0.8)
    held.record.force.append(np.column_stack([normal_N, 0 * times_s, 0 * times_s]))
    reading = grip_reading(held.record)
    stages = [reading[f"squeeze_{name}_s"] for name in ("decided", "sent", "acknowledged", "risen")]
    assert stages == pytest.approx([0.003, 0.004, 0.005, 0.013], abs=1.1e-3)
    assert reading["squeezes"] == 1
