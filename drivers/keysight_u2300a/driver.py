"""Keysight U2300A and U2500A series DAQ as a DataAcquisition, SCPI over USBTMC.

The U2331A and U2351A-U2356A scan their channels through one converter: channel k of a scan is
sampled k conversion times late, which the record's scaling states. The U254xA sample together.
Burst mode packs a scan as tightly as the converter can; it is always on where there is a scan.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from drivers.keysight_u2300a.models import MODELS, U2300AModel
from drivers.keysight_u2300a.settings import KeysightU2300ASettings
from drivers.shared.visa_link import VisaLink
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError, LimitError
from rig.instruments.roles import Acquisition, Identity, InputChannel, Limits, Record, Scaling

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

ROLES = ("daq",)
"""The roles this driver can play."""

DIGITAL_BITS = {501: 8, 502: 8, 503: 4, 504: 4}
"""Digital channels and their bits."""
INPUTS = tuple(f"{channel}.{bit}" for channel, bits in DIGITAL_BITS.items() for bit in range(bits))
"""Digital inputs: channel and bit. A whole channel is an input or an output."""

LOWEST_RATE_S_S = 3.0
MOST_SAMPLES = 8_000_000  # of one acquisition, all channels together
POLL_S = 0.001
PATIENCE_S = 1.0
"""Time in s that an acquisition may take longer than its nominal duration."""
ASKED_EVERY_S = 0.1
"""Longest time in s for which blocks are read without asking whether the buffer has overrun."""
UNIT_BEHIND = 0.02
"""Far more than the clocks of unit and computer do: a block that is asked for too early ends the
acquisition, and one more question costs a reader who is behind little."""

_READBACK_HINT = "check the cable and that nothing else controls the DAQ; then start again"

Settings = KeysightU2300ASettings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""


class U2300ADaq:
    """A U2300A or U2500A series unit. Any thread may call `stop`; otherwise one at a time."""

    def __init__(self, settings: KeysightU2300ASettings, clock: Clock):
        self._settings = settings
        self._clock = clock
        self._link = VisaLink("daq", settings.resource, settings.timeout_s, clock)
        self._identity: Identity | None = None
        self._configured: tuple[Acquisition, bool] | None = None
        self._scaling: Scaling | None = None
        self._running: Acquisition | None = None
        self._rows_read = 0
        self._seen = (-math.inf, 0)
        """Time at which the unit last said that a block was there, and the rows up to its end."""
        self._block_lost = False
        """A block of the running acquisition was lost in its transfer."""
        self._exchange = threading.RLock()
        self._digital_inputs: tuple[int, ...] = ()
        """Digital channels that have been made inputs."""

    @property
    def identity(self) -> Identity:
        """Identity of the DAQ that answered when it was connected."""
        assert self._identity is not None, "connect() identifies before anything else"
        return self._identity

    @property
    def model(self) -> U2300AModel:
        """The connected model's data."""
        return MODELS[self.identity.model]

    def prepare(self) -> None:
        """Identify, stop whatever runs, and check the wiring against the model.

        Raises InstrumentError for another model and LimitError for a terminal that the model lacks.
        """
        self._identity = self._link.identify()
        if self._identity.model not in MODELS:
            raise InstrumentError(
                "daq",
                "*IDN?",
                f"{self._settings.resource} is a {self._identity.vendor} {self._identity.model}",
                f"one of {', '.join(MODELS)} is expected; correct [daq] in the bench file",
            )
        for name, terminal in self._settings.channels.items():
            if terminal > 100 + self.model.terminals:
                raise LimitError(
                    f"daq {self._identity.model}: channel {name} = {terminal} is beyond the last "
                    f"terminal {100 + self.model.terminals}",
                    "correct [daq.channels] in the bench file",
                )
        self._link.command("*CLS", "STOP")

    def limits(self) -> Mapping[str, Limits]:
        """Return the rate of one channel; `check` knows what the others cost."""
        limited_by = f"daq {self.identity.model}"
        return {"rate": Limits(LOWEST_RATE_S_S, self.model.total_rate_S_s, "S/s", limited_by)}

    def highest_rate_S_s(self, channels: int) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the highest rate per channel, in S/s, at which `channels` channels can be
        sampled."""
        sharing = 1 if self.model.simultaneous else channels
        return float(self.model.total_rate_S_s // sharing)  # units take whole S/s

    def ranges_V(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """Return the bipolar full scales of this model, ascending."""
        return tuple(sorted(self.model.ranges_V))

    def check(self, acquisition: Acquisition) -> None:
        """Raise LimitError where this model cannot do the acquisition."""
        device = f"daq {self.identity.model}"
        names = [channel.name for channel in acquisition.channels]
        if not names or len(set(names)) != len(names):
            raise LimitError(
                f"{device}: cannot sample {', '.join(names) or 'no channel'} in one scan",
                "name each channel once, and one at least",
            )
        for channel in acquisition.channels:
            if channel.name not in self._settings.channels:
                raise LimitError(
                    f"{device}: no terminal is named {channel.name}",
                    "add it to [daq.channels] in the bench file",
                )
            if channel.range_V not in self.model.ranges_V:
                choices = ", ".join(f"{value:g}" for value in sorted(self.model.ranges_V))
                raise LimitError(
                    f"{device}: {channel.name}: a range of {channel.range_V:g} V does not exist",
                    f"choose one of {choices} V",
                )
        count = len(acquisition.channels)
        highest = self.highest_rate_S_s(count)
        if not LOWEST_RATE_S_S <= acquisition.rate_S_s <= highest:
            raise LimitError(
                f"{device}: {acquisition.rate_S_s:g} S/s a channel for {count} channels is outside "
                f"{LOWEST_RATE_S_S:g} to {highest:g} S/s",
                "choose another rate or sample fewer channels",
            )
        if acquisition.samples < 1 or acquisition.samples * count > MOST_SAMPLES:
            raise LimitError(
                f"{device}: {acquisition.samples} samples of each of {count} channels are "
                f"{acquisition.samples * count} in all, which is outside 1 to {MOST_SAMPLES}",
                "choose a shorter record or a lower rate",
            )

    def acquire(self, acquisition: Acquisition) -> Record:
        """Sample once; waits on the bench clock until the unit says that it has finished.

        Raises InstrumentError if that takes too long.
        """
        self._configure(acquisition, continuous=False)
        configured, self._configured = self._configured, None  # until the unit has obeyed
        self._link.command("DIG")
        # One period more than the samples': its clock and ours begin somewhere within one.
        nominal_s = (acquisition.samples + 1) / self._scaling_now().rate_S_s
        self._clock.sleep(nominal_s)
        give_up = self._clock.now() + PATIENCE_S
        while self._ask("WAV:COMP?", ("YES", "NO")) == "NO":
            if self._clock.now() > give_up:
                raise InstrumentError(
                    "daq",
                    "DIG",
                    f"not complete {PATIENCE_S:g} s after the {nominal_s:g} s that it should take",
                    "check the trigger settings of the unit",
                )
            self._clock.sleep(POLL_S)
        counts = self._block(acquisition)
        self._configured = configured
        return Record(counts, self._scaling_now(), first_index=0)

    def start(self, acquisition: Acquisition) -> Scaling:
        """Sample until `stop`, in blocks of `acquisition.samples` rows; returns the scaling."""
        self._configure(acquisition, continuous=True)
        self._configured = None  # what follows a stream begins with a stop
        self._link.command("RUN")
        self._running = acquisition
        self._rows_read = 0
        self._seen = (-math.inf, 0)
        self._block_lost = False
        return self._scaling_now()

    def read(self) -> Record | None:
        """Return the next block of raw counts with the scaling to volts, or None while no block is
        complete. Raises InstrumentError where data were lost.

        A block takes two exchanges, or one where the next is already complete, so that a reader who
        is behind catches up.
        """
        with self._exchange:
            return self._read()

    def _read(self) -> Record | None:
        if self._running is None:
            raise InstrumentError("daq", "WAV:DATA?", "no acquisition is running")
        if self._block_lost:
            raise InstrumentError(
                "daq",
                "WAV:DATA?",
                f"the block after row {self._rows_read} was lost in its transfer",
                "start the acquisition again",
            )
        known = self._is_known_complete()
        if not (known or self._says_complete()):
            return None
        first = self._rows_read
        self._block_lost = True  # the unit hands a block out once, whether it arrives or not
        try:
            counts = self._block(self._running)
        except InstrumentError as error:
            # After an overrun, which it has not been asked about, the unit has nothing to send.
            if known and not isinstance(error, InstrumentTimeoutError) and self._has_overrun():
                raise self._overrun() from error
            raise
        self._block_lost = False
        self._rows_read += len(counts)
        return Record(counts, self._scaling_now(), first)

    def _is_known_complete(self) -> bool:
        """Return whether the next block is complete by what the unit has said shortly before and
        the time that has passed since."""
        assert self._running is not None
        at_s, rows = self._seen
        since_s = self._clock.now() - at_s
        sampled = rows + since_s * self._scaling_now().rate_S_s * (1 - UNIT_BEHIND)
        return since_s < ASKED_EVERY_S and sampled >= self._rows_read + self._running.samples

    def _says_complete(self) -> bool:
        """Ask the unit whether the next block is complete. Raises InstrumentError where its buffer
        has overrun."""
        assert self._running is not None
        state = self._status()
        if state == "OVER":
            raise self._overrun()
        if state == "DATA":
            self._seen = (self._clock.now(), self._rows_read + self._running.samples)
        return state == "DATA"

    def _has_overrun(self) -> bool:
        """Ask the unit whether its buffer has overrun; False if it does not answer that."""
        with contextlib.suppress(InstrumentError):
            return self._status() == "OVER"
        return False

    def _status(self) -> str:
        return self._ask("WAV:STAT?", ("EPTY", "FRAG", "DATA", "OVER"))

    def _overrun(self) -> InstrumentError:
        return InstrumentError(
            "daq",
            "WAV:STAT?",
            f"its buffer overran after row {self._rows_read}; samples are lost",
            "read faster, lower the rate, or sample fewer channels",
        )

    def stop(self) -> None:
        """End a running acquisition, once a `read` in another thread is over."""
        with self._exchange:
            self._running = None
            self._link.command("STOP")

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the levels of digital lines, such as "501.0", bit 0 of channel 501: True for high.

        Their channels are made inputs first, which reads back. That the unit answers while an
        acquisition runs is unconfirmed. Raises InstrumentError if a channel does not read back as
        an input, or its answer is not a number.
        """
        lines = {name: tuple(map(int, name.split("."))) for name in names}
        channels = tuple(dict.fromkeys(channel for channel, _ in lines.values()))
        where = f"(@{','.join(map(str, channels))})"
        if channels != self._digital_inputs:
            (ways,) = self._link.command(
                f"CONF:DIG:DIR INP,{where}", then=(f"CONF:DIG:DIR? {where}",)
            )
            if ways.split(",") != ["INP"] * len(channels):
                raise InstrumentError(
                    "daq",
                    "CONF:DIG:DIR",
                    f"channels {where} set to INP but read back {ways}",
                    _READBACK_HINT,
                )
            self._digital_inputs = channels
        query = f"MEAS:DIG? {where}"
        replies = self._link.query(query).split(",")
        if len(replies) != len(channels) or not all(one.strip().isdigit() for one in replies):
            self._link.close()
            raise InstrumentError(
                "daq",
                query,
                f"the answer {','.join(replies)!r} is not a number for each channel",
                f"check the cable and that nothing else talks to {self._settings.resource}",
            )
        words = dict(zip(channels, map(int, replies), strict=True))
        return {name: bool(words[channel] >> bit & 1) for name, (channel, bit) in lines.items()}

    def make_safe(self) -> None:
        """End the acquisition, whatever the error queue holds; a DAQ drives nothing."""
        with self._exchange:
            self._running = None
            self._ask("STOP;*OPC?", ("1",))

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def _configure(self, acquisition: Acquisition, continuous: bool) -> None:
        if self._configured == (acquisition, continuous):
            return
        self.check(acquisition)
        self._configured = self._running = None
        terminals = ",".join(str(self._terminal(c)) for c in self._scan_order(acquisition))
        if self.model.simultaneous:
            scan = [f"ROUT:ENAB ON,(@{terminals})"]  # first: a scan is never empty
            if others := self._other_terminals(acquisition):
                scan.append(f"ROUT:ENAB OFF,(@{','.join(map(str, others))})")
        else:
            scan = [f"ROUT:SCAN (@{terminals})", "ACQ:BURS ON"]
        ranges = []
        for channel in acquisition.channels:
            where = f"(@{self._terminal(channel)})"
            ranges += [f"ROUT:CHAN:RANG {channel.range_V:g},{where}", f"ROUT:CHAN:POL BIP,{where}"]
        points = "WAV:POIN" if continuous else "ACQ:POIN"
        rate, samples = self._link.command(
            "STOP",  # settings are refused while something runs, left over by a failure perhaps
            f"ACQ:SRAT {LOWEST_RATE_S_S:g}",  # a longer scan list is refused at a high rate
            *scan,
            *ranges,
            f"ACQ:SRAT {acquisition.rate_S_s:.9G}",
            f"{points} {acquisition.samples}",
            then=("ACQ:SRAT?", f"{points}?"),
        )
        if self._link.number(f"{points}?", samples) != acquisition.samples:
            raise InstrumentError(
                "daq",
                points,
                f"set to {acquisition.samples} but reads back {samples}",
                _READBACK_HINT,
            )
        rate_S_s = self._link.number("ACQ:SRAT?", rate)
        if not 0 < rate_S_s < math.inf:
            raise InstrumentError(
                "daq",
                "ACQ:SRAT",
                f"set to {acquisition.rate_S_s:g} but reads back {rate}",
                _READBACK_HINT,
            )
        self._scaling = self._scaling_at(acquisition, rate_S_s)
        self._configured = (acquisition, continuous)

    def _terminal(self, channel: InputChannel) -> int:
        return self._settings.channels[channel.name]

    def _other_terminals(self, acquisition: Acquisition) -> list[int]:
        wanted = {self._terminal(channel) for channel in acquisition.channels}
        return [t for t in range(101, 101 + self.model.terminals) if t not in wanted]

    def _scan_order(self, acquisition: Acquisition) -> tuple[InputChannel, ...]:
        """Return the channels in the order in which the unit sends their samples.

        A scan list keeps its order; simultaneous channels come in the terminals' order.
        """
        if self.model.simultaneous:
            return tuple(sorted(acquisition.channels, key=self._terminal))
        return acquisition.channels

    def _scaling_at(self, acquisition: Acquisition, rate_S_s: float) -> Scaling:
        """Return the scaling from codes to volts, and the delay of each channel by the multiplexer,
        from the data sheet."""
        model, channels = self.model, acquisition.channels
        spare = 16 - model.bits
        # U2331A: V = code * span / (2^12 - 1); 16-bit models: V = code * range / 32768.
        per_range = 2 / (2**model.bits - 1) if spare else 1 / 2 ** (model.bits - 1)
        skew_s = 0.0 if model.simultaneous else 1 / model.total_rate_S_s
        return Scaling(
            channels=tuple(c.name for c in channels),
            rate_S_s=rate_S_s,
            volts_per_count=tuple(c.range_V * per_range for c in channels),
            offset_V=tuple(0.0 for _ in channels),
            range_V=tuple(c.range_V for c in channels),
            delay_s=tuple(k * skew_s for k in range(len(channels))),
            lowest_count=-(2 ** (model.bits - 1)),
            highest_count=2 ** (model.bits - 1) - 1,
        )

    def _block(self, acquisition: Acquisition) -> npt.NDArray[np.int16]:
        import numpy as np

        width = len(acquisition.channels)
        raw = self._link.query_block("WAV:DATA?", 2 * width * acquisition.samples)
        words = np.frombuffer(raw, dtype="<i2").reshape(-1, width)
        sent = self._scan_order(acquisition)
        if sent != acquisition.channels:  # who records the counts goes by the order asked for
            words = words[:, [sent.index(channel) for channel in acquisition.channels]]
        return words >> (16 - self.model.bits)

    def _ask(self, query: str, known: tuple[str, ...]) -> str:
        reply = self._link.query(query)
        if reply not in known:
            self._link.close()
            raise InstrumentError(
                "daq",
                query,
                f"the answer {reply!r} is not one of {', '.join(known)}",
                f"check the cable and that nothing else talks to {self._settings.resource}",
            )
        return reply

    def _scaling_now(self) -> Scaling:
        assert self._scaling is not None, "an acquisition is configured before it is used"
        return self._scaling


def connect(settings: KeysightU2300ASettings, clock: Clock) -> U2300ADaq:
    """Connect to the DAQ, with nothing running."""
    daq = U2300ADaq(settings, clock)
    try:
        daq.prepare()
    except BaseException:
        daq.close()
        raise
    return daq


def make_safe(settings: KeysightU2300ASettings) -> None:
    """End any acquisition over a connection of its own; may be called repeatedly."""
    with contextlib.closing(U2300ADaq(settings, WallClock())) as daq:
        daq.make_safe()
