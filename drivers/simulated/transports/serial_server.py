"""A pseudo-terminal that puts a simulated instrument on a serial port.

It may move bytes between a client and a core, let `WireFaults` disturb them, and count them. It may
not know an instrument, and never waits for one: the core answers at once. Everything runs in the
event loop that called ``start``.

A kernel buffer of a pseudo-terminal holds about 20 kB; what it does not take is queued here and
follows as the client reads. A client that does not read loses measurements, as on a real line:
beyond `LONGEST_BACKLOG` bytes of queue, what an instrument sends without being asked is dropped,
whole batches at a time, and counted in ``bytes_lost``. Answers are never dropped.

``bytes_sent`` is the number of bytes handed to the kernel or in the queue, since the server was
made: all of it reaches a client that reads on. A slaved clock waits for exactly that.
"""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Mapping
from pathlib import Path

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import Delivery, WireFaults
from drivers.simulated.ports import SerialInstrument, TimePort
from drivers.simulated.transports.port_folder import PortFolder

LONGEST_BACKLOG = 64 * 1024
TICK_S = 0.002
"""Interval in s at which a server in real time polls whether its instrument has something to send,
and whether the kernel accepts more of the queue. Half of it takes a twentieth of a processor more
(docs/decisions/0142)."""
READ_BYTES = 65536
GONE_US = 300_000
"""Bench time in us for which a port that is reset does not exist."""


class PtyServer:
    """One instrument on a pseudo-terminal whose path stays the same over disconnections.

    `faults` disturb replies, request by request, by device where several are on the line;
    `stream_faults` what the instrument says of its
    own accord, one `pump` that has something counting as one request named ``STREAM``. A fault of
    kind ``close`` unplugs the port: clients see it vanish, and the path leads to a new one. After
    one of kind ``reset`` the port is gone for `GONE_US` of bench time, as while an adapter starts
    again; behind one of kind ``half-open`` the line is cut: nothing passes in either direction.

    In slaved time the owner of the time calls `pump` after every advance. In real time, from
    `start` or from `set_free` on, the server does that by itself.
    """

    def __init__(
        self,
        instrument: SerialInstrument,
        timeline: TimePort,
        slaved: bool = False,
        faults: WireFaults | Mapping[str, WireFaults] | None = None,
        stream_faults: WireFaults | None = None,
        name: str = "serial",
    ):
        self.instrument = instrument
        self.bytes_sent = 0
        """Bytes handed to the kernel or queued, of answers and stream."""
        self.bytes_lost = 0
        """Bytes of the stream dropped because the client did not read."""
        none = FaultPlan()
        by_device = faults if isinstance(faults, Mapping) else {"": faults or WireFaults(none, "")}
        self._links = {device: own.link() for device, own in by_device.items()}
        self._stream_link = (stream_faults or WireFaults(none, "")).link()
        self._timeline = timeline
        self._slaved = slaved
        self._name = name
        self._queue = bytearray()
        self._master = self._slave = -1
        self._folder: PortFolder | None = None
        self._ticking: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._back_us: int | None = None
        """World time in us at which a port that is gone is there again."""
        self._cut = False
        """True behind a half-open line."""

    @property
    def path(self) -> str:
        """Path that a client opens as its serial port."""
        assert self._folder is not None, "the server has been started"
        return str(self._folder.path / self._name)

    @property
    def backlog(self) -> int:
        """Bytes that wait for the kernel to take them."""
        return len(self._queue)

    async def start(self) -> None:
        """Open the port."""
        self._loop = asyncio.get_running_loop()
        self._folder = PortFolder()
        self._plug_in()
        if not self._slaved:
            self.set_free()

    async def close(self) -> None:
        """Close the port; clients see it vanish."""
        if self._ticking is not None:
            self._ticking.cancel()
        if self._master >= 0:
            self._unplug()
        if self._folder is not None:
            self._folder.remove()
            self._folder = None

    def set_free(self) -> None:
        """Follow the timeline by itself from now on; call it from the event loop's thread."""
        assert self._loop is not None, "the server has been started"
        if self._ticking is None:
            self._ticking = self._loop.create_task(self._tick())

    def pump(self) -> None:
        """Send what the instrument has to say up to now."""
        if self._back_us is not None and self._timeline.now_us >= self._back_us:
            self._back_us = None
            self._plug_in()
        data = self.instrument.frames_until(self._timeline.now_us)
        if data:
            self._deliver(self._stream_link.exchange(b"STREAM", data), may_be_lost=True)

    async def _tick(self) -> None:
        while True:
            self.pump()
            await asyncio.sleep(TICK_S)

    # --- the port ----------------------------------------------------------------------------

    def _plug_in(self) -> None:
        """Create a new pseudo-terminal, raw; a descriptor of its own keeps it open without a
        client."""
        assert self._loop is not None
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        link = Path(self.path)
        fresh = link.with_suffix(".new")
        fresh.symlink_to(os.ttyname(self._slave))
        fresh.replace(link)
        self._loop.add_reader(self._master, self._readable)

    def _unplug(self, plug_in: bool = False) -> None:
        """Close the port, so that clients see it vanish; `plug_in` has another ready before they
        do."""
        assert self._loop is not None
        old = self._master, self._slave
        self._loop.remove_reader(self._master)
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        self._queue.clear()
        self._master = self._slave = -1
        if plug_in:
            self._plug_in()
        else:  # else the path would lead to a terminal of another program
            Path(self.path).unlink(missing_ok=True)
        for descriptor in old:
            os.close(descriptor)

    def _readable(self) -> None:
        try:
            data = os.read(self._master, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        self.pump()  # what fell due before the request goes out before its reply
        if self._cut:
            return
        for exchange in self.instrument.exchanges(data, self._name):
            link = self._links[exchange.device]
            delivery = link.exchange(exchange.request, exchange.reply)
            self._cut = link.half_open
            line_s = exchange.delay_s if self._ticking is not None else 0.0
            if line_s + delivery.after_s:
                assert self._loop is not None
                self._loop.call_later(line_s + delivery.after_s, self._deliver, delivery)
            else:
                self._deliver(delivery)
            if delivery.close or self._cut:
                return  # and with the port or the line went what had been sent after it

    def _deliver(self, delivery: Delivery, may_be_lost: bool = False) -> None:
        for reply in delivery.replies:
            self._send(reply.data, may_be_lost)
        if delivery.close:
            if delivery.reset:  # before clients see it vanish: they may move the time on at once
                self._back_us = self._timeline.now_us + GONE_US
            self._unplug(plug_in=not delivery.reset)

    def _send(self, data: bytes, may_be_lost: bool) -> None:
        if self._master < 0 or self._cut:  # a reply that took its time finds the port closed
            return
        if may_be_lost and len(self._queue) + len(data) > LONGEST_BACKLOG:
            self.bytes_lost += len(data)
            return
        self.bytes_sent += len(data)
        self._queue += data
        if self._retry is None:
            self._flush()

    def _flush(self) -> None:
        """Hand the queue to the kernel; what it does not take is tried again in a moment."""
        assert self._loop is not None
        self._retry = None
        while self._queue:
            try:
                written = os.write(self._master, self._queue)
            except (BlockingIOError, InterruptedError):
                self._retry = self._loop.call_later(TICK_S, self._flush)
                return
            del self._queue[:written]
