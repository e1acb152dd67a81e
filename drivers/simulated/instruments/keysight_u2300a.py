"""Simulated Keysight U2300A-family data acquisition unit, as SCPI core.

It may keep its settings, ask the World for volts at given instants, and quantise them. It may not
wait: whether an acquisition is over follows from the World's time when it is asked for.

Codes and volts, for a range R (source: the family's programmer's reference as a public driver
quotes it). 12-bit models send the code left-justified in an int16; with ``c = word >> 4``:

    bipolar   V = c * 2 R / (2**12 - 1)
    unipolar  V = c * R / (2**12 - 1) + R / 2

16-bit models send the code itself:

    bipolar   V = c / 32768 * R
    unipolar  V = (c / 65536 + 0.5) * R

A multiplexed unit converts one channel after the other: the k-th channel of a scan is k / (rate *
channels) late, or k / (largest aggregate rate) with ``ACQ:BURS ON``. The U254x convert together.

What the family's documents leave open is marked UNCONFIRMED, each in one place.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.simulated.ports import AnalogueInputPort, DigitalInputPort, LogPort
from drivers.simulated.transports.scpi import (
    Boolean,
    Call,
    ChannelList,
    Choice,
    Numeric,
    ScpiBlock,
    ScpiCommand,
    ScpiError,
    ScpiInstrument,
    ScpiQuantity,
)

RANGES_12_BIT_V = (10.0, 5.0, 2.5, 2.0, 1.25, 1.0, 0.5, 0.25, 0.2, 0.05)
RANGES_16_BIT_V = (10.0, 5.0, 2.5, 1.25)
LOWEST_RATE_S_s = 3
BUFFER_SAMPLES = 8_000_000
"""Samples of all channels that the unit holds (UNCONFIRMED for continuous acquisition)."""
SMALLEST_BLOCK = 1
"""Points per channel of the smallest continuous block (UNCONFIRMED)."""
DEFAULT_RATE_S_s = 1000
DEFAULT_POINTS = 500
FIRST_CHANNEL = 101
DIGITAL_BITS = {501: 8, 502: 8, 503: 4, 504: 4}
"""Bits of each digital channel. They are inputs when the unit is switched on (UNCONFIRMED), and may
be read while an acquisition runs (UNCONFIRMED)."""


CONVERTED_ROWS = 32_768
"""Rows of a single shot that are converted at once while time passes: some 10 ms of processor
time."""


class Terminals(AnalogueInputPort, DigitalInputPort, Protocol):
    """The signals at the unit's terminals."""


@dataclass(frozen=True)
class SimulatedDaqModel:
    """The differences between the units of the family."""

    bits: int
    channels: int
    single_rate_S_s: int
    """Largest rate with one channel in the scan."""
    aggregate_rate_S_s: int
    """Largest sum of the channels' rates with several."""
    ranges_V: tuple[float, ...]
    simultaneous: bool = False
    """Converts all channels together (UNCONFIRMED for the U254x); selected by ``ROUT:ENAB``."""

    def highest_rate(self, channels: int) -> int:
        """Return the largest rate per channel, in S/s, with `channels` channels in the scan."""
        if channels == 1 or self.simultaneous:
            return self.single_rate_S_s
        return self.aggregate_rate_S_s // channels

    def skew_s(self, channels: int, rate_S_s: int, burst: bool) -> tuple[float, ...]:
        """Return the delay of each channel of a scan after the first, in s."""
        if self.simultaneous:
            return (0.0,) * channels
        conversions_per_s = self.aggregate_rate_S_s if burst else rate_S_s * channels
        return tuple(position / conversions_per_s for position in range(channels))


MODELS: dict[str, SimulatedDaqModel] = {
    "U2331A": SimulatedDaqModel(12, 64, 3_000_000, 1_000_000, RANGES_12_BIT_V),
    "U2351A": SimulatedDaqModel(16, 16, 250_000, 250_000, RANGES_16_BIT_V),
    "U2352A": SimulatedDaqModel(16, 16, 250_000, 250_000, RANGES_16_BIT_V),
    "U2353A": SimulatedDaqModel(16, 16, 500_000, 500_000, RANGES_16_BIT_V),
    "U2354A": SimulatedDaqModel(16, 16, 500_000, 500_000, RANGES_16_BIT_V),
    "U2355A": SimulatedDaqModel(16, 64, 250_000, 250_000, RANGES_16_BIT_V),
    "U2356A": SimulatedDaqModel(16, 64, 500_000, 500_000, RANGES_16_BIT_V),
    "U2541A": SimulatedDaqModel(16, 4, 250_000, 1_000_000, RANGES_16_BIT_V, simultaneous=True),
    "U2542A": SimulatedDaqModel(16, 4, 500_000, 2_000_000, RANGES_16_BIT_V, simultaneous=True),
}


@dataclass(frozen=True)
class SimulatedInput:
    """Settings of one channel."""

    range_V: float = 10.0
    polarity: str = "BIP"
    signal_type: str = "SING"


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


def codes_of_volts(
    volts: npt.NDArray[np.float64], range_V: float, polarity: str, bits: int
) -> npt.NDArray[np.int16]:
    """Return the volts, quantised and clipped at the rails, as the words that a unit sends.

    The module's docstring has the formulas.
    """
    steps = 2**bits - 1 if bits == 12 else 2**bits
    span = 2 * range_V if polarity == "BIP" else range_V
    middle = 0.0 if polarity == "BIP" else range_V / 2
    half = 2 ** (bits - 1)
    codes = np.clip(np.rint((volts - middle) * (steps / span)), -half, half - 1)
    return np.asarray(codes * 2 ** (16 - bits), dtype=np.int16)


def volts_of_codes(
    words: npt.NDArray[np.int16], range_V: float, polarity: str, bits: int
) -> npt.NDArray[np.float64]:
    """Return the volts that a client computes from the words: the inverse of `codes_of_volts`."""
    steps = 2**bits - 1 if bits == 12 else 2**bits
    span = 2 * range_V if polarity == "BIP" else range_V
    middle = 0.0 if polarity == "BIP" else range_V / 2
    codes = np.right_shift(words, 16 - bits).astype(np.float64)
    return np.asarray(codes * (span / steps) + middle)


class KeysightU2300A(ScpiInstrument):
    """The unit's SCPI core over the World's input terminals, which are named as its channels are.

    ``model`` is a key of `MODELS`; ``name`` is the unit's name in the World's log;
    ``buffer_samples`` is what its buffer holds, all channels together.
    """

    BLOCK_TERMINATOR = b""

    def __init__(
        self,
        model: str,
        port: Terminals,
        log: LogPort,
        name: str = "daq",
        buffer_samples: int = BUFFER_SAMPLES,
    ):
        self.model = MODELS[model]
        self._buffer_samples = buffer_samples
        self._port = port
        self._log = log
        self._name = name
        self._acquisition: SimulatedAcquisition | None = None
        self._converted: list[npt.NDArray[np.int16]] = []
        """Words of the present single shot that `settle` has converted, `CONVERTED_ROWS` each."""
        self._defaults()
        super().__init__(
            ("Agilent Technologies", model, "SIMULATED", "A.2010.01.01"), self._commands()
        )

    def reset(self, by: str) -> None:
        """Reset as ``*RST`` does: nothing runs; channel 101, 10 V bipolar, 1 kS/s, 500 points."""
        self._end("stop", by)
        self._defaults()

    def overrun(self) -> None:
        """Overrun the buffer of a running acquisition, for a fault plan."""
        acquisition = self._caught_up()
        if acquisition is not None and not acquisition.lost and not self._is_complete():
            self._lose(acquisition)

    # --- the command table -------------------------------------------------------------------

    def _commands(self) -> list[ScpiCommand]:
        return [
            *self._scan_commands(),
            *self._input_commands(),
            *self._acquisition_commands(),
            *self._trigger_commands(),
            *self._data_commands(),
            *self._digital_commands(),
        ]

    def _scan_commands(self) -> list[ScpiCommand]:
        if self.model.simultaneous:
            return [
                ScpiCommand("ROUTe:ENABle", self._enable, (Boolean(), ChannelList())),
                ScpiCommand("ROUTe:ENABle?", self._enabled, (ChannelList(),)),
            ]
        return [
            ScpiCommand("ROUTe:SCAN", self._set_scan, (ChannelList(),)),
            ScpiCommand("ROUTe:SCAN?", lambda _: f"(@{','.join(map(str, self._scan))})"),
        ]

    def _input_commands(self) -> list[ScpiCommand]:
        types = Choice("SINGle", "DIFFerential", "NRSingle")
        rows: list[ScpiCommand] = []
        for root in ("[ROUTe:]CHANnel:", "[SENSe:]VOLTage:"):
            rows += [
                ScpiCommand(root + "RANGe", self._set_range, (Numeric(("V",)), ChannelList())),
                ScpiCommand(root + "RANGe?", self._get_range, (ChannelList(),)),
                *self._input_word(root + "POLarity", "polarity", Choice("BIPolar", "UNIPolar")),
                *self._input_word(root + "STYPe", "signal_type", types),
            ]
        return rows

    def _input_word(self, pattern: str, field: str, kind: Choice) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            word, channels = call.arguments
            for channel in self._known(channels):
                self._inputs[channel] = replace(self._inputs[channel], **{field: word})

        def read(call: Call) -> str:
            channels = self._known(call.arguments[0])
            return ",".join(getattr(self._inputs[channel], field) for channel in channels)

        return [
            ScpiCommand(pattern, write, (kind, ChannelList())),
            ScpiCommand(pattern + "?", read, (ChannelList(),)),
        ]

    def _acquisition_commands(self) -> list[ScpiCommand]:
        return [
            *self._whole_number("ACQuire:SRATe", "_rate", self._rate_bounds, ("HZ",)),
            *self._whole_number("ACQuire:POINts", "_points", self._points_bounds),
            *self._whole_number("WAVeform:POINts", "_block_points", self._block_bounds),
            ScpiCommand("ACQuire:BURSt", self._set_burst, (Boolean(),)),
            ScpiCommand("ACQuire:BURSt?", lambda _: str(int(self._burst))),
            ScpiCommand("DIGitize", lambda call: self._begin(call.by, continuous=False)),
            ScpiCommand("RUN", lambda call: self._begin(call.by, continuous=True)),
            ScpiCommand("STOP", lambda call: self._end("stop", call.by)),
        ]

    def _whole_number(
        self,
        pattern: str,
        field: str,
        bounds: Callable[[], tuple[int, int]],
        units: tuple[str, ...] = (),
    ) -> list[ScpiCommand]:
        def asked(quantity: ScpiQuantity) -> float:
            low, high = bounds()
            return {"": quantity.value, "MIN": low, "MAX": high}[quantity.keyword]

        def write(call: Call) -> None:
            self._refuse_while_running()
            setattr(self, field, self._clip(asked(call.arguments[0]), *bounds()))

        def read(call: Call) -> str:
            return f"{asked(call.arguments[0]) if call.arguments else getattr(self, field):.0f}"

        kind = Numeric(units, ("MIN", "MAX"))
        return [
            ScpiCommand(pattern, write, (kind,)),
            ScpiCommand(pattern + "?", read, (kind,), optional=1),
        ]

    def _trigger_commands(self) -> list[ScpiCommand]:
        words = {
            "TRIGger:SOURce": Choice("NONE", "EXTD", "EXTA", "STRG"),
            "TRIGger:TYPe": Choice("POST", "PRE", "MID", "DELay"),
            "TRIGger:DTRiGger:POLarity": Choice("POSitive", "NEGative"),
            "TRIGger:ATRiGger:CONDition": Choice("AHIGh", "BLOW", "WINDow"),
        }
        return [row for item in words.items() for row in self._trigger_word(*item)]

    def _trigger_word(self, pattern: str, kind: Choice) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            self._words[pattern] = call.arguments[0]

        return [
            ScpiCommand(pattern, write, (kind,)),
            ScpiCommand(pattern + "?", lambda _: self._words[pattern]),
        ]

    def _data_commands(self) -> list[ScpiCommand]:
        return [
            ScpiCommand("WAVeform:COMPlete?", lambda _: "YES" if self._is_complete() else "NO"),
            ScpiCommand("WAVeform:STATus?", self._status),
            ScpiCommand("WAVeform:DATA?", self._data),
            ScpiCommand("MEASure[:VOLTage][:DC]?", self._measure, (ChannelList(),)),
        ]

    def _digital_commands(self) -> list[ScpiCommand]:
        ways = Choice("INPut", "OUTPut")
        root = "CONFigure:DIGital:DIRection"
        return [
            ScpiCommand(root, self._set_direction, (ways, ChannelList())),
            ScpiCommand(root + "?", self._directions, (ChannelList(),)),
            ScpiCommand("MEASure:DIGital?", self._digital, (ChannelList(),)),
        ]

    def _set_direction(self, call: Call) -> None:
        way, channels = call.arguments
        for channel in self._known_digital(channels):
            self._ways[channel] = way

    def _directions(self, call: Call) -> str:
        return ",".join(self._ways[one] for one in self._known_digital(call.arguments[0]))

    def _digital(self, call: Call) -> str:
        """Return the bits of each channel as one number; what an output reads back as is
        UNCONFIRMED."""
        return ",".join(
            str(sum(self._bit(one, bit) << bit for bit in range(DIGITAL_BITS[one])))
            for one in self._known_digital(call.arguments[0])
        )

    def _bit(self, channel: int, bit: int) -> bool:
        if self._ways[channel] != "INP":
            return False
        return self._port.input_high(self._name, f"{channel}.{bit}")

    def _known_digital(self, channels: tuple[int, ...]) -> tuple[int, ...]:
        if not all(channel in DIGITAL_BITS for channel in channels):
            raise ScpiError(-222, "no such channel")
        return channels

    # --- settings ----------------------------------------------------------------------------

    def _defaults(self) -> None:
        first = FIRST_CHANNEL
        self._inputs = {first + index: SimulatedInput() for index in range(self.model.channels)}
        self._ways = dict.fromkeys(DIGITAL_BITS, "INP")
        self._scan: tuple[int, ...] = (first,)
        self._rate = DEFAULT_RATE_S_s
        self._points = DEFAULT_POINTS
        self._block_points = DEFAULT_POINTS
        self._burst = False
        self._words = {
            "TRIGger:SOURce": "NONE",
            "TRIGger:TYPe": "POST",
            "TRIGger:DTRiGger:POLarity": "POS",
            "TRIGger:ATRiGger:CONDition": "AHIG",
        }

    def _clip(self, value: float, low: int, high: int) -> int:
        """Return a whole number within [low, high]; moving it there queues -222.

        Rates are whole S/s (UNCONFIRMED): a client reads back what it got.
        """
        clipped = min(max(value, low), high)
        if clipped != value:
            self.report(ScpiError(-222, "value clipped"))
        return math.floor(clipped)

    def _rate_bounds(self) -> tuple[int, int]:
        return LOWEST_RATE_S_s, self.model.highest_rate(len(self._scan))

    def _points_bounds(self) -> tuple[int, int]:
        return 1, self._buffer_samples // len(self._scan)

    def _block_bounds(self) -> tuple[int, int]:
        return SMALLEST_BLOCK, self._buffer_samples // len(self._scan)

    def _known(self, channels: tuple[int, ...]) -> tuple[int, ...]:
        if not all(channel in self._inputs for channel in channels):
            raise ScpiError(-222, "no such channel")
        return channels

    def _set_scan(self, call: Call) -> None:
        self._scan_becomes(self._known(call.arguments[0]))

    def _enable(self, call: Call) -> None:
        on, channels = call.arguments
        named = set(self._known(channels))
        chosen = set(self._scan) | named if on else set(self._scan) - named
        self._scan_becomes(tuple(sorted(chosen)))

    def _enabled(self, call: Call) -> str:
        return ",".join(str(int(c in self._scan)) for c in self._known(call.arguments[0]))

    def _scan_becomes(self, channels: tuple[int, ...]) -> None:
        """Refused while the rate or the points would be too many for it (UNCONFIRMED how)."""
        self._refuse_while_running()
        if not channels or len(set(channels)) != len(channels):
            raise ScpiError(-224, "a scan names each channel once, and one at least")
        if self._rate > self.model.highest_rate(len(channels)):
            raise ScpiError(-221, "sampling rate too high for the scan list")
        if max(self._points, self._block_points) * len(channels) > self._buffer_samples:
            raise ScpiError(-221, "too many points for the scan list")
        self._scan = channels

    def _set_range(self, call: Call) -> None:
        quantity, channels = call.arguments
        ranges = self.model.ranges_V
        keywords = {"MIN": ranges[-1], "MAX": ranges[0], "DEF": ranges[0]}
        asked = keywords.get(quantity.keyword, quantity.value)
        chosen = min((r for r in ranges if r >= asked), default=ranges[0])
        known = self._known(channels)
        if chosen != asked:
            self.report(ScpiError(-222, "no such range; the next one was taken"))  # UNCONFIRMED
        for channel in known:
            self._inputs[channel] = replace(self._inputs[channel], range_V=chosen)

    def _get_range(self, call: Call) -> str:
        return ",".join(f"{self._inputs[c].range_V:g}" for c in self._known(call.arguments[0]))

    def _set_burst(self, call: Call) -> None:
        self._refuse_while_running()
        self._burst = call.arguments[0]

    # --- acquisition -------------------------------------------------------------------------

    def _refuse_while_running(self) -> None:
        acquisition = self._caught_up()
        if acquisition is not None and not acquisition.lost and not self._is_complete():
            raise ScpiError(-221, "acquisition is running")

    def _begin(self, by: str, continuous: bool) -> None:
        self._refuse_while_running()
        self._converted = []
        self._acquisition = SimulatedAcquisition(
            number=self._port.begin_acquisition(),
            start_us=self._port.now_us,
            rate_S_s=self._rate,
            channels=self._scan,
            inputs=tuple(self._inputs[channel] for channel in self._scan),
            skew_s=self.model.skew_s(len(self._scan), self._rate, self._burst),
            points=self._block_points if continuous else self._points,
            continuous=continuous,
            triggered=self._words["TRIGger:SOURce"] == "NONE",
        )
        self._log.log(self._name, "acquisition", "run" if continuous else "digitize", by)

    def _end(self, why: str, by: str) -> None:
        if self._acquisition is not None:
            self._log.log(self._name, "acquisition", why, by)
        self._acquisition = None
        self._converted = []

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

    def _rows_converted(self) -> int:
        return len(self._converted) * CONVERTED_ROWS

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
        self._log.log(self._name, "acquisition", "overrun", "itself")
        self._acquisition = lost = replace(acquisition, lost=True)
        return lost

    def _is_complete(self) -> bool:
        acquisition = self._acquisition
        if acquisition is None:
            return True
        if acquisition.continuous:
            return acquisition.lost
        return acquisition.taken(self._port.now_us) >= acquisition.points

    def _status(self, call: Call) -> str:
        acquisition = self._caught_up()
        if acquisition is None:
            return "EPTY"
        if acquisition.lost:
            return "OVER"
        unread = acquisition.taken(self._port.now_us) - acquisition.read
        if unread <= 0:
            return "EPTY"
        return "DATA" if unread >= acquisition.points else "FRAG"

    def _data(self, call: Call) -> ScpiBlock:
        """Return one block, or the whole single shot; an empty block and error -230 if there is
        none yet.

        UNCONFIRMED: the answer of a real unit to a read that comes too early.
        """
        acquisition = self._caught_up()
        if acquisition is None or acquisition.lost:
            self.report(ScpiError(-230, "no acquisition"))
            return ScpiBlock(b"")
        first = acquisition.read if acquisition.continuous else 0
        if acquisition.taken(self._port.now_us) < first + acquisition.points:
            self.report(ScpiError(-230, "not acquired yet"))
            return ScpiBlock(b"")
        self._acquisition = replace(acquisition, read=first + acquisition.points)
        # A block of a stream is not converted before; a single shot is up to its last rows.
        ready = 0 if acquisition.continuous else self._rows_converted()
        rest = self._samples_of(acquisition, first + ready, acquisition.points - ready)
        words = np.concatenate([*self._converted, rest]) if ready else rest
        codes = np.right_shift(words, 16 - self.model.bits).astype("<i2")
        handed_out = {
            "acquisition": acquisition.number,
            "first": first,
            "rows": acquisition.points,
            "crc32": zlib.crc32(codes.tobytes()),
        }
        self._log.log(self._name, "block", handed_out, call.by)
        return ScpiBlock(words.astype("<i2").tobytes())

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
                volts[:, column], settings.range_V, settings.polarity, self.model.bits
            )
        return words

    def _measure(self, call: Call) -> str:
        """Return one quantised voltage of each channel, converted now."""
        channels = self._known(call.arguments[0])
        self._refuse_while_running()
        skew = self.model.skew_s(len(channels), self.model.highest_rate(len(channels)), True)
        now_us, number = self._port.now_us, self._port.begin_acquisition()
        volts = self._port.volts(number, channels, now_us, 1.0, 0, 1, skew)[0]
        replies = []
        for channel, value in zip(channels, volts, strict=True):
            settings = (self._inputs[channel].range_V, self._inputs[channel].polarity)
            word = codes_of_volts(np.array([value]), *settings, self.model.bits)
            replies.append(f"{volts_of_codes(word, *settings, self.model.bits)[0]:.6f}")
        return ",".join(replies)
