"""The axes of a bench as keys move them: their ranges, steps and speeds, and how each is moved."""

from __future__ import annotations

from pydantic import Field

from rig.bench.braking import braking_bound
from rig.bench.connected import Bench
from rig.control.speed_bound import SpeedBound
from rig.core.errors import ConfigurationError
from rig.core.settings import Settings
from rig.instruments.roles import Limits, LinearStage, RotaryStage
from rig.jog.keys import LONGEST_STEP_S, JogAxis, Key

AXES = ("stage_z", "stage_x", "rotary")
"""Roles that can be jogged."""
OFF = {"stage_z": Key.LESS}
"""Direction that leads away from contact: on the z stage a larger position is deeper."""
FASTEST = {"mm": 1.0, "deg": 2.0}
"""Largest speed per second, by unit: slow enough for a person to react."""
TURN_ACCELERATION_deg_s2 = 100.0


class JogSettings(Settings):
    """Settings of a jogging session."""

    step_mm: float = Field(default=0.1, gt=0)
    """Distance by which one press of a key moves a linear axis."""
    speed_mm_s: float = Field(default=FASTEST["mm"], gt=0)
    """Speed of linear axes; the default is the largest."""
    angle_step_deg: float = Field(default=0.2, gt=0)
    """Angle by which one press of a key turns the rotary stage."""
    turn_speed_deg_s: float = Field(default=FASTEST["deg"], gt=0)
    """Speed of the rotary stage; the default is the largest."""
    largest_force_N: float = Field(default=5.0, gt=0)
    """Safety limit on the force along any axis of the sensor, which is not tared; exceeding it
    stops everything."""


class LinearMover:
    """Moves a linear stage."""

    def __init__(self, stage: LinearStage):
        self.stage: LinearStage | RotaryStage = stage
        self.position = stage.position_mm
        self.start = stage.start_move


class RotaryMover:
    """Moves a rotary stage."""

    def __init__(self, stage: RotaryStage):
        self.stage: LinearStage | RotaryStage = stage
        self.position = stage.angle_deg
        largest = stage.limits()["acceleration"].high
        self._acceleration_deg_s2 = min(TURN_ACCELERATION_deg_s2, largest)

    def start(self, angle_deg: float, speed_deg_s: float) -> None:
        """Begin to turn to an angle, or change the turn under way."""
        self.stage.start_turn(angle_deg, speed_deg_s, self._acceleration_deg_s2)  # type: ignore[union-attr]


def axes_of(bench: Bench, settings: JogSettings) -> tuple[list[JogAxis], list[str]]:
    """Return the bench's axes for jogging, and in words the settings that were reduced.

    Raises ConfigurationError for a bench that has none, LimitError where the slowest speed of z is
    too fast for the largest force.
    """
    axes, limited = [], []
    for name in AXES:
        if name not in bench.instruments:
            continue
        limits = bench.instruments[name].limits()
        turns = name == "rotary"
        turn, angle = ("turn-", "angle-") if turns else ("", "")
        places = limits["angle" if turns else "position"]
        step = settings.angle_step_deg if turns else settings.step_mm
        asked = settings.turn_speed_deg_s if turns else settings.speed_mm_s
        speed, why = _speed(asked, places.unit, limits["speed"]), ""
        if name == "stage_z" and (bound := _bound_on_z(bench, settings)) is not None:
            bound.require(name, limits["speed"].low)
            if speed > bound.speed_mm_s:
                speed, why = bound.speed_mm_s, f" ({bound.in_words()})"
        if speed != asked:
            limited.append(
                f"--{turn}speed {asked:g} {places.unit}/s reduced to {speed:.3g} {places.unit}/s"
                f"{why}"
            )
        if step > (longest := speed * LONGEST_STEP_S):
            limited.append(
                f"--{angle}step {step:g} {places.unit} reduced to {longest:.3g} {places.unit} (the "
                f"longest step allowed, {LONGEST_STEP_S:g} s at {speed:g} {places.unit}/s)"
            )
            step = longest
        axes.append(JogAxis(name, places.unit, places.low, places.high, step, speed, OFF.get(name)))
    if not axes:
        raise ConfigurationError(
            f"{bench.plan.source}: the bench has no axis", f"add a table of {', '.join(AXES)}"
        )
    return axes, limited


def _bound_on_z(bench: Bench, settings: JogSettings) -> SpeedBound | None:
    """Return the bound on the speed of z: what has been stopped at the largest force may rise no
    further than the force sensor's limit. None without a force sensor, by which nothing stops."""
    if "force_sensor" not in bench.instruments:
        return None
    limit_N = bench.force_sensor.limits()["force"].high
    return braking_bound(bench, limit_N - settings.largest_force_N)


def _speed(asked: float, unit: str, limits: Limits) -> float:
    return limits.nearest(min(asked, FASTEST[unit]))
