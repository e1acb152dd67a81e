"""A skin under a plate on a z axis, with a force sensor: what a servo has before it.

The contact is the model's under position control at steps of 0.1 ms; the axis is the simulated
drive's, with its acceleration and counts; a command reaches it `LINK_ms` after it was given; a
frame is the mean force of a millisecond, with noise, and comes `LATENCY_ms` later. Nothing gives
way but the skin, so this is the stiffest bench there can be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.simulated.world.axis import AxisCommand, Mechanics, SimulatedAxis
from rig.control.approach import Approach
from rig.control.force_servo import ContactShift, ForceServo, settings_from
from rig.physics.contact.settings import ContactSettings, FrictionSettings, Plate
from rig.physics.contact.stepper import ContactStepper
from rig.physics.skin.condensed import CondensedSkin

LINK_ms, LATENCY_ms = 2, 1
MEAN = 2
"""Frames whose mean a controller is given."""
NOISE_N = 3e-3
ACCELERATION_mm_s2 = 200.0
ABOVE_mm = 0.02
"""Where the axis begins, above touch."""
REST_ms = 300
"""From the arrival of the force to the beginning of the slide."""
RAMP_s = 0.05
ORIGIN_mm = 10.0
"""Of the axis at first touch."""
FORCE_AGE_s = 1e-3 * (LATENCY_ms + 0.5 + (MEAN - 1) / 2 + 0.5)
"""Half a frame, half the mean, and the relaxation time of the rubber, 0.5 ms."""
DELAY_s = 1e-3 * LINK_ms + FORCE_AGE_s


class PressedSkin:
    """The bench."""

    def __init__(
        self,
        skin: CondensedSkin,
        friction: FrictionSettings,
        unit_mm: float = 1e-4,
        seed: int = 0,
    ):
        self._contact = ContactStepper(skin, ContactSettings(friction=friction), Plate())
        mechanics = Mechanics(start_mm=ORIGIN_mm - ABOVE_mm)
        self._axis = SimulatedAxis(mechanics, lambda position, t: 0.0)
        self._unit_mm = unit_mm
        self._orders: list[tuple[int, AxisCommand]] = []
        self._rng = np.random.default_rng([35, seed])
        self._frames: list[float] = []
        self.now_ms = 0
        self.normal_N: list[float] = []
        self.tangential_N: list[float] = []
        self.slide_from_ms: int | None = None
        self.speed_mm_s = 0.0

    def position_mm(self) -> float:
        """Of the axis, 0 at first touch."""
        return self._axis.position(1000 * self.now_ms) - ORIGIN_mm

    def force_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Mean of the latest frames that have come."""
        last = len(self._frames) - LATENCY_ms
        return float(np.mean(self._frames[max(last - MEAN, 0) : last])) if last > 0 else 0.0

    def go(self, position_mm: float, speed_mm_s: float) -> None:
        """Send the axis there, to the nearest count."""
        counted = round(position_mm / self._unit_mm) * self._unit_mm
        acceleration = ACCELERATION_mm_s2
        command = AxisCommand(
            ORIGIN_mm + counted, max(speed_mm_s, 1e-3), acceleration, acceleration
        )
        self._orders.append((self.now_ms + LINK_ms, command))

    def pass_ms(self) -> None:
        """A millisecond."""
        while self._orders and self._orders[0][0] <= self.now_ms:
            self._axis.move(1000 * self.now_ms, self._orders.pop(0)[1])
        t_us = 1000 * self.now_ms + 100 * np.arange(1, 11)
        depth = np.array([self._axis.position(int(t)) - ORIGIN_mm for t in t_us])
        block = self._contact.advance(depth, self._travel(t_us), normal_control="position")
        self.normal_N.append(float(block.normal_force_N.mean()))
        self.tangential_N.append(float(block.tangential_force_N.mean()))
        self._frames.append(self.normal_N[-1] + NOISE_N * float(self._rng.normal()))
        self.now_ms += 1

    def _travel(self, t_us: np.ndarray) -> np.ndarray:
        if self.slide_from_ms is None:
            return np.zeros(t_us.size)
        since = t_us * 1e-6 - 1e-3 * self.slide_from_ms
        ramped = np.clip(since, 0, RAMP_s) ** 2 / (2 * RAMP_s) + np.clip(since - RAMP_s, 0, None)
        return self.speed_mm_s * ramped


@dataclass(frozen=True)
class Held:
    """How a force was brought up and held; relative to the target."""

    overshoot: float
    arrived_s: float
    stiffness_N_mm: float
    rest: float
    """Mean error of the last 50 ms before the slide."""
    rms: float
    """Of the error during the slide."""
    low: float
    high: float
    shift: ContactShift
    """What the slide has shown."""


def press_and_slide(
    skin: CondensedSkin,
    friction: FrictionSettings,
    target_N: float,
    speed_mm_s: float,
    rate_Hz: int,
    *,
    stiffness_error: float = 1.0,
    unit_mm: float = 1e-4,
    expected: ContactShift | None = None,
    seed: int = 0,
) -> Held:
    """Approach, press, rest, slide through gross slip under the servo."""
    bench, period = PressedSkin(skin, friction, unit_mm, seed), 1000 // rate_Hz
    approach = Approach(target_N, 1 / rate_Hz, DELAY_s, ACCELERATION_mm_s2)
    while True:
        here = bench.position_mm()
        now_s = 1e-3 * bench.now_ms
        step = approach.step(now_s, here, now_s - FORCE_AGE_s, bench.force_N())
        if step.arrived:
            break
        bench.go(here + step.ahead_mm, step.speed_mm_s)
        for _ in range(period):
            bench.pass_ms()
        assert bench.now_ms < 20_000
    arrived = bench.now_ms
    stiffness = stiffness_error * approach.stiffness_N_mm
    servo = ForceServo(settings_from(target_N, stiffness, 1 / rate_Hz, DELAY_s, ACCELERATION_mm_s2))
    commanded = bench.position_mm()
    slide_s = (0.09 * friction.static_coefficient * target_N + 0.1) / speed_mm_s + RAMP_s
    begin = arrived + REST_ms // period * period
    while bench.now_ms < begin + 1000 * slide_s:
        if bench.now_ms == begin:
            bench.slide_from_ms, bench.speed_mm_s = begin, speed_mm_s
            servo.slide_begins(expected)
        move = servo.step(bench.force_N())
        commanded += move.increment_mm
        bench.go(commanded, move.speed_mm_s)
        for _ in range(period):
            bench.pass_ms()
    error = np.array(bench.normal_N) / target_N - 1
    sliding = error[begin:]
    return Held(
        overshoot=float(error[:begin].max()),
        arrived_s=1e-3 * arrived,
        stiffness_N_mm=approach.stiffness_N_mm,
        rest=float(error[begin - 50 : begin].mean()),
        rms=float(np.sqrt(np.mean(sliding**2))),
        low=float(sliding.min()),
        high=float(sliding.max()),
        shift=servo.shift,
    )
