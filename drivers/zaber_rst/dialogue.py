"""Questions to a Zaber stage and their answers as values: identity, units, angle and flags.

Nothing here turns the stage or sets anything; the driver adds that, the reader does not.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from drivers.zaber_rst.frames import Reply
from drivers.zaber_rst.link import ZaberLink
from drivers.zaber_rst.settings import (
    FLAGS,
    OLDEST_FIRMWARE,
    REASONS,
    UNKNOWN_FLAG,
    UNKNOWN_REASON,
    ZaberRstSettings,
)
from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Identity

DEVICE = "rotary"
THE_DEVICE = 0
"""The axis number that means the whole device."""
FULL_TURN_deg = 360.0
LOOK = "check the stage and what is mounted on it"

_NUMBER = re.compile(r"-?\d+(\.\d+)?")


class ZaberRejectionError(InstrumentError):
    """The stage rejected a command."""


class ZaberDialogue:
    """One axis and what can be asked of it, over a link of its own."""

    def __init__(self, settings: ZaberRstSettings, clock: Clock):
        self._settings = settings
        self.link = ZaberLink(
            DEVICE,
            settings.port,
            settings.baudrate,
            settings.device,
            settings.timeout_s,
            clock,
        )
        self.position = "pos"
        """The setting that holds the angle: the encoder's, where there is one (`check_units`)."""

    # --- one exchange -------------------------------------------------------------------------

    def command(
        self, words: str, charge: bool = True, permit: Callable[[], None] = lambda: None
    ) -> Reply:
        """Send a command to the axis; a rejection raises."""
        return self._accepted(words, self.link.ask(self._settings.axis, words, charge, permit))

    def number(self, name: str, axis: int | None = None) -> float:
        """Return a setting of the stage's axis as a number, or of another `axis`: 0 is the device.
        Raises InstrumentError where the stage refuses, or its answer is not a number."""
        words = f"get {name}"
        reply = self.link.ask(self._settings.axis if axis is None else axis, words)
        return self._as_number(words, self._accepted(words, reply).data)

    def angle(self) -> tuple[float, Reply]:
        """Return the angle in deg, with the reply, which carries status and gravest flag."""
        words = f"get {self.position}"
        reply = self.command(words)
        return self._as_number(words, reply.data) * self._settings.microstep_deg, reply

    def flags(self) -> list[str]:
        """Return all warning flags that stand, the gravest first.

        Raises InstrumentError if their number is not the one that the stage states.
        """
        reply = self.command("warnings")
        count, *flags = reply.data.split()
        if not count.isdigit() or int(count) != len(flags):
            raise self.error("warnings", f"answers {reply.data!r}", LOOK)
        return flags

    def _accepted(self, words: str, reply: Reply) -> Reply:
        if reply.accepted:
            return reply
        known = REASONS.get(reply.data, UNKNOWN_REASON)
        raise ZaberRejectionError(
            DEVICE, words, f"rejected with {reply.data}: {known.meaning}", known.remedy
        )

    def _device_setting(self, name: str) -> str:
        """Return a setting of the whole device."""
        words = f"get {name}"
        return self._accepted(words, self.link.ask(THE_DEVICE, words)).data

    def _as_number(self, words: str, data: str) -> float:
        if _NUMBER.fullmatch(data) is None:
            raise self.error(words, f"answers {data!r}, which is not a number", LOOK)
        return float(data)

    # --- who is there -------------------------------------------------------------------------

    def identify(self) -> Identity:
        """Return the identity of the stage. Raises InstrumentError for another device."""
        number = self._device_setting("deviceid")
        serial, firmware = self._device_setting("system.serial"), self._device_setting("version")
        turn = self._turn()
        parts = re.fullmatch(r"(\d+)\.(\d+)", firmware)
        version = (int(parts[1]), int(parts[2])) if parts else (0, 0)
        if turn == 0 or version < OLDEST_FIRMWARE:
            oldest = ".".join(map(str, OLDEST_FIRMWARE))
            raise self.error(
                "identify",
                f"{self.link.where} has device id {number}, serial number {serial}, firmware "
                f"{firmware}" + (" and is not a rotary stage" if turn == 0 else ""),
                f"a rotary stage with firmware {oldest} or later is expected; correct port and "
                "device in the bench file, or update the stage",
            )
        axes = self.number("system.axiscount", THE_DEVICE)
        if axes < self._settings.axis:
            raise self.error(
                "identify",
                f"{self.link.where} has no axis {self._settings.axis}; it has {axes:g}",
                "correct axis in the bench file",
            )
        return Identity("Zaber", f"X-RST (device id {number})", serial, firmware)

    def _turn(self) -> float | None:
        """Return microsteps in one turn; 0 for a linear axis, None where the stage does not report
        it."""
        reply = self.link.ask(self._settings.axis, "get limit.cycle.dist")
        if not reply.accepted:
            return None
        return self._as_number("get limit.cycle.dist", reply.data)

    def check_units(self) -> None:
        """Check that a microstep is as the bench file states, and find the setting from which the
        angle is read.

        Raises InstrumentError if the stage's microstep differs.
        """
        own = self._settings
        resolution = self.number("resolution")
        if resolution != own.resolution:
            raise self.error(
                "get resolution",
                f"the stage has {resolution:g} microsteps in a full step, the bench file says "
                f"{own.resolution}: a microstep would be "
                f"{own.microstep_deg * own.resolution / max(resolution, 1):.9g} deg",
                "set the stage's resolution, or correct resolution and microstep_deg",
            )
        turn = self._turn()
        if turn is not None and abs(turn - FULL_TURN_deg / own.microstep_deg) > 0.5:
            raise self.error(
                "get limit.cycle.dist",
                f"the stage has {turn:g} microsteps in a turn: a microstep is "
                f"{FULL_TURN_deg / turn:.9g} deg, not {own.microstep_deg:.9g} deg",
                "correct microstep_deg in the bench file",
            )
        encoder = self.link.ask(own.axis, "get encoder.pos")
        self.position = "encoder.pos" if encoder.accepted else "pos"

    # --- what goes wrong ----------------------------------------------------------------------

    def flagged(self, command: str, flag: str) -> InstrumentError:
        """Return the error for a flag that keeps the stage from what was asked."""
        known = FLAGS.get(flag, UNKNOWN_FLAG)
        return self.error(command, f"the stage reports {flag}: {known.meaning}", known.remedy)

    def error(self, command: str, cause: str, hint: str) -> InstrumentError:
        """Return an error of this stage."""
        return InstrumentError(DEVICE, command, cause, hint)
