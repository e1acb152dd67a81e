"""Keysight 33500B series waveform generator as a SignalGenerator, SCPI over LAN or USB.

The instrument has no communication watchdog: its output stays on when the host dies, so the guard
process switches it off. Its voltage limits are the last barrier before the vibrator's amplifier;
they are set at connect and read back. The amplifier's input is high-impedance, so the load setting
comes before any amplitude: the same terminal voltage is stated twice as large with load INF.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from drivers.shared.visa_link import VisaLink
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError
from rig.core.settings import Address, Wiring
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Identity, Limits

ROLES = ("generator",)
"""The roles this driver can play."""

LOWEST_FREQUENCY_HZ = 1e-6
HIGHEST_FREQUENCY_HZ = 20e6  # sine, 33511B/33512B; the 3352xB go to 30 MHz
LOWEST_AMPLITUDE_V = 1e-3  # 2 mVpp into an open circuit [unconfirmed]
HIGHEST_AMPLITUDE_V = 10.0  # 20 Vpp into an open circuit [unconfirmed]
OPEN_CIRCUIT_REPLY = 9.9e37
MODES = ("AM", "FM", "PM", "FSK", "BPSK", "PWM", "SUM", "BURS")
"""Modulations and the burst mode: what would shape a sine, while frequency and amplitude still read
back as they were set."""
READBACK_TOLERANCE = 1e-5  # relative; the 16-bit amplitude and 1 uHz frequency are finer


class Keysight33500BSettings(BaseSettings):
    """Address and output limits of the generator."""

    driver: Literal["keysight-33500b"] = "keysight-33500b"
    resource: Address[str]
    """VISA resource, for example TCPIP::192.168.0.12::5025::SOCKET."""
    timeout_s: Wiring[float] = Field(default=2.0, gt=0, le=60)
    """Longest wait for an answer."""
    channel: Literal[1, 2] = 1
    """Output that drives the vibrator."""
    max_amplitude_V: float = Field(gt=0, le=HIGHEST_AMPLITUDE_V)
    """Largest peak voltage at the vibrator amplifier's input, set in the instrument too."""


Settings = Keysight33500BSettings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""


class Generator33500B:
    """One output of a 33500B series generator."""

    def __init__(self, settings: Keysight33500BSettings, clock: Clock):
        self._settings = settings
        self._link = VisaLink("generator", settings.resource, settings.timeout_s, clock)
        self._source = f"SOUR{settings.channel}"
        self._output = f"OUTP{settings.channel}"
        self._identity: Identity | None = None

    @property
    def identity(self) -> Identity:
        """Identity of the generator that answered when it was connected."""
        assert self._identity is not None, "connect() identifies before anything else"
        return self._identity

    def prepare(self) -> None:
        """Identify, switch off, end what the front panel or another program has left switched on
        (bursts, modulation, a sweep or list of frequencies), set load and voltage limits, and read
        all of it back.

        Raises InstrumentError for another model, and for a setting that reads back differently.
        """
        self._identity = self._link.identify()
        if not self._identity.model.startswith("335"):
            raise InstrumentError(
                "generator",
                "*IDN?",
                f"{self._settings.resource} is a {self._identity.vendor} {self._identity.model}",
                "a 33500B series generator is expected; correct [generator] in the bench file",
            )
        self._link.command("*CLS")
        self.output(False)
        for mode in MODES:
            self._set(f"{self._source}:{mode}:STAT", "0", 0)
        self._set_one_frequency()
        highest = self._settings.max_amplitude_V
        self._set(f"{self._output}:LOAD", "INF", OPEN_CIRCUIT_REPLY)
        self._set(f"{self._source}:VOLT:LIM:STAT", "0", 0)
        self._link.command(f"{self._source}:FUNC SIN", f"{self._source}:VOLT:UNIT VPP")
        self._set(f"{self._source}:VOLT", f"{2 * LOWEST_AMPLITUDE_V:.6G}", 2 * LOWEST_AMPLITUDE_V)
        self._set(f"{self._source}:VOLT:OFFS", "0", 0)
        self._set(f"{self._source}:VOLT:LIM:HIGH", f"{highest:.6G}", highest)
        self._set(f"{self._source}:VOLT:LIM:LOW", f"{-highest:.6G}", -highest)
        self._set(f"{self._source}:VOLT:LIM:STAT", "1", 1)

    def limits(self) -> Mapping[str, Limits]:
        """Return the frequency and peak amplitude that instrument and bench file allow."""
        limited_by = f"generator {self.identity.model}"
        return {
            "frequency": Limits(LOWEST_FREQUENCY_HZ, HIGHEST_FREQUENCY_HZ, "Hz", limited_by),
            "amplitude": Limits(
                LOWEST_AMPLITUDE_V, self._settings.max_amplitude_V, "V", limited_by
            ),
        }

    def sine(self, frequency_Hz: float, amplitude_V: float) -> None:
        """Set a sine of this frequency and peak amplitude, and read both back."""
        source = self._source
        vpp = 2 * amplitude_V
        frequency, amplitude = self._link.command(
            f"{source}:FREQ {frequency_Hz:.12G}",
            f"{source}:VOLT {vpp:.9G}",
            then=(f"{source}:FREQ?", f"{source}:VOLT?"),
        )
        self._verify(f"{source}:FREQ", frequency, frequency_Hz)
        self._verify(f"{source}:VOLT", amplitude, vpp)

    def output(self, on: bool) -> None:
        """Switch the output and verify its state by query."""
        (state,) = self._link.command(f"{self._output} {on:d}", then=(f"{self._output}?",))
        self._verify(self._output, state, float(on))

    def output_is_on(self) -> bool:
        """Return the output's state as the instrument reports it.

        Raises InstrumentError if the answer is neither 0 nor 1; the link is then closed.
        """
        reply = self._link.query(f"{self._output}?")
        if reply not in ("0", "1"):
            self._link.close()
            raise InstrumentError(
                "generator",
                f"{self._output}?",
                f"the answer {reply!r} is neither 0 nor 1",
                f"check the cable and that nothing else talks to {self._settings.resource}",
            )
        return reply == "1"

    def make_safe(self) -> None:
        """Switch the output off and verify its state, whatever the error queue holds."""
        reply = self._link.query(f"{self._output} 0;:{self._output}?")
        self._verify(self._output, reply, 0)

    def close(self) -> None:
        """Close the connection; the output stays as it is."""
        self._link.close()

    def _set(self, header: str, value: str, expected: float) -> None:
        (reply,) = self._link.command(f"{header} {value}", then=(f"{header}?",))
        self._verify(header, reply, expected)

    def _set_one_frequency(self) -> None:
        header = f"{self._source}:FREQ:MODE"
        (reply,) = self._link.command(f"{header} CW", then=(f"{header}?",))
        if reply != "CW":
            raise InstrumentError(
                "generator",
                header,
                f"set to CW but reads back {reply}",
                "switch off its sweep or list of frequencies at the front panel",
            )

    def _verify(self, header: str, reply: str, wanted: float) -> None:
        got = self._link.number(f"{header}?", reply)
        if not abs(got - wanted) <= READBACK_TOLERANCE * max(abs(wanted), 1e-9):  # NaN too
            raise InstrumentError(
                "generator",
                header,
                f"set to {wanted:g} but reads back {got:g}",
                "something else controls the generator, or the value is outside its range",
            )


def connect(settings: Keysight33500BSettings, clock: Clock) -> Generator33500B:
    """Connect to the generator, leaving its output off and its limits set."""
    generator = Generator33500B(settings, clock)
    try:
        generator.prepare()
    except BaseException:
        generator.close()
        raise
    return generator


def make_safe(settings: Keysight33500BSettings) -> None:
    """Switch the output off over a connection of its own; may be called repeatedly."""
    with contextlib.closing(Generator33500B(settings, WallClock())) as generator:
        generator.make_safe()
