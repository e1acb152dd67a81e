"""The drives of the axes that keys move: where they stand, what moves them and what stops them."""

from __future__ import annotations

from collections.abc import Sequence

from rig.bench.connected import Bench
from rig.jog.axes import LinearMover, RotaryMover
from rig.jog.keys import AxisPosition
from rig.run.arming import Arming

OTHERS_EVERY_S = 0.5
"""Interval between polls of the axes that are not chosen."""


class JogDrives:
    """The drives of the axes `names`, with the position at which each was last seen."""

    def __init__(self, bench: Bench, names: Sequence[str]):
        self._clock = bench.clock
        self._movers: dict[str, LinearMover | RotaryMover] = {
            name: RotaryMover(bench.rotary)
            if name == "rotary"
            else LinearMover(getattr(bench, name))
            for name in names
        }
        self.positions: dict[str, AxisPosition] = {}
        """Positions by axis; empty until `stop` has been called once."""
        self._others_at_s = 0.0

    def register(self, arming: Arming, deadline_s: float) -> None:
        """Have every drive stopped at the end, each within `deadline_s`."""
        for name, mover in self._movers.items():
            arming.register(name, mover.stage.stop, deadline_s, mover.stage.make_safe)

    def start(self, name: str, target: float, speed: float) -> None:
        """Begin to move an axis, or give the motion under way a new target; mm or deg, per s."""
        self._movers[name].start(target, speed)

    def check_motion(self, name: str) -> None:
        """Raise the reason why the motion of an axis has ended, if it ended by a fault."""
        self._movers[name].stage.moving()

    def home(self, name: str) -> None:
        """Let an axis find its reference; return once it has."""
        self._movers[name].stage.home()

    def stop_one(self, name: str) -> None:
        """Stop one axis and read where it stands."""
        self._movers[name].stage.stop()
        self.poll_one(name)

    def stop(self, first: str | None) -> None:
        """Stop every axis, `first` before the others; then read positions and references."""
        names = sorted(self._movers, key=lambda name: name != first)
        for name in names:
            self._movers[name].stage.stop()
        for name in names:
            mover = self._movers[name]
            self.positions[name] = AxisPosition(mover.position(), mover.stage.homed())

    def poll(self, chosen: str) -> None:
        """Read the position of the chosen axis, and every `OTHERS_EVERY_S` those of the others."""
        now = self._clock.now()
        others = now - self._others_at_s >= OTHERS_EVERY_S
        if others:
            self._others_at_s = now
        for name in self._movers:
            if others or name == chosen:
                self.poll_one(name)

    def poll_one(self, name: str) -> None:
        """Read the position of one axis."""
        homed = self.positions[name].homed
        self.positions[name] = AxisPosition(self._movers[name].position(), homed)
