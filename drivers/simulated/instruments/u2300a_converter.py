"""Converter of a U2300A and its buffer: the acquisition that runs, and the points it hands out."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.simulated.instruments.u2300a_models import (
    SimulatedDaqModel,
    codes_of_volts,
    volts_of_codes,
)
from drivers.simulated.instruments.u2300a_settings import ScanSettings, SimulatedInput
from drivers.simulated.ports import AnalogueInputPort, LogPort
from drivers.simulated.transports.scpi import ScpiError

CONVERTED_ROWS = 32_768
"""Rows of a single shot that are converted at once while time passes: some 10 ms of processor
time."""


@dataclass(frozen=True)
class SimulatedAcquisition:
    """An acquisition from its start, with all that later settings must not change."""

    number: int
    start_us: int
    rate_S_s: int
    channels: tuple[int, ...]
    inputs: tuple[SimulatedInput, ...]
    skew_s: tuple[float, ...]
    points: int
    """Per channel: of the single shot, or of one block."""
    continuous: bool
    triggered: bool
    """False waits for a trigger that nothing in the simulation gives."""
    read: int = 0
    """Points per channel already handed out."""
    lost: bool = False

    def taken(self, now_us: int) -> int:
        """Return points per channel converted by now."""
        if not self.triggered:
            return 0
        taken = (now_us - self.start_us) * self.rate_S_s // 1_000_000
        return taken if self.continuous else min(taken, self.points)


class DaqConverter:
    """The converter and its buffer: at most one acquisition, which later settings do not change.

    A point of a continuous acquisition is handed out once; a single shot can be read again.
    """

    def __init__(
        self,
        model: SimulatedDaqModel,
        port: AnalogueInputPort,
        log: LogPort,
        name: str,
        buffer_samples: int,
    ):
        self._model = model
        self._port, self._log, self._name = port, log, name
        self._buffer_samples = buffer_samples
        """What the buffer holds, all channels together."""
        self._acquisition: SimulatedAcquisition | None = None
        self._converted: list[npt.NDArray[np.int16]] = []
        """Words of the present single shot that `settle` has converted, `CONVERTED_ROWS` each."""

    # --- from its begin to its end ------------------------------------------------------------

    def begin(
        self,
        scan: ScanSettings,
        inputs: tuple[SimulatedInput, ...],
        by: str,
        continuous: bool,
        triggered: bool,
    ) -> None:
        """Begin an acquisition of the scan, whose channels are set up as `inputs` say, in place of
        the last one. Raises ScpiError while one is running."""
        self.refuse_while_running()
        self._converted = []
        self._acquisition = SimulatedAcquisition(
            number=self._port.begin_acquisition(),
            start_us=self._port.now_us,
            rate_S_s=scan.rate_S_s,
            channels=scan.channels,
            inputs=inputs,
            skew_s=scan.skew_s(),
            points=scan.block_points if continuous else scan.points,
            continuous=continuous,
            triggered=triggered,
        )
        self._log_acquisition("run" if continuous else "digitize", by)

    def stop(self, by: str) -> None:
        """End the acquisition and forget it; nothing happens without one."""
        if self._acquisition is not None:
            self._log_acquisition("stop", by)
        self._acquisition = None
        self._converted = []

    def overrun(self) -> None:
        """Overrun the buffer of a running acquisition, for a fault plan."""
        running = self._running()
        if running is not None:
            self._lose(running)

    def settle(self) -> None:
        """Convert what is due of a single shot, as a real converter does while it samples.

        Called while time passes. A record of 20 s that was converted only when it is read would
        keep the client waiting for all of it at once, beyond its time-out on a busy computer.
        """
        acquisition = self._acquisition
        if acquisition is None or acquisition.continuous:
            return
        taken = acquisition.taken(self._port.now_us)
        while taken >= (first := self._rows_converted()) + CONVERTED_ROWS:
            self._converted.append(self._samples_of(acquisition, first, CONVERTED_ROWS))

    def refuse_while_running(self) -> None:
        """Raise ScpiError while an acquisition is running."""
        if self._running() is not None:
            raise ScpiError(-221, "acquisition is running")

    def _running(self) -> SimulatedAcquisition | None:
        """Return the acquisition that still samples."""
        acquisition = self._caught_up()
        if acquisition is None or acquisition.lost or self.is_complete():
            return None
        return acquisition

    def _caught_up(self) -> SimulatedAcquisition | None:
        """Return the acquisition as it is now; a full buffer has stopped it and lost its data."""
        acquisition = self._acquisition
        if acquisition is None or not acquisition.continuous or acquisition.lost:
            return acquisition
        unread = acquisition.taken(self._port.now_us) - acquisition.read
        if unread * len(acquisition.channels) > self._buffer_samples:
            return self._lose(acquisition)
        return acquisition

    def _lose(self, acquisition: SimulatedAcquisition) -> SimulatedAcquisition:
        self._log_acquisition("overrun", "itself")
        self._acquisition = lost = replace(acquisition, lost=True)
        return lost

    # --- what it has taken --------------------------------------------------------------------

    def is_complete(self) -> bool:
        """Return whether nothing is being sampled; a continuous acquisition ends by an overrun."""
        acquisition = self._acquisition
        if acquisition is None:
            return True
        if acquisition.continuous:
            return acquisition.lost
        return acquisition.taken(self._port.now_us) >= acquisition.points

    def status(self) -> str:
        """Return what can be read: EPTY nothing, FRAG less than a block, DATA a block; OVER after
        an overrun."""
        acquisition = self._caught_up()
        if acquisition is None:
            return "EPTY"
        if acquisition.lost:
            return "OVER"
        unread = acquisition.taken(self._port.now_us) - acquisition.read
        if unread <= 0:
            return "EPTY"
        return "DATA" if unread >= acquisition.points else "FRAG"

    def read(self, by: str) -> npt.NDArray[np.int16]:
        """Return the words of the next block, or of the whole single shot, (points, channels).
        Raises ScpiError if there is none yet."""
        acquisition = self._caught_up()
        if acquisition is None or acquisition.lost:
            raise ScpiError(-230, "no acquisition")
        first = acquisition.read if acquisition.continuous else 0
        if acquisition.taken(self._port.now_us) < first + acquisition.points:
            raise ScpiError(-230, "not acquired yet")
        self._acquisition = replace(acquisition, read=first + acquisition.points)
        # A block of a stream is not converted before; a single shot is up to its last rows.
        ready = 0 if acquisition.continuous else self._rows_converted()
        rest = self._samples_of(acquisition, first + ready, acquisition.points - ready)
        words = np.concatenate([*self._converted, rest]) if ready else rest
        codes = np.right_shift(words, 16 - self._model.bits).astype("<i2")
        handed_out = {
            "acquisition": acquisition.number,
            "first": first,
            "rows": acquisition.points,
            "crc32": zlib.crc32(codes.tobytes()),
        }
        self._log.log(self._name, "block", handed_out, by)
        return words

    def measure(self, channels: tuple[int, ...], inputs: Sequence[SimulatedInput]) -> list[float]:
        """Return one voltage of each channel, quantised, converted now. Raises ScpiError while an
        acquisition is running."""
        self.refuse_while_running()
        count, bits = len(channels), self._model.bits
        skew = self._model.skew_s(count, self._model.highest_rate(count), True)
        now_us, number = self._port.now_us, self._port.begin_acquisition()
        volts = self._port.volts(number, channels, now_us, 1.0, 0, 1, skew)[0]
        measured = []
        for own, value in zip(inputs, volts, strict=True):
            word = codes_of_volts(np.array([value]), own.range_V, own.polarity, bits)
            measured.append(float(volts_of_codes(word, own.range_V, own.polarity, bits)[0]))
        return measured

    def _rows_converted(self) -> int:
        return len(self._converted) * CONVERTED_ROWS

    def _samples_of(
        self, acquisition: SimulatedAcquisition, first: int, rows: int
    ) -> npt.NDArray[np.int16]:
        volts = self._port.volts(
            acquisition.number,
            acquisition.channels,
            acquisition.start_us,
            float(acquisition.rate_S_s),
            first,
            rows,
            acquisition.skew_s,
        )
        words = np.empty(volts.shape, np.int16)
        for column, settings in enumerate(acquisition.inputs):
            words[:, column] = codes_of_volts(
                volts[:, column], settings.range_V, settings.polarity, self._model.bits
            )
        return words

    def _log_acquisition(self, what: str, by: str) -> None:
        self._log.log(self._name, "acquisition", what, by)
