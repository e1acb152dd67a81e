"""Lifts z off what it presses on a bench whose run has died, unless something speaks against it.

Whoever does this knows less than the run did, so it moves z only

- away from contact: up, never deeper than it stands, to just clear of the earliest contact or to
  the parking position, whichever is nearer;
- slowly (`LIFT_mm_s`), and not after a fault of the drive other than its own communication
  time-out;
- while z knows its position, and every interlock contact is closed and none is latched;
- while the force does not rise, where a force sensor can be read.

Whether z is lifted follows from where it stands, not from the force: a force sensor that is dead
shows no force where one is.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rig.bench.clear_of_contact import CLEAR_mm
from rig.bench.connected import Bench
from rig.bench.settings import FixtureSettings
from rig.control.interlock import STEADY_S
from rig.core.errors import RigError
from rig.instruments.roles import Instrument, ReadsInputs, ReportsFault
from rig.run.interlocks.store import InterlockStore

LIFT_mm_s = 1.0
"""Speed: that of hand control, slow enough for a person to react."""
THERE_mm = 0.002
"""Distance to that place within which z is regarded as clear, in mm."""
RISE_N = 1.0
"""Rise of the force on the way up from which something else is in the way."""
LOOK_EVERY_S = 0.1
"""Interval between two readings of the contacts, which every driver can keep."""
LONGEST_S = 10.0
"""Longest time that a lift may take, and with it the longest way, at `LIFT_mm_s`; a slower stage
has the time that it needs for that way."""

Force = Callable[[], float | None]
"""Return the latest force in N, None where none is known."""


class NotLiftedError(RigError):
    """Raised when z must not be lifted, or when a lift had to be stopped on its way."""


class Lift:
    """One lift on a connected bench; `readers` are the instruments that read contacts."""

    def __init__(
        self,
        bench: Bench,
        readers: dict[str, Instrument],
        store: InterlockStore,
        until_s: float = math.inf,
    ):
        """`until_s` is the time on the bench's clock by which z has to stand again."""
        self._bench, self._readers, self._store = bench, readers, store
        self._clock, self._stage = bench.clock, bench.stage_z
        self._until_s = until_s

    def is_needed(self) -> bool:
        """Return whether z stands where contact may be, or does not know where it stands. Raises
        InstrumentError if it does not answer."""
        if not self._stage.homed():
            return True
        return self._stage.position_mm() > clear_mm(self._bench.settings.fixture) + THERE_mm

    def carry_out(self, force: Force) -> None:
        """Lift z. Raises NotLiftedError, or what the stage raises, and leaves z stopped."""
        self._require_sound()
        before_N = force()
        target_mm = clear_mm(self._bench.settings.fixture)
        limits = self._stage.limits()
        if not limits["position"].holds(target_mm):
            raise NotLiftedError(f"{target_mm:g} mm is outside the limits of stage_z")
        speed_mm_s = limits["speed"].nearest(LIFT_mm_s)
        longest_s = STEADY_S + LONGEST_S * max(1.0, LIFT_mm_s / speed_mm_s)
        give_up_s = min(self._clock.now() + longest_s, self._until_s)
        for _ in range(round(STEADY_S / LOOK_EVERY_S)):
            self._require_contacts()
            self._clock.sleep(LOOK_EVERY_S)
        self._require_contacts()  # last of all before z moves
        if self._clock.now() > give_up_s:
            raise NotLiftedError("no time was left for it")
        try:
            self._stage.start_move(target_mm, speed_mm_s)
            looked_s = self._clock.now()
            while self._stage.moving():
                self._clock.sleep(0.02)
                if self._clock.now() > give_up_s:
                    raise NotLiftedError(
                        f"stage_z has come to {self._stage.position_mm():.2f} mm and not to "
                        f"{target_mm:g} mm in time"
                    )
                self._require_no_rise(before_N, force())
                if self._clock.now() - looked_s >= LOOK_EVERY_S:
                    self._require_contacts()
                    looked_s = self._clock.now()
        finally:
            self._stage.stop()

    def _require_sound(self) -> None:
        """Refuse a stage that is not homed, or that has another fault than its own time-out; let
        one move again that has timed out."""
        if not self._stage.homed():
            raise NotLiftedError("stage_z does not know its position")
        if not isinstance(self._stage, ReportsFault):
            raise NotLiftedError("the driver of stage_z cannot say whether it has a fault")
        fault = self._stage.fault()
        if fault is not None and not self._stage.acknowledge_timeout():
            raise NotLiftedError(f"stage_z has fault {fault}")

    def _require_contacts(self) -> None:
        """Refuse to move while a contact is open or latched, or cannot be read."""
        for one in self._bench.settings.interlock:
            if self._store.get(one.name).opened is not None:
                raise NotLiftedError(f"interlock {one.name!r} is latched")
            reader = self._readers.get(one.role)
            if not isinstance(reader, ReadsInputs):
                raise NotLiftedError(f"interlock {one.name!r} cannot be read")
            if not one.is_closed(reader.inputs_high([one.line])[one.line]):
                raise NotLiftedError(f"interlock {one.name!r} is open")

    def _require_no_rise(self, before_N: float | None, force_N: float | None) -> None:
        if before_N is not None and force_N is not None and force_N > before_N + RISE_N:
            raise NotLiftedError(
                f"the force rose from {before_N:.1f} N to {force_N:.1f} N on the way up: something "
                "is above z"
            )


def clear_mm(fixture: FixtureSettings) -> float:
    """Return where z is clear of contact: just above the earliest one, or parked if that is lower
    or no contact range is stated."""
    if fixture.contact_from_mm is None:
        return fixture.parked_mm
    return max(fixture.contact_from_mm - CLEAR_mm, fixture.parked_mm)
