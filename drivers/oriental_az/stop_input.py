"""The STOP input of an AZ drive. As long as it stands, the drive starts nothing, whoever asks."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from drivers.oriental_az.link import AzLink, halves
from drivers.oriental_az.motions import longest_stop_s
from drivers.oriental_az.readings import AzReadings
from drivers.oriental_az.registers import INPUT_COMMAND, AzInput, AzOutput
from drivers.oriental_az.settings import OrientalAzSettings
from rig.core.clock import Clock
from rig.core.errors import InstrumentError, RigError

POLL_S = 0.005
LOOK = "check the drive's display and the axis"
"""Remedy where a drive does not do what it was asked for."""


class StopInput:
    """Switches STOP on, waits for rest, and lifts it; alarms are not reported meanwhile."""

    def __init__(
        self, link: AzLink, readings: AzReadings, settings: OrientalAzSettings, clock: Clock
    ):
        self._link, self._readings = link, readings
        self._settings, self._clock = settings, clock
        self.may_stand = False
        """True from a stop of this program until it is known to be lifted."""

    def switch_on(self, charge: bool = True) -> None:
        """Switch STOP on, ahead of what waits for the line. `charge` off: a time-out does not move
        the bench's clock."""
        self.may_stand = True
        self._link.write(INPUT_COMMAND, halves(AzInput.STOP), charge, urgent=True)

    def switch_on_and_verify(self) -> None:
        """Switch STOP on and read it back, within the drive's time-out; the bench's clock is not
        waited on. Raises InstrumentError where the drive does not have it on."""
        give_up = time.monotonic() + self._settings.timeout_s
        self.switch_on(charge=False)
        while not self._link.read(INPUT_COMMAND, 2, waits=False)[1] & AzInput.STOP:
            if time.monotonic() > give_up:
                raise self._error("make safe", "did not accept the stop")

    def stop_and_lift(self, may_be_lifted: Callable[[], bool]) -> None:
        """Stop, wait for rest, and lift STOP where `may_be_lifted` when it is that write's turn."""
        line = self._link.line
        line.wait_until_free()
        self.switch_on()
        self.await_rest()
        line.wait_until_free()

        def permit() -> None:
            if not may_be_lifted():
                raise _StopStandsError("the stop stands")

        with contextlib.suppress(_StopStandsError):
            self._link.write(INPUT_COMMAND, halves(AzInput.NONE), permit=permit)
            self.may_stand = False

    def await_rest(self) -> None:
        """Wait until the axis is at rest. Raises InstrumentError where it is not in time."""
        longest = longest_stop_s(self._settings)
        give_up = self._clock.now() + longest
        while self._readings.state().outputs & AzOutput.MOVE:
            if self._clock.now() > give_up:
                raise self._error("stop", f"is still moving after {longest:g} s")
            self._clock.sleep(POLL_S)

    def _error(self, command: str, cause: str) -> InstrumentError:
        return InstrumentError(self._link.device, command, cause, LOOK)


class _StopStandsError(RigError):
    """The STOP input may not be lifted: the axis has been made safe meanwhile.

    A RigError, since the line takes every other exception for a failure of its own."""
