"""Faults on the wire between a simulated instrument and its client, as a fault plan has them.

This module decides what becomes of a reply on its way; it touches neither instrument nor client.
The instrument always receives the request and acts on it, as one does whose answer is lost; only
behind a half-open connection nothing receives it. The form of a reply is known to its protocol
(`WireDialect`).

A new kind is one more function in `_KINDS`, and a line in `faults.plan`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.simulated.faults.plan import (
    ErrorReply,
    FaultPlan,
    FlippedBit,
    LateReply,
    RefusedConnections,
    Rejection,
    ReplyFault,
    WireFault,
)
from drivers.simulated.ports import TaskLogPort, TimePort
from drivers.simulated.task_log import TaskLog


class MomentPort(TimePort, TaskLogPort, Protocol):
    """The World's time and tasks, by which a fault's moment is found."""


class _Standing:
    """A bench on which no time passes and nothing begins."""

    now_us = 0
    tasks = TaskLog()


def _never(reply: bytes, code: object = None) -> bytes | None:
    return None


@dataclass(frozen=True)
class WireDialect:
    """The error replies of a protocol. Each method returns None if the protocol has no such
    reply."""

    error: Callable[[bytes, int], bytes | None] = _never
    """The reply with an error code in it instead of success."""
    rejection: Callable[[bytes, str], bytes | None] = _never
    """The reply as a rejection for a reason in words."""
    checksum: Callable[[bytes], bytes | None] = _never
    """The reply with a wrong check."""


@dataclass(frozen=True)
class WireReply:
    """Bytes for the client, and the tag that their exchange was given."""

    data: bytes
    tag: int = 0


@dataclass(frozen=True)
class Delivery:
    """The server's actions after a request: send these, in order, then close if `close` is set."""

    replies: tuple[WireReply, ...] = ()
    close: bool = False
    reset: bool = False
    """Close it as a broken connection is."""
    after_s: float = 0.0
    """Wall time in s after which the replies are sent."""


class WireFaults:
    """The faults of one device; counts requests over all its connections.

    `report` is called with the kind of every fault when it disturbs something; `bench` knows the
    time and which tasks have begun.
    """

    def __init__(
        self,
        plan: FaultPlan,
        device: str,
        dialect: WireDialect | None = None,
        report: Callable[[str], None] = lambda kind: None,
        bench: MomentPort | None = None,
    ):
        self.dialect = dialect or WireDialect()
        self.report = report
        self._bench = bench or _Standing()
        refused: tuple[RefusedConnections, ...] = plan.of(RefusedConnections, device)
        self.refused_from = min((fault.at for fault in refused), default=None)
        """The first TCP connection that is refused, from 1."""
        self._faults: tuple[ReplyFault, ...] = plan.of(ReplyFault, device)
        self._matched = [0] * len(self._faults)
        self._first_us: dict[int, int] = {}
        """World time in us at which each fault disturbed its first request, by index."""

    def link(self) -> FaultyLink:
        """Return the faults as one connection meets them."""
        return FaultyLink(self)

    def fault_for(self, request: bytes, reply: bytes | None) -> ReplyFault | None:
        """Count a request; returns the first fault of the plan that disturbs its reply, or None."""
        chosen: ReplyFault | None = None
        now_us = self._bench.now_us
        for index, fault in enumerate(self._faults):
            come = self._bench.tasks.is_past(fault.task, fault.after_s, now_us)
            if come and fault.matches(request) and self._can_carry(fault, reply):
                self._matched[index] += 1
                since_us = now_us - self._first_us.get(index, now_us)
                if fault.disturbs(self._matched[index], since_us):
                    self._first_us.setdefault(index, now_us)
                    chosen = chosen or fault
        if chosen is not None:
            self.report(_name(chosen))
        return chosen

    def _can_carry(self, fault: ReplyFault, reply: bytes | None) -> bool:
        if isinstance(fault, ErrorReply):
            return reply is not None and self.dialect.error(reply, fault.code) is not None
        if isinstance(fault, Rejection):
            return reply is not None and self.dialect.rejection(reply, fault.reason) is not None
        if _name(fault) == "checksum":
            return reply is not None and self.dialect.checksum(reply) is not None
        return True


class FaultyLink:
    """One connection's exchanges, disturbed as planned."""

    def __init__(self, faults: WireFaults):
        self.faults = faults
        self.withheld: list[WireReply] = []
        self.last: tuple[WireReply, ...] = ()
        """The latest two replies that went out as they were, the earlier one first."""
        self._late = 0
        """Number of replies that were late."""
        self.half_open = False
        """True if what is sent on it reaches no instrument any more."""

    def exchange(self, request: bytes, reply: bytes | None, tag: int = 0) -> Delivery:
        """Return the delivery of a request's reply (None if it has none), together with ``tag``."""
        fault = self.faults.fault_for(request, reply)
        whole = None if reply is None else WireReply(reply, tag)
        if isinstance(fault, ErrorReply):
            code = fault.code
            return _spoilt(whole, lambda data: self.faults.dialect.error(data, code))
        if isinstance(fault, Rejection):
            reason = fault.reason
            return _spoilt(whole, lambda data: self.faults.dialect.rejection(data, reason))
        if isinstance(fault, FlippedBit):
            byte, bit = fault.byte, fault.bit
            return _spoilt(whole, lambda data: _flipped(data, byte, bit))
        if isinstance(fault, LateReply):
            self._late += 1
            after_s = fault.by_s + fault.jitter_s * (self._late * _GOLDEN % 1.0)
            return Delivery(() if whole is None else (whole,), after_s=after_s)
        if fault is not None:
            return _KINDS[_name(fault)](self, whole)
        if whole is None:
            return Delivery()
        self.last = (*self.last[-1:], whole)
        late, self.withheld = self.withheld, []
        return Delivery((*late, whole))


def _name(fault: ReplyFault) -> str:
    assert isinstance(fault, WireFault | LateReply | FlippedBit | ErrorReply | Rejection)
    return fault.kind


def _spoilt(reply: WireReply | None, spoil: Callable[[bytes], bytes | None]) -> Delivery:
    """Return the reply, made into something else where there is one."""
    if reply is None:
        return Delivery()
    return Delivery((WireReply(spoil(reply.data) or b"", reply.tag),))


def _flipped(data: bytes, byte: int, bit: int) -> bytes:
    """Return the reply with one bit turned over, where it has that byte."""
    if not -len(data) <= byte < len(data):
        return data
    spoilt = bytearray(data)
    spoilt[byte] ^= 1 << bit
    return bytes(spoilt)


def _silence(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery()


def _garbage(link: FaultyLink, reply: WireReply | None) -> Delivery:
    """Return every byte but the last turned over: same length, same end, no ASCII."""
    return _spoilt(reply, lambda data: data[:-1].translate(_TURNED_OVER) + data[-1:])


def _truncate(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return _spoilt(reply, lambda data: data[: len(data) // 2])


def _double(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery() if reply is None else Delivery((reply, reply))


def _stale(link: FaultyLink, reply: WireReply | None) -> Delivery:
    if reply is not None:
        link.withheld.append(reply)
    return Delivery()


def _before_last(link: FaultyLink, reply: WireReply | None) -> Delivery:
    """Return an earlier reply as it was sent, with its own number; the one that is due is lost."""
    return Delivery(link.last[:-1])


def _checksum(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return _spoilt(reply, link.faults.dialect.checksum)


def _close(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery(close=True)


def _reset(link: FaultyLink, reply: WireReply | None) -> Delivery:
    return Delivery(close=True, reset=True)


def _half_open(link: FaultyLink, reply: WireReply | None) -> Delivery:
    link.half_open = True
    return Delivery()


_GOLDEN = 0.6180339887498949
"""Multiples of it, without their integer part, are spread evenly over 0 to 1 and never repeat."""
_TURNED_OVER = bytes(byte ^ 0xA5 for byte in range(256))
_KINDS: dict[str, Callable[[FaultyLink, WireReply | None], Delivery]] = {
    "silence": _silence,
    "garbage": _garbage,
    "truncate": _truncate,
    "double": _double,
    "stale": _stale,
    "before-last": _before_last,
    "checksum": _checksum,
    "close": _close,
    "reset": _reset,
    "half-open": _half_open,
}
