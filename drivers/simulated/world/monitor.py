"""The World's own monitor of the program that drives it: checks after every step for what must not
happen.

It reads forces, axes and outputs and writes to the World's log; it changes nothing. What it finds
is logged as ``violation``. It runs only where the World's settings ask for it.

- The force by which the stages press stays below its limit but for what a sensor cannot know yet:
  beyond the limit it never gets further than it has risen within one `reaction_s`, and never stays
  beyond it for longer than `longest_over_s`.
- The largest force by which the stages have pressed is logged as ``largest-force`` at the
  end, the latest as ``last-force``, and the longest time without a break over the limit as
  ``longest-over-limit``, in s.
- Where the World ends, because its run has said so or has died, nothing moves or is driven.

It also writes down what a record can be held against: where the carriages really were while they
moved (``places``), and a checksum of every frame that the force sensor sends; the DAQ logs its
blocks by itself.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.simulated.ports import Exchange, SerialInstrument
from rig.core.settings import Settings

STEP_us = 1000
"""Between the instants at which the force is checked."""
FRAME_VALUES = slice(3, 15)
"""Bytes of a frame of three floats."""
FRAME_BYTES = (16, 18)
"""Without and with a CRC."""

PLACE_DIGITS = 4
"""Decimal places of a carriage's position in the log: 0.1 um."""

Report = Callable[[str, object], None]
Places = Callable[[npt.NDArray[np.int64]], npt.NDArray[np.float64]]
"""Positions in mm or deg, (n,), of a carriage at ascending World times in us, (n,)."""
PRESSED_N = 0.2
"""Force from which the stages press on something."""


class WatchSettings(Settings):
    """The limits that a monitored World is checked against."""

    force_limit_N: float = Field(gt=0)
    """Along any axis, of what the stages press with."""
    reaction_s: float = Field(default=0.015, gt=0, le=60)
    """Time in s within which a force over the limit has to stop rising: one delivery of frames,
    which is the longest advance of a slaved bench, and the axis's braking."""
    longest_over_s: float = Field(default=0.3, gt=0)
    """Time in s after which a force over the limit has to be below it again: reaction, braking and
    the beginning of the way off. A force that has stopped rising crushes a sensor all the same."""


class Monitor:
    """Monitors one World. `force_N` gives what the stages press with, (n,) World seconds to (n, 3);
    `active` names what moves or is driven now; `places` says by role where the carriages are."""

    def __init__(
        self,
        settings: WatchSettings,
        force_N: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]],
        active: Callable[[], Iterable[str]],
        report: Report,
        places: Mapping[str, Places] | None = None,
    ):
        self._settings, self._force_N, self._active, self._report = (
            settings,
            force_N,
            active,
            report,
        )
        self._places = places or {}
        self._rests_at: dict[str, float] = {}
        """Latest position of each carriage that was written down."""
        self._before = max(1, round(settings.reaction_s * 1e6 / STEP_us))
        self._recent = np.zeros(self._before)
        """Forces at the steps before the next one, N."""
        self._next_us = 0
        self._allowed_N = 0.0
        """Largest rise within one reaction since the force went over its limit."""
        self._reported = False
        self._over_since_us: int | None = None
        self._reported_long = False
        self._longest_over_us = 0
        self._largest_N = 0.0
        self._pressed = False

    def check(self, now_us: int) -> None:
        """Check everything since the last call."""
        times = np.arange(self._next_us, now_us + 1, STEP_us)
        if not times.size:
            return
        self._next_us = int(times[-1]) + STEP_us
        force = np.abs(self._force_N(np.asarray(times * 1e-6, np.float64))).max(axis=1)
        self._largest_N = max(self._largest_N, float(force.max()))
        self._note_pressed(force, times)
        self._note_places(times)
        history = np.concatenate([self._recent, force])
        self._recent = history[-self._before :]
        if force.max() <= self._settings.force_limit_N:
            self._allowed_N, self._reported = 0.0, False
            self._over_since_us, self._reported_long = None, False
            return
        self._time_over(force.tolist(), times.tolist())
        for after, before in zip(force.tolist(), history.tolist(), strict=False):
            self._judge(after, after - before)

    def over(self) -> None:
        """Report, at the end of the World and of the run, what is still active, and the largest and
        the last force."""
        for what in self._active():
            self._report("violation", f"{what} although no run is active")
        self._report("largest-force", round(self._largest_N, 3))
        self._report("last-force", round(float(self._recent[-1]), 3))
        self._report("longest-over-limit", round(self._longest_over_us * 1e-6, 3))

    def _note_pressed(
        self, force_N: npt.NDArray[np.float64], times_us: npt.NDArray[np.int64]
    ) -> None:
        """Report each time at which the stages begin or cease to press."""
        pressed = force_N > PRESSED_N
        changes = np.flatnonzero(np.diff(pressed, prepend=self._pressed))
        for at in changes.tolist():
            self._report("pressed" if pressed[at] else "released", {"at_us": int(times_us[at])})
        self._pressed = bool(pressed[-1])

    def _note_places(self, times_us: npt.NDArray[np.int64]) -> None:
        """Report where each carriage was at these times, unless it has stayed where it was."""
        for role, places in self._places.items():
            at = np.round(places(times_us), PLACE_DIGITS)
            if np.all(at == self._rests_at.get(role)):
                continue
            self._rests_at[role] = float(at[-1])
            where = {"role": role, "from_us": int(times_us[0]), "every_us": STEP_us}
            self._report("places", where | {"at": at.tolist()})

    def _time_over(self, force_N: list[float], times_us: list[int]) -> None:
        """Judge how long the force has been over its limit without a break."""
        for force, time_us in zip(force_N, times_us, strict=True):
            if force <= self._settings.force_limit_N:
                self._over_since_us, self._reported_long = None, False
                continue
            if self._over_since_us is None:
                self._over_since_us = time_us
            over_us = time_us - self._over_since_us
            self._longest_over_us = max(self._longest_over_us, over_us)
            if over_us > self._settings.longest_over_s * 1e6 and not self._reported_long:
                self._reported_long = True
                self._report(
                    "violation",
                    f"force of {force:.3g} N, over its limit for more than "
                    f"{self._settings.longest_over_s:g} s",
                )

    def _judge(self, force_N: float, rise_N: float) -> None:
        excess = force_N - self._settings.force_limit_N
        if excess <= 0:
            self._allowed_N, self._reported = 0.0, False
            return
        self._allowed_N = max(self._allowed_N, rise_N)
        if excess > self._allowed_N and not self._reported:
            self._reported = True
            self._report(
                "violation",
                f"force of {force_N:.3g} N, {excess:.3g} N over its limit, which it rose by "
                f"{self._allowed_N:.3g} N at most in {self._settings.reaction_s:g} s",
            )


class WatchedLine:
    """A serial instrument whose frames are written down, each by the CRC-32 of its values."""

    def __init__(self, instrument: SerialInstrument, report: Report):
        self._instrument, self._report = instrument, report

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Return the exchanges of the instrument."""
        return self._instrument.exchanges(data, by)

    def frames_until(self, now_us: int) -> bytes:
        """Return the frames of the instrument; those of three floats are recorded."""
        sent = self._instrument.frames_until(now_us)
        size = FRAME_BYTES[bool(sent and sent[1] & 0x20)]
        if sent and sent[1] & 15 == 2 and len(sent) % size == 0:
            frames = (sent[at : at + size] for at in range(0, len(sent), size))
            self._report("frames", [zlib.crc32(frame[FRAME_VALUES]) for frame in frames])
        return sent
