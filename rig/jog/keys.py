"""The logic of jogging: keys, time and positions in, actions out; no I/O.

A terminal reports that a key is pressed, and again with each auto-repeat, but never that it is
released. Therefore each press moves the axis by one step from its position, and a held key by one
step after the other: a slow motion whose end is never more than a step ahead. No key for
`SILENCE_S` means released.

    at rest --direction--> moving --the same, again--> moving (a step from where it is by then)
    moving --released | the other direction | any other key | a trip | a block--> stop, at rest
    stopped otherwise than by release: deaf to directions until no key has come for `SILENCE_S`
    pressed (the force tripped) --the force has fallen--> free; until then only the way off moves
    blocked (the force is not known, a pause) --over--> free; until then nothing moves
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

SILENCE_S = 0.2
"""Time without a key that means a release. Keyboards repeat every 0.03 to 0.1 s."""
LONGEST_STEP_S = 0.15
"""Longest duration of a step: it has ended by itself when the release is noticed."""
CONFIRM_S = 3.0
"""Time in s for which homing waits for the key that confirms it."""
FALLEN = 0.8
"""Fraction of the largest force below which all axes may move again after a trip."""
RETREAT = 1.25
"""Limit of the force during the retreat, as a multiple of the force at which the tripped bench came
to rest: a larger force ends the session."""
THERE = 0.01
"""Distance from a limit, as a fraction of a step, within which an axis is at the limit."""


class Key(Enum):
    """What a key means to hand control, whichever key of the keyboard it is."""

    LESS = -1
    MORE = 1
    NEXT_AXIS = "tab"
    HOME = "h"
    CONFIRM = "y"
    LEAVE = "q"
    STOP = "stop"
    """Space, and every key without another meaning."""


@dataclass(frozen=True)
class JogAxis:
    """An axis for jogging; values in `unit` (mm or deg), the speed in `unit` per second."""

    name: str
    unit: str
    low: float
    high: float
    step: float
    speed: float
    off: Key | None = None
    """Direction that leads away from the object that may be pressed."""


@dataclass(frozen=True)
class AxisPosition:
    """Position of an axis, and whether it has been homed."""

    position: float
    homed: bool


@dataclass(frozen=True)
class MoveAxis:
    """Action: move the axis there, or change the target of the motion under way."""

    axis: JogAxis
    start: float
    target: float
    begins: bool


@dataclass(frozen=True)
class StopAxes:
    """Action: stop this axis, or all of them (None), and wait for rest; then call `Jog.stopped`."""

    axis: JogAxis | None
    why: str


@dataclass(frozen=True)
class HomeAxis:
    """Action: have the axis find its reference."""

    axis: JogAxis


@dataclass(frozen=True)
class WatchForce:
    """Action: trip above this force in N from now on."""

    limit_N: float


@dataclass(frozen=True)
class ShowMessage:
    """Action: show a message."""

    text: str


@dataclass(frozen=True)
class EndSession:
    """Action: end the session."""


Action = MoveAxis | StopAxes | HomeAxis | WatchForce | ShowMessage | EndSession


@dataclass(frozen=True)
class _Motion:
    axis: JogAxis
    way: Key
    pressed_s: float


class Jog:
    """The state of a jogging session. Only one axis moves at a time, the chosen one."""

    def __init__(self, axes: Sequence[JogAxis], largest_N: float, chosen: str):
        self._axes = tuple(axes)
        self._largest_N = largest_N
        self._number = [axis.name for axis in axes].index(chosen)
        self._motion: _Motion | None = None
        self._deaf_until_s = float("-inf")
        self._homing_asked_s: float | None = None
        self._blocked = ""
        self._last_message = ""
        """Latest message, which a held key must not repeat."""
        self.pressed = False
        """True from a trip until the force has fallen."""

    @property
    def chosen(self) -> JogAxis:
        """Axis that the keys move."""
        return self._axes[self._number]

    @property
    def moving(self) -> JogAxis | None:
        """Axis that was sent to a target and not stopped since; None if there is none."""
        return self._motion.axis if self._motion is not None else None

    def press(self, key: Key, now_s: float, place: AxisPosition) -> list[Action]:
        """Return the actions for a key, given the position of the chosen axis."""
        asked_s, self._homing_asked_s = self._homing_asked_s, None
        if key in (Key.LESS, Key.MORE):
            return self._direction(key, now_s, place)
        self._last_message = ""
        if key is Key.CONFIRM and asked_s is not None and now_s - asked_s <= CONFIRM_S:
            return [HomeAxis(self.chosen)]
        actions: list[Action] = [StopAxes(None, "a key")]
        if key is Key.LEAVE:
            actions.append(EndSession())
        elif key is Key.NEXT_AXIS:
            self._number = (self._number + 1) % len(self._axes)
            actions.append(ShowMessage(f"Now moving: {self.chosen.name}"))
        elif key is Key.HOME:
            actions.append(ShowMessage(self._ask_to_home(now_s)))
        return actions

    def poll(self, now_s: float, force_N: float | None) -> list[Action]:
        """Return the actions that time and force require; `force_N` is the largest along any axis,
        or None."""
        if self._motion is not None and now_s - self._motion.pressed_s >= SILENCE_S:
            return [StopAxes(self._motion.axis, "released")]
        if self.pressed and force_N is not None and force_N < FALLEN * self._largest_N:
            self.pressed = False
            return [
                WatchForce(self._largest_N),
                ShowMessage(f"the force has fallen to {force_N:.2g} N: every axis may move again"),
            ]
        return []

    def trip(self, force_N: float) -> list[Action]:
        """Return the actions after a trip; `force_N` is the force now that all axes are at rest."""
        self.pressed = True
        self._homing_asked_s = None
        ways = [_in_words(axis, axis.off) for axis in self._axes if axis.off is not None]
        only = f"only {' and '.join(ways)} moves" if ways else "nothing moves"
        return [
            WatchForce(RETREAT * max(force_N, self._largest_N)),
            ShowMessage(f"{only} until the force is below {FALLEN * self._largest_N:.3g} N"),
        ]

    def block(self, why: str) -> list[Action]:
        """Return the actions that stop all axes and block motions until `unblock` is called."""
        self._blocked = why
        self._homing_asked_s = None
        return [StopAxes(None, why), ShowMessage(f"stopped: {why}; nothing moves meanwhile")]

    def unblock(self) -> list[Action]:
        """Return the actions when the reason for blocking is over."""
        self._blocked = ""
        return [ShowMessage("Resumed.")]

    def stopped(self, now_s: float, released: bool = False) -> None:
        """Note that the axes were stopped. A key that is still held is ignored until it has been
        released, unless its release ended the motion."""
        self._motion = None
        if not released:
            self._deaf_until_s = now_s + SILENCE_S

    def _direction(self, way: Key, now_s: float, place: AxisPosition) -> list[Action]:
        if now_s < self._deaf_until_s:
            self._deaf_until_s = now_s + SILENCE_S
            return []
        if self._motion is not None and self._motion.way is not way:
            return [StopAxes(None, "the other direction")]
        axis = self.chosen
        target = min(max(place.position + way.value * axis.step, axis.low), axis.high)
        onward = (target - place.position) * way.value
        if refusal := self._refusal(way, place, onward):
            return self._say_once(refusal)
        begins = self._motion is None
        self._motion = _Motion(axis, way, now_s)
        move = MoveAxis(axis, place.position, target, begins)
        at_limit = target in (axis.low, axis.high)
        return [move, *self._say_once(_limit_reached(axis, target) if at_limit else "")]

    def _refusal(self, way: Key, place: AxisPosition, onward: float) -> str:
        """Return why the chosen axis may not move this way; empty if it may."""
        axis = self.chosen
        if self._blocked:
            return f"{axis.name} does not move: {self._blocked}"
        if not place.homed:
            return f"{axis.name} is not homed and does not move; h homes it"
        if self.pressed and way is not axis.off:
            return f"the force is over {FALLEN * self._largest_N:.3g} N: this way stays closed"
        if onward > axis.step * (1 + THERE):
            return (
                f"{axis.name} is at {place.position:.4g} {axis.unit}, outside {axis.low:g} to "
                f"{axis.high:g} {axis.unit}, farther than a step; h homes it"
            )
        if onward <= axis.step * THERE:
            return _limit_reached(axis, axis.high if way is Key.MORE else axis.low)
        return ""

    def _say_once(self, text: str) -> list[Action]:
        """Return the action that shows a message unless it was the latest one; an empty one clears
        that."""
        known, self._last_message = self._last_message, text
        return [ShowMessage(text)] if text and text != known else []

    def _ask_to_home(self, now_s: float) -> str:
        axis = self.chosen
        if self._blocked or self.pressed:
            return f"{axis.name} is not homed now: {self._blocked or 'the force is over its limit'}"
        self._homing_asked_s = now_s
        return (
            f"Home {axis.name}? It will move on its own until it finds its reference. "
            f"Press y within {CONFIRM_S:g} s; any key stops it."
        )


def _limit_reached(axis: JogAxis, limit: float) -> str:
    return f"limit {limit:g} {axis.unit} of {axis.name} reached"


def _in_words(axis: JogAxis, way: Key | None) -> str:
    return f"{axis.name} {'-' if way is Key.LESS else '+'}"
