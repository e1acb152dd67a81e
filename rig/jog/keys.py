"""Jogging: what keys ask of the axes. Keys, time and places in, actions out; no I/O.

A terminal tells that a key is pressed and pressed again by its auto-repeat, never that it is let
go. So each press asks for one step from where the axis is, and a held key for one after the other:
a slow motion whose end is never more than a step ahead. No key for `SILENCE_S` means released.

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
"""No key for so long is a release. Keyboards repeat every 0.03 to 0.1 s."""
LONGEST_STEP_S = 0.15
"""A step takes no longer: it has ended by itself when the release is seen."""
CONFIRM_S = 3.0
"""How long homing waits for its confirming key."""
FALLEN = 0.8
"""Share of the largest force below which all axes may move again after a trip."""
RETREAT = 1.25
"""Times the force at which a tripped bench came to rest, on the way off: more trips for good."""
THERE = 0.01
"""Share of a step from a limit at which an axis stands there: finer than any motion asked for."""


class Key(Enum):
    """What a person may ask for."""

    LESS = -1
    MORE = 1
    NEXT_AXIS = "tab"
    HOME = "h"
    CONFIRM = "y"
    LEAVE = "q"
    STOP = "stop"
    """Space, and every key that means nothing else."""


@dataclass(frozen=True)
class Axis:
    """An axis as it is jogged; values in `unit` (mm or deg), the speed in `unit` a second."""

    name: str
    unit: str
    low: float
    high: float
    step: float
    speed: float
    off: Key | None = None
    """The direction that leads away from what may be pressed."""


@dataclass(frozen=True)
class Place:
    """Where an axis is, and whether it knows that."""

    position: float
    homed: bool


@dataclass(frozen=True)
class Move:
    """Send the axis there, or change the target of the motion under way."""

    axis: Axis
    start: float
    target: float
    begins: bool


@dataclass(frozen=True)
class Stop:
    """Stop this axis, or all of them (None), and wait for rest; then call `Jog.stopped`."""

    axis: Axis | None
    why: str


@dataclass(frozen=True)
class Home:
    """Have the axis find its reference."""

    axis: Axis


@dataclass(frozen=True)
class Watch:
    """Trip over this force from now on, in N."""

    limit_N: float


@dataclass(frozen=True)
class Say:
    """Tell the person."""

    text: str


@dataclass(frozen=True)
class Leave:
    """The person has had enough."""


Action = Move | Stop | Home | Watch | Say | Leave


@dataclass(frozen=True)
class _Motion:
    axis: Axis
    way: Key
    pressed_s: float


class Jog:
    """The state of one session of jogging. Only one axis moves at a time, the chosen one."""

    def __init__(self, axes: Sequence[Axis], largest_N: float, chosen: str):
        self._axes = tuple(axes)
        self._largest_N = largest_N
        self._number = [axis.name for axis in axes].index(chosen)
        self._motion: _Motion | None = None
        self._deaf_until_s = float("-inf")
        self._homing_asked_s: float | None = None
        self._blocked = ""
        self._told = ""
        """The refusal that a held key would have repeated."""
        self.pressed = False
        """Whether the force has tripped and not fallen since."""

    @property
    def chosen(self) -> Axis:
        """The axis that keys move."""
        return self._axes[self._number]

    @property
    def moving(self) -> Axis | None:
        """The axis that is under way, as far as it was told."""
        return self._motion.axis if self._motion is not None else None

    def press(self, key: Key, now_s: float, place: Place) -> list[Action]:
        """A key, with the place of the chosen axis."""
        asked_s, self._homing_asked_s = self._homing_asked_s, None
        if key in (Key.LESS, Key.MORE):
            return self._direction(key, now_s, place)
        self._told = ""
        if key is Key.CONFIRM and asked_s is not None and now_s - asked_s <= CONFIRM_S:
            return [Home(self.chosen)]
        actions: list[Action] = [Stop(None, "a key")]
        if key is Key.LEAVE:
            actions.append(Leave())
        elif key is Key.NEXT_AXIS:
            self._number = (self._number + 1) % len(self._axes)
            actions.append(Say(f"{self.chosen.name} is chosen"))
        elif key is Key.HOME:
            actions.append(Say(self._ask_to_home(now_s)))
        return actions

    def look(self, now_s: float, force_N: float | None) -> list[Action]:
        """What time and force ask for; `force_N` is the largest along any axis, if it is known."""
        if self._motion is not None and now_s - self._motion.pressed_s >= SILENCE_S:
            return [Stop(self._motion.axis, "released")]
        if self.pressed and force_N is not None and force_N < FALLEN * self._largest_N:
            self.pressed = False
            return [
                Watch(self._largest_N),
                Say(f"the force has fallen to {force_N:.2g} N: every axis may move again"),
            ]
        return []

    def trip(self, force_N: float) -> list[Action]:
        """The watcher has stopped all axes over the force; it is `force_N` now that they rest."""
        self.pressed = True
        ways = [_in_words(axis, axis.off) for axis in self._axes if axis.off is not None]
        only = f"only {' and '.join(ways)} moves" if ways else "nothing moves"
        return [
            Watch(RETREAT * max(force_N, self._largest_N)),
            Say(f"{only} until the force is below {FALLEN * self._largest_N:.3g} N"),
        ]

    def block(self, why: str) -> list[Action]:
        """Nothing may move for now."""
        self._blocked = why
        return [Stop(None, why), Say(f"stopped: {why}; nothing moves until that is over")]

    def unblock(self) -> list[Action]:
        """What blocked is over."""
        self._blocked = ""
        return [Say("going on")]

    def stopped(self, now_s: float, released: bool = False) -> None:
        """What `Stop` asked for is done. A key that is still held is not heard until it has been
        let go, unless that is how the motion ended."""
        self._motion = None
        if not released:
            self._deaf_until_s = now_s + SILENCE_S

    def _direction(self, way: Key, now_s: float, place: Place) -> list[Action]:
        if now_s < self._deaf_until_s:
            self._deaf_until_s = now_s + SILENCE_S
            return []
        if self._motion is not None and self._motion.way is not way:
            return [Stop(None, "the other direction")]
        axis = self.chosen
        target = min(max(place.position + way.value * axis.step, axis.low), axis.high)
        onward = (target - place.position) * way.value
        if refusal := self._refusal(way, place, onward):
            return self._tell_once(refusal)
        begins = self._motion is None
        self._motion = _Motion(axis, way, now_s)
        move = Move(axis, place.position, target, begins)
        at_limit = target in (axis.low, axis.high)
        return [move, *self._tell_once(_limit_reached(axis, target) if at_limit else "")]

    def _refusal(self, way: Key, place: Place, onward: float) -> str:
        """Why the chosen axis may not move this way; empty where it may."""
        axis = self.chosen
        if self._blocked:
            return f"{axis.name} does not move: {self._blocked}"
        if not place.homed:
            return f"{axis.name} is not homed and does not move; h homes it"
        if self.pressed and way is not axis.off:
            return f"the force is over {FALLEN * self._largest_N:.3g} N: this way stays closed"
        if onward > axis.step * (1 + THERE):
            return (
                f"{axis.name} stands at {place.position:.4g} {axis.unit}, outside {axis.low:g} to "
                f"{axis.high:g} {axis.unit}, farther than a step; h homes it"
            )
        if onward <= axis.step * THERE:
            return _limit_reached(axis, axis.high if way is Key.MORE else axis.low)
        return ""

    def _tell_once(self, text: str) -> list[Action]:
        """Say it unless it is what was said last; the way is free again where it is empty."""
        known, self._told = self._told, text
        return [Say(text)] if text and text != known else []

    def _ask_to_home(self, now_s: float) -> str:
        axis = self.chosen
        if self._blocked or self.pressed:
            return f"{axis.name} is not homed now: {self._blocked or 'the force is over its limit'}"
        self._homing_asked_s = now_s
        return (
            f"y within {CONFIRM_S:g} s homes {axis.name}: it searches its reference by itself, as "
            "its drive is set; any key then stops it"
        )


def _limit_reached(axis: Axis, limit: float) -> str:
    return f"limit {limit:g} {axis.unit} of {axis.name} reached"


def _in_words(axis: Axis, way: Key | None) -> str:
    return f"{axis.name} {'-' if way is Key.LESS else '+'}"
