"""Simulated Keysight U2300A-family data acquisition unit, as SCPI core.

It may keep its settings, ask the World for volts at given instants, and quantise them. It may not
wait: whether an acquisition is over follows from the World's time when it is asked for.

The table of commands is here, by subsystem. What they act on: `u2300a_settings`, the inputs and the
scan of them; `u2300a_converter`, the acquisition and its buffer; `u2300a_digital`. The models of
the family, and the codes in which they send volts, are in `u2300a_models`.

What the family's documents leave open is marked UNCONFIRMED, each in one place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from drivers.simulated.instruments.u2300a_converter import DaqConverter
from drivers.simulated.instruments.u2300a_digital import DigitalChannels
from drivers.simulated.instruments.u2300a_models import MODELS
from drivers.simulated.instruments.u2300a_settings import AnalogueInputs, ScanSettings
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

BUFFER_SAMPLES = 8_000_000
"""Samples of all channels that the unit holds (UNCONFIRMED for continuous acquisition)."""

_SOURCE = "TRIGger:SOURce"
TRIGGER_WORDS = {
    _SOURCE: (Choice("NONE", "EXTD", "EXTA", "STRG"), "NONE"),
    "TRIGger:TYPe": (Choice("POST", "PRE", "MID", "DELay"), "POST"),
    "TRIGger:DTRiGger:POLarity": (Choice("POSitive", "NEGative"), "POS"),
    "TRIGger:ATRiGger:CONDition": (Choice("AHIGh", "BLOW", "WINDow"), "AHIG"),
}
"""The settings of the trigger, which are kept and read back: the words that each may be, and the
one after a reset. Only the source matters here: any but NONE gives no trigger, ever."""

Report = Callable[[ScpiError], None]
"""Queues an error although the command is carried out."""


class Terminals(AnalogueInputPort, DigitalInputPort, Protocol):
    """The signals at the unit's terminals."""


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
        own = MODELS[model]
        self._inputs = AnalogueInputs(own, self.report)
        self._scan = ScanSettings(own, buffer_samples)
        self._trigger = _untouched_trigger()
        self._converter = DaqConverter(own, port, log, name, buffer_samples)
        self._digital = DigitalChannels(port, name)
        scan, converter = self._scan, self._converter
        choose = _enable_commands if own.simultaneous else _scan_commands
        super().__init__(
            ("Agilent Technologies", model, "SIMULATED", "A.2010.01.01"),
            [
                *choose(scan, self._inputs, converter),
                *_input_commands(self._inputs),
                *_acquisition_commands(scan, self._inputs, self._trigger, converter, self.report),
                *_trigger_commands(self._trigger),
                *_data_commands(self._inputs, converter, self.report),
                *_digital_commands(self._digital),
            ],
        )

    def reset(self, by: str) -> None:
        """Reset as ``*RST`` does: nothing runs; channel 101, 10 V bipolar, 1 kS/s, 500 points."""
        self._converter.stop(by)
        self._inputs.reset()
        self._scan.reset()
        self._trigger.update(_untouched_trigger())
        self._digital.reset()

    def overrun(self) -> None:
        """Overrun the buffer of a running acquisition, for a fault plan."""
        self._converter.overrun()

    def settle(self) -> None:
        """Convert what is due, while time passes: see `DaqConverter.settle`."""
        self._converter.settle()


def _untouched_trigger() -> dict[str, str]:
    return {pattern: default for pattern, (_, default) in TRIGGER_WORDS.items()}


# --- ROUTe: which channels a scan has --------------------------------------------------------


def _scan_commands(
    scan: ScanSettings, inputs: AnalogueInputs, converter: DaqConverter
) -> list[ScpiCommand]:
    def write(call: Call) -> None:
        channels = inputs.known(call.arguments[0])
        converter.refuse_while_running()
        scan.choose(channels)

    return [
        ScpiCommand("ROUTe:SCAN", write, (ChannelList(),)),
        ScpiCommand("ROUTe:SCAN?", lambda _: f"(@{','.join(map(str, scan.channels))})"),
    ]


def _enable_commands(
    scan: ScanSettings, inputs: AnalogueInputs, converter: DaqConverter
) -> list[ScpiCommand]:
    """Return what a unit that converts all channels together has in place of a scan list."""

    def write(call: Call) -> None:
        on, channels = call.arguments
        named = set(inputs.known(channels))
        converter.refuse_while_running()
        chosen = set(scan.channels) | named if on else set(scan.channels) - named
        scan.choose(tuple(sorted(chosen)))

    def read(call: Call) -> str:
        channels = inputs.known(call.arguments[0])
        return ",".join(str(int(channel in scan.channels)) for channel in channels)

    return [
        ScpiCommand("ROUTe:ENABle", write, (Boolean(), ChannelList())),
        ScpiCommand("ROUTe:ENABle?", read, (ChannelList(),)),
    ]


# --- ROUTe:CHANnel and SENSe:VOLTage: how a channel is set up --------------------------------


def _input_commands(inputs: AnalogueInputs) -> list[ScpiCommand]:
    types = Choice("SINGle", "DIFFerential", "NRSingle")
    rows: list[ScpiCommand] = []
    for root in ("[ROUTe:]CHANnel:", "[SENSe:]VOLTage:"):
        rows += [
            *_range_commands(root + "RANGe", inputs),
            *_word_commands(root + "POLarity", inputs, "polarity", Choice("BIPolar", "UNIPolar")),
            *_word_commands(root + "STYPe", inputs, "signal_type", types),
        ]
    return rows


def _range_commands(pattern: str, inputs: AnalogueInputs) -> list[ScpiCommand]:
    def write(call: Call) -> None:
        quantity, channels = call.arguments
        inputs.set_range(channels, quantity)

    def read(call: Call) -> str:
        return ",".join(f"{one.range_V:g}" for one in inputs.of(call.arguments[0]))

    return [
        ScpiCommand(pattern, write, (Numeric(("V",)), ChannelList())),
        ScpiCommand(pattern + "?", read, (ChannelList(),)),
    ]


def _word_commands(
    pattern: str, inputs: AnalogueInputs, field: str, kind: Choice
) -> list[ScpiCommand]:
    def write(call: Call) -> None:
        word, channels = call.arguments
        inputs.change(channels, **{field: word})

    def read(call: Call) -> str:
        return ",".join(getattr(one, field) for one in inputs.of(call.arguments[0]))

    return [
        ScpiCommand(pattern, write, (kind, ChannelList())),
        ScpiCommand(pattern + "?", read, (ChannelList(),)),
    ]


# --- ACQuire, WAVeform:POINts, DIGitize, RUN, STOP: acquisitions -----------------------------


def _acquisition_commands(
    scan: ScanSettings,
    inputs: AnalogueInputs,
    trigger: dict[str, str],
    converter: DaqConverter,
    report: Report,
) -> list[ScpiCommand]:
    def whole_number(
        pattern: str, field: str, bounds: Callable[[], tuple[int, int]], *units: str
    ) -> list[ScpiCommand]:
        """Return the commands of a field of the scan's settings."""

        def asked(quantity: ScpiQuantity) -> float:
            low, high = bounds()
            return {"": quantity.value, "MIN": low, "MAX": high}[quantity.keyword]

        def write(call: Call) -> None:
            converter.refuse_while_running()
            setattr(scan, field, _clipped(asked(call.arguments[0]), *bounds(), report))

        def read(call: Call) -> str:
            return f"{asked(call.arguments[0]) if call.arguments else getattr(scan, field):.0f}"

        kind = Numeric(units, ("MIN", "MAX"))
        return [
            ScpiCommand(pattern, write, (kind,)),
            ScpiCommand(pattern + "?", read, (kind,), optional=1),
        ]

    def set_burst(call: Call) -> None:
        converter.refuse_while_running()
        scan.burst = call.arguments[0]

    def begin(call: Call, continuous: bool) -> None:
        triggered = trigger[_SOURCE] == "NONE"
        converter.begin(scan, inputs.of(scan.channels), call.by, continuous, triggered)

    return [
        *whole_number("ACQuire:SRATe", "rate_S_s", scan.rate_bounds, "HZ"),
        *whole_number("ACQuire:POINts", "points", scan.points_bounds),
        *whole_number("WAVeform:POINts", "block_points", scan.block_bounds),
        ScpiCommand("ACQuire:BURSt", set_burst, (Boolean(),)),
        ScpiCommand("ACQuire:BURSt?", lambda _: str(int(scan.burst))),
        ScpiCommand("DIGitize", lambda call: begin(call, continuous=False)),
        ScpiCommand("RUN", lambda call: begin(call, continuous=True)),
        ScpiCommand("STOP", lambda call: converter.stop(call.by)),
    ]


def _clipped(value: float, low: int, high: int, report: Report) -> int:
    """Return a whole number within [low, high]; moving it there queues -222.

    Rates are whole S/s (UNCONFIRMED): a client reads back what it got.
    """
    clipped = min(max(value, low), high)
    if clipped != value:
        report(ScpiError(-222, "value clipped"))
    return math.floor(clipped)


# --- TRIGger ---------------------------------------------------------------------------------


def _trigger_commands(trigger: dict[str, str]) -> list[ScpiCommand]:
    def rows(pattern: str, kind: Choice) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            trigger[pattern] = call.arguments[0]

        return [
            ScpiCommand(pattern, write, (kind,)),
            ScpiCommand(pattern + "?", lambda _: trigger[pattern]),
        ]

    return [row for pattern, (kind, _) in TRIGGER_WORDS.items() for row in rows(pattern, kind)]


# --- WAVeform and MEASure: what was sampled --------------------------------------------------


def _data_commands(
    inputs: AnalogueInputs, converter: DaqConverter, report: Report
) -> list[ScpiCommand]:
    def data(call: Call) -> ScpiBlock:
        """Return one block, or the whole single shot; an empty block and error -230 if there is
        none yet.

        UNCONFIRMED: the answer of a real unit to a read that comes too early.
        """
        try:
            return ScpiBlock(converter.read(call.by).astype("<i2").tobytes())
        except ScpiError as error:
            report(error)
            return ScpiBlock(b"")

    def measure(call: Call) -> str:
        channels = call.arguments[0]
        volts = converter.measure(channels, inputs.of(channels))
        return ",".join(f"{value:.6f}" for value in volts)

    return [
        ScpiCommand("WAVeform:COMPlete?", lambda _: "YES" if converter.is_complete() else "NO"),
        ScpiCommand("WAVeform:STATus?", lambda _: converter.status()),
        ScpiCommand("WAVeform:DATA?", data),
        ScpiCommand("MEASure[:VOLTage][:DC]?", measure, (ChannelList(),)),
    ]


# --- CONFigure:DIGital and MEASure:DIGital ---------------------------------------------------


def _digital_commands(digital: DigitalChannels) -> list[ScpiCommand]:
    def set_direction(call: Call) -> None:
        direction, channels = call.arguments
        digital.set_direction(channels, direction)

    def directions(call: Call) -> str:
        return ",".join(digital.directions(call.arguments[0]))

    def values(call: Call) -> str:
        return ",".join(map(str, digital.values(call.arguments[0])))

    root = "CONFigure:DIGital:DIRection"
    return [
        ScpiCommand(root, set_direction, (Choice("INPut", "OUTPut"), ChannelList())),
        ScpiCommand(root + "?", directions, (ChannelList(),)),
        ScpiCommand("MEASure:DIGital?", values, (ChannelList(),)),
    ]
