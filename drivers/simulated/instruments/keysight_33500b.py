"""Simulated Keysight 33512B: two-channel function generator of the 33500B series, as SCPI core.

It keeps its settings, sets in the World what its terminals carry, and logs what changed. It does
not open connections or wait. Voltages are kept as an open circuit would see them: the amplifier
behind 50 ohm does not change when the load *setting* does, only the displayed volts do, so a value
set for 50 ohm reads twice as large once the load is INF.

Limits of the simulation: bursts, modulations, sweeps and lists of frequencies are set and read back
but not played. While one is switched on the terminals rest at the offset, so that nothing mistakes
an endless wave for what the instrument would give. Arbitrary
waveforms are stored; the World gets the function ``ARB``, not its samples.

ScpiCommand set: Keysight 33500 series Operating and Service Guide as two public clients use it
(PyMeasure's and QCoDeS's drivers). Behaviour not confirmed on a real unit is marked UNCONFIRMED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from drivers.simulated.ports import Excitation, GeneratorPort, LogPort
from drivers.simulated.transports.scpi import (
    Boolean,
    Call,
    Choice,
    Numeric,
    Parameter,
    Rest,
    ScpiCommand,
    ScpiError,
    ScpiInstrument,
    ScpiQuantity,
    Text,
)

IDENTITY = ("Agilent Technologies", "33512B", "SIMULATED", "4.00-1.00-4.00-00-00")
CHANNELS = (1, 2)
OUTPUT_RESISTANCE_ohm = 50.0
INFINITE = 9.9e37
"""SCPI's notation of infinity."""

# UNCONFIRMED figures of the data sheet, as open-circuit volts (twice those into 50 ohm).
SMALLEST_AMPLITUDE_Vpp = 2e-3
LARGEST_PEAK_V = 10.0
LOWEST_FREQUENCY_Hz = 1e-6
HIGHEST_FREQUENCY_Hz = {
    "SIN": 20e6, "SQU": 20e6, "TRI": 200e3, "RAMP": 200e3, "PULS": 20e6,
    "PRBS": 20e6, "NOIS": 20e6, "ARB": 20e6, "DC": 20e6,
}  # fmt: skip
MODULATIONS = ("AM", "FM", "PM", "FSKey", "BPSK", "PWM", "SUM")
_FREQUENCY_MODES = Choice("CW", "LIST", "SWEep", "FIXed")
_FUNCTIONS = Choice("SINusoid", "SQUare", "TRIangle", "RAMP", "PULSe", "PRBS", "NOISe", "ARB", "DC")
PEAK_TO_PEAK_PER_RMS = {
    "SIN": 2 * math.sqrt(2), "SQU": 2.0, "PULS": 2.0, "PRBS": 2.0,
    "TRI": 2 * math.sqrt(3), "RAMP": 2 * math.sqrt(3),
    "NOIS": 6.6,  # UNCONFIRMED
    "ARB": 2 * math.sqrt(2),  # UNCONFIRMED: depends on the waveform
}  # fmt: skip


@dataclass(frozen=True)
class ChannelState:
    """The settings that determine a channel's output; voltages into an open circuit. Defaults are
    ``*RST``'s."""

    on: bool = False
    function: str = "SIN"
    frequency_Hz: float = 1e3
    amplitude_Vpp: float = 0.2
    offset_V: float = 0.0
    phase_deg: float = 0.0
    inverted: bool = False
    burst: bool = False
    modulation: str = ""
    """Name of the modulation that is switched on; empty for none. There is one at a time."""
    frequency_mode: str = "CW"
    load_ohm: float = 50.0
    limited: bool = False
    limit_high_V: float = LARGEST_PEAK_V
    limit_low_V: float = -LARGEST_PEAK_V

    @property
    def swing(self) -> float:
        """Largest deviation of the wave from its offset, in open-circuit volts."""
        return 0.0 if self.function == "DC" else self.amplitude_Vpp / 2

    @property
    def rails(self) -> tuple[float, float]:
        """Lowest and highest open-circuit volts the wave may reach."""
        if not self.limited:
            return -LARGEST_PEAK_V, LARGEST_PEAK_V
        return self.limit_low_V, self.limit_high_V

    @property
    def shown(self) -> float:
        """Displayed volts per open-circuit volt at the load setting."""
        if self.load_ohm >= INFINITE:
            return 1.0
        return self.load_ohm / (self.load_ohm + OUTPUT_RESISTANCE_ohm)

    def excitation(self) -> Excitation:
        """Return the excitation at the terminals."""
        shaped = self.burst or self.modulation or self.frequency_mode not in ("CW", "FIX")
        resting = shaped or self.function == "DC"
        return Excitation(
            on=self.on,
            function=self.function,
            frequency_Hz=self.frequency_Hz,
            amplitude_V=0.0 if resting else self.amplitude_Vpp / 2,
            offset_V=self.offset_V,
            phase_rad=math.radians(self.phase_deg) + (math.pi if self.inverted else 0.0),
        )


@dataclass(frozen=True)
class SettingBounds:
    """Bounds of a numeric setting, in displayed units."""

    low: float
    high: float
    default: float


@dataclass(frozen=True)
class StoredNumber:
    """A number that is kept and read back, and shapes nothing in the simulation."""

    pattern: str
    bounds: SettingBounds
    units: tuple[str, ...] = ()
    keywords: tuple[str, ...] = ("MIN", "MAX", "DEF")


@dataclass(frozen=True)
class StoredWord:
    """A word or flag that is kept and read back."""

    pattern: str
    kind: Choice | Boolean
    default: str | bool


_SECONDS = ("S",)
STORED_NUMBERS = (
    StoredNumber("[SOURce#:]FUNCtion:SQUare:DCYCle", SettingBounds(0.01, 99.99, 50), ("PCT",)),
    StoredNumber("[SOURce#:]FUNCtion:RAMP:SYMMetry", SettingBounds(0, 100, 100), ("PCT",)),
    StoredNumber("[SOURce#:]FUNCtion:PULSe:WIDTh", SettingBounds(16e-9, 1e6, 1e-4), _SECONDS),
    StoredNumber("[SOURce#:]FUNCtion:PULSe:DCYCle", SettingBounds(0.01, 99.99, 10), ("PCT",)),
    StoredNumber(
        "[SOURce#:]FUNCtion:PULSe:TRANsition[:BOTH|:LEADing]",
        SettingBounds(8.4e-9, 1e-6, 1e-8),
        _SECONDS,
    ),
    StoredNumber("[SOURce#:]FUNCtion:ARBitrary:SRATe", SettingBounds(1e-6, 250e6, 40e3)),
    StoredNumber(
        "[SOURce#:]BURSt:NCYCles", SettingBounds(1, 1e8, 1), (), ("MIN", "MAX", "DEF", "INF")
    ),
    StoredNumber("[SOURce#:]BURSt:INTernal:PERiod", SettingBounds(1e-6, 8000, 0.01), _SECONDS),
    StoredNumber("[SOURce#:]BURSt:PHASe", SettingBounds(-360, 360, 0), ("DEG",)),
    StoredNumber("TRIGger#:COUNt", SettingBounds(1, 1e6, 1)),
    StoredNumber("TRIGger#:DELay", SettingBounds(0, 1000, 0), _SECONDS),
    StoredNumber("TRIGger#:TIMer", SettingBounds(1e-6, 8000, 1), _SECONDS),
)
STORED_WORDS = (
    StoredWord("[SOURce#:]FUNCtion:PULSe:HOLD", Choice("WIDTh", "DCYCle"), "WIDT"),
    StoredWord("[SOURce#:]FUNCtion:ARBitrary:FILTer", Choice("NORMal", "STEP", "OFF"), "STEP"),
    StoredWord("[SOURce#:]FUNCtion:ARBitrary:ADVance", Choice("TRIGger", "SRATe"), "SRAT"),
    StoredWord("[SOURce#:]BURSt:MODE", Choice("TRIGgered", "GATed"), "TRIG"),
    StoredWord("[SOURce#:]BURSt:GATE:POLarity", Choice("NORMal", "INVerted"), "NORM"),
    StoredWord("TRIGger#:SOURce", Choice("IMMediate", "EXTernal", "TIMer", "BUS"), "IMM"),
    StoredWord("TRIGger#:SLOPe", Choice("POSitive", "NEGative"), "POS"),
    StoredWord("OUTPut#:SYNC[:STATe]", Boolean(), True),
    StoredWord("OUTPut#:SYNC:SOURce", Choice("CH1", "CH2"), "CH1"),
    StoredWord("OUTPut#:SYNC:MODE", Choice("NORMal", "CARRier", "MARKer"), "NORM"),
    StoredWord("OUTPut#:TRIGger[:STATe]", Boolean(), False),
    StoredWord("OUTPut#:TRIGger:SOURce", Choice("CH1", "CH2"), "CH1"),
    StoredWord("OUTPut#:TRIGger:SLOPe", Choice("POSitive", "NEGative"), "POS"),
    StoredWord("FORMat:BORDer", Choice("NORMal", "SWAPped"), "NORM"),
)
_TRIGGER_SOURCE = "TRIGger#:SOURce"
_BYTE_ORDER = "FORMat:BORDer"
_NO_WAVEFORM = ""


class Keysight33500B(ScpiInstrument):
    """The generator's SCPI core over a port into the World; ``name`` is its name in the log."""

    def __init__(self, port: GeneratorPort, log: LogPort, name: str = "generator"):
        self._port = port
        self._log = log
        self._name = name
        self._states = {channel: ChannelState() for channel in CHANNELS}
        self._units = dict.fromkeys(CHANNELS, "VPP")
        self._stored: dict[tuple[str, int], float | str | bool] = {}
        self._waveforms: dict[int, dict[str, npt.NDArray[np.float64]]] = {}
        self._selected = dict.fromkeys(CHANNELS, _NO_WAVEFORM)
        self._forget_settings()
        super().__init__(IDENTITY, self._commands())

    def reset(self, by: str) -> None:
        """Reset as ``*RST`` does: outputs off, 1 kHz sine of 100 mVpp into 50 ohm on both
        channels."""
        for channel in CHANNELS:
            self._become(channel, ChannelState(), by)
        self._forget_settings()

    def trigger(self, by: str) -> None:
        """Handle a bus trigger, which is ignored with an error unless a burst waits for one."""
        waiting = any(
            self._states[channel].burst and self._stored[_TRIGGER_SOURCE, channel] == "BUS"
            for channel in CHANNELS
        )
        if not waiting:
            super().trigger(by)

    def state(self, channel: int) -> ChannelState:
        """Return the present settings of a channel, for tests and inspection."""
        return self._states[channel]

    # --- state -------------------------------------------------------------------------------

    def _forget_settings(self) -> None:
        for channel in CHANNELS:
            self._units[channel] = "VPP"
            self._waveforms[channel] = {}
            self._selected[channel] = _NO_WAVEFORM
            for number in STORED_NUMBERS:
                self._stored[number.pattern, channel] = number.bounds.default
            for word in STORED_WORDS:
                self._stored[word.pattern, channel] = word.default

    def _become(self, channel: int, new: ChannelState, by: str) -> None:
        old, self._states[channel] = self._states[channel], new
        for field in fields(ChannelState):
            value = getattr(new, field.name)
            if value != getattr(old, field.name):
                self._log.log(self._name, f"ch{channel}.{field.name}", value, by)
        if new.excitation() != old.excitation():
            self._port.excite(channel, new.excitation(), by)

    def _clip(self, value: float, low: float, high: float) -> float:
        """Return the value moved into [low, high]; leaving it there queues -222, rounding does
        not."""
        clipped = min(max(value, low), high)
        if abs(value - clipped) > 1e-9 * abs(clipped):
            side = "upper" if value > clipped else "lower"
            self.report(ScpiError(-222, f"value clipped to {side} limit"))
        return clipped

    # --- the command table -------------------------------------------------------------------

    def _commands(self) -> list[ScpiCommand]:
        return [
            *self._wave_commands(),
            *self._voltage_commands(),
            *self._output_commands(),
            *self._waveform_commands(),
            *(row for number in STORED_NUMBERS for row in self._stored_number(number)),
            *(row for word in STORED_WORDS for row in self._stored_word(word)),
            ScpiCommand("UNIT:ANGLe", lambda _: None, (Choice("DEGree"),)),
            ScpiCommand("UNIT:ANGLe?", lambda _: "DEG"),
            ScpiCommand("SYSTem:BEEPer[:IMMediate]", lambda _: None),
        ]

    def _wave_commands(self) -> list[ScpiCommand]:
        return [
            ScpiCommand("[SOURce#:]FUNCtion", self._set_function, (_FUNCTIONS,)),
            ScpiCommand("[SOURce#:]FUNCtion?", lambda call: self._state_of(call).function),
            *self._number(
                "[SOURce#:]FREQuency[:CW|:FIXed]",
                ("HZ",),
                self._frequency_bounds,
                lambda state: state.frequency_Hz,
                lambda state, value: replace(state, frequency_Hz=value),
            ),
            *self._number(
                "[SOURce#:]FUNCtion:PULSe:PERiod",
                _SECONDS,
                lambda _: SettingBounds(1 / HIGHEST_FREQUENCY_Hz["PULS"], 1e6, 1e-3),
                lambda state: 1 / state.frequency_Hz,
                lambda state, value: replace(state, frequency_Hz=1 / value),
            ),
            *self._number(
                "[SOURce#:]PHASe[:ADJust]",
                ("DEG",),
                lambda _: SettingBounds(-360, 360, 0),
                lambda state: state.phase_deg,
                lambda state, value: replace(state, phase_deg=value),
            ),
            ScpiCommand("[SOURce#:]PHASe:SYNChronize", self._synchronise),
            *self._flag(
                "[SOURce#:]BURSt:STATe",
                lambda state: state.burst,
                lambda state, on: replace(state, burst=on),
            ),
            *(row for name in MODULATIONS for row in self._modulation(name)),
            ScpiCommand("[SOURce#:]FREQuency:MODE", self._set_frequency_mode, (_FREQUENCY_MODES,)),
            ScpiCommand(
                "[SOURce#:]FREQuency:MODE?", lambda call: self._state_of(call).frequency_mode
            ),
        ]

    def _voltage_commands(self) -> list[ScpiCommand]:
        amplitude = "[SOURce#:]VOLTage[:LEVel][:IMMediate][:AMPLitude]"
        units = ("VPP", "VRMS", "DBM", "V")
        return [
            ScpiCommand(amplitude, self._set_amplitude, (Numeric(units),)),
            ScpiCommand(amplitude + "?", self._get_amplitude, (Numeric(),), optional=1),
            ScpiCommand("[SOURce#:]VOLTage:UNIT", self._set_unit, (Choice("VPP", "VRMS", "DBM"),)),
            ScpiCommand("[SOURce#:]VOLTage:UNIT?", lambda call: self._units[_channel(call)]),
            *self._volts("OFFSet", _offset_bounds, _get_offset, _put_offset),
            *self._volts("HIGH", _high_bounds, _get_high, _put_high),
            *self._volts("LOW", _low_bounds, _get_low, _put_low),
            *self._volts(
                "LIMit:HIGH",
                _limit_high_bounds,
                lambda state: state.limit_high_V,
                lambda state, value: replace(state, limit_high_V=value),
            ),
            *self._volts(
                "LIMit:LOW",
                _limit_low_bounds,
                lambda state: state.limit_low_V,
                lambda state, value: replace(state, limit_low_V=value),
            ),
            *self._flag("[SOURce#:]VOLTage:LIMit:STATe", lambda state: state.limited, _put_limited),
        ]

    def _output_commands(self) -> list[ScpiCommand]:
        load = Numeric(("OHM",), ("MIN", "MAX", "DEF", "INF"))
        return [
            *self._flag(
                "OUTPut#[:STATe]",
                lambda state: state.on,
                lambda state, on: replace(state, on=on),
            ),
            ScpiCommand("OUTPut#:LOAD", self._set_load, (load,)),
            ScpiCommand("OUTPut#:LOAD?", lambda call: _number(self._state_of(call).load_ohm)),
            ScpiCommand("OUTPut#:POLarity", self._set_polarity, (Choice("NORMal", "INVerted"),)),
            ScpiCommand(
                "OUTPut#:POLarity?", lambda call: "INV" if self._state_of(call).inverted else "NORM"
            ),
        ]

    def _waveform_commands(self) -> list[ScpiCommand]:
        upload: tuple[Parameter, ...] = (Text(), Rest())
        return [
            ScpiCommand("[SOURce#:]DATA:VOLatile:CLEar", self._clear_waveforms),
            ScpiCommand("[SOURce#:]DATA:VOLatile:CATalog?", self._catalogue),
            ScpiCommand("[SOURce#:]DATA:ARBitrary", self._upload_floats, upload),
            ScpiCommand("[SOURce#:]DATA:ARBitrary:DAC", self._upload_codes, upload),
            ScpiCommand("[SOURce#:]FUNCtion:ARBitrary", self._select_waveform, (Text(),)),
            ScpiCommand(
                "[SOURce#:]FUNCtion:ARBitrary?", lambda call: f'"{self._selected[_channel(call)]}"'
            ),
        ]

    # --- rows of one kind --------------------------------------------------------------------

    def _number(
        self,
        pattern: str,
        units: tuple[str, ...],
        bounds: Callable[[ChannelState], SettingBounds],
        get: Callable[[ChannelState], float],
        put: Callable[[ChannelState, float], ChannelState],
        shown: Callable[[ChannelState], float] = lambda _: 1.0,
    ) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            state = self._state_of(call)
            scale, allowed = shown(state), bounds(state)
            value = _asked(call.arguments[0], allowed, scale)
            value = self._clip(value, allowed.low, allowed.high)
            self._become(_channel(call), put(state, value), call.by)

        def read(call: Call) -> str:
            state = self._state_of(call)
            value = get(state)
            if call.arguments:
                value = _asked(call.arguments[0], bounds(state), shown(state))
            return _number(value * shown(state))

        return [
            ScpiCommand(pattern, write, (Numeric(units),)),
            ScpiCommand(pattern + "?", read, (Numeric(),), optional=1),
        ]

    def _volts(
        self,
        node: str,
        bounds: Callable[[ChannelState], SettingBounds],
        get: Callable[[ChannelState], float],
        put: Callable[[ChannelState, float], ChannelState],
    ) -> list[ScpiCommand]:
        pattern = f"[SOURce#:]VOLTage:{node}"
        return self._number(pattern, ("V",), bounds, get, put, lambda state: state.shown)

    def _flag(
        self,
        pattern: str,
        get: Callable[[ChannelState], bool],
        put: Callable[[ChannelState, bool], ChannelState],
    ) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            state = put(self._state_of(call), call.arguments[0])
            self._become(_channel(call), state, call.by)

        return [
            ScpiCommand(pattern, write, (Boolean(),)),
            ScpiCommand(pattern + "?", lambda call: str(int(get(self._state_of(call))))),
        ]

    def _modulation(self, name: str) -> list[ScpiCommand]:
        def put(state: ChannelState, on: bool) -> ChannelState:
            others = "" if state.modulation == name else state.modulation
            return replace(state, modulation=name if on else others)

        return self._flag(f"[SOURce#:]{name}:STATe", lambda state: state.modulation == name, put)

    def _stored_number(self, row: StoredNumber) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            asked: ScpiQuantity = call.arguments[0]
            value = _asked(asked, row.bounds, 1.0)
            if asked.keyword != "INF":
                value = self._clip(value, row.bounds.low, row.bounds.high)
            self._stored[row.pattern, _channel(call)] = value

        def read(call: Call) -> str:
            value = self._stored[row.pattern, _channel(call)]
            return _number(_asked(call.arguments[0], row.bounds, 1.0) if call.arguments else value)

        return [
            ScpiCommand(row.pattern, write, (Numeric(row.units, row.keywords),)),
            ScpiCommand(row.pattern + "?", read, (Numeric(),), optional=1),
        ]

    def _stored_word(self, row: StoredWord) -> list[ScpiCommand]:
        def write(call: Call) -> None:
            self._stored[row.pattern, _channel(call)] = call.arguments[0]

        def read(call: Call) -> str:
            value = self._stored[row.pattern, _channel(call)]
            return str(int(value)) if isinstance(value, bool) else str(value)

        return [ScpiCommand(row.pattern, write, (row.kind,)), ScpiCommand(row.pattern + "?", read)]

    # --- commands with a meaning of their own ------------------------------------------------

    def _state_of(self, call: Call) -> ChannelState:
        return self._states[_channel(call)]

    def _frequency_bounds(self, state: ChannelState) -> SettingBounds:
        return SettingBounds(LOWEST_FREQUENCY_Hz, HIGHEST_FREQUENCY_Hz[state.function], 1e3)

    def _set_function(self, call: Call) -> None:
        function = call.arguments[0]
        state = replace(self._state_of(call), function=function)
        highest = HIGHEST_FREQUENCY_Hz[function]
        if state.frequency_Hz > highest:
            self.report(ScpiError(-221, "frequency reduced for this function"))
            state = replace(state, frequency_Hz=highest)
        low, high = state.rails
        if not low <= state.offset_V - state.swing <= state.offset_V + state.swing <= high:
            raise ScpiError(-221, "amplitude or offset too large for this function")
        self._become(_channel(call), state, call.by)

    def _set_frequency_mode(self, call: Call) -> None:
        mode = call.arguments[0]
        self._become(_channel(call), replace(self._state_of(call), frequency_mode=mode), call.by)

    def _synchronise(self, call: Call) -> None:
        for channel in CHANNELS:
            self._port.excite(channel, self._states[channel].excitation(), call.by)

    def _set_amplitude(self, call: Call) -> None:
        channel, state = _channel(call), self._state_of(call)
        asked: ScpiQuantity = call.arguments[0]
        allowed = _amplitude_bounds(state)
        if asked.keyword:
            value = _asked(asked, allowed, 1.0)
        else:
            unit = "VPP" if asked.unit == "V" else asked.unit or self._units[channel]
            value = _peak_to_peak(asked.value, unit, state) / state.shown
        value = self._clip(value, allowed.low, allowed.high)
        self._become(channel, replace(state, amplitude_Vpp=value), call.by)

    def _get_amplitude(self, call: Call) -> str:
        state = self._state_of(call)
        value = state.amplitude_Vpp
        if call.arguments:
            value = _asked(call.arguments[0], _amplitude_bounds(state), 1.0)
        return _number(_in_unit(value * state.shown, self._units[_channel(call)], state))

    def _set_unit(self, call: Call) -> None:
        unit, state = call.arguments[0], self._state_of(call)
        if unit == "DBM" and state.load_ohm >= INFINITE:
            raise ScpiError(-221, "dBm needs a finite load")
        self._units[_channel(call)] = unit

    def _set_load(self, call: Call) -> None:
        channel, asked = _channel(call), call.arguments[0]
        value = min(_asked(asked, SettingBounds(1.0, 10e3, 50.0), 1.0), INFINITE)
        if value < INFINITE:
            value = self._clip(value, 1.0, 10e3)
        elif self._units[channel] == "DBM":
            self._units[channel] = "VPP"  # UNCONFIRMED
        self._become(channel, replace(self._state_of(call), load_ohm=value), call.by)

    def _set_polarity(self, call: Call) -> None:
        inverted = call.arguments[0] == "INV"
        self._become(_channel(call), replace(self._state_of(call), inverted=inverted), call.by)

    def _clear_waveforms(self, call: Call) -> None:
        self._waveforms[_channel(call)].clear()
        self._selected[_channel(call)] = _NO_WAVEFORM

    def _catalogue(self, call: Call) -> str:
        return ",".join(f'"{name}"' for name in self._waveforms[_channel(call)]) or '""'

    def _upload_floats(self, call: Call) -> None:
        self._store_waveform(call, np.dtype(np.float32), 1.0)

    def _upload_codes(self, call: Call) -> None:
        self._store_waveform(call, np.dtype(np.int16), 32767.0)

    def _store_waveform(self, call: Call, sample: np.dtype[np.generic], full_scale: float) -> None:
        name, data = call.arguments
        swapped = self._stored[_BYTE_ORDER, 1] == "SWAP"
        points = _samples(data, sample.newbyteorder("<" if swapped else ">")) / full_scale
        if not np.all(np.abs(points) <= 1.0):
            raise ScpiError(-222)
        known = self._waveforms[_channel(call)]
        if name in known:
            raise ScpiError(-221, "waveform already exists")  # UNCONFIRMED number
        known[name] = points

    def _select_waveform(self, call: Call) -> None:
        if call.arguments[0] not in self._waveforms[_channel(call)]:
            raise ScpiError(-224, "waveform does not exist")  # UNCONFIRMED number
        self._selected[_channel(call)] = call.arguments[0]


# --- pure functions over a channel's state ---------------------------------------------------


def _number(value: float | str | bool) -> str:
    if value == INFINITE:
        return "+9.900000000000000E+37"  # 9.9e37 has no exact double: its 16 digits end in 9s
    return f"{float(value):+.15E}"


def _channel(call: Call) -> int:
    channel = call.suffixes[0] if call.suffixes else 1
    if channel not in CHANNELS:
        raise ScpiError(-114)
    return channel


def _asked(quantity: ScpiQuantity, bounds: SettingBounds, shown: float) -> float:
    """Return the value that a parameter requests. Numbers are displayed values; bounds and result
    are stored ones."""
    if not quantity.keyword:
        return quantity.value / shown
    kept = {"MIN": bounds.low, "MAX": bounds.high, "DEF": bounds.default, "INF": INFINITE}
    return kept[quantity.keyword]


def _peak_to_peak(value: float, unit: str, state: ChannelState) -> float:
    """Return the displayed volts peak to peak of an amplitude given in ``unit``."""
    if unit == "VPP":
        return value
    if state.function == "DC":
        raise ScpiError(-221, "DC has no such amplitude")
    if unit == "DBM":
        if state.load_ohm >= INFINITE:
            raise ScpiError(-221, "dBm needs a finite load")
        value = math.sqrt(1e-3 * state.load_ohm * 10 ** (min(value, 100.0) / 10))
    return value * PEAK_TO_PEAK_PER_RMS[state.function]


def _in_unit(peak_to_peak: float, unit: str, state: ChannelState) -> float:
    """Return the inverse of `_peak_to_peak`."""
    if unit == "VPP" or state.function == "DC":
        return peak_to_peak
    rms = peak_to_peak / PEAK_TO_PEAK_PER_RMS[state.function]
    return rms if unit == "VRMS" else 10 * math.log10(rms**2 / state.load_ohm / 1e-3)


def _amplitude_bounds(state: ChannelState) -> SettingBounds:
    low, high = state.rails
    if state.function == "DC":
        low, high = -LARGEST_PEAK_V + state.offset_V, LARGEST_PEAK_V + state.offset_V
    room = 2 * min(high - state.offset_V, state.offset_V - low)
    return SettingBounds(SMALLEST_AMPLITUDE_Vpp, max(room, SMALLEST_AMPLITUDE_Vpp), 0.2)


def _offset_bounds(state: ChannelState) -> SettingBounds:
    low, high = state.rails
    return SettingBounds(low + state.swing, high - state.swing, 0.0)


def _high_bounds(state: ChannelState) -> SettingBounds:
    return SettingBounds(_get_low(state) + SMALLEST_AMPLITUDE_Vpp, state.rails[1], 0.1)


def _low_bounds(state: ChannelState) -> SettingBounds:
    return SettingBounds(state.rails[0], _get_high(state) - SMALLEST_AMPLITUDE_Vpp, -0.1)


def _limit_high_bounds(state: ChannelState) -> SettingBounds:
    """Return the bounds: a limit that is on cannot cut the present wave (UNCONFIRMED)."""
    wave = state.offset_V + state.swing if state.limited else state.limit_low_V
    return SettingBounds(wave, LARGEST_PEAK_V, LARGEST_PEAK_V)


def _limit_low_bounds(state: ChannelState) -> SettingBounds:
    wave = state.offset_V - state.swing if state.limited else state.limit_high_V
    return SettingBounds(-LARGEST_PEAK_V, wave, -LARGEST_PEAK_V)


def _get_offset(state: ChannelState) -> float:
    return state.offset_V


def _put_offset(state: ChannelState, value: float) -> ChannelState:
    return replace(state, offset_V=value)


def _get_high(state: ChannelState) -> float:
    return state.offset_V + state.amplitude_Vpp / 2


def _get_low(state: ChannelState) -> float:
    return state.offset_V - state.amplitude_Vpp / 2


def _put_high(state: ChannelState, value: float) -> ChannelState:
    low = _get_low(state)
    return replace(state, amplitude_Vpp=value - low, offset_V=(value + low) / 2)


def _put_low(state: ChannelState, value: float) -> ChannelState:
    high = _get_high(state)
    return replace(state, amplitude_Vpp=high - value, offset_V=(high + value) / 2)


def _put_limited(state: ChannelState, on: bool) -> ChannelState:
    """Limits cannot be switched on around a wave that exceeds them (UNCONFIRMED)."""
    high, low = state.offset_V + state.swing, state.offset_V - state.swing
    if on and not state.limit_low_V <= low <= high <= state.limit_high_V:
        raise ScpiError(-221, "present wave exceeds the voltage limits")
    return replace(state, limited=on)


def _samples(data: list[bytes], sample: np.dtype[np.generic]) -> npt.NDArray[np.float64]:
    """Return the points of an upload: one binary block, or a list of numbers."""
    first = data[0].lstrip()
    try:
        if first[:1] == b"#":
            start = 2 + int(first[1:2])
            length = int(first[2:start])
            raw = first[start : start + length]
            if len(raw) < length:
                raise ScpiError(-102, "block is too short")
            points = np.frombuffer(raw, sample).astype(np.float64)
        else:
            points = np.array([float(point) for point in data])
    except ValueError:
        raise ScpiError(-104) from None
    if len(points) < 8:
        raise ScpiError(-109, "a waveform has at least 8 points")
    return points
